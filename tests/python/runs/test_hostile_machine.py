# SPDX-License-Identifier: Apache-2.0
"""A machine that takes away processes, descriptors, time and caches changes no result."""

from __future__ import annotations

import math
import os
import re
import signal
import time
from collections import deque
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from crash_victims import Victims, build_faults, evaluate
from fakes import LineAgent, LineTask
from test_crash import facts

import wiw.errors
from wiw import scenes
from wiw.errors import ArgumentError, InfrastructureError
from wiw.runs import workers
from wiw.runs.limits import Limits
from wiw.runs.workers import Job, Silence, WorkerSpec, lease_again
from wiw.studies.evaluate import run_arms


@dataclass
class Mortal(LineAgent):
    """Its process is killed at every tenth episode, once."""

    markers: str = ""
    every: int = 10

    def _decide(self, query: Any) -> Any:
        marker = Path(self.markers, str(query.key.episode))
        if query.key.episode % self.every == self.every - 1 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._decide(query)


@dataclass
class Forking(LineAgent):
    """Its process is killed once, and leaves a child of its own that holds all that it had open."""

    def _decide(self, query: Any) -> Any:
        marker = Path(self.marker)
        if query.key.decision == 1 and not marker.exists():
            if (child := os.fork()) == 0:
                time.sleep(120)
                os._exit(0)
            marker.write_text(str(child))
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._decide(query)


@dataclass
class Leaving(LineAgent):
    """Its process is told to end at every decision, as by the machine's owner."""

    def _decide(self, query: Any) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)
        return super()._decide(query)


@dataclass
class Starting(LineAgent):
    """Starts processes: one that ends, and one that is left running, whose number it writes into a folder."""

    children: str = ""

    def _decide(self, query: Any) -> Any:
        context = get_context("fork")
        done, left = context.Process(target=int), context.Process(target=time.sleep, args=(120,))
        done.start()
        done.join()
        left.start()
        Path(self.children, str(left.pid)).touch()
        return super()._decide(query)


@pytest.fixture(scope="module")
def victims(tmp_path_factory: pytest.TempPathFactory) -> Any:
    server = Victims(build_faults(tmp_path_factory.mktemp("library")))
    yield server
    server.close()


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("reference") / "run"
    evaluate(out, episodes=3)
    return out


def test_a_worker_killed_every_ten_episodes_costs_no_result(tmp_path: Path) -> None:
    (tmp_path / "markers").mkdir()
    found = []
    for name, agent in (("quiet", LineAgent()), ("killed", Mortal(markers=str(tmp_path / "markers")))):
        workers = 1 if name == "quiet" else 2
        run_arms(LineTask(), {"a": agent}, 30, out=tmp_path / name, progress=False, workers=workers, salt="")
        found.append(facts(tmp_path / name)[:3])
    assert len(list((tmp_path / "markers").iterdir())) == 3
    assert found[0] == found[1]


def test_a_worker_that_hangs_is_replaced_and_costs_no_result(tmp_path: Path) -> None:
    """In code that has no deadline of its own; the others go on meanwhile."""
    agent = LineAgent(kill=(4,), hangs=True, marker=str(tmp_path / "marker"))
    found = []
    for name, own, options in (("quiet", LineAgent(), {}), ("hung", agent, {"workers": 2, "stall": 8.0})):
        run_arms(LineTask(), {"a": own}, 10, out=tmp_path / name, progress=False, salt="", **options)
        found.append(facts(tmp_path / name)[:3])
    assert (tmp_path / "marker").exists() and found[0] == found[1]


def test_a_worker_that_is_killed_and_leaves_a_child_is_replaced(tmp_path: Path) -> None:
    """The pipe to it does not end: the child has it, too."""
    agent = Forking(marker=str(tmp_path / "child"))
    try:
        log = run_arms(LineTask(), {"a": agent}, 6, out=tmp_path / "run", progress=False, workers=2, stall=8.0)
        assert {row["status"] for row in log.episodes} == {"done"} and len(log.episodes) == 6
    finally:
        os.kill(int((tmp_path / "child").read_text()), signal.SIGKILL)


def test_a_worker_that_is_told_to_end_is_named_by_the_signal(tmp_path: Path) -> None:
    log = run_arms(LineTask(), {"a": Leaving()}, 2, out=tmp_path / "run", progress=False, workers=2, live=1)
    assert all(re.search(r"died twice on this episode, last: SIGTERM", row["error"]) for row in log.episodes)


def test_only_episodes_that_were_live_are_charged_with_the_loss_of_a_worker() -> None:
    episodes, rows, discarded = dict(enumerate(LineTask().episodes(8))), list[Any](), list[Any]()
    receiver: Any = SimpleNamespace(write=rows.append, discard=lambda arm, lost: discarded.append((arm, lost)))
    unfinished = {index: episodes[index] for index in range(2, 8)}
    jobs = lease_again(Job("a", tuple(episodes.items())), unfinished, 4, receiver, 2, "lost")
    assert [([index for index, _ in job.episodes], job.attempt) for job in jobs] == [
        ([2], 1),
        ([3], 1),
        ([4], 1),
        ([5], 1),
        ([6, 7], 0),
    ]
    assert discarded == [("a", [2, 3, 4, 5, 6, 7])] and not rows
    assert lease_again(jobs[0], {2: episodes[2]}, 4, receiver, 2, "lost") == []
    assert [row.result.episode for row in rows] == [2]


def test_an_episode_that_began_once_survives_two_lost_workers(tmp_path: Path) -> None:
    """Each kills its worker once, and there are two in a job."""
    (tmp_path / "markers").mkdir()
    agent = Mortal(markers=str(tmp_path / "markers"), every=1)
    log = run_arms(LineTask(), {"a": agent}, 8, out=tmp_path / "run", progress=False, workers=2, salt="", live=1)
    assert len(list((tmp_path / "markers").iterdir())) == 8
    assert [row["status"] for row in log.episodes] == ["done"] * 8


def end_soon(pipe: Any, parent: int) -> None:
    """Stand in for a worker that dies while it imports."""
    time.sleep(1.5)
    os._exit(3)


def test_workers_start_at_the_same_time_and_a_dead_one_is_said_however_much_they_are_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A pipe takes 200 kB; the rest waits until the worker reads."""
    monkeypatch.setattr(workers, "_run_worker", end_soon)
    episodes = LineTask().episodes(20000)
    spec = WorkerSpec(None, {}, 0, "", 1, frozenset(), episodes=episodes)
    jobs = deque(Job("a", (item,)) for item in list(enumerate(episodes))[:2])
    pool = workers._WorkerPool(spec, jobs, SimpleNamespace(), 2)  # type: ignore[arg-type]
    assert len(pool._spec) > 1e6
    with pytest.raises(InfrastructureError, match=r"could not start \(exit code 3\).*if __name__ == '__main__'"):
        pool.run()
    assert len(pool._workers) == 1, "the other one had been started, too"
    pool.stop()


def test_agents_may_start_processes_in_workers_which_end_with_these(tmp_path: Path) -> None:
    """As those of a data loader."""
    (tmp_path / "children").mkdir()
    agent = Starting(children=str(tmp_path / "children"))
    log = run_arms(LineTask(), {"a": agent}, 4, out=tmp_path / "run", progress=False, workers=2, live=1)
    assert [row["error"] for row in log.episodes] == [""] * 4
    left = [int(each.name) for each in (tmp_path / "children").iterdir()]
    until = time.monotonic() + 20
    while any(is_running(each) for each in left) and time.monotonic() < until:
        time.sleep(0.05)
    assert len(left) >= 4 and not any(is_running(each) for each in left)


def is_running(process: int) -> bool:
    """Return whether a process is there, and no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_an_episode_that_hangs_every_worker_is_an_error(tmp_path: Path) -> None:
    agent = LineAgent(kill=(4,), hangs=True)
    log = run_arms(LineTask(), {"a": agent}, 6, out=tmp_path / "run", progress=False, workers=2, stall=8.0, live=1)
    assert len(log.episodes) == 6
    (error,) = [row for row in log.episodes if row["status"] == "error"]
    assert (error["episode"], error["kind"]) == (4, "worker")
    assert re.search(r"died twice on this episode, last: no news for \d+ s: .*--stall", error["error"])


def test_silence_is_what_was_waited_for_since_the_last_news() -> None:
    silence = Silence()
    for has_news, waited, seconds in ((False, 3, 3), (False, 3, 6), (True, 3, 0), (False, 2, 2)):
        silence.note(has_news, waited)
        assert silence.seconds == seconds
    assert [Limits(**given).patience for given in ({}, {"stall": 9.0}, {"deadline": 1.0}, {"deadline": 1e12})] == [
        7200,
        9,
        7200,
        math.inf,
    ]
    with pytest.raises(ArgumentError, match="expected a stall above 0"):
        Limits(stall=0.0)


def test_out_of_descriptors_a_run_ends_with_the_reason_and_goes_on_later(
    victims: Victims, reference: Path, tmp_path: Path
) -> None:
    ends = []
    for most in (5, 7, 9, 11, 13, 15, 17, 20, 64):
        out = tmp_path / str(most)
        code = victims.run("evaluate", out, episodes=3, limits={"RLIMIT_NOFILE": most})
        kind, _, reason = victims.said.partition(": ")
        typed = issubclass(getattr(wiw.errors, kind, int), wiw.errors.Error)
        assert code == 0 or typed or "Too many open files" in reason, victims.said
        ends.append(code)
        assert victims.run("evaluate", out, episodes=3) == 0, victims.said
        assert facts(out) == facts(reference)
    assert ends[0] != 0 and ends[-1] == 0


def test_a_clock_that_jumps_by_thirty_years_changes_no_result(
    victims: Victims, reference: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    assert victims.run("evaluate", out, episodes=3, jumps=True) == 0, victims.said
    assert facts(out) == facts(reference)


def test_a_scene_is_read_where_nothing_can_be_cached(
    tmp_path: Path, two_rooms: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    expected = scenes.load(two_rooms).describe()
    (tmp_path / "file").write_text("in the way of a folder")
    monkeypatch.setenv("WIW_CACHE", str(tmp_path / "file"))
    assert scenes.load(two_rooms).describe() == expected
