# SPDX-License-Identifier: Apache-2.0
"""Compose an agent: wrap a policy and a world model in a run's experiments and limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from wiw.errors import ArgumentError
from wiw.experiments.errors.erroneous import Erroneous
from wiw.experiments.errors.kinds import make_error
from wiw.experiments.fidelity import FidelityObserver
from wiw.experiments.gating import Gated
from wiw.experiments.ground_truth import TruePlans, TrueScores, sort_stages
from wiw.experiments.placebos import NO_POSES, PLACEBOS, BlindPlacebo, ShuffledPlacebo, SwappedPlacebo
from wiw.experiments.semantics import SIMULATOR, Labelled
from wiw.loop.agent import Agent
from wiw.loop.agent_spec import AgentSpec, space_option
from wiw.loop.attempts import Attempted, make_model
from wiw.loop.imagination import Imaginer, ModelInput
from wiw.loop.keys import make_key
from wiw.loop.limits import DEADLINE
from wiw.loop.model_imaginer import ModelImaginer
from wiw.loop.rollout_cache import cache_rollouts
from wiw.registry import WORLD_MODELS
from wiw.runs.limits import Limits
from wiw.types import PRIMITIVES, Episode, Key
from wiw.world_models.base import WorldModel
from wiw.world_models.oracle import Oracle


@dataclass(frozen=True)
class RunContext:
    """The task that an agent is run on, and the episodes of the whole run."""

    task: Any
    episodes: Sequence[Episode] = ()
    seed: int = 0
    salt: str = ""

    def list_keys(self) -> list[Key]:
        """Return the keys of the episodes' first decisions."""
        return [make_key(self.seed, index, self.salt) for index in range(len(self.episodes))]


@dataclass(frozen=True)
class Experiment:
    """The experiments done to an agent; see `wiw.experiments`."""

    placebo: str | None = None
    """"shuffled" or "swapped"."""
    imagine_fraction: float | None = None
    """Share of decisions for which the model is consulted; None means all."""
    ground_truth: tuple[str, ...] = ()
    """Stages that are given the ground truth."""
    semantics: Any = None
    """Source of semantics for models that need it."""
    error: str | None = None
    """KIND@DOSE of an error that imagined futures have; see `wiw.experiments.errors`."""


def compose(spec: AgentSpec, experiment: Experiment, limits: Limits, context: RunContext) -> Agent:
    """Return the agent that a run evaluates.

    Raises:
        ArgumentError: an experiment without a world model, or one that does not fit the plans.
    """
    stages = sort_stages(experiment.ground_truth)
    config = spec.config.resolve(context.task.defaults)
    policy = AgentSpec(spec.policy, None, None, config, ()).build().policy
    placebo = None if "imagination" in stages else experiment.placebo
    model = make_for_space("oracle" if "imagination" in stages else spec.model, policy.space, limits.deadline)
    error = None if "imagination" in stages else experiment.error
    imaginer = _wrap_model(model, policy.space, replace(experiment, placebo=placebo, error=error), limits, context)
    reviser = spec.reviser
    if reviser is None and not policy.can_revise:
        reviser = context.task.defaults.get("revision")
    if "scoring" in stages or "proposals" in stages:
        reviser = AgentSpec(policy, imaginer, reviser, config, ()).build().reviser
    if "scoring" in stages:
        reviser = TrueScores(reviser, config)
    if "proposals" in stages:
        policy = TruePlans(policy)
    oracle = imaginer.model.unwrapped if imaginer is not None and imaginer.model is not None else None
    truth = oracle if isinstance(oracle, Oracle) else None  # of the same size
    measured = [FidelityObserver(limits.lpips, limits.fidelity_share, truth)] if limits.measures_fidelity else []
    observers = [*spec.observers, *measured]
    return Agent(policy, imaginer, reviser, config, observers=observers)


def make_for_space(model: Any, space: str, deadline: float = DEADLINE, **options: Any) -> WorldModel | Imaginer | None:
    """Return a world model for plans of a space, from a name or class; instances and imaginers as they are."""
    if model is None or isinstance(model, WorldModel | Imaginer):
        return model
    return make_model(model, deadline, **{**space_option(WORLD_MODELS, model, space), **options})


def _wrap_model(
    model: WorldModel | Imaginer | None,
    space: str,
    experiment: Experiment,
    limits: Limits,
    context: RunContext,
) -> Imaginer | None:
    placebo = experiment.placebo
    if model is None:
        for name in ("placebo", "error"):
            if (given := getattr(experiment, name)) is not None:
                raise ArgumentError(f"{name}='{given}' needs a world model, but this agent has none")
        return None
    imaginer = _make_imaginer(model, experiment.error, limits)
    if experiment.semantics is not None:
        imaginer = Labelled(imaginer, experiment.semantics)
    if placebo is not None:
        imaginer = _as_placebo(imaginer, placebo, space, context)
    if experiment.imagine_fraction is not None:
        imaginer = Gated(imaginer, experiment.imagine_fraction)
    return imaginer


def _make_imaginer(model: WorldModel | Imaginer, error: str | None, limits: Limits) -> Imaginer:
    if isinstance(model, Imaginer):
        if error is not None:
            raise ArgumentError(f"error='{error}' needs a world model, got a {type(model).__name__} that asks one")
        return model
    if error is None:
        return ModelImaginer(_limit(model, limits))
    made = make_error(error)
    return Erroneous(_limit(model, limits, changes_world=made.needs_simulator and made.dose > 0), made)


def _limit(model: WorldModel, limits: Limits, changes_world: bool = False) -> WorldModel:
    """Return the model with deadline, retries and cache; one that its user has wrapped stays as it is."""
    if model is not model.unwrapped:
        return model
    attempted = Attempted(model, limits.deadline, checks_pictures=not changes_world)
    return cache_rollouts(attempted, limits.cache, limits.cache_gb)


def require_placebo(placebo: str, space: str, episodes: int) -> None:
    """Require that a run of so many episodes, with plans of a space, can have a placebo.

    Raises:
        ArgumentError: it cannot, or there is no such placebo.
    """
    if placebo not in PLACEBOS:
        raise ArgumentError(f"expected placebo {' or '.join(PLACEBOS)}, got '{placebo}'")
    if placebo == "shuffled" and space != PRIMITIVES:
        raise ArgumentError(NO_POSES)
    if placebo == "swapped" and episodes < 2:
        raise ArgumentError(
            f"placebo-swapped shows the model another episode, so it needs at least 2 episodes; got {episodes}"
        )


def _as_placebo(imaginer: Imaginer, placebo: str, space: str, context: RunContext) -> Imaginer:
    require_placebo(placebo, space, len(context.episodes))
    if placebo == "swapped":
        return SwappedPlacebo(imaginer, NextEpisodes(context, imaginer))
    if placebo == "blind":
        return BlindPlacebo(imaginer)
    return ShuffledPlacebo(imaginer)


class NextEpisodes:
    """First observations of the run's next episode (cyclic), for swapped placebos."""

    def __init__(self, context: RunContext, imaginer: Imaginer) -> None:
        self._context, self._needs = context, imaginer.accepts.needs
        self._depth = "depth" in imaginer.needs
        self._labels = isinstance(imaginer, Labelled) and imaginer.source == SIMULATOR and "semantic" in self._needs
        self._indices = {(key.seed, key.episode): index for index, key in enumerate(context.list_keys())}
        self._env: Any = None
        self._moments: dict[tuple[int, int], ModelInput] = {}

    def of(self, key: Key) -> ModelInput:
        """Return the first observation of the next episode."""
        name = key.seed, key.episode
        if name not in self._moments:
            self._moments[name] = self._begin((self._indices[name] + 1) % len(self._context.episodes))
        return self._moments[name]

    def forget(self, key: Key) -> None:
        """Drop the observation stored for an episode."""
        self._moments.pop((key.seed, key.episode), None)

    def _begin(self, index: int) -> ModelInput:
        if self._env is None:
            self._env = self._context.task.environment(depth=self._depth)
        observation = self._env.begin(self._context.episodes[index])
        simulator = self._env.fork() if "simulator" in self._needs else None
        semantic = self._env.semantic() if self._labels else None
        return ModelInput(observation, simulator, semantic)
