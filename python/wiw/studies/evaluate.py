# SPDX-License-Identifier: Apache-2.0
"""Runs an agent, or several that differ in one thing, on the same episodes and records everything."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from wiw.errors import ArgumentError, Error, StoreError
from wiw.metrics import Lpips
from wiw.runs.execute import recipes_of, require_left, require_own_sources, run_pending, sources_of
from wiw.runs.pictures import pool_episodes
from wiw.runs.platform import describe_platform
from wiw.runs.recipes import agent_recipe, arm_recipes, task_recipe
from wiw.runs.store import RunStore, removed_if_empty
from wiw.studies.run_log import RunLog
from wiw.types import checked_seed


def evaluate(
    env_or_task: Any,
    agent: Any,
    episodes: int | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    workers: int = 1,
    progress: bool = True,
    arms: Sequence[Any] | Mapping[str, Any] | None = None,
    *,
    live: int = 4,
    keep_images: int | Literal["all"] = 2,
    resume: bool = False,
    deadline: float | None = None,
    cache: str | Path | None = None,
    cache_gb: float | None = None,
    fidelity: bool = False,
    lpips: str | Path | None = None,
    **task_options: Any,
) -> RunLog:
    """Runs an agent on the first `episodes` episodes of a task.

        log = wiw.evaluate(env, agent, episodes=20)
        log = wiw.evaluate(env, agent, episodes=20, arms=["none", "copy", "warp", "oracle"])
        log = wiw.evaluate(env, agent, episodes=20, arms={"none": "none", "mine": MyModel(), "oracle": "oracle"})
        log = wiw.evaluate("imagenav", agent, episodes=20, scenes="apartments:val", preset="official")

    All randomness is keyed by (seed, episode, decision, candidate): neither `workers` nor `live` changes a result.

    Args:
        env_or_task: an environment from `wiw.make`, its task, a `TaskRecipe`, or a task's name.
        agent: a `wiw.Agent` or an `AgentRecipe`.
        episodes: how many; None means as many as the task says: all of an episode file, else 20.
        seed: of the run; None means the task's own.
        out: folder of the run; None means `runs/<task>-<time>`.
        workers: processes; more than one needs a task and an agent that can be pickled, or recipes.
        progress: whether to show bars.
        arms: world models to run on the same episodes with this agent's policies, by name, class or instance, or
            "policy+model" for one with another built-in policy, such as "heuristic+none"; "placebo-shuffled" and
            "placebo-swapped" are placebos of the agent's model (else of warp), "placebo-shuffled:oracle" of another. A
            mapping gives the arms names of their own. None means the agent's own model.
        live: episodes kept live at a time in each process, so that model calls are batched.
        keep_images: how many episodes keep pictures for report and view, spread evenly but for one in which a model
            succeeds and the floor fails; "all" for every one. Where a task has several kinds, at least one of each,
            unless it is 0.
        resume: whether to go on with the run in `out` where it was stopped.
        deadline: seconds that a call of a world model may take before it counts as failed; None means the agent's own,
            300 unless it was given another.
        cache: where rollouts are kept and found: a folder, "off", or "auto" (those of models that declare themselves
            `cacheable`, in `~/.cache/wiw/rollouts`); None means the agent's own, "auto" unless it was given another.
        cache_gb: most gigabytes of that folder.
        fidelity: whether every imagined plan is also replayed in the simulator, to tell how true imagination was; see
            `RunLog.fidelity`. Changes no decision and no cost that is reported, but takes about as long as `oracle`.
        lpips: folder of the weights of LPIPS, or "auto" (`~/.cache/wiw/weights`): measures fidelity by it as well.
        task_options: options of a task given by name, such as `scenes` and `preset`.

    Raises:
        ArgumentError: options for a task that is already made; a number out of range.
        StoreError: `out` holds a run and `resume` is off, or a run of another configuration, or of source files that
            have changed since.
        ContractError: a policy or a world model broke its contract.
        InfrastructureError: worker processes cannot be started or given their work.
        WeightsError: those of LPIPS are not there; says which, and how to get them.
    """
    limits = _Limits(deadline, cache, cache_gb, fidelity, lpips)
    task = task_recipe(env_or_task, task_options)
    options = _Options(_count(task, episodes), seed, out, workers, progress, live, keep_images, resume, limits)
    return _run(task, arm_recipes(agent, arms), options)


def run_arms(
    env_or_task: Any,
    agents: Mapping[str, Any],
    episodes: int | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    workers: int = 1,
    progress: bool = True,
    *,
    live: int = 4,
    keep_images: int | Literal["all"] = 2,
    resume: bool = False,
    deadline: float | None = None,
    cache: str | Path | None = None,
    cache_gb: float | None = None,
    fidelity: bool = False,
    lpips: str | Path | None = None,
) -> RunLog:
    """Runs several named agents on the same episodes; see `evaluate` for the rest."""
    limits = _Limits(deadline, cache, cache_gb, fidelity, lpips)
    task = task_recipe(env_or_task)
    options = _Options(_count(task, episodes), seed, out, workers, progress, live, keep_images, resume, limits)
    return _run(task, {name: agent_recipe(agent) for name, agent in agents.items()}, options)


def resume_run(
    run: str | Path, workers: int | None = None, progress: bool = True, retry_errors: bool = False
) -> RunLog:
    """Goes on with a run of named parts: only episodes that have not ended are run.

    Args:
        run: the run's folder.
        workers: processes; None means as many as it was begun with.
        progress: whether to show bars.
        retry_errors: whether to rerun episodes that ended with an infrastructure error.

    Raises:
        ArgumentError: fewer than one worker.
        StoreError: see `RunStore.resume`; also when the run was begun with objects that exist only in memory, or when
            its preset's file or the source file of a model, policy or task of the user's own has changed, or the
            navigation mesh beside a scene has come or gone.
        FileError: the scene of an episode that is left is not there; nothing is recorded.
    """
    if workers is not None:
        _at_least("workers", workers, 1)
    store = RunStore.resume(run)
    try:
        if "attributes" in store.config:
            own, whole = store.path.parent, store.path.parent.parent
            raise StoreError(f"{own} is what `wiw blame` keeps of {whole}; go on with it by `wiw blame {whole}`")
        task, agents = recipes_of(store)
        require_own_sources(store, task, agents)
        built = task.build()
        store.require_task(built.describe())
    except Error:
        store.close()
        raise
    require_left(built, store, agents, retry_errors)
    return _finish(store, task, agents, workers or store.info["workers"], progress, retry_errors=retry_errors)


FOR_EVER = 1e12
"""Seconds that stand for no deadline where a number has to be written down."""


@dataclass(frozen=True)
class _Limits:
    """What every agent of a run is built with beyond its own recipe; none of it changes what an agent decides."""

    deadline: float | None
    cache: str | Path | None
    cache_gb: float | None
    fidelity: bool
    lpips: str | Path | None

    def __post_init__(self) -> None:
        if self.deadline is not None and not self.deadline > 0:
            raise ArgumentError(f"evaluate: expected a deadline above 0 s, got {self.deadline}")
        if self.cache_gb is not None and not self.cache_gb > 0:
            raise ArgumentError(f"evaluate: expected a cache_gb above 0, got {self.cache_gb}")
        if self.lpips is not None:
            Lpips(self.lpips)  # what is missing is told before anything is run

    def as_dict(self) -> dict[str, Any]:
        """Options of `wiw.Agent`; those that are None are left to it."""
        deadline = None if self.deadline is None else min(self.deadline, FOR_EVER)
        limits = {
            "deadline": deadline,
            "cache": _anywhere(self.cache, "auto", "off"),
            "cache_gb": self.cache_gb,
            "fidelity": self.fidelity or self.lpips is not None or None,
            "lpips": _anywhere(self.lpips, "auto"),
        }
        return {name: value for name, value in limits.items() if value is not None}


def _anywhere(folder: str | Path | None, *names: str) -> str | None:
    """A folder so that it means the same anywhere; None and `names`, which stand for something else, as they are."""
    if folder is None or str(folder) in names:
        return None if folder is None else str(folder)
    return str(Path(folder).expanduser().resolve())


@dataclass(frozen=True)
class _Options:
    """What `evaluate` and `run_arms` have in common."""

    episodes: int
    seed: int | None
    out: str | Path | None
    workers: int
    progress: bool
    live: int
    keep_images: int | Literal["all"]
    resume: bool
    limits: _Limits

    def __post_init__(self) -> None:
        for name, least in (("episodes", 1), ("workers", 1), ("live", 1)):
            _at_least(name, getattr(self, name), least)
        _at_least("keep_images", self.pictures, 0)
        if self.seed is not None:
            checked_seed(self.seed)

    @property
    def pictures(self) -> int:
        """How many episodes keep pictures."""
        return self.episodes if self.keep_images == "all" else self.keep_images


def _count(task: Any, episodes: int | None) -> int:
    """Return how many episodes to run."""
    return int(task.build().default_episodes) if episodes is None else episodes


def _at_least(name: str, value: int, least: int) -> None:
    if value < least:
        raise ArgumentError(f"evaluate: expected {name} of at least {least}, got {value}")


def _run(task: Any, agents: Mapping[str, Any], options: _Options) -> RunLog:
    built = task.build()
    seed = built.seed if options.seed is None else options.seed
    config = {
        "task": built.describe(),
        "seed": seed,
        "episodes": options.episodes,
        "arms": [{"name": arm, "agent": recipe.describe()} for arm, recipe in agents.items()],
    }
    for recipe in agents.values():
        recipe.require(config["task"])
    if options.resume and options.out is not None and RunStore.exists(options.out):
        store = RunStore.resume(options.out, config)
        require_left(built, store, agents)
        require_own_sources(store, task, agents)
    else:
        started = time.perf_counter()
        episodes = built.episodes(options.episodes)
        used = built.require(episodes)
        folder = options.out or Path("runs") / f"{built.name}-{datetime.now():%Y%m%d-%H%M%S}"
        info = {
            "platform": describe_platform(),
            "task": task.to_json(),
            "agents": {arm: recipe.to_json() for arm, recipe in agents.items()},
            "sources": sources_of(task, agents),
            "pictures": pool_episodes(episodes, options.pictures),
            "keep_images": options.pictures,
            "scenes": used,
            "stage": built.stage,
            "wording": asdict(built.wording),
            "live": options.live,
            "workers": options.workers,
            "limits": options.limits.as_dict(),
            "command": sys.argv,
            "preparation_seconds": time.perf_counter() - started,
        }
        store = RunStore.create(folder, config, info, episodes)
        with removed_if_empty(store.path):
            return _finish(store, task, agents, options.workers, options.progress)
    return _finish(store, task, agents, options.workers, options.progress)


def _finish(
    store: RunStore,
    task: Any,
    agents: Mapping[str, Any],
    workers: int,
    progress: bool,
    *,
    retry_errors: bool = False,
) -> RunLog:
    """Runs what is missing, closes the store and opens it for reading."""
    pending = {arm: store.pending(arm, retry_errors) for arm in agents}
    run_pending(store, task, agents, pending, workers, progress)
    return RunLog(RunStore.read(store.path))
