# SPDX-License-Identifier: Apache-2.0
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fakes import LineAgent, LineEnv, LineTask, agent_for
from locations import PYTHON_TESTS

import wiw
import wiw.tasks.navigation
from wiw.errors import ArgumentError, ContractError, FileError, InfrastructureError, RegistryError, StoreError
from wiw.experiments.fidelity import FidelityObserver
from wiw.experiments.gating import Gated
from wiw.experiments.placebos import ShuffledPlacebo
from wiw.loop.attempts import Attempted
from wiw.runs.recipes import AgentRecipe, TaskInMemory, TaskRecipe, absolute, arm_recipes
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import evaluate, resume_run, run_arms
from wiw.studies.run_log import load_run

TIMINGS = ("seconds",)


def facts(log):
    """Everything a run found out, without how long it took."""
    keep = [{k: v for k, v in row.items() if k not in TIMINGS} for row in [*log.episodes, *log.decisions]]
    pictures = [log.store.images(d["arm"], d["episode"], d["decision"]) for d in log.decisions]
    return keep, pictures


def run(out, workers=1, live=4, agent=None, task=None, episodes=8, **options):
    arms = {"none": LineAgent(0.5), "warp": agent or LineAgent(0.8)}
    return run_arms(task or LineTask(), arms, episodes, out=out, workers=workers, live=live, progress=False, **options)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    return run(tmp_path_factory.mktemp("reference") / "run")


def test_every_arm_ends_every_episode(reference):
    assert reference.complete and len(reference.episodes) == 16
    lines = reference.numbers()
    assert lines["warp"].estimates["success"].value > lines["none"].estimates["success"].value


@pytest.mark.parametrize(("workers", "live"), [(1, 1), (1, 8), (2, 2), (3, 1)])
def test_results_do_not_depend_on_workers_or_batches(reference, tmp_path, workers, live):
    assert facts(run(tmp_path / "run", workers, live)) == facts(reference)


def test_results_depend_on_the_seed(reference, tmp_path):
    assert facts(run(tmp_path / "run", seed=1)) != facts(reference)


def test_pictures_are_kept_for_chosen_episodes(reference, tmp_path):
    assert reference.store.info["pictures"] == [1, 7]  # a model wins the first, the other is spread evenly
    assert reference.store.images("warp", 7, 0) and not reference.store.images("warp", 3, 0)
    assert not run(tmp_path / "run", episodes=2, keep_images=0).store.images("warp", 0, 0)


def find_pictured(log):
    return sorted({row["episode"] for row in log.store._rows("SELECT DISTINCT episode FROM image")})


def test_a_run_that_a_rule_may_stop_keeps_the_pictures_that_it_names(tmp_path):
    arms = {"none": LineAgent(0.1), "warp": LineAgent(0.9)}

    def keep(name, until, pictured):
        options = {"until": until, "look_every": 10, "keep_images": pictured, "progress": False}
        with closing(run_arms(LineTask(), arms, 20, out=tmp_path / name, **options)) as log:
            assert find_pictured(log) == sorted(log.store.info["pictures"])
            return sorted(log.store.info["pictures"])

    for name, until in (("whole", "width<1"), ("stopped", "width<100")):
        kept = keep(name, until, 3)
        assert len(kept) == 3 and max(kept) < 10, "of the episodes before the first look"
    assert keep("all", "width<1", "all") == list(range(20))
    assert keep("all-stopped", "width<100", "all") == list(range(10))


def test_pictures_of_other_episodes_are_not_to_be_had_by_resuming(tmp_path):
    run(tmp_path / "run", keep_images=1).close()
    for same in ({}, {"keep_images": 1}):
        run(tmp_path / "run", resume=True, **same).close()
    with pytest.raises(StoreError, match="keep_images: the run has 1, now 8"):
        run(tmp_path / "run", resume=True, keep_images="all")


def test_broken_episodes_fail_for_infrastructure_and_the_rest_goes_on(tmp_path):
    log = run(tmp_path / "run", task=LineTask(broken=("0002",)), workers=2)
    failed = [row for row in log.episodes if row["status"] == "error"]
    assert [row["episode"] for row in failed] == [2, 2]
    assert "no such scene" in failed[0]["error"] and failed[0]["metrics"] == {}
    assert log.numbers()["warp"].done == 7


def test_a_worker_that_dies_once_costs_nothing(reference, tmp_path):
    agent = LineAgent(0.8, kill=(3,), marker=str(tmp_path / "struck"))
    assert facts(run(tmp_path / "run", workers=2, agent=agent)) == facts(reference)
    assert (tmp_path / "struck").exists()


def test_an_episode_that_kills_two_workers_is_recorded_as_an_error(tmp_path):
    log = run(tmp_path / "run", workers=2, agent=LineAgent(0.8, kill=(3,)))
    failed = [row for row in log.episodes if row["status"] == "error"]
    assert [(row["arm"], row["episode"]) for row in failed] == [("warp", 3)]
    assert "SIGKILL" in failed[0]["error"]
    assert log.complete and log.numbers()["warp"].done == 7


@dataclass
class Doomed(LineTask):
    """A task that ends every process it is sent to, as a broken extension module may."""

    def __setstate__(self, state):
        os.kill(os.getpid(), signal.SIGKILL)


def test_workers_that_die_while_they_start_stop_the_run(tmp_path):
    with pytest.raises(InfrastructureError, match=r"could not start.*SIGKILL"):
        run(tmp_path / "run", workers=2, task=Doomed())


class Sloppy(LineAgent):
    """An agent whose world model broke its contract."""

    def decide_batch(self, queries):
        raise ContractError("Sloppy.rollout: expected uint8, got float32")


@pytest.mark.parametrize("workers", [1, 2])
def test_a_broken_contract_stops_the_run(tmp_path, workers):
    with pytest.raises(ContractError, match="got float32"):
        run(tmp_path / "run", workers, agent=Sloppy())
    assert not load_run(tmp_path / "run").complete


class UnscoredEnv(LineEnv):
    def result(self):
        return {name: value for name, value in super().result().items() if name != "success"}


@dataclass
class Unscored(LineTask):
    """A task that forgets to say which episodes succeed."""

    def environment(self, depth=False):
        return UnscoredEnv(self)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_task_without_success_stops_the_run(tmp_path, workers):
    with pytest.raises(
        ContractError, match=r"expected the metric 'success', .* got only actions, .*; return it from the"
    ):
        run(tmp_path / "run", workers, task=Unscored())
    assert not load_run(tmp_path / "run").episodes


def test_a_script_without_a_main_guard_is_told_so(tmp_path):
    script = tmp_path / "script.py"
    head = f"import sys\nsys.path.append({str(PYTHON_TESTS)!r})\nimport wiw\nfrom fakes import LineAgent, LineTask\n"
    call = f"wiw.evaluate(LineTask(), LineAgent(), 2, workers=2, out={str(tmp_path / 'run')!r}, progress=False)\n"
    script.write_text(head + call)
    told = subprocess.run([sys.executable, str(script)], check=False, capture_output=True, text=True)
    assert told.returncode == 1
    assert "call wiw.evaluate under `if __name__ == '__main__':`" in told.stderr.splitlines()[-1]
    script.write_text(head + f"if __name__ == '__main__':\n    {call}")
    assert subprocess.run([sys.executable, str(script)], check=False, capture_output=True).returncode == 0


def test_what_cannot_be_pickled_is_refused_with_advice(tmp_path):
    agent = LineAgent()
    agent.model = lambda: None
    with pytest.raises(InfrastructureError, match=r"path\.py:Class.*workers=1"):
        run(tmp_path / "run", workers=2, agent=agent)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"episodes": "2"}, "evaluate: episodes: expected a whole number or null, got '2'"),
        ({"episodes": 2.5}, "episodes: expected a whole number or null, got 2.5"),
        ({"workers": "2"}, "workers: expected a whole number, got '2'"),
        ({"progress": "no"}, "progress: expected true or false, got 'no'"),
        ({"keep_images": "every"}, "keep_images: expected a whole number or all, got 'every'"),
    ],
)
def test_settings_of_other_types_are_refused_before_anything_is_written(tmp_path, settings, said):
    with pytest.raises(ArgumentError, match=said):
        evaluate(LineTask(), LineAgent(), out=tmp_path / "run", **{"progress": False, **settings})
    assert not (tmp_path / "run").exists()


def test_numbers_of_numpy_are_numbers(tmp_path):
    log = evaluate(LineTask(), LineAgent(), np.int64(2), workers=np.int32(1), out=tmp_path / "run", progress=False)
    assert len(log.episodes) == 2 and load_run(tmp_path / "run").complete


@pytest.mark.parametrize(
    ("misspelt", "meant"), [("episode", "episodes"), ("worker", "workers"), ("keep_image", "keep_images")]
)
def test_a_misspelt_setting_is_told_from_an_option_of_the_task(misspelt, meant):
    for task in ("imagenav", LineTask()):
        with pytest.raises(
            ArgumentError, match=rf"'?{misspelt}'?.*\w[.?] As a setting of the run: Did you mean {meant}.*\?$"
        ):
            evaluate(task, LineAgent(), **{misspelt: 1})
    with pytest.raises(ArgumentError) as error:
        evaluate("imagenav", LineAgent(), decision=1)
    assert "Did you mean decisions" in str(error.value) and "run's settings" not in str(error.value)


def test_arguments_are_checked(tmp_path):
    with pytest.raises(ArgumentError, match="episodes of at least 1, got 0"):
        run(tmp_path / "run", episodes=0)
    for workers in (0, -1):
        with pytest.raises(ArgumentError, match=f"workers of at least 1, got {workers}"):
            resume_run(tmp_path / "run", workers=workers)
    with pytest.raises(ArgumentError, match="different world models"):
        arm_recipes(AgentRecipe("matcher"), ["warp", "warp"])


def test_an_arm_may_have_a_policy_of_its_own():
    made = arm_recipes(AgentRecipe("matcher", horizon=7), ["none", "heuristic+none", "climber+x/a+b.py:Mine"])
    assert made == {
        "none": AgentRecipe("matcher", horizon=7),
        "heuristic": AgentRecipe("heuristic", horizon=7),
        "climber+Mine": AgentRecipe("climber", "x/a+b.py:Mine", horizon=7),
    }
    arms = arm_recipes(wiw.Agent("matcher", "copy", candidates=4), ["copy", "heuristic+copy"])
    ready = agent_for(LineTask(), arms["heuristic+copy"])
    assert type(ready.policy).__name__ == "Heuristic" and ready.config.candidates == 4 and ready.model is not None


def test_an_arm_may_be_a_world_model_in_memory_and_have_a_name_of_its_own():
    class Mine(wiw.WorldModel):
        accepts = wiw.accepts(control="trajectory")

        def rollout(self, observations, controls, seeds):
            raise NotImplementedError

    agent, mine = wiw.Agent("matcher", candidates=4), Mine()
    made = arm_recipes(agent, {"off": None, "this": mine, "that": Mine, "floor": "copy", "h": "heuristic+none"})
    built = {name: agent_for(LineTask(), recipe) for name, recipe in made.items()}
    assert built["this"].model.unwrapped is mine and built["off"].model is None and built["h"].model is None
    assert [type(built[name].model.unwrapped).__name__ for name in ("that", "floor")] == ["Mine", "Copy"]
    assert type(built["h"].policy).__name__ == "Heuristic"
    assert {each.config.candidates for each in built.values()} == {4}
    assert list(arm_recipes(agent, ["none", mine, "copy"])) == ["none", "mine", "copy"]
    with pytest.raises(ArgumentError, match=r"different world models, got \['mine', 'mine'\]"):
        arm_recipes(agent, [mine, Mine])
    in_memory = arm_recipes(AgentRecipe("matcher"), [mine])["mine"]
    assert in_memory.model is mine and in_memory.to_json() is None, "a later process could not make it again"


def test_an_agents_own_arm_is_named_by_the_class_of_its_model_behind_all_wrappers(tmp_path):
    (tmp_path / "mine.py").write_text(MODEL.format(name="Heavy", steps=5))
    name = f"{tmp_path}/mine.py:Heavy"
    assert list(arm_recipes(AgentRecipe("matcher", name), None)) == ["Heavy"]
    assert list(arm_recipes(wiw.Agent("matcher", name), None)) == ["heavy"]
    assert list(arm_recipes(wiw.Agent("matcher", Attempted(wiw.world_model("copy"))), None)) == ["copy"]
    assert list(arm_recipes(wiw.Agent("matcher"), None)) == list(arm_recipes(LineAgent(), None)) == ["none"]


def test_an_existing_run_is_continued_only_on_request(reference, tmp_path):
    first = run(tmp_path / "run")
    with pytest.raises(StoreError, match="already holds a run"):
        run(tmp_path / "run")
    assert facts(run(tmp_path / "run", resume=True)) == facts(first) == facts(reference)
    with pytest.raises(
        StoreError, match=r"a different configuration \(arms\.\w+\.drive: the run has [0-9.]+, now 0\.9\)"
    ):
        run(tmp_path / "run", resume=True, agent=LineAgent(0.9))
    with pytest.raises(StoreError, match="resume=True"):
        resume_run(tmp_path / "run")


def test_a_run_gains_arms_on_request_unless_a_rule_may_stop_it(tmp_path):
    arms = {"none": LineAgent(0.5), "warp": LineAgent(0.8)}

    def run_some(*names, **options):
        some = {name: arms[name] for name in names}
        return run_arms(LineTask(), some, 8, out=tmp_path / "run", progress=False, salt="pepper", **options)

    begun = run_some("none").episodes
    with pytest.raises(StoreError, match="a different configuration"):
        run_some("none", "warp", resume=True)
    grown = run_some("none", "warp", resume=True, more_arms=True)
    assert grown.complete and grown.episodes[:8] == begun
    assert facts(grown)[0] == facts(run(tmp_path / "whole", salt="pepper"))[0]
    looked = {"until": "width(none)<1", "more_arms": True, "progress": False}
    run_arms(LineTask(), {"none": arms["none"]}, 8, out=tmp_path / "until", **looked)
    with pytest.raises(StoreError, match="may stop early"):
        run_arms(LineTask(), arms, 8, out=tmp_path / "until", resume=True, **looked)


def test_a_run_whose_creation_was_cut_off_is_begun_again(reference, tmp_path):
    (tmp_path / "run").mkdir()
    sqlite3.connect(store_path(tmp_path / "run")).execute("PRAGMA journal_mode = WAL")
    assert facts(run(tmp_path / "run", resume=True)) == facts(reference)


def test_evaluate_takes_one_agent(tmp_path):
    log = evaluate(LineTask(), LineAgent(1.0), episodes=3, out=tmp_path / "run", progress=False)
    assert log.arms == ["none"] and log.numbers()["none"].estimates["success"].value == 100.0


SCRIPT = """
import sys
import wiw
from fakes import LineAgent, LineTask, agent_for
from wiw.studies.evaluate import run_arms
if __name__ == "__main__":
    out, workers, delay = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    arms = {"none": LineAgent(0.5), "warp": LineAgent(0.8)}
    run_arms(LineTask(delay=delay), arms, 8, out=out, workers=workers, progress=False, resume=True, salt="")
"""


def start(folder, workers, delay, out):
    script = folder / "script.py"
    script.write_text(SCRIPT)
    paths = os.pathsep.join([str(PYTHON_TESTS), *sys.path])
    return subprocess.Popen(
        [sys.executable, script, out, str(workers), str(delay)], env={**os.environ, "PYTHONPATH": paths}
    )


@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_killed_at_random_moments_ends_as_if_nothing_had_happened(reference, tmp_path, workers):
    out, draw = tmp_path / "run", random.Random(workers)
    for _ in range(4):
        process = start(tmp_path, workers, 0.04, out)
        deadline = time.monotonic() + 20
        while not (out / "run.sqlite").exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(draw.uniform(0, 0.6))
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert start(tmp_path, workers, 0.0, out).wait(60) == 0
    assert facts(load_run(out)) == facts(reference)


def test_recipes_survive_json():
    agent = AgentRecipe("matcher", "warp", horizon=7)
    assert AgentRecipe(**agent.to_json()) == agent and agent.arm == "warp"
    task = TaskRecipe("imagenav", {"scenes": "apartments:val", "seed": 3, "backend": "cpu"})
    assert TaskRecipe(**task.to_json()) == task
    assert TaskInMemory(LineTask()).to_json() is None
    assert agent.with_model("none").arm == "none" and AgentRecipe("m", "/x/y.py:Mine").arm == "Mine"
    assert absolute("a.py:Mine") == f"{Path.cwd() / 'a.py'}:Mine" and absolute("pkg.mod:Mine") == "pkg.mod:Mine"


MODEL = """
from pathlib import Path

import numpy as np
import wiw


class Heavy(wiw.WorldModel):
    accepts = wiw.accepts(control="image", causal=True)

    def __init__(self):
        with Path(__file__).with_suffix(".log").open("a") as log:
            log.write("{name} built\\n")
        self.network, self.steps, self.weights = object(), {steps}, Path("weights.pt")
        self.table, self._secret, self.sizes = np.zeros(3), 1, {{"a": (1, 2)}}

    def rollout(self, observations, controls, seeds):
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
"""


def models(folder, steps=5):
    names = ("first", "second")
    for name in names:
        (folder / f"{name}.py").write_text(MODEL.format(name=name, steps=steps))
    return [f"{folder / name}.py:Heavy" for name in names]


@pytest.mark.parametrize("workers", [1, 2])
def test_models_are_built_once_and_described_by_plain_values(tmp_path, two_rooms, workers):
    first, second = models(tmp_path)
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1})
    agent = AgentRecipe("heuristic", first, reviser="geometric")
    log = run_arms(
        task,
        {"first": agent, "second": agent.with_model(second)},
        1,
        out=tmp_path / "run",
        workers=workers,
        progress=False,
    )
    assert [(tmp_path / f"{n}.log").read_text() for n in ("first", "second")] == ["first built\n", "second built\n"]
    assert log.store.info["built"]["first"]["model"] == {
        "name": "Heavy",
        "steps": 5,
        "weights": "weights.pt",
        "sizes": {"a": [1, 2]},
    }
    assert log.store.config["arms"][0]["agent"]["model"] == first


def test_a_run_is_not_resumed_with_an_agent_that_has_changed(tmp_path, two_rooms, monkeypatch):
    first, _ = models(tmp_path)
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1})
    evaluate(task, AgentRecipe("heuristic", first), 2, out=tmp_path / "run", progress=False)
    with sqlite3.connect(store_path(tmp_path / "run")) as store:
        store.execute("DELETE FROM outcome WHERE episode = 1")
        store.execute("UPDATE run SET info = json_remove(info, '$.sources')")  # as of a run that kept none
    models(tmp_path, steps=6)
    monkeypatch.setattr(sys, "modules", {k: v for k, v in sys.modules.items() if not k.startswith("wiw_user_first")})
    with pytest.raises(StoreError, match="steps"):
        resume_run(tmp_path / "run", progress=False)


def test_a_run_is_resumed_from_another_folder(tmp_path, two_rooms, monkeypatch):
    scene = Path(two_rooms)
    monkeypatch.chdir(scene.parent)
    options = {"scenes": scene.name, "decisions": 1, "preset": "mine.yaml"}
    (scene.parent / "mine.yaml").write_text("base: paper\n")
    evaluate(TaskRecipe("imagenav", options), AgentRecipe("heuristic"), 2, out=tmp_path / "run", progress=False)
    with sqlite3.connect(store_path(tmp_path / "run")) as store:
        store.execute("DELETE FROM outcome WHERE episode = 1")
    monkeypatch.chdir(tmp_path)
    log = resume_run(tmp_path / "run", progress=False)
    assert [row["status"] for row in log.episodes] == ["done", "done"]


def test_a_run_is_resumed_with_the_renderer_it_was_begun_with(tmp_path, two_rooms, monkeypatch):
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1})
    log = evaluate(task, AgentRecipe("heuristic"), 1, out=tmp_path / "run", progress=False)
    begun_with = log.store.config["task"]["backend"]
    assert begun_with in ("cpu", "gpu") and log.store.info["task"]["options"]["backend"] == begun_with
    now = {"auto": {"cpu": "gpu", "gpu": "cpu"}[begun_with], begun_with: begun_with}
    monkeypatch.setattr(wiw.tasks.navigation, "resolve_backend", now.get)
    assert resume_run(tmp_path / "run", progress=False).complete
    with pytest.raises(StoreError, match="backend"):
        evaluate(task, AgentRecipe("heuristic"), 1, out=tmp_path / "run", resume=True, progress=False)


def test_a_run_whose_scenes_are_gone_is_not_resumed(tmp_path, two_rooms):
    folder = tmp_path / "scans"
    folder.mkdir()
    for name in ("two_rooms.obj", "two_rooms.mtl"):
        (folder / name).write_bytes(Path(two_rooms).with_name(name).read_bytes())
    task = TaskRecipe("imagenav", {"scenes": folder / "two_rooms.obj", "decisions": 1})
    agent = AgentRecipe("heuristic")
    evaluate(task, agent, 2, out=tmp_path / "run", progress=False)
    with sqlite3.connect(store_path(tmp_path / "run")) as store:
        store.execute("DELETE FROM outcome WHERE episode = 1")
    folder.rename(tmp_path / "away")
    for resume in (
        lambda: resume_run(tmp_path / "run", progress=False),
        lambda: evaluate(task, agent, 2, out=tmp_path / "run", resume=True, progress=False),
    ):
        with pytest.raises(FileError, match=r"two_rooms\.obj: no such file"):
            resume()
    assert [row["episode"] for row in load_run(tmp_path / "run").episodes] == [0]
    (tmp_path / "away").rename(folder)
    assert resume_run(tmp_path / "run", progress=False).complete
    with pytest.raises(FileError, match="no such file"):
        evaluate("imagenav", agent, 1, out=tmp_path / "b", progress=False, scenes=tmp_path / "none.obj")
    assert not (tmp_path / "b").exists()


def test_an_unknown_part_is_named_before_a_run_begins(tmp_path):
    with pytest.raises(RegistryError, match="no world model is named 'wrap'"):
        evaluate(LineTask(), AgentRecipe("heuristic", "wrap"), 2, out=tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()
    for wrong in ("candidates", "horizon", "depth", "width"):
        with pytest.raises(ArgumentError, match=f"{wrong} of at least 1"):
            AgentRecipe("heuristic", **{wrong: 0})


def test_rules_of_the_task_reach_an_agent_in_memory(two_rooms, tmp_path):
    log = wiw.evaluate(
        "imagenav", wiw.Agent("heuristic"), 1, out=tmp_path / "run", progress=False, scenes=two_rooms, decisions=1,
        candidates=2, horizon=9, execute=7,
    )  # fmt: skip
    row = log.decisions[0]
    assert len(row["executed"]) == 7 and len(row["proposals"]) <= 2
    assert "execute" not in log.store.config["arms"][0]["agent"]
    assert log.store.info["built"][log.arms[0]]["horizon"] == 9


def test_a_run_that_begins_with_the_same_failure_stops_and_says_so(tmp_path):
    task = LineTask(broken=frozenset(f"{i:04d}" for i in range(12)))
    with pytest.raises(
        InfrastructureError, match=r"first 5 episodes of arm .* ended with the same error.*no such scene"
    ):
        run_arms(task, {"a": LineAgent()}, episodes=12, out=tmp_path / "run", progress=False)
    assert len(wiw.load_run(tmp_path / "run").episodes) == 5


def test_agents_of_wrapped_parts_are_evaluated_as_they_are(two_rooms: str, tmp_path: Path) -> None:
    agent = wiw.Agent(
        "heuristic",
        Gated(ShuffledPlacebo(Attempted(wiw.world_model("copy"), 5.0)), 0.5),
        "matcher",
        candidates=2,
        observers=[FidelityObserver()],
    )
    log = wiw.evaluate("imagenav", agent, 1, scenes=two_rooms, decisions=4, out=tmp_path / "run", progress=False)
    said = log.store.config["arms"][0]["agent"]["model"]
    assert (said["placebo"], said["imagine_fraction"]) == ("shuffled", 0.5)
    imagined = [row for row in log.decisions if row["fidelity"] is not None]
    assert 0 < len(imagined) < len(log.decisions) == 4


def test_runs_that_begin_in_the_same_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        run(None, episodes=1).close()
    assert len({log.parent for log in Path("runs").glob("*/run.sqlite")}) == 2


def test_a_task_is_held_to_its_contract(tmp_path):
    class Careless(LineTask):
        def __init__(self, episodes, is_placeless=False):
            super().__init__()
            self._episodes, self._is_placeless = episodes, is_placeless

        def episodes(self, count):
            return super().episodes(count) if self._episodes is None else self._episodes

        def environment(self, depth=False):
            return None if self._is_placeless else super().environment(depth)

    for task, said in (
        (Careless([]), r"Careless\.episodes: expected 8 episodes \(wiw\.types\.Episode\), got 0$"),
        (Careless([1] * 8), "expected 8 .*got 8, int"),
        (Careless(None, is_placeless=True), r"Careless\.environment: expected a wiw\.Env, got None"),
    ):
        with pytest.raises(ContractError, match=said):
            run(tmp_path / str(len(said)), task=task)
