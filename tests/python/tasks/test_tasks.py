# SPDX-License-Identifier: Apache-2.0
"""What evaluation asks of tasks and environments, tasks of one's own, and what the generator makes of scans."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from locations import ROOT

import wiw
from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT
from wiw.cli import main
from wiw.datasets import episodes as episode_file
from wiw.errors import ArgumentError, FileError, RegistryError
from wiw.metrics import path_efficiency
from wiw.registry import TASKS
from wiw.runs.recipes import AgentRecipe, task_recipe
from wiw.scenes import resolve
from wiw.tasks.imagenav import ImageNav
from wiw.tasks.manipulation import Manipulation
from wiw.types import GRIPPER_POSES, PRIMITIVES

EXAMPLES = ROOT / "docs/examples"
PROBED_ROOMS = ("runs", "studies", "report", "analysis", "registry.py", "cli", "loop/scheduler.py", "envs", "tasks")


def scan_of(rooms: str, folder: Path) -> str:
    """The same walls and furniture as one mesh of one material, as scans are."""
    lines = [line for line in Path(rooms).read_text().splitlines() if not line.startswith(("o ", "usemtl", "mtllib"))]
    path = folder / "scan.obj"
    path.write_text("\n".join(["o scan", *lines]))
    return str(path)


# -- one numbering of actions ------------------------------------------------------------------------------------------


def test_stepping_through_a_decision_walks_what_it_meant(two_rooms: str) -> None:
    stepped, run = (wiw.make("ImageNav-v0", scenes=two_rooms, seed=3) for _ in range(2))
    for env in (stepped, run):
        env.reset(options={"episode": 1})
    actions = np.array([FORWARD, TURN_LEFT, FORWARD, TURN_RIGHT, TURN_RIGHT, FORWARD], np.int8)
    for action in actions:
        observation, *_ = stepped.step(action)
    segment = run.run(actions)
    np.testing.assert_array_equal(observation["panorama"], segment.observation.panorama)
    np.testing.assert_array_equal(stepped.truth().position, run.truth().position)
    assert stepped.truth().yaw == run.truth().yaw
    expected = wiw.action.to_trajectory(actions)[-1]
    assert observation["odometry"][2] == pytest.approx(expected[2])


def test_the_action_space_is_numbered_as_the_actions_are(two_rooms: str) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms)
    space = env.action_space
    assert [space.start, space.start + space.n - 1] == [FORWARD, STOP] and STOP in space and 0 not in space
    vector = wiw.make_vec("ImageNav-v0", 2, scenes=two_rooms)
    assert vector.action_space.start.tolist() == [1, 1] and vector.single_action_space == space
    env.reset(options={"episode": 0})
    with pytest.raises(ArgumentError, match=r"an action from 1 to 4, as wiw\.action has them, got 0"):
        env.step(0)
    assert env.state.actions == 0


# -- environments ------------------------------------------------------------------------------------------------------


def test_bounds_of_observations_are_shared(two_rooms: str) -> None:
    task = ImageNav(scenes=two_rooms)
    first, second, without = task.environment(True), ImageNav(scenes=two_rooms).environment(True), task.environment()
    assert first.observation_space is second.observation_space is not without.observation_space
    vectors = [task.vector_environment(2) for _ in range(2)]
    assert vectors[0].observation_space is vectors[1].observation_space
    assert Manipulation().environment().observation_space is Manipulation().environment().observation_space


@pytest.mark.parametrize("make", [wiw.make, lambda name, **options: wiw.make_vec(name, 2, **options)])
def test_an_unknown_reset_option_is_refused(make: Any, two_rooms: str) -> None:
    for env in (make("ImageNav-v0", scenes=two_rooms), make("Manipulation-v0", size=32)):
        with pytest.raises(ArgumentError, match="reset: unknown option 'episodes'; the only option is 'episode'"):
            env.reset(options={"episodes": 3})
        env.close()


def test_what_an_environment_lacks_is_named() -> None:
    env = TASKS.make(f"{EXAMPLES / 'corridor.py'}:Corridor").environment()
    for use, message in (
        (env.fork, "CorridorEnv has no simulator.*implement `CorridorEnv.fork`"),
        (env.guide, "wiw blame.*CorridorEnv.guide"),
        (env.semantic, "--semantics simulator"),
    ):
        with pytest.raises(ArgumentError, match=message):
            use()
    env.close()


def test_spl_of_an_episode_is_the_metric_s(two_rooms: str) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms, depth=False)
    env.reset(options={"episode": 0})
    env.run(env.guide().suggest_plan(60))
    got = env.result()
    assert got["success"] == 1 and 0.5 < got["spl"] <= 1
    assert got["spl"] == path_efficiency([True], [got["shortest"]], [got["travelled"]])[0]
    assert 100 * got["spl"] == wiw.metrics.spl([True], [got["shortest"]], [got["travelled"]])


# -- tasks of one's own ------------------------------------------------------------------------------------------------


def test_nothing_probes_tasks_or_environments() -> None:
    files = [
        f for room in PROBED_ROOMS for f in [*(ROOT / "python/wiw").glob(f"{room}/**/*.py"), ROOT / "python/wiw" / room]
    ]
    probe = re.compile(r"hasattr\(\s*(task|built|made|env|outcome)\b|getattr\(\s*(task|built|made|env|outcome|TASKS)\b")
    assert [f"{f.name}: {m[0]}" for f in files if f.suffix == ".py" for m in probe.finditer(f.read_text())] == []


def test_a_class_that_is_no_task_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("class Mine:\n    name = 'mine'\n\n\ndef make():\n    return Mine()\n")
    for name in ("Mine", "make"):
        with pytest.raises(RegistryError, match=r"is not a task: expected a class derived from wiw\.Task"):
            TASKS.make(f"{tmp_path / 'mine.py'}:{name}")
    with pytest.raises(ArgumentError, match="expected a task"):
        task_recipe(object())
    assert issubclass(wiw.Task, object) and ImageNav.space == PRIMITIVES and Manipulation.space == GRIPPER_POSES


def test_an_environment_stands_for_its_task_however_it_is_wrapped(two_rooms: str) -> None:
    import gymnasium

    env = wiw.make("ImageNav-v0", scenes=two_rooms)
    for given in (
        env,
        gymnasium.wrappers.TimeLimit(env, 3),
        env.task,
        wiw.make_vec("ImageNav-v0", 1, scenes=two_rooms),
    ):
        assert task_recipe(given).build().describe() == env.task.describe()


def test_the_example_of_a_world_of_ones_own_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    task = f"{EXAMPLES / 'corridor.py'}:Corridor"
    options = ["--arms", "none,copy", "--episodes", "3", "--horizon", "3", "--keep-images", "1"]
    assert main(["run", task, *options, "--out", str(tmp_path / "run"), "--task-option", "budget=12"]) == 0
    log = wiw.load_run(tmp_path / "run")
    assert log.store.config["task"] == {"task": "corridor", "seed": 0, "budget": 12}
    assert {row["status"] for row in log.episodes} == {"done"} and len(log.episodes) == 6
    assert (tmp_path / "run/report.html").exists()
    with pytest.raises(SystemExit):
        main(["run", task, "--nonsense"])


def test_a_task_without_a_seed_runs_and_is_refused_with_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = "class Own(Corridor):\n    def __init__(self, budget: int = 12):\n        super().__init__(5, budget)\n"
    (tmp_path / "own.py").write_text(f"{(EXAMPLES / 'corridor.py').read_text()}\n\n{own}")
    task, agent = f"{tmp_path / 'own.py'}:Own", AgentRecipe("heuristic")
    flags = ["--policy", "heuristic", "--episodes", "1", "--no-report", "--out", str(tmp_path / "run")]
    assert main(["run", task, *flags]) == 0
    log = wiw.evaluate(task, agent, 1, out=tmp_path / "python", progress=False)
    assert wiw.load_run(tmp_path / "run").store.config == log.store.config and log.store.config["seed"] == 5
    assert main(["run", task, *flags, "--seed", "3", "--resume"]) == 2
    assert "unexpected keyword argument 'seed'; it takes (budget" in capsys.readouterr().err
    with pytest.raises(RegistryError, match="unexpected keyword argument 'seed'"):
        wiw.evaluate(task, agent, 1, seed=3, out=tmp_path / "seeded", progress=False)


def test_the_example_of_a_variant_runs_under_the_presets_of_what_it_derives_from(two_rooms: str) -> None:
    name = f"{EXAMPLES / 'walkable_imagenav.py'}:WalkableImageNav"
    task = TASKS.make(name, scenes=two_rooms)
    assert task.rules == ImageNav().rules and TASKS.make(name, preset="official").rules.decisions == 21
    env, longer = task.environment(), TASKS.make(name, scenes=two_rooms, radius=50.0).environment()
    env.begin(task.episode(0))
    assert env.state.distance_to_goal() > 0.5 and env.run(env.guide().suggest_plan(60)).terminated
    assert env.result()["success"] == 1
    longer.begin(task.episode(0))
    state = longer.state
    state.geodesic_to_goal = lambda: 100.1
    assert not longer.run([TURN_LEFT]).terminated
    state.geodesic_to_goal = lambda: 100.0
    assert longer.run([TURN_LEFT]).terminated and longer.result()["success"] == 1
    with pytest.raises(
        ArgumentError,
        match=r"no preset 'offical'; choose from default, paper, .*Did you mean official\?",
    ):
        TASKS.make(name, preset="offical")


def test_a_variant_is_asked_with_the_prompts_of_what_it_derives_from(two_rooms: str, tmp_path: Path) -> None:
    pytest.importorskip("pydantic")
    name, policy = (
        f"{EXAMPLES / 'walkable_imagenav.py'}:WalkableImageNav",
        wiw.policy("vlm", vlm="mock", task="imagenav"),
    )
    how: Any = {"scenes": two_rooms, "decisions": 1, "out": tmp_path / "run", "progress": False}
    log = wiw.evaluate(name, wiw.Agent(policy, "copy"), 1, **how)
    assert [row["status"] for row in log.episodes] == ["done"]
    assert log.store.config["task"]["task"] == "walkable-imagenav"


def test_a_task_with_rules_of_its_own_needs_no_preset(two_rooms: str, tmp_path: Path) -> None:
    @dataclass(frozen=True)
    class Rules:
        radius: float
        decisions: int = 7
        candidates: int = 2
        horizon: int = 4
        execute: int = 1
        motion: str = "refuse"

    class Mine(wiw.tasks.navigation.NavigationTask):
        name, rules_class, generator_class = "mine", Rules, wiw.datasets.imagenav.EpisodeRules
        generate_episodes, measure = ImageNav.generate_episodes, ImageNav.measure
        make_goal, find_goal_position = ImageNav.make_goal, ImageNav.find_goal_position

        def is_success(self, state: Any) -> bool:
            return state.distance_to_goal() <= self.rules.radius

    assert Mine(scenes=two_rooms, radius=1).rules == Rules(1.0)
    own = tmp_path / "own.yaml"
    own.write_text("decisions: 3\nradius: 2\n")
    assert Mine(scenes=two_rooms, preset=own).rules == Rules(2.0, 3)
    with pytest.raises(ArgumentError, match="leaves open radius, or give Rules defaults"):
        Mine(scenes=two_rooms)
    with pytest.raises(
        ArgumentError, match=r"mine: no preset 'official'; it has none of its own; give the path of a \.yaml"
    ):
        Mine(scenes=two_rooms, preset="official")


# -- scenes, episodes and files ----------------------------------------------------------------------------------------


def test_a_scan_of_one_mesh_has_episodes(two_rooms: str, tmp_path: Path) -> None:
    scan = scan_of(two_rooms, tmp_path)
    task = ImageNav(scenes=scan, backend="cpu", shortest=1.5)
    episodes = task.episodes(3)
    assert len({episode.goal_position for episode in episodes}) == 3
    assert task.describe()["generator"] == {"shortest": 1.5} and "generator" not in ImageNav().describe()
    out = tmp_path / "episodes.json"
    option = ["--task-option", "goal_instances=1", "--task-option", "shortest=1.5"]
    assert main(["episodes", "imagenav", "--scenes", scan, "--episodes", "2", "--out", str(out), *option]) == 0
    assert [e.goal_position for e in episode_file.load(out)] == [e.goal_position for e in episodes[:2]]


def test_a_scene_where_nothing_fits_says_which_rule_is_broken(two_rooms: str) -> None:
    with pytest.raises(ArgumentError, match=r"among 20 satisfy .*: \d+ broke shortest, longest.*--task-option"):
        ImageNav(scenes=two_rooms, longest=2.1, attempts=20).episodes(1)


@pytest.mark.parametrize(
    ("task", "option", "value"),
    [
        ("imagenav", "per_scene", 0),
        ("imagenav", "per_scene", 1.5),
        ("ar", "per_scene", -1),
        ("imagenav", "attempts", 0),
        ("ar", "survey", 0),
        ("ar", "places", 0),
        ("ar", "attempts", -2),
    ],
)
def test_numbers_that_leave_no_episode_are_refused(task: str, option: str, value: Any, two_rooms: str) -> None:
    with pytest.raises(ArgumentError, match=rf"{task}: {option}: expected a?.*at least 1, got {value}"):
        TASKS.make(task, scenes=two_rooms, **{option: value})


def test_a_file_of_episodes_is_run_whole_unless_asked_otherwise(two_rooms: str, tmp_path: Path) -> None:
    path = tmp_path / "two.json"
    assert main(["episodes", "imagenav", "--scenes", two_rooms, "--episodes", "2", "--out", str(path)]) == 0
    task = ImageNav(episode_file=path)
    assert task.default_episodes == 2 and ImageNav(scenes=two_rooms).default_episodes == 20
    with pytest.raises(
        ArgumentError, match=r"3 episodes were requested, but .*two\.json has only 2; request fewer, or omit"
    ):
        task.episodes(3)
    arguments = ["--policy", "heuristic", "--no-report", "--keep-images", "0", "--task-option", "decisions=1"]
    assert main(["run", "imagenav", "--episode-file", str(path), "--out", str(tmp_path / "run"), *arguments]) == 0
    assert len(wiw.load_run(tmp_path / "run").episodes) == 2


def test_a_file_of_episodes_is_not_overwritten_unasked(two_rooms: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text("precious")
    command = ["episodes", "imagenav", "--scenes", two_rooms, "--episodes", "1", "--out", str(path)]
    assert main(command) != 0 and path.read_text() == "precious"
    assert main([*command, "--overwrite"]) == 0 and len(episode_file.load(path)) == 1


@pytest.mark.parametrize(
    ("spec", "meant"),
    [
        ("apartment:val", "apartments:val"),
        ("apartments:vall:40", "apartments:val:40"),
        ("apartmnts:tset:3", "apartments:test:3"),
    ],
)
def test_a_misspelt_scene_spec_has_a_hint(spec: str, meant: str) -> None:
    with pytest.raises((ArgumentError, FileError), match=rf"Did you mean {meant}\?"):
        resolve(spec)


def test_other_misspelt_names_have_one_too(two_rooms: str) -> None:
    with pytest.raises(FileError, match=r"Did you mean two_rooms\.obj"):
        resolve(str(Path(two_rooms).with_name("two_room.obj")))
    with pytest.raises(ArgumentError, match=r"unknown option 'goal_instance'; .*Did you mean goal_instances or"):
        ImageNav(goal_instance=1)
    with pytest.raises(ArgumentError, match=r"Did you mean decisions\?"):
        ImageNav(decison=3)
