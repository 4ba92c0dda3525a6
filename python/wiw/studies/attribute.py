# SPDX-License-Identifier: Apache-2.0
"""Runs the failed episodes of a run again, each with one stage of the loop told the truth, and with all of them.

The episodes, keys, agents and limits are the run's own, so that what mends a failure is the swap and nothing else.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from wiw._core import core
from wiw.analysis.blame import FOLDER, SWAPS, Blame, blame, failed_episodes, swapped, swaps_of
from wiw.errors import ArgumentError
from wiw.runs.execute import recipes_of, require_own_sources, require_scenes, run_pending
from wiw.runs.platform import describe_platform
from wiw.runs.recipes import AgentRecipe
from wiw.runs.store import RunStore

_ORDER = 0x626C616D
"""Keeps the order in which failures are examined apart from all other draws."""


def attribute(
    run: str | Path,
    arms: str | Sequence[str] | None = None,
    episodes: int | None = None,
    workers: int | None = None,
    progress: bool = True,
    *,
    retry_failed: bool = False,
) -> Blame:
    """Finds out which stage the failures of a run are due to: imagination, scoring or proposals.

        found = wiw.attribute("runs/first", "warp")
        found.summary()
        found["warp"].verdicts      # {"imagination": 3, "scoring": 12, "proposals": 7, "joint": 1, "beyond": 0}

    Each failed episode is run again with the oracle world model, with plans scored by the truth, with a true plan
    among the proposals, and with all three (`wiw.experiments.ground_truth`). What is run is kept in `blame`; calling
    it again goes on where it was stopped, and runs nothing twice.

    Args:
        run: the run's folder.
        arms: one, several, or None for all.
        episodes: most failed episodes of each arm, drawn at random; a larger number contains a smaller one's. None
            means all.
        workers: processes; None means as many as the run was begun with. Results do not depend on it.
        progress: whether to show bars.
        retry_failed: whether to run swapped episodes again whose infrastructure failed.

    Raises:
        ArgumentError: an unknown arm, no failed episode, a number out of range, a task that does not say what success
            or progress is, or an agent that cannot do with what it is told, such as one without a reviser.
        StoreError: no readable run, one that was begun with objects in memory or by another version, or whose task,
            agents or navigation meshes have changed.
        FileError: a scene is not there.
    """
    for name, value in (("episodes", episodes), ("workers", workers)):
        if value is not None and value < 1:
            raise ArgumentError(f"attribute: expected {name} of at least 1, got {value}")
    with RunStore.read(run) as base:
        wanted = _wanted(base, arms, episodes)
        task, agents = _recipes(base, wanted)
        store = _store(base, agents)
        named = {swapped(arm, swap): indices for arm, indices in wanted.items() for swap in swaps_of(base, arm)}
        pending = {name: sorted({*store.pending(name, retry_failed)} & indices) for name, indices in named.items()}
        run_pending(store, task, agents, pending, workers or base.info["workers"], progress)
        found = blame(base)
        assert found is not None
        return Blame(found.run, tuple(line for line in found.arms if line.arm in wanted))


def _wanted(base: RunStore, arms: str | Sequence[str] | None, most: int | None) -> dict[str, set[int]]:
    """By arm the failed episodes that are to be examined."""
    known = [one["name"] for one in base.config["arms"]]
    names = known if arms is None else [arms] if isinstance(arms, str) else list(arms)
    if unknown := [name for name in names if name not in known]:
        raise ArgumentError(f"attribute: no arm '{unknown[0]}' in {base.path.parent}; it has {', '.join(known)}")
    failed = {arm: failed_episodes(base, arm) for arm in dict.fromkeys(names)}
    if not any(failed.values()):
        broken = sum(row["status"] == "failed" and row["arm"] in failed for row in base.outcomes())
        more = f"; {broken} failed for infrastructure, see `wiw resume --retry-failed`" if broken else ""
        raise ArgumentError(
            f"attribute: no episode of {', '.join(failed)} in {base.path.parent} was judged and failed{more}"
        )
    seed = base.config["seed"]
    return {arm: {*sorted(found, key=lambda episode: _draw(seed, episode))[:most]} for arm, found in failed.items()}


def _draw(seed: int, episode: int) -> int:
    return int(core.fold_key([seed, episode, _ORDER]))


def _recipes(base: RunStore, wanted: Mapping[str, set[int]]) -> tuple[Any, dict[str, AgentRecipe]]:
    """The run's task, and for every arm of it the agent with each swap.

    Raises:
        ArgumentError: the task does not say what progress is.
        StoreError: see `attribute`.
        FileError: a scene is not there.
    """
    base.require_version()
    task, agents = recipes_of(base)
    require_own_sources(base, task, agents)
    built, episodes = task.build(), base.episodes()
    base.require_task(built.describe())
    if not built.has_guide:
        raise ArgumentError(
            f"attribute: task '{base.config['task'].get('task')}' does not say what a plan is truly worth; derive it "
            "from wiw.tasks.navigation.NavigationTask, or write `guide` of its environment and set `has_guide`"
        )
    require_scenes(built, base, [episodes[index] for found in wanted.values() for index in found])
    return task, {
        swapped(arm, swap): _told(recipe, SWAPS[swap]) for arm, recipe in agents.items() for swap in swaps_of(base, arm)
    }


def _told(recipe: AgentRecipe, stages: tuple[str, ...]) -> AgentRecipe:
    """The agent with stages told the truth; a model that the oracle stands in for need not be made."""
    own = replace(recipe.with_model("oracle"), placebo=None) if "imagination" in stages else recipe
    return replace(own, ground_truth=stages)


def _store(base: RunStore, agents: Mapping[str, AgentRecipe]) -> RunStore:
    """The store of swapped episodes, begun or gone on with."""
    config = {
        "task": base.config["task"],
        "seed": base.config["seed"],
        "episodes": base.config["episodes"],
        "arms": [{"name": name, "agent": _given(recipe)} for name, recipe in agents.items()],
        "attributes": base.created,
    }
    folder = base.path.parent / FOLDER
    if RunStore.begun(folder):
        return RunStore.resume(folder, config)
    info = base.info
    info |= {
        "platform": describe_platform(),
        "agents": {name: recipe.to_json() for name, recipe in agents.items()},
        "limits": {name: value for name, value in info["limits"].items() if name not in ("fidelity", "lpips")},
        "command": sys.argv,
        "preparation_seconds": 0.0,
        "built": _expected(base),
    }
    return RunStore.create(folder, config, info, base.episodes())


def _given(recipe: AgentRecipe) -> dict[str, Any]:
    return {name: value for name, value in (recipe.to_json() or {}).items() if value not in (None, {})}


def _expected(base: RunStore) -> dict[str, Any]:
    """What swapped agents must say of themselves, so that one of other weights than the run's is refused."""
    return {
        swapped(arm, swap): {**agent, "ground_truth": list(SWAPS[swap])}
        for arm, agent in base.info.get("built", {}).items()
        for swap in ("scoring", "proposals")
    }
