# SPDX-License-Identifier: Apache-2.0
"""Rerun some episodes of a run and compare every decision and measurement with the record.

Recorded answers of a language model are replayed. Timings are not compared, nor is LPIPS, whose last digits depend on
threads and device; the rollout cache is not used, as it would return what is to be checked.
"""

from __future__ import annotations

import hashlib
import json
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError, StoreError
from wiw.runs.execute import read_recipes, require_own_sources, require_scenes
from wiw.runs.limits import Limits
from wiw.runs.rows import AgentRow, DecisionRow, LostRow, OutcomeRow, RestartRow, to_json
from wiw.runs.run import Run, find_folder
from wiw.runs.store import DECISION_JSON, RunStore
from wiw.runs.workers import Job, Runner, WorkerSpec

UNLIKE = ("seconds", "calls", "spent", "arm", "episode", "decision")
"""Columns of a decision that are not compared: timings, what depends on retries and caches, and the row's own name."""


@dataclass(frozen=True)
class Check:
    """One episode of one arm, recorded and rerun."""

    arm: str
    episode: int
    recorded: str
    """SHA-256 of everything that was decided and measured, in hexadecimal."""
    again: str
    difference: str
    """The first difference, e.g. "decision 3: scores: recorded [0.25,0.5], now [0.25,0.75]"; empty if there is none."""

    @property
    def same(self) -> bool:
        """Whether both are equal."""
        return self.recorded == self.again


@dataclass(frozen=True)
class Verification:
    """The result of `wiw.verify`; prints as one line per episode."""

    run: Path
    checks: tuple[Check, ...]

    @property
    def same(self) -> bool:
        """Whether every episode is as recorded."""
        return all(check.same for check in self.checks)

    def __str__(self) -> str:
        lines = [
            f"{check.arm} episode {check.episode}: "
            + (f"same, {check.again[:16]}" if check.same else f"DIFFERS at {check.difference}")
            for check in self.checks
        ]
        wrong = sum(not check.same for check in self.checks)
        verdict = (
            "everything is as recorded" if not wrong else f"{wrong} of {len(self.checks)} differ from what was recorded"
        )
        return "\n".join([*lines, f"{self.run}: {verdict}"])


Facts = list[tuple[str, dict[str, Any]]]
"""(place, values) of an episode in order: "agent", "decision 0", ..., "outcome"."""


def verify(run: str | Path | Run, episodes: int = 3, seed: int = 0) -> Verification:
    """Rerun `episodes` random episodes of a run, in every arm that has finished them, and compare.

    Args:
        run: a run, or its folder.
        episodes: how many; all if the run has fewer.
        seed: seed of the sample of episodes.

    Raises:
        ArgumentError: fewer than one episode.
        StoreError: the run cannot be read, is of another version of the benchmark, was started with objects in memory,
            has no finished episode, or its task, scenes or source files have changed.
        FileError: a scene does not exist.
    """
    if episodes < 1:
        raise ArgumentError(f"verify: expected episodes of at least 1, got {episodes}")
    with RunStore.read(find_folder(run)) as store:
        store.require_benchmark()
        ended = {(row["arm"], row["episode"]): row for row in store.recorded_outcomes() if row["status"] == "done"}
        if not ended:
            raise StoreError(f"{store.path} has no finished episode to rerun; see `wiw resume`")
        known = sorted({index for _, index in ended})
        chosen = sorted(random.Random(seed).sample(known, min(episodes, len(known))))
        again = _run_again(store, {key for key in ended if key[1] in chosen})
        arms = [arm["name"] for arm in store.config["arms"]]
        keys = [(arm, index) for index in chosen for arm in arms if (arm, index) in ended]
        return Verification(
            store.path.parent, tuple(_check(key, read_facts(store, ended[key]), again[key]) for key in keys)
        )


def _run_again(store: RunStore, keys: set[tuple[str, int]]) -> dict[tuple[str, int], Facts]:
    task, agents = read_recipes(store)
    require_own_sources(store, task, agents)
    built, info, all_episodes = task.build(), store.info, store.episodes()
    store.require_task(built.describe())
    require_scenes(built, store, [all_episodes[index] for _, index in keys])
    recorded = Limits(**info.get("limits", {}))
    limits = {**recorded.to_json(), "cache": "off", "lpips": None, "fidelity": recorded.measures_fidelity}
    agents = {arm: recipe.replaying(store.path) for arm, recipe in agents.items()}
    pictures = frozenset(info["pictures"])
    spec = WorkerSpec(task, agents, store.config["seed"], store.salt, info["live"], pictures, limits, all_episodes)
    runner, found = Runner(spec), dict[tuple[str, int], Facts]()
    for arm in agents:
        indices = sorted(index for name, index in keys if name == arm)
        if indices:
            collected = _Collected()
            runner.run(Job(arm, tuple((index, all_episodes[index]) for index in indices)), collected)
            found |= {(arm, index): collected.list_facts(index) for index in indices}
    return found


class _Collected:
    """Collects rows in memory instead of a run store."""

    def __init__(self) -> None:
        self._agent: Facts = []
        self._episodes: dict[int, Facts] = {}

    def __call__(self, row: AgentRow | RestartRow | DecisionRow | LostRow | OutcomeRow) -> None:
        if isinstance(row, AgentRow):
            self._agent = [("agent", json.loads(to_json(row.agent)))]
        elif isinstance(row, RestartRow):
            for index in row.episodes:
                self._episodes.pop(index, None)
        elif isinstance(row, DecisionRow):
            values = {
                name: json.loads(value) if name in DECISION_JSON and value is not None else value
                for name, value in row.values.items()
            }
            self._get_facts(row.episode).append(_describe_decision(row.decision, values, row.images))
        elif isinstance(row, OutcomeRow):
            self._get_facts(row.result.episode).append(
                _describe_outcome(row.result.status, row.result.metrics, row.result.error)
            )

    def list_facts(self, index: int) -> Facts:
        return [*self._agent, *self._get_facts(index)]

    def _get_facts(self, index: int) -> Facts:
        return self._episodes.setdefault(index, [])


def read_facts(store: RunStore, outcome: Mapping[str, Any]) -> Facts:
    """Return what was decided and measured in a finished episode, given its row of `recorded_outcomes`."""
    arm, index = outcome["arm"], outcome["episode"]
    decisions = [
        _describe_decision(row["decision"], row, store.images(arm, index, row["decision"]))
        for row in store.decisions(arm, index)
    ]
    agent = [("agent", store.info["built"][arm])] if arm in store.info.get("built", {}) else []
    return [*agent, *decisions, _describe_outcome(outcome["status"], outcome["metrics"], outcome["error"])]


def _describe_decision(
    number: int, values: Mapping[str, Any], images: Mapping[str, bytes]
) -> tuple[str, dict[str, Any]]:
    facts = {name: value for name, value in values.items() if name not in UNLIKE}
    if facts["fidelity"] is not None:
        facts["fidelity"] = {name: value for name, value in facts["fidelity"].items() if name != "lpips"}
    facts["calls"] = {name: values["calls"].get(name) for name in ("rows", "frames")}
    seen = {f"picture {name}": _digest(jpeg) for name, jpeg in images.items() if not name.startswith("true/")}
    return f"decision {number}", json.loads(to_json({**facts, **seen}))


def _describe_outcome(status: str, metrics: Mapping[str, float], error: str) -> tuple[str, dict[str, Any]]:
    last = (error.strip().splitlines() or [""])[-1]
    return "outcome", json.loads(to_json({"status": status, **metrics, "error": last}))


def _check(key: tuple[str, int], recorded: Facts, again: Facts) -> Check:
    was, now = (_digest(json.dumps(facts, sort_keys=True).encode()) for facts in (recorded, again))
    return Check(*key, was, now, next(list_differences(recorded, again), ""))


def list_differences(recorded: Sequence[tuple[str, Any]], again: Sequence[tuple[str, Any]]) -> Iterator[str]:
    """Yield in words what differs between two records of an episode, in order."""
    for (place, was), (place_now, now) in zip(recorded, again, strict=False):
        if place != place_now:
            yield f"{place}: now {place_now}, {now.get('error') or 'another number of decisions'}"
            return
        for name in dict.fromkeys([*was, *now]):
            if was.get(name) != now.get(name):
                yield f"{place}: {name}: recorded {_shorten(was.get(name))}, now {_shorten(now.get(name))}"
    if len(recorded) != len(again):
        yield f"the end: recorded {len(recorded)} facts, now {len(again)}"


def _shorten(value: Any, most: int = 200) -> str:
    if isinstance(value, float) and math.isfinite(value):
        return repr(value)
    text = to_json(value)
    return text if len(text) <= most else text[: most - 1] + "…"


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
