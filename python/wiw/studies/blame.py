# SPDX-License-Identifier: Apache-2.0
"""Rerun the failures of a run with ground truth in one stage at a time, and in several.

Episodes, keys, agents and limits are the run's own, so that a rerun differs only by its ground truth.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from wiw._core import core
from wiw.analysis.blame import FOLDER, Blame, list_failures, list_reruns, name_rerun, read_blame
from wiw.analysis.blame_schemes import Scheme, choose_scheme
from wiw.errors import ArgumentError
from wiw.experiments.counterparts import find_counterpart
from wiw.registry import WORLD_MODELS
from wiw.runs.execute import read_recipes, require_own_sources, require_scenes, run_pending
from wiw.runs.platform import describe_platform
from wiw.runs.recipes import AgentRecipe
from wiw.runs.run import Run, find_folder
from wiw.runs.store import RunStore

_ORDER = 0x626C616D
"""Separates the order in which failures are rerun from all other random numbers."""


def blame(
    run: str | Path | Run,
    arms: str | Sequence[str] | None = None,
    episodes: int | None = None,
    workers: int | None = None,
    progress: bool = True,
    *,
    retry_errors: bool = False,
    reviser_options: Mapping[str, Any] | None = None,
    tracker: str | None = None,
    tracker_options: Mapping[str, Any] | None = None,
) -> Blame:
    """Find the stage that causes the failures of a run: imagination, scoring, proposals; perception, exploration.

        found = wiw.blame("runs/first", "warp")
        found.summary()
        found["warp"].verdicts      # {"imagination": 3, "scoring": 12, "proposals": 7, "joint": 1, "beyond": 0}

    Each failure is rerun with the oracle world model, with ground-truth scores, with a ground-truth plan among the
    proposals, and with all three (`wiw.experiments.ground_truth`). For question answering with policy `explorer`, the
    stages after imagination are different: true labels and colours for real views, a tour of the whole home, and both
    (`wiw.experiments.privileged_explorers`). Reruns are stored in the run's folder `blame`; a second call continues
    where the first one stopped, and runs nothing twice.

    Args:
        run: a run, or its folder.
        arms: one, several, or None for all.
        episodes: maximum number of failures per arm, sampled at random; a larger number includes the failures of a
            smaller one. None means all.
        workers: number of processes; None means as many as the run was started with. Results do not depend on it.
        progress: whether to show bars.
        retry_errors: whether to repeat reruns that ended with an infrastructure error.
        reviser_options: options that override those of the run's revision policy, for things that have moved: a
            server's address, a folder of weights. Whatever would change results is refused.
        tracker: overrides the tracker by name, under the same conditions.
        tracker_options: override the tracker's options, under the same conditions.

    Raises:
        ArgumentError: an unknown arm, no failure, a number out of range, a task that does not say what success or
            progress is, or an agent that cannot use the ground truth, such as one without a reviser, or one that
            answers questions with another policy than `explorer`; or overrides if nothing is left to rerun.
        StoreError: the run cannot be read, was started with objects in memory or by another version, or its task,
            agents, scenes or navigation meshes have changed.
        FileError: a scene does not exist.
    """
    for name, value in (("episodes", episodes), ("workers", workers)):
        if value is not None and value < 1:
            raise ArgumentError(f"blame: expected {name} of at least 1, got {value}")
    with RunStore.read(find_folder(run)) as base:
        wanted = _choose_failures(base, arms, episodes)
        task, agents = _make_recipes(base, wanted)
        store = _open_store(base, agents)
        named = {name_rerun(arm, rerun): indices for arm, indices in wanted.items() for rerun in list_reruns(base, arm)}
        pending = {name: sorted({*store.pending(name, retry_errors)} & indices) for name, indices in named.items()}
        if (reviser_options or tracker or tracker_options) and not any(pending.values()):
            store.close()
            raise ArgumentError(
                f"blame: {base.path.parent} has nothing left to rerun, so overriding options of the reviser or the "
                "tracker has no effect; leave them out to see the verdicts, or repeat reruns that ended with an error "
                "(--retry-errors)"
            )
        relocated = {
            name: _replace_options(agent, reviser_options or {}, tracker, tracker_options or {})
            for name, agent in agents.items()
        }
        run_pending(store, task, relocated, pending, workers or base.info["workers"], progress)
        found = read_blame(base)
        assert found is not None
        return replace(found, arms=tuple(line for line in found.arms if line.arm in wanted))


def _choose_failures(base: RunStore, arms: str | Sequence[str] | None, most: int | None) -> dict[str, set[int]]:
    """Return the failures to rerun, by arm."""
    known = [one["name"] for one in base.config["arms"]]
    names = known if arms is None else [arms] if isinstance(arms, str) else list(arms)
    if unknown := [name for name in names if name not in known]:
        raise ArgumentError(f"blame: no arm '{unknown[0]}' in {base.path.parent}; it has {', '.join(known)}")
    _require_allowed(base, names)
    failures = {arm: list_failures(base, arm) for arm in dict.fromkeys(names)}
    if not any(failures.values()):
        errors = sum(row["status"] == "error" and row["arm"] in failures for row in base.outcomes())
        more = f"; {errors} ended with an infrastructure error, see `wiw resume --retry-errors`" if errors else ""
        raise ArgumentError(f"blame: {', '.join(failures)} in {base.path.parent} has no failure to explain{more}")
    seed = base.config["seed"]
    return {arm: {*sorted(found, key=lambda episode: _draw(seed, episode))[:most]} for arm, found in failures.items()}


def _require_allowed(base: RunStore, arms: Sequence[str]) -> None:
    """Check that the failures of these arms can be blamed on the stages of the run's scheme.

    Raises:
        ArgumentError: an arm's agent has no such stages.
    """
    scheme, agents = choose_scheme(base.config["task"]), base.info["agents"]
    named = {arm: agent for arm, agent in agents.items() if agent is not None}  # objects in memory are refused later
    if refused := next((arm for arm in arms if arm in named and not scheme.allows(named[arm])), None):
        raise ArgumentError(f"blame: {_explain_refusal(base, scheme, refused, named)}")


def _explain_refusal(base: RunStore, scheme: Scheme, arm: str, agents: Mapping[str, Any]) -> str:
    """Return why an arm's failures cannot be blamed on any stage, and what to do."""
    policy, reviser = agents[arm]["policy"], agents[arm].get("reviser")
    own = f"policy '{policy}'" + ("" if reviser is None else f" and reviser '{reviser}'")
    stages = ", ".join(list(scheme.reruns)[:-1])
    allowed = ",".join(name for name, agent in agents.items() if scheme.allows(agent))
    todo = (
        f"choose from the arms with that policy: --arm {allowed}"
        if allowed
        else f"`wiw run {base.config['task'].get('task')} --policy {scheme.policy}` starts a run with such arms"
    )
    return (
        f"arm '{arm}' answers questions with {own}; only policy '{scheme.policy}' has stages that can be rerun with "
        f"ground truth ({stages}); {todo}"
    )


def _draw(seed: int, episode: int) -> int:
    return int(core.fold_key([seed, episode, _ORDER]))


def _make_recipes(base: RunStore, wanted: Mapping[str, set[int]]) -> tuple[Any, dict[str, AgentRecipe]]:
    """Return the run's task, and for each of its arms the agent of each rerun.

    Raises:
        ArgumentError: the task does not say what progress is.
        StoreError: see `blame`.
        FileError: a scene does not exist.
    """
    base.require_version()
    task, agents = read_recipes(base)
    require_own_sources(base, task, agents)
    built, episodes, scheme = task.build(), base.episodes(), choose_scheme(base.config["task"])
    base.require_task(built.describe())
    if scheme.needs_guide and not built.has_guide:
        raise ArgumentError(
            f"blame: task '{base.config['task'].get('task')}' does not define the true value of a plan; derive it from "
            "wiw.tasks.navigation.NavigationTask, or implement `guide` in its environment and set `has_guide`"
        )
    require_scenes(built, base, [episodes[index] for found in wanted.values() for index in found])
    return task, {
        name_rerun(arm, rerun): _with_ground_truth(recipe, scheme.reruns[rerun].stages)
        for arm, recipe in agents.items()
        if scheme.allows(base.info["agents"][arm])
        for rerun in list_reruns(base, arm)
    }


def _with_ground_truth(recipe: AgentRecipe, stages: tuple[str, ...]) -> AgentRecipe:
    """Return the agent with ground truth in some stages; a model that the oracle replaces is not built.

    The oracle shows futures in the view and size that were chosen for the model.
    """
    if (counterpart := find_counterpart(recipe.policy, stages)) is not None:
        own = recipe.with_policy(counterpart.policy)
        return own if recipe.reviser is None else replace(own, reviser=counterpart.policy)
    own = recipe
    if "imagination" in stages:
        is_own = isinstance(recipe.model, str) and recipe.model in WORLD_MODELS.built_in
        kept = {name: value for name, value in recipe.model_options.items() if is_own and name in ("view", "size")}
        own = replace(recipe.with_model("oracle"), model_options=kept, placebo=None, error=None)
    return replace(own, ground_truth=stages)


def _replace_options(
    recipe: AgentRecipe, reviser_options: Mapping[str, Any], tracker: str | None, tracker_options: Mapping[str, Any]
) -> AgentRecipe:
    """Return the agent with overridden options; whether it is still the same agent is checked once it is built."""
    name = recipe.policy if recipe.reviser is None else recipe.reviser
    policy_options = {**recipe.policy_options, name: {**recipe.policy_options.get(name, {}), **reviser_options}}
    return replace(
        recipe,
        policy_options=policy_options if reviser_options else recipe.policy_options,
        tracker=tracker or recipe.tracker,
        tracker_options={**recipe.tracker_options, **tracker_options},
    )


def _open_store(base: RunStore, agents: Mapping[str, AgentRecipe]) -> RunStore:
    """Create or resume the store of reruns."""
    config = {
        "task": base.config["task"],
        "seed": base.config["seed"],
        "episodes": base.config["episodes"],
        "arms": [{"name": name, "agent": _list_explicit_options(recipe)} for name, recipe in agents.items()],
        "attributes": base.created,
    }
    folder = base.path.parent / FOLDER
    built, recipes = _describe_expected_agents(base), {name: recipe.to_json() for name, recipe in agents.items()}
    if RunStore.exists(folder):
        store = RunStore.resume(folder, config, more_arms=True)  # the run may have been given arms since
        if len(store.config["arms"]) < len(agents):
            store.add_arms(config, {"agents": recipes, "built": {**built, **store.info["built"]}})
        return store
    own = ("keep_images", "resumed_with", "session")  # the run chooses pictures for both
    info = {name: value for name, value in base.info.items() if name not in own}
    info |= {
        "platform": describe_platform(),
        "agents": recipes,
        "limits": {name: value for name, value in info["limits"].items() if name not in ("fidelity", "lpips")},
        "command": sys.argv,
        "preparation_seconds": 0.0,
        "built": built,
    }
    return RunStore.create(folder, config, info, base.episodes())


def _list_explicit_options(recipe: AgentRecipe) -> dict[str, Any]:
    return {name: value for name, value in (recipe.to_json() or {}).items() if value not in (None, {})}


def _describe_expected_agents(base: RunStore) -> dict[str, Any]:
    """Return how the agents of reruns must describe themselves, so that weights other than the run's are refused."""
    scheme, found = choose_scheme(base.config["task"]), dict[str, Any]()
    for arm, agent in base.info.get("built", {}).items():
        for rerun, made in scheme.reruns.items():
            counterpart = find_counterpart(base.info["agents"][arm]["policy"], made.stages)
            if counterpart is not None:
                changed = dict.fromkeys(("policy", "revision"), counterpart.identity)
            else:
                changed = {part: {"ground_truth": rerun} for part in _WRAPPED.get(rerun, ())}
            if changed:
                own = {part: {**agent[part], **changes} for part, changes in changed.items()}
                found[name_rerun(arm, rerun)] = {**agent, **own}
    return found


_WRAPPED = {"scoring": ("revision",), "proposals": ("policy",)}
"""Part of an agent that is wrapped for a rerun, and says so."""
