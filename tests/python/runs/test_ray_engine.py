# SPDX-License-Identifier: Apache-2.0
"""Runs in Ray actors are the same as in this process, whichever actors are lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import deque
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from fakes import LineAgent, LineTask
from locations import PYTHON_TESTS
from run_facts import list_facts

from wiw.cli import main
from wiw.errors import ArgumentError, ContractError, DependencyError, InfrastructureError, StoreError
from wiw.runs import ray_engine
from wiw.runs.config import EngineConfig, RunConfig
from wiw.runs.execute import _group_by_scene
from wiw.runs.recipes import AgentRecipe, TaskInMemory, TaskRecipe
from wiw.runs.rows import OutcomeRow
from wiw.runs.workers import Job, WorkerSpec, pickle_spec
from wiw.studies.evaluate import evaluate, resume_run, run_arms
from wiw.studies.run_log import load_run
from wiw.types import EpisodeResult

TASK = f"{PYTHON_TESTS / 'fakes.py'}:line_task"


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    out = tmp_path_factory.mktemp("reference") / "run"
    run_arms(LineTask(), {"none": LineAgent(0.5), "warp": LineAgent(0.8)}, 10, out=out, progress=False).close()
    return list_facts(out)


def run_line(out, workers=2, **options):
    arms = {"none": LineAgent(0.5, **options), "warp": LineAgent(0.8, **options)}
    return run_arms(LineTask(), arms, 10, out=out, progress=False, engine="ray", workers=workers, live=2)


@pytest.mark.parametrize("workers", [1, 2])
def test_one_and_two_actors_record_what_one_process_does(ray, reference, tmp_path, workers):
    run_line(tmp_path / "run", workers).close()
    assert list_facts(tmp_path / "run") == reference
    assert ray.is_initialized()  # it was there before


def test_a_lost_actor_costs_the_episodes_in_flight_and_nothing_else(ray, reference, tmp_path):
    """Its process is killed at decision 1 of episode 6, once."""
    run_line(tmp_path / "run", kill=(6,), marker=str(tmp_path / "marker")).close()
    assert list_facts(tmp_path / "run") == reference


def test_an_actor_that_hangs_is_replaced_and_costs_no_result(ray, reference, tmp_path):
    agents = {
        arm: LineAgent(drive, kill=(6,), hangs=True, marker=str(tmp_path / arm))
        for arm, drive in (("none", 0.5), ("warp", 0.8))
    }
    options = {"progress": False, "engine": "ray", "workers": 2, "live": 2, "stall": 8.0}
    run_arms(LineTask(), agents, 10, out=tmp_path / "run", **options).close()
    assert (tmp_path / "none").exists() and list_facts(tmp_path / "run") == reference


class RayError(Exception):
    """Ray's base class of errors; its kill for want of memory is of no other."""


class RayActorError(RayError): ...


class RayTaskError(RayError): ...


EXCEPTIONS = SimpleNamespace(RayError=RayError, RayActorError=RayActorError, RayTaskError=RayTaskError)
LOSSES = [RayActorError("lost"), RayError("killed due to the node running low on memory"), RayError()]


class ActorInThisProcess:
    """An actor that is lost after the first row of a job of three episodes."""

    loss = LOSSES[0]

    def __init__(self, spec, threads):
        self.jobs = []
        self.prepare = SimpleNamespace(remote=lambda: "started")
        self.run = SimpleNamespace(options=lambda **options: SimpleNamespace(remote=self.start))

    def start(self, job):
        self.jobs.append(job)
        for index, episode in job.episodes:
            yield [OutcomeRow(job.arm, EpisodeResult(index, episode.episode_id, episode.scene, "done"))]
            if len(job.episodes) == 3:
                yield self.loss


@pytest.mark.parametrize("loss", LOSSES, ids=repr)
def test_actors_without_work_take_that_of_a_lost_one(monkeypatch, loss):
    monkeypatch.setattr(ActorInThisProcess, "loss", loss)

    def get(row):
        if isinstance(row, RayError):
            raise row
        return row

    def start(*given):
        made.append(ActorInThisProcess(*given))
        return made[-1]

    made, rows, killed = [], [], []
    played = SimpleNamespace(
        remote=lambda **options: lambda kind: SimpleNamespace(remote=start),
        wait=lambda waiting, timeout: (waiting, []),
        get=get,
        kill=killed.append,
        nodes=lambda: [{}],
        exceptions=EXCEPTIONS,
    )
    episodes = list(enumerate(LineTask().episodes(4)))
    jobs = deque([Job("none", tuple(episodes[:1])), Job("none", tuple(episodes[1:]))])
    receiver = SimpleNamespace(write=rows.append, discard=lambda arm, lost: None)
    spec = WorkerSpec(None, {}, 0, "", 4, frozenset())
    ray_engine._ActorPool(played, spec, jobs, receiver, 2, EngineConfig(engine="ray")).run()
    assert sorted(row.result.episode for row in rows) == [0, 1, 2, 3]
    assert [len(actor.jobs) for actor in made] == [2, 1, 1]  # the first, the lost one, and the one in its place
    assert killed == [made[1]]  # Ray may have lost its answer alone


@pytest.mark.parametrize(("is_own", "cores"), [(True, 4), (False, 1)])
def test_an_actor_uses_the_cores_that_it_asks_for(monkeypatch, is_own, cores):
    """In a cluster of the run's own, actors share all of them; in another one each has one."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(8))
    asked = []
    actor = SimpleNamespace(prepare=SimpleNamespace(remote=lambda: "started"))

    def make(**options):
        return lambda kind: SimpleNamespace(remote=lambda spec, threads: asked.append((options, threads)) or actor)

    played = SimpleNamespace(remote=make, nodes=lambda: [{}], exceptions=EXCEPTIONS)
    jobs = deque(Job("none", (episode,)) for episode in enumerate(LineTask().episodes(2)))
    spec = WorkerSpec(None, {}, 0, "", 4, frozenset())
    ray_engine._ActorPool(played, spec, jobs, None, 2, EngineConfig(engine="ray"), is_own)._start()
    ((options, threads),) = asked
    assert options["num_cpus"] == threads == cores


ACTOR = """
import sys
import cv2
from fakes import LineTask
from wiw._core import core
from wiw.runs.ray_engine import EpisodeActor
from wiw.runs.recipes import TaskInMemory
from wiw.runs.workers import WorkerSpec, pickle_spec
if {before}:
    import torch
EpisodeActor(pickle_spec(WorkerSpec(TaskInMemory(LineTask()), {{}}, 0, "", 1, frozenset())), 1)
import torch
print(core.num_threads(), cv2.getNumThreads(), torch.get_num_threads())
"""


@pytest.mark.parametrize(("own", "before"), [({}, False), ({}, True), ({"WIW_NUM_THREADS": "2"}, False)])
def test_an_actor_has_as_many_threads_as_cores(own, before):
    pytest.importorskip("torch", reason="needs torch")
    kept = {name: text for name, text in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", ACTOR.format(before=before)],
        env={**kept, "PYTHONPATH": os.pathsep.join(sys.path), **own},
        capture_output=True,
        text=True,
        check=True,
    )
    count = own.get("WIW_NUM_THREADS", "1")
    assert done.stdout.split() == [count, count, "1"]


def test_an_error_in_an_actor_is_no_loss_of_it():
    """Ray's error of a task is also of the class of its cause, which may be the loss of an actor of its own."""

    class BothError(RayTaskError, RayActorError): ...

    def get(row):
        raise BothError("boom")

    episodes = tuple(enumerate(LineTask().episodes(2)))
    spec = WorkerSpec(None, {}, 0, "", 4, frozenset())
    played = SimpleNamespace(get=get, nodes=lambda: [{}], exceptions=EXCEPTIONS)
    pool = ray_engine._ActorPool(played, spec, deque(), None, 1, EngineConfig(engine="ray"))
    with pytest.raises(InfrastructureError, match="a Ray actor failed: boom"):
        pool._receive(ray_engine._Lease(None, Job("none", episodes), iter([None])))


class ActorWithoutServer(ActorInThisProcess):
    """An actor whose first answers say that a server of the run was away for too long."""

    failures = 2
    kind = ""

    def start(self, job):
        self.jobs.append(job)
        for index, episode in job.episodes:
            lost = index == 1 and job.attempt < self.failures
            status, kind = ("error", self.kind) if lost else ("done", "")
            yield [OutcomeRow(job.arm, EpisodeResult(index, episode.episode_id, episode.scene, status, kind=kind))]


@dataclass
class Exiting:
    """Recipe of an agent whose constructor means to end the process."""

    reseed: int | None = None

    def build(self, context, limits):
        raise SystemExit(3)


def test_a_constructor_that_ends_the_process_ends_no_job_in_silence():
    spec = WorkerSpec(TaskInMemory(LineTask()), {"none": Exiting()}, 0, "", 2, frozenset())
    actor = ray_engine.EpisodeActor(pickle_spec(spec), 1)
    (rows,) = actor.run(Job("none", tuple(enumerate(LineTask().episodes(3)))))
    assert [type(row) for row in rows] == [InfrastructureError] and "SystemExit: 3" in str(rows[0])


@pytest.mark.parametrize(
    ("kind", "failures", "errors", "begun"),
    [
        ("world_model/connection", 2, 0, 3),
        ("vlm/unreachable", 2, 0, 3),
        ("world_model/connection", 9, 1, 3),
        ("world_model/deadline", 9, 1, 1),
    ],
)
def test_an_episode_that_a_lost_server_has_cost_is_leased_again(monkeypatch, kind, failures, errors, begun):
    monkeypatch.setattr(ActorWithoutServer, "kind", kind)
    monkeypatch.setattr(ActorWithoutServer, "failures", failures)

    def start(*given):
        made.append(ActorWithoutServer(*given))
        return made[-1]

    made, rows = [], []
    played = SimpleNamespace(
        remote=lambda **options: lambda kind: SimpleNamespace(remote=start),
        wait=lambda waiting, timeout: (waiting, []),
        get=lambda row: row,
        nodes=lambda: [{}],
        exceptions=EXCEPTIONS,
    )
    episodes = list(enumerate(LineTask().episodes(3)))
    receiver = SimpleNamespace(write=rows.append, discard=lambda arm, lost: None)
    spec = WorkerSpec(None, {}, 0, "", 4, frozenset())
    jobs = deque([Job("none", tuple(episodes))])
    pool = ray_engine._ActorPool(played, spec, jobs, receiver, 1, EngineConfig(engine="ray"))
    monkeypatch.setattr(ray_engine.ServerPool, "__len__", lambda pool: 1)
    pool.run()
    assert sorted(row.result.episode for row in rows) == [0, 1, 2]
    assert sum(row.result.status == "error" for row in rows) == errors
    assert sum(1 in dict(job.episodes) for each in made for job in each.jobs) == begun


def make_pool(monkeypatch, episodes, serving, size=2, **played):
    """A pool whose actors ask servers of a language model; `serving` are the addresses of those that serve."""
    started, killed = [], []

    def start(spec, threads):
        run = SimpleNamespace(options=lambda **options: SimpleNamespace(remote=lambda job: f"rows of {job.episodes}"))
        started.append(SimpleNamespace(prepare=SimpleNamespace(remote=lambda: "started"), run=run))
        return started[-1]

    given = {"nodes": lambda: [{}], "exceptions": EXCEPTIONS, "kill": killed.append, **played}
    remote = lambda **options: lambda kind: SimpleNamespace(remote=start)  # noqa: E731
    items = enumerate(LineTask().episodes(episodes))
    jobs, spec = deque(Job("none", (item,)) for item in items), WorkerSpec(None, {}, 0, "", 4, frozenset())
    notes = []
    receiver = SimpleNamespace(discard=lambda arm, lost: None, note=notes.append)
    monkeypatch.setattr(ray_engine.ServerPool, "serving", property(lambda pool: serving if pool is found._vlms else []))
    monkeypatch.setattr(ray_engine._ActorPool, "_pickle_spec", lambda pool, vlm: b"")
    found = ray_engine._ActorPool(
        SimpleNamespace(remote=remote, **given), spec, jobs, receiver, size, EngineConfig(engine="ray")
    )
    return found, started, killed, notes


def test_actors_are_moved_from_a_lost_server_of_the_language_model_and_spread_again_once_it_is_back(monkeypatch):
    serving = ["a", "b"]
    pool, started, killed, _ = make_pool(monkeypatch, 12, serving, size=4)
    pool._place_jobs()
    assert [lease.vlm for lease in pool._leases] == ["a", "b", "a", "b"]
    for lease in pool._leases:
        lease.rows = None
    pool._place_jobs()
    assert all(lease.job is not None for lease in pool._leases) and len(pool._jobs) == 8
    bound = [lease.actor for lease in pool._leases if lease.vlm == "b"]
    serving.remove("b")
    pool._place_jobs()
    assert killed == bound and [lease.vlm for lease in pool._leases] == ["a"] * 4
    assert len(pool._jobs) == 10 and [job.attempt for job in pool._jobs][-2:] == [1, 1], "a try of what was live"
    serving.append("b")
    for lease in pool._leases:
        lease.rows = lease.job = None
    pool._place_jobs()
    assert sorted(lease.vlm for lease in pool._leases) == ["a", "a", "b", "b"] and len(started) == 8


def test_what_the_cluster_lacks_is_said_once_and_then_ends_the_run(monkeypatch):
    monkeypatch.setattr(ray_engine, "NOTICE", 0.2)
    monkeypatch.setattr(ray_engine, "PLACE_SECONDS", 0.9)
    waits = []
    wait = lambda waiting, timeout: waits.append(timeout) or ([], waiting)  # noqa: E731
    pool, _, _, notes = make_pool(monkeypatch, 2, [], wait=wait)
    with pytest.raises(
        InfrastructureError, match=r"no actor could be started within 0\.9 s: .*with a free core for each"
    ):
        pool.run()
    assert notes == ["waiting for Ray: expected a Ray cluster with a free core for each actor; see `ray status`"]
    assert len(waits) == 5


@pytest.mark.parametrize(("gpus", "asked"), [(1.5, None), (1.25, "expected at least 1.5")])
def test_gpus_that_this_machine_has_not_are_not_waited_for(gpus, asked):
    played = SimpleNamespace(nodes=lambda: [{}], cluster_resources=lambda: {"GPU": gpus}, exceptions=EXCEPTIONS)
    spec = WorkerSpec(TaskInMemory(LineTask()), {"none": AgentRecipe("heuristic", "warp")}, 0, "", 4, frozenset())
    config = EngineConfig(engine="ray", servers=2, server_gpus=0.5, worker_gpus=0.5)
    for is_own in (False, True):
        with pytest.raises(InfrastructureError, match=asked) if is_own and asked else nullcontext():
            ray_engine._ActorPool(played, spec, deque([None]), None, 1, config, is_own)


def test_an_episode_that_kills_every_actor_is_an_error_after_three_tries(ray, tmp_path):
    log = run_line(tmp_path / "run", kill=(6,))
    errors = [row for row in log.episodes if row["status"] == "error"]
    assert [(row["arm"], row["episode"], row["kind"]) for row in errors] == [
        ("none", 6, "worker"),
        ("warp", 6, "worker"),
    ]
    assert all("the worker process died three times on this episode" in row["error"] for row in errors)
    assert len(log.episodes) == 20


def test_actors_that_are_killed_at_any_time_change_nothing(ray, reference, tmp_path, monkeypatch):
    """Five actors are killed from outside, each once a row of its has come."""
    killed, receive = [], ray_engine._ActorPool._receive

    def receive_and_kill(pool, lease):
        receive(pool, lease)
        if lease.job is not None and lease.job.attempt == 0 and len(killed) < 5:
            killed.append(lease.actor)
            ray.kill(lease.actor)

    monkeypatch.setattr(ray_engine._ActorPool, "_receive", receive_and_kill)
    run_line(tmp_path / "run").close()
    assert len(killed) == 5 and list_facts(tmp_path / "run") == reference


def test_a_broken_contract_stops_the_run_as_in_this_process(ray, tmp_path):
    method = "    def propose(self, situations, candidates, horizon):\n        return 3\n"
    (tmp_path / "bad.py").write_text(f"import wiw\n\nclass Bad(wiw.Policy):\n{method}")
    with pytest.raises(ContractError, match="propose"):
        evaluate(
            TaskRecipe(TASK),
            AgentRecipe(f"{tmp_path}/bad.py:Bad"),
            2,
            out=tmp_path / "run",
            progress=False,
            engine="ray",
        )


def test_scenes_with_few_episodes_share_a_job():
    """Else a model would be asked for two episodes at a time, however many are to be live."""
    episodes = LineTask().episodes(10)  # two of a scene
    assert _group_by_scene(range(10), episodes, 2) == [[0, 1], [2, 3], [4, 5], [6, 7], [8, 9]]
    assert _group_by_scene(range(10), episodes, 3) == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    assert _group_by_scene([9, 0, 8, 1], episodes, 2) == [[9, 8], [0, 1]]
    assert _group_by_scene([], episodes, 2) == []


def test_jobs_are_of_one_scene(ray, tmp_path, monkeypatch):
    leased, assign = [], ray_engine._ActorPool._assign

    def assign_and_note(pool, lease):
        assign(pool, lease)
        leased.extend([lease.job] if lease.job is not None else [])

    monkeypatch.setattr(ray_engine._ActorPool, "_assign", assign_and_note)
    run_line(tmp_path / "run").close()
    assert all(len({episode.scene for _, episode in job.episodes}) == 1 for job in leased)
    assert sum(len(job.episodes) for job in leased) == 20


@pytest.mark.extra
def test_a_driver_that_is_stopped_is_resumed_in_processes(tmp_path):
    pytest.importorskip("ray", reason="needs ray: pip install 'wiw[ray]'")
    out = tmp_path / "run"
    command = ["run", TASK, "--policy", "heuristic", "--scenes", "slow", "--episodes", "12", "--live", "1"]
    command += ["--salt", "7"]
    command += ["--out", str(out), "--engine", "ray", "--workers", "2", "--no-report"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    driver = subprocess.Popen([sys.executable, "-m", "wiw.cli", *command], env=environment)
    while driver.poll() is None and count_ended(out) < 3:
        time.sleep(0.05)
    driver.send_signal(signal.SIGTERM)
    assert driver.wait(60) == 75  # Ray's own handler would end it otherwise
    assert 3 <= count_ended(out) < 12
    resume_run(out, progress=False, engine={"engine": "processes"}).close()
    assert main([*command[:12], "--out", str(tmp_path / "whole"), "--no-report"]) == 0
    assert list_facts(out) == list_facts(tmp_path / "whole")


def count_ended(out):
    with suppress(FileNotFoundError, StoreError):  # it is being created
        return len(load_run(out).episodes)
    return 0


def test_without_ray_or_a_cluster_it_is_said(tmp_path, monkeypatch):
    with pytest.raises(ArgumentError, match="give --engine ray"):
        RunConfig(address="auto")
    evaluate(TaskRecipe(TASK), AgentRecipe("heuristic"), 1, out=tmp_path / "here", progress=False).close()
    with pytest.raises(ArgumentError, match="resume: address requires engine ray"):
        resume_run(tmp_path / "here", engine={"address": "auto"})
    with pytest.raises(ArgumentError, match="worker_gpus of at least 0"):
        RunConfig(engine="ray", worker_gpus=-1)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(DependencyError, match=r"wiw\[ray\]"):
        run_line(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_objects_that_cannot_be_sent_are_refused(ray, tmp_path):
    agent = LineAgent(0.5)
    agent.model = lambda: None
    with pytest.raises(InfrastructureError, match="cannot be sent to worker processes"):
        run_arms(LineTask(), {"none": agent}, 2, out=tmp_path / "run", progress=False, engine="ray")
