# SPDX-License-Identifier: Apache-2.0
"""Run an agent, or several variants of it, on the same episodes, and record everything."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from wiw.analysis.stopping import StopRule, parse_stop_rule
from wiw.errors import ArgumentError, ContractError, Error, StoreError
from wiw.loop import keys
from wiw.metrics import Lpips
from wiw.runs.config import EngineConfig, ResumeConfig, RunConfig, name_folder, read_resume_settings, take_settings
from wiw.runs.departures import describe_departures
from wiw.runs.execute import read_recipes, require_left, run_pending, sources_of, update_own_sources
from wiw.runs.limits import Limits
from wiw.runs.pictures import pool_episodes
from wiw.runs.platform import describe_platform
from wiw.runs.recipes import (
    AgentRecipe,
    TaskInMemory,
    TaskRecipe,
    agent_recipe,
    arm_recipes,
    require_semantics_use,
    task_recipe,
)
from wiw.runs.servers import require_servable
from wiw.runs.shards import Shard
from wiw.runs.store import RunStore, leave_resumable
from wiw.studies.run_log import RunLog
from wiw.suggestions import did_you_mean
from wiw.types import Episode


def evaluate(
    env_or_task: Any,
    agent: Any,
    episodes: int | None = None,
    *,
    arms: Sequence[Any] | Mapping[str, Any] | None = None,
    more_arms: bool = False,
    config: RunConfig | None = None,
    **settings: Any,
) -> RunLog:
    """Run an agent on the first `episodes` episodes of a task.

        log = wiw.evaluate(env, agent, episodes=20)
        log = wiw.evaluate(env, agent, episodes=20, arms=["none", "copy", "warp", "oracle"])
        log = wiw.evaluate(env, agent, episodes=20, arms={"none": "none", "mine": MyModel(), "oracle": "oracle"})
        log = wiw.evaluate("imagenav", agent, episodes=20, scenes="apartments:val", preset="official", workers=2)

    Args:
        env_or_task: an environment from `wiw.make`, its task, a `TaskRecipe`, or a task's name.
        agent: a `wiw.Agent` or an `AgentRecipe`.
        episodes: number of episodes; None means the task's default.
        arms: world models to run on the same episodes with this agent's policies, by name, class or instance, or
            "policy+model" for one with another built-in policy, such as "heuristic+none"; "placebo-shuffled" and
            "placebo-swapped" are placebos of the agent's model (or else of warp), "placebo-blind" is one of a text
            model, "placebo-shuffled:oracle" one of another model. "small=warpnet?weights=small.npz" names an arm and
            sets options of its model, as on the command line; with a mapping, the keys are the arms' names, and else an
            arm is named as it is written, a path by its class, and a class or instance by its class in lower case. None
            means the agent's own model.
        more_arms: with `resume`, whether to add arms that the run lacks; the existing ones must be unchanged.
        config: settings of the run.
        settings: settings of `RunConfig` that override the config's, such as seed, out, workers, keep_images, resume,
            deadline, cache and fidelity; and options of a task given by name, such as `scenes` and `preset`.

    Raises:
        ArgumentError: options for a task that already exists; a number out of range.
        StoreError: `out` holds a run and `resume` is off, or a run with a different configuration or with source files
            that have changed since; or arms are to be added to a run that a rule stops early.
        ContractError: a policy or a world model broke its contract.
        InfrastructureError: worker processes cannot be started or given their work.
        WeightsError: those of LPIPS are missing; says which, and how to get them.
    """
    own, task_options = take_settings(config, settings, episodes)
    if own.servers and own.served is None:
        own = replace(own, served=_find_model_name(agent))
    return _run(_find_task(env_or_task, task_options, own), arm_recipes(agent, arms), own, more_arms)


def run_arms(
    env_or_task: Any,
    agents: Mapping[str, Any],
    episodes: int | None = None,
    *,
    more_arms: bool = False,
    config: RunConfig | None = None,
    **settings: Any,
) -> RunLog:
    """Run several named agents on the same episodes; see `evaluate` for the rest."""
    own, task_options = take_settings(config, settings, episodes)
    recipes = {name: agent_recipe(agent) for name, agent in agents.items()}
    return _run(_find_task(env_or_task, task_options, own), recipes, own, more_arms)


def _find_model_name(agent: Any) -> str | None:
    """Return the name of an agent's world model; None if it has none, or if it is an object."""
    recipe = agent_recipe(agent)
    return recipe.model if isinstance(recipe, AgentRecipe) and isinstance(recipe.model, str) else None


def _find_task(env_or_task: Any, options: dict[str, Any], settings: RunConfig) -> TaskRecipe | TaskInMemory:
    """Return the task; one by name takes its episodes from the run's seed, as on the command line."""
    if isinstance(env_or_task, str) and settings.seed is not None:
        options = {"seed": settings.seed, **options}
    with _hint_at_settings(options):
        return task_recipe(env_or_task, options)


@contextmanager
def _hint_at_settings(options: Iterable[str]) -> Iterator[None]:
    """Add to an error about an option of the task which setting of the run may be meant, where it is like one."""
    try:
        yield
    except ArgumentError as error:
        names = [field.name for field in fields(RunConfig)]
        hints = [did_you_mean(name, names) for name in options if name in str(error).partition(";")[0]]
        if not any(hints):
            raise
        end, hint = "" if str(error).endswith((".", "?")) else ".", next(filter(None, hints)).removesuffix("?")
        raise ArgumentError(f"{error}{end} As a setting of the run:{hint}?") from None


def resume_run(
    run: str | Path,
    workers: int | None = None,
    progress: bool = True,
    retry_errors: bool = False,
    scratch: str | Path | None = None,
    engine: Mapping[str, Any] | None = None,
    **settings: Any,
) -> RunLog:
    """Resume a run whose parts are given by name: only episodes that have not finished are run.

    Args:
        run: the run's folder.
        workers: number of processes; None means as many as before.
        progress: whether to show bars.
        retry_errors: whether to rerun episodes that ended with an infrastructure error.
        scratch: folder on a local disk in which the store is written; see `RunConfig`.
        engine: values of `EngineConfig` that replace the run's, such as {"engine": "processes"}.
        settings: settings of `ResumeConfig` (live, deadline, cache, cache_gb) that replace the run's from now on.

    Raises:
        ArgumentError: a number out of range, a setting that is fixed once a run has started, or an address without Ray.
        StoreError: see `RunStore.resume`; also if the run was started with objects that exist only in memory, if its
            preset's file or the source file of the user's own model, policy or task has changed, or if a navigation
            mesh next to a scene was added or removed.
        FileError: the scene of a remaining episode does not exist; nothing is recorded.
    """
    if workers is not None:
        RunConfig(workers=workers)  # its numbers are checked there
    given = {} if engine is None else engine
    changes = read_resume_settings(settings).to_json()
    store = RunStore.resume(run, scratch=scratch)
    try:
        place = EngineConfig(**{**store.info.get("engine", {}), **given})
        if place.engine != "ray" and given.get("address") is not None:
            raise ArgumentError("resume: address requires engine ray: give --engine ray (engine=) as well")
        if place.engine != "ray":  # each worker has its own model then
            place = EngineConfig(engine=place.engine)
        if "attributes" in store.config:
            own, whole = store.path.parent, store.path.parent.parent
            raise StoreError(f"{own} holds the reruns of `wiw blame {whole}`; resume them with that command")
        task, agents = read_recipes(store)
        update_own_sources(store, task, agents)
        built = task.build()
        store.require_task(built.describe())
    except Error:
        store.close()
        raise
    require_left(built, store, agents, retry_errors)
    store.change_settings(changes)
    workers = workers or store.info["workers"]
    return _finish(store, task, agents, workers, progress, place, retry_errors=retry_errors)


def _run(task: Any, agents: Mapping[str, Any], settings: RunConfig, more_arms: bool) -> RunLog:
    require_servable(agents, settings.place)
    require_semantics_use(agents)
    if settings.lpips is not None:
        Lpips(settings.lpips)  # report missing weights before anything is run
    with _hint_at_settings(task.options if isinstance(task, TaskRecipe) else ()):
        built = task.build()
    seed = built.seed if settings.seed is None else settings.seed
    count = built.default_episodes if settings.episodes is None else settings.episodes
    config = {
        "task": built.describe(),
        "seed": seed,
        "episodes": count,
        "arms": [{"name": arm, "agent": recipe.describe()} for arm, recipe in agents.items()],
    }
    looks = _make_looks(settings.looks, list(agents))
    for recipe in agents.values():
        recipe.require(built, count)
    if settings.shard is not None:
        Shard.parse(settings.shard).select(count)
    if settings.resume and settings.out is not None and RunStore.exists(settings.out):
        store = RunStore.resume(settings.out, config, settings.scratch, more_arms)
        begun_with = [arm["name"] for arm in store.config["arms"]]
        require_left(built, store, agents)
        update_own_sources(store, task, {arm: agents[arm] for arm in begun_with})
        _apply_settings(store, settings)
        if len(agents) > len(begun_with):
            _add_arms(store, config, _describe_agents(task, agents, built, count))
    else:
        started, salt = time.perf_counter(), _choose_salt(settings)
        episodes, pictured = _list_episodes(built, count), settings.count_pictured(count)
        used = built.require(episodes)
        folder = settings.out or name_folder(built.name)
        info = {
            "platform": describe_platform(),
            "task": task.to_json(),
            **_describe_agents(task, agents, built, count),
            "pictures": _pool_pictures(episodes, looks, pictured),
            "keep_images": pictured,
            "pictured": pictured,
            "scenes": used,
            "stage": built.stage,
            "wording": asdict(built.wording),
            "tables": asdict(built.tables),
            **({} if settings.shard is None else {"shard": settings.shard}),
            **({} if settings.looks is None else {"until": settings.looks}),
            "salt": salt,
            "live": settings.live,
            "workers": settings.workers,
            "engine": asdict(settings.place),
            "limits": settings.to_json(),
            "command": sys.argv,
            "preparation_seconds": time.perf_counter() - started,
        }
        store = RunStore.create(folder, config, info, episodes, settings.scratch)
        with leave_resumable(store):
            return _finish(store, task, agents, settings.workers, settings.progress, settings.place)
    return _finish(store, task, agents, settings.workers, settings.progress, settings.place)


def _pool_pictures(episodes: Sequence[Episode], looks: StopRule | None, count: int) -> list[int]:
    """Return the episodes that keep pictures while the run goes on; with looks, of those before the first if any."""
    certain = episodes if looks is None or count >= len(episodes) else episodes[: looks.every]
    return pool_episodes(certain, count)


def _choose_salt(settings: RunConfig) -> str:
    """Return the salt of a new run: the given one, or a random one.

    Raises:
        ArgumentError: none is given for a shard, although all shards of a run must share one.
    """
    if settings.salt is None and settings.shard is not None:
        raise ArgumentError(
            f"evaluate: shard {settings.shard} without a salt, which all shards of a run must share; give each of "
            f"them, say, --salt {keys.draw_salt()} (salt=)"
        )
    return keys.draw_salt() if settings.salt is None else settings.salt


def _describe_agents(task: Any, agents: Mapping[str, Any], built: Any, count: int) -> dict[str, Any]:
    """Return what a run store keeps about all arms."""
    return {
        "agents": {arm: recipe.to_json() for arm, recipe in agents.items()},
        "sources": sources_of(task, agents),
        "departures": describe_departures(built, agents, count),
    }


def _add_arms(store: RunStore, config: dict[str, Any], info: Mapping[str, Any]) -> None:
    """Add the arms that a resumed run lacks; close the store if they must not be added.

    Raises:
        StoreError: a rule may stop the run early based on its arms, and has not seen these.
    """
    if "until" in store.info:
        store.close()
        raise StoreError(
            f"{store.path}: a run that a rule may stop early (--until) keeps the arms that it was started with; run "
            "the new ones in another folder"
        )
    store.add_arms(config, info)


def _apply_settings(store: RunStore, settings: RunConfig) -> None:
    """Let a resumed run continue with these settings; close the store if that would change what is measured.

    Raises:
        StoreError: fidelity was measured differently so far, other episodes keep pictures, or shard or salt differ.
    """
    begun_with, now = Limits(**store.info["limits"]).to_json(), settings.to_json()
    begun_with["shard"], now["shard"] = store.info.get("shard"), settings.shard
    begun_with["until"], now["until"] = store.info.get("until"), settings.looks
    begun_with["keep_images"] = now["keep_images"] = store.info.get("pictured")
    if settings.keep_images != RunConfig.keep_images and begun_with["keep_images"] is not None:
        now["keep_images"] = settings.count_pictured(store.config["episodes"])  # pictures cannot be added later
    try:
        begun_with["salt"], now["salt"] = store.salt, store.salt if settings.salt is None else settings.salt
        names = ("fidelity", "fidelity_share", "lpips", "shard", "until", "salt", "keep_images")
        store.require_same(*({name: each[name] for name in names} for each in (begun_with, now)))
    except StoreError:
        store.close()
        raise
    changeable = [field.name for field in fields(ResumeConfig)]
    store.change_settings(ResumeConfig(**{name: getattr(settings, name) for name in changeable}).to_json())


def _finish(
    store: RunStore,
    task: Any,
    agents: Mapping[str, Any],
    workers: int,
    progress: bool,
    place: EngineConfig,
    *,
    retry_errors: bool = False,
) -> RunLog:
    """Run what is missing, close the store and open it for reading."""
    pending = {arm: store.pending(arm, retry_errors) for arm in agents}
    home, info = store.home, store.info
    looks = None if "stopped" in info else _make_looks(info.get("until"), list(agents))
    run_pending(store, task, agents, pending, workers, progress, place, looks)
    return RunLog(RunStore.read(home))


def _list_episodes(task: Any, count: int) -> list[Episode]:
    """Return a task's first `count` episodes.

    Raises:
        ContractError: the task returns another number of them, or something else.
    """
    found = list(task.episodes(count))
    if len(found) != count or not all(isinstance(each, Episode) for each in found):
        kinds = "".join(f", {kind}" for kind in sorted({type(each).__name__ for each in found}))
        name = f"{type(task).__name__}.episodes"
        raise ContractError(f"{name}: expected {count} episodes (wiw.types.Episode), got {len(found)}{kinds}")
    return found


def _make_looks(until: Mapping[str, Any] | None, arms: Sequence[str]) -> StopRule | None:
    """Return the rule that may stop a run early, from its description in the run store.

    Raises:
        ArgumentError: the rule is not understood.
    """
    return None if until is None else parse_stop_rule(until["rule"], arms, until["every"])
