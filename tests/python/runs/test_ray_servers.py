# SPDX-License-Identifier: Apache-2.0
"""Servers that a run brings up itself, as Ray actors: results are those of one process, whichever of them are lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import served_models
from fakes import LineTask
from locations import PYTHON_TESTS
from run_facts import list_facts

import wiw
from wiw.cli import main
from wiw.errors import ArgumentError, InfrastructureError
from wiw.runs import ray_engine, ray_servers
from wiw.runs.config import EngineConfig
from wiw.runs.part_options import parse_options
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.servers import ServerCommand, _format_option, ask_servers, find_served, write_commands, write_vlm_commands
from wiw.studies.evaluate import evaluate, resume_run
from wiw.studies.run_log import load_run
from wiw.world_models.remote.model import ServedModel

HERE = Path(__file__)
TASK = f"{PYTHON_TESTS / 'fakes.py'}:line_task"
WALKER = f"{HERE}:Walker"
MODEL = f"{HERE}:Fading"


class Fading(served_models.Fading):
    version = "1"  # several servers of it can be told to serve the same


class Walker(wiw.Policy):
    """Proposes two plans and prefers the one whose futures are brighter."""

    def propose(self, situations, candidates, horizon):
        from wiw.types import Proposal

        return [[Proposal([1, turn, 1, 1, 1]) for turn in (2, 3)] for _ in situations]

    def score(self, situations, proposals, rollouts):
        import numpy as np

        return [np.array([float(each.frames.mean()) for each in plans]) for plans in rollouts]


@pytest.fixture(scope="module")
def calls(tmp_path_factory):
    """The file in which served models note their calls, known to all processes of the cluster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALLS", str(tmp_path_factory.mktemp("calls") / "calls"))
        yield


@pytest.fixture(scope="module")
def ray(calls, ray):
    return ray


def run_walk(out, **settings):
    """Eight episodes of two arms; one asks the model, which shades its futures by plan and seed."""
    agent = AgentRecipe(WALKER, MODEL, candidates=2, horizon=5, execute=3)
    arms = {"none": "none", "fading": MODEL}
    given = {"salt": "", "progress": False, "cache": "off", **settings}
    return evaluate(TaskRecipe(TASK), agent, 8, arms=arms, out=out, **given)


@pytest.fixture(scope="module")
def reference(ray, tmp_path_factory):
    out = tmp_path_factory.mktemp("reference") / "run"
    run_walk(out).close()
    return list_facts(out)


SERVED = {"engine": "ray", "workers": 2, "live": 2, "servers": 2, "server_gpus": 0}


def list_servers():
    """Process ids of `wiw serve` that this test has started; each has the model's file among its arguments."""
    found = []
    for folder in Path("/proc").iterdir():
        with suppress(OSError):
            words = (folder / "cmdline").read_bytes().split(b"\0") if folder.name.isdigit() else []
            if MODEL.encode() in words and b"serve" in words:
                found.append(int(folder.name))
    return found


def wait_until(condition, seconds=30.0):
    give_up = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < give_up, "it did not happen"
        time.sleep(0.05)


def test_a_run_with_its_own_servers_records_what_one_process_does(ray, reference, tmp_path):
    run_walk(tmp_path / "run", **SERVED).close()
    assert list_facts(tmp_path / "run") == reference
    log = load_run(tmp_path / "run")
    assert log.store.config["arms"][1]["agent"]["model"] == MODEL  # as it was named, whoever computes it
    assert log.store.info["engine"]["servers"] == 2
    wait_until(lambda: not list_servers(), 10)


@pytest.mark.nightly
def test_servers_that_are_killed_come_back_and_nothing_is_lost(ray, reference, tmp_path):
    killed = []

    def kill():
        while len(killed) < 4:
            for process in list_servers():
                if len(killed) < 4 and process not in killed and count_calls() > before + 3 * len(killed):
                    os.kill(process, signal.SIGKILL)
                    killed.append(process)
            time.sleep(0.02)

    before = count_calls()
    threading.Thread(target=kill, daemon=True).start()
    run_walk(tmp_path / "run", **SERVED).close()
    assert len(killed) == 4 and list_facts(tmp_path / "run") == reference


def count_calls():
    file = Path(os.environ["CALLS"])
    return len(file.read_text().splitlines()) if file.exists() else 0


class RayError(Exception):
    """Ray's base class of errors; its kill for want of memory is of no other."""


class RayTaskError(RayError):
    cause = "no weights"


@pytest.mark.parametrize(
    ("error", "cause", "is_gone"),
    [
        (RayError("killed due to the node running low on memory\nmore"), "killed .* on memory", True),
        (RayError(), "RayError", True),
        (RayTaskError(), "no weights", False),
    ],
)
def test_a_server_whose_actor_ray_kills_is_started_again_three_times(monkeypatch, error, cause, is_gone):
    def get(ref):
        raise error

    made, killed = [], []
    played = SimpleNamespace(
        get=get, kill=killed.append, exceptions=SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)
    )

    def make(pool, server):
        made.append(SimpleNamespace(start=SimpleNamespace(remote=lambda port: len(made))))
        return made[-1]

    monkeypatch.setattr(ray_servers.ServerPool, "_make_actor", make)
    pool = ray_servers.ServerPool(played, [ServerCommand(("serve", "warp"), 1, 0)], None, "")
    pool.start()
    for _ in range(ray_servers.TRIES - 1):
        pool.update_servers(pool.refs)
    with pytest.raises(ray_servers.LostServersError, match=cause):
        pool.update_servers(pool.refs)
    assert len(made) == (ray_servers.TRIES if is_gone else 1) and killed == made


class PlayedServers:
    """Stands in for Ray: two servers that begin to serve once they are started, one of which is lost later."""

    def __init__(self, monkeypatch):
        self.exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)
        self.killed, self.answers, self.count = [], {}, 0
        monkeypatch.setattr(ray_servers.ServerPool, "_make_actor", self.make)
        commands = [ServerCommand(("serve", "warp"), 2, 1)]
        self.pool = ray_servers.ServerPool(self, commands, None, "")
        self.pool.start()

    def make(self, server):
        self.count += 1
        number, name = self.count, f"actor {self.count}"
        self.answers[f"{name} starts"] = (f"ws://host:{number}", f"node {number}")
        refs = {"start": lambda port: f"{name} starts", "wait": lambda: f"{name} ends"}
        return SimpleNamespace(name=name, **{each: SimpleNamespace(remote=make) for each, make in refs.items()})

    def get(self, ref):
        if ref.endswith("ends"):
            raise RayError("its node was lost")
        return self.answers[ref]

    def kill(self, actor):
        self.killed.append(actor.name)


def test_a_run_begins_with_all_of_its_servers_and_goes_on_with_any_of_them(monkeypatch):
    played = PlayedServers(monkeypatch)
    pool = played.pool
    pool.update_servers(["actor 1 starts"])
    assert not pool.serves and pool.serving == ["ws://host:1"]
    pool.update_servers(["actor 2 starts"])
    assert pool.serves
    pool.update_servers(["actor 1 ends"])
    assert pool.serves and pool.serving == ["ws://host:2"] and len(pool) == 2
    pool.update_servers(["actor 2 ends"])
    assert not pool.serves and pool.serving == []
    pool.update_servers(["actor 4 starts"])
    assert pool.serves and pool.serving == ["ws://host:4"]


def test_a_server_for_which_there_is_no_place_any_more_is_given_up_and_the_others_go_on(monkeypatch):
    monkeypatch.setattr(ray_servers, "START_SECONDS", 0.1)
    monkeypatch.setattr(ray_servers, "PLACE_SECONDS", 0.1)
    played = PlayedServers(monkeypatch)
    pool = played.pool
    pool.update_servers(["actor 1 starts"])
    time.sleep(0.3)
    pool.update_servers([])
    assert len(pool) == 2, "at the beginning all are waited for"
    pool.update_servers(["actor 2 starts"])
    pool.update_servers(["actor 1 ends"])
    pool.update_servers([])
    assert len(pool) == 2
    time.sleep(0.3)
    pool.update_servers([])
    assert len(pool) == 1 and pool.serving == ["ws://host:2"] and played.killed[-1] == "actor 3"
    pool.update_servers(["actor 2 ends"])
    time.sleep(0.3)
    pool.update_servers([])
    assert len(pool) == 1, "the last one is waited for by the run"


def test_a_server_that_never_comes_back_is_given_up_though_others_finish_episodes(monkeypatch):
    played = PlayedServers(monkeypatch)
    pool = played.pool
    pool.update_servers(["actor 1 starts", "actor 2 starts"])
    pool.update_servers(["actor 1 ends"])
    played.get = lambda ref: (_ for _ in ()).throw(RayTaskError())
    for _ in range(ray_servers.TRIES - 1):
        pool.note_progress()
        pool.update_servers(["actor 3 starts"])
    assert pool.serving == ["ws://host:2"] and len(pool) == 1


def test_a_lost_actor_of_a_server_is_replaced_and_its_address_kept(ray, reference, tmp_path, monkeypatch):
    """The node is still there, so the server comes back at the same port, and its workers find it again."""
    seen, receive = [], ray_servers.ServerPool.note_progress

    def kill_once(pool):
        receive(pool)
        if not seen and len(pool):
            seen.append(list(pool.addresses))
            ray.kill(pool._servers[0].actor)
        elif seen and pool.serves and len(pool):
            seen.append(list(pool.addresses))

    monkeypatch.setattr(ray_servers.ServerPool, "note_progress", kill_once)
    run_walk(tmp_path / "run", **SERVED).close()
    assert list_facts(tmp_path / "run") == reference
    assert len(seen) > 1 and all(each == seen[0] for each in seen)


@pytest.mark.nightly
def test_workers_begin_anew_where_a_server_has_moved(ray, reference, tmp_path, monkeypatch):
    moved, restart = [], ray_servers.ServerPool._restart

    def move(pool, server, cause, is_gone=False):
        moved.append(server.address)
        server.address = server.address.rpartition(":")[0]  # no port: a free one is taken, as on another node
        restart(pool, server, cause, is_gone)

    def kill_once(pool):
        if not killed and len(pool):
            killed.append(True)
            ray.kill(pool._servers[0].actor)

    killed = []
    monkeypatch.setattr(ray_servers.ServerPool, "_restart", move)
    monkeypatch.setattr(ray_servers.ServerPool, "note_progress", kill_once)
    run_walk(tmp_path / "run", **SERVED).close()
    assert len(moved) == 1 and list_facts(tmp_path / "run") == reference


MORTAL = """
import os
import wiw

class Mortal(wiw.WorldModel):
    accepts = wiw.accepts("trajectory", view="perspective", size=(48, 48), frames=6, best_batch=4)

    def rollout(self, observations, controls, seeds):
        if os.path.exists({marker!r}):
            os._exit(9)
        return observations.image[:, None].repeat(6, 1)
"""


def test_a_server_that_dies_at_every_question_ends_the_run_after_three_tries(ray, tmp_path):
    """The episodes that were live are errors, no failures; what is left runs once the cause is mended."""
    marker = tmp_path / "die"
    marker.touch()
    (tmp_path / "mortal.py").write_text(MORTAL.format(marker=str(marker)))
    model = f"{tmp_path}/mortal.py:Mortal"
    agent = AgentRecipe(WALKER, model, candidates=2, horizon=5, execute=3)
    out = tmp_path / "run"
    settings = {"engine": "ray", "servers": 1, "server_gpus": 0, "live": 2, "cache": "off", "progress": False}
    with pytest.raises(
        InfrastructureError, match=r"lost 3 times without any episode finishing: wiw serve .*exit code 9"
    ):
        evaluate(TaskRecipe(TASK), agent, 6, out=out, **settings)
    rows = load_run(out).episodes
    assert [(row["status"], row["kind"]) for row in rows] == [("error", "server")] * 2
    marker.unlink()
    log = resume_run(out, progress=False, retry_errors=True, engine={"engine": "processes"})
    assert [row["status"] for row in log.episodes] == ["done"] * 6


HANGING = """
import time
from pathlib import Path
import wiw

class Hanging(wiw.WorldModel):
    accepts = wiw.accepts("trajectory", view="perspective", size=(48, 48), frames=6, best_batch=4)

    def rollout(self, observations, controls, seeds):
        if not Path({marker!r}).exists():
            Path({marker!r}).touch()
            time.sleep(3600)
        return observations.image[:, None].repeat(6, 1)
"""


@pytest.mark.nightly
def test_a_server_whose_model_hangs_is_started_again(ray, tmp_path, monkeypatch):
    """The first call never returns, though the server answers pings: it ends itself, and the run goes on."""
    (tmp_path / "hanging.py").write_text(HANGING.format(marker=str(tmp_path / "hung")))
    causes, restart = [], ray_servers.ServerPool._restart

    def write(*given):
        return [replace(each, arguments=(*each.arguments, "--stall", "2")) for each in write_commands(*given)]

    def note(pool, server, cause, is_gone=False):
        causes.append(cause)
        restart(pool, server, cause, is_gone)

    monkeypatch.setattr(ray_engine, "write_commands", write)
    monkeypatch.setattr(ray_servers.ServerPool, "_restart", note)
    agent = AgentRecipe(WALKER, f"{tmp_path}/hanging.py:Hanging", candidates=2, horizon=5, execute=3)
    settings = {"engine": "ray", "servers": 1, "server_gpus": 0, "live": 2, "cache": "off", "progress": False}
    log = evaluate(TaskRecipe(TASK), agent, 4, out=tmp_path / "run", **settings)
    assert [row["status"] for row in log.episodes] == ["done"] * 4
    assert len(causes) == 1 and "exit code 2" in causes[0] and "Hanging has not returned from a call" in causes[0]


def test_a_server_that_cannot_start_is_said_with_its_output(ray, tmp_path):
    (tmp_path / "broken.py").write_text(
        MORTAL.format(marker="") + "\n    def __init__(self):\n        raise OSError('no weights')\n"
    )
    agent = AgentRecipe(WALKER, f"{tmp_path}/broken.py:Mortal", candidates=2, horizon=5, execute=3)
    with pytest.raises(InfrastructureError, match="no weights"):
        evaluate(
            TaskRecipe(TASK), agent, 2, out=tmp_path / "run", progress=False, engine="ray", servers=1, server_gpus=0
        )


@pytest.mark.nightly
def test_a_killed_driver_leaves_no_server_and_its_run_is_resumed(ray, reference, tmp_path):
    out = tmp_path / "run"
    command = ["run", TASK, "--policy", WALKER, "--world-model", MODEL, "--arms", f"none,fading={MODEL}"]
    command += ["--candidates", "2", "--horizon", "5", "--execute", "3", "--episodes", "8", "--salt", "", "--live", "1"]
    command += ["--cache", "off", "--out", str(out), "--no-report", "--no-progress", "--engine", "ray"]
    command += ["--workers", "2", "--servers", "2", "--server-gpus", "0"]
    environment = {**os.environ, "RAY_ADDRESS": "", "PYTHONPATH": os.pathsep.join([str(HERE.parent), *sys.path])}
    driver = subprocess.Popen([sys.executable, "-m", "wiw.cli", *command], env=environment)
    wait_until(lambda: driver.poll() is not None or count_ended(out) >= 10, 120)
    driver.kill()
    driver.wait()
    assert 10 <= count_ended(out) < 16
    wait_until(lambda: not list_servers(), 60)
    assert main(["resume", str(out), "--no-report"]) == 0
    assert list_facts(out) == reference


def count_ended(out):
    with suppress(Exception):  # no store yet
        return len(load_run(out).episodes)
    return 0


def test_a_language_model_is_served_and_asked_with_its_token(ray, two_rooms, tmp_path):
    """Two actors ask a server each; the answers are those of the model in this process."""
    asked = [
        "imagenav",
        "--scenes",
        two_rooms,
        "--policy",
        "vlm",
        "--vlm",
        "mock",
        "--episodes",
        "2",
        "--backend",
        "cpu",
    ]
    asked += [
        "--policy-option",
        "cache=off",
        "--salt",
        "",
        "--no-report",
        "--no-progress",
        "--task-option",
        "decisions=1",
    ]
    served = ["--engine", "ray", "--workers", "2", "--live", "1", "--vlm-servers", "2", "--vlm-server-gpus", "0"]
    assert main(["run", *asked, "--out", str(tmp_path / "here")]) == 0
    assert main(["run", *asked, *served, "--out", str(tmp_path / "run")]) == 0
    one, other = load_run(tmp_path / "here"), load_run(tmp_path / "run")
    assert [row["status"] for row in other.episodes] == ["done", "done"]
    assert [row["actions"] for row in one.decisions] == [row["actions"] for row in other.decisions]


def test_commands_and_agents_of_servers():
    agents = {
        "none": AgentRecipe("vlm", policy_options={"vlm": {"vlm": "transformers:qwen", "tries": 2}}),
        "copy": AgentRecipe("matcher", "copy"),
        "big": AgentRecipe("matcher", "warp", model_options={"size": [480, 480], "weights": "a b"}),
        "placebo": AgentRecipe(
            "matcher", "warp", placebo="shuffled", model_options={"size": [480, 480], "weights": "a b"}
        ),
    }
    config = EngineConfig(engine="ray", servers=2, server_gpus=0.5, vlm_servers=1)
    (command,) = write_commands(LineTask(), agents, config)
    options = ("--world-model-option", "size=[480, 480]", "--world-model-option", "weights=a b")
    assert (command.arguments, command.count, command.gpus) == (("serve", "warp", *options), 2, 0.5)
    (command,) = write_vlm_commands(agents, config)
    assert (command.arguments, command.count, command.gpus) == (("serve-vlm", "--model", "qwen"), 1, 1)
    asking = ask_servers(agents, "warp", ["ws://a", "ws://b"], "http://c/v1", "secret")
    assert asking["copy"] == agents["copy"]
    told = {"dialect": "vllm", "vlm": "http://c/v1", "tries": 2, "key": "secret"}  # so that choices reach the server
    assert asking["none"].policy_options["vlm"] == told
    for arm in ("big", "placebo"):
        assert (asking[arm].model, asking[arm].placebo) == (ServedModel, agents[arm].placebo)
        assert asking[arm].model_options["address"] == "ws://a,ws://b"


def test_options_reach_a_served_model_as_they_are():
    def make(weights: str | None = "own", steps: int = 3, revision: str = "", size: Sequence[int] = ()) -> None: ...

    given = {"weights": None, "steps": 4, "revision": "null", "size": [480, 480]}
    assert parse_options([_format_option(*item) for item in given.items()], make, "--world-model-option") == given


def test_servers_without_a_model_or_with_several_are_refused(tmp_path, monkeypatch):
    agents = {"a": AgentRecipe("matcher", "warp"), "b": AgentRecipe("matcher", "warpnet"), "c": AgentRecipe("matcher")}
    with pytest.raises(ArgumentError, match="got none; the arms have warp, warpnet"):
        find_served(agents, None)
    with pytest.raises(ArgumentError, match="got svd"):
        find_served(agents, "svd")
    assert find_served(agents, "warpnet").model == "warpnet"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").touch()
    for given, named in (("mine.py:M", f"{tmp_path}/mine.py:M"), (f"{tmp_path}/mine.py:M", "mine.py:M")):
        assert find_served({**agents, "d": AgentRecipe("matcher", given)}, named).model == given
    other = {**agents, "d": AgentRecipe("matcher", "warp", model_options={"steps": 3})}
    with pytest.raises(ArgumentError, match="different options"):
        find_served(other, "warp")
    with pytest.raises(ArgumentError, match="servers are Ray actors"):
        evaluate(TaskRecipe(TASK), AgentRecipe("heuristic", "warp"), 1, out=tmp_path / "run", servers=1)
    with pytest.raises(ArgumentError, match=r"give --engine ray .*or start `wiw serve-vlm`"):
        evaluate(TaskRecipe(TASK), AgentRecipe("heuristic"), 1, out=tmp_path / "run", vlm_servers=1)
    with pytest.raises(ArgumentError, match="one language model"):
        evaluate(TaskRecipe(TASK), AgentRecipe("heuristic"), 1, out=tmp_path / "run", engine="ray", vlm_servers=1)
