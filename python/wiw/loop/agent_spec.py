# SPDX-License-Identifier: Apache-2.0
"""Specify an agent by names or objects, build its parts and check them against each other."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any

from wiw.errors import ArgumentError
from wiw.loop.config import AgentConfig
from wiw.loop.contract import check_declaration
from wiw.loop.decision_pass import AgentParts, choose_frames
from wiw.loop.imagination import Imaginer, NoModel
from wiw.loop.imagine import NO_SEMANTICS
from wiw.loop.memory import EpisodeMemories
from wiw.loop.model_imaginer import as_imaginer
from wiw.loop.observers import Observer
from wiw.loop.plan_space import plan_space
from wiw.policies.base import Policy
from wiw.registry import POLICIES, WORLD_MODELS, Registry
from wiw.types import PRIMITIVES


@dataclass(frozen=True)
class AgentSpec:
    """An agent's parts as given by the user, before anything is looked up; see `wiw.Agent`."""

    policy: Any
    model: Any
    reviser: Any
    config: AgentConfig
    observers: tuple[Observer, ...]

    def build(self) -> AgentParts:
        """Look up the parts and check that they fit together.

        Raises:
            ArgumentError: they do not.
            RegistryError: a name is not known.
        """
        config = self.config.complete()
        name = config.space or _space_of(self.policy)
        space = plan_space(name)
        policy = _make_policy(self.policy, name)
        imaginer = _make_imaginer(self.model, name)
        model = imaginer.model
        reviser = self._make_reviser(policy, name, imagines=model is not None)
        if model is not None:
            space.check_model(model, config.longest)
            if "semantic" in set(model.accepts.needs) - imaginer.gives:
                raise ArgumentError(f"{type(model.unwrapped).__name__} {NO_SEMANTICS}")
            if config.depth > 1:
                space.check_search(model, policy, config.depth)
        observers = () if model is None else self.observers
        shown = None if model is None else model.accepts.at_size(choose_frames(policy, reviser, config).source_size)
        memories = EpisodeMemories(policy, reviser, config, shown)
        return AgentParts(policy, imaginer, reviser, space, config, observers, memories)

    def _make_reviser(self, policy: Policy, space: str, imagines: bool) -> Policy:
        if self.reviser is not None:
            reviser = POLICIES.make(self.reviser, **space_option(POLICIES, self.reviser, space))
        elif policy.can_revise or not imagines:
            return policy
        elif policy.default_revision is not None:
            reviser = POLICIES.make(policy.default_revision, **space_option(POLICIES, policy.default_revision, space))
        else:
            raise ArgumentError(
                f"Agent: policy {type(policy.unwrapped).__name__} only proposes; let it implement `score`, or name "
                "a policy that scores with --revision (reviser=)"
            )
        check_declaration(reviser)
        if reviser.space != space:
            raise ArgumentError(
                f"Agent: {type(policy.unwrapped).__name__} plans in {plan_space(space).words}, but the reviser "
                f"{type(reviser.unwrapped).__name__} in {plan_space(reviser.space).words}"
            )
        return reviser


def _space_of(policy: Any) -> str:
    """Return the space a policy plans in; one that supports several spaces and is built by name plans in primitives."""
    found = POLICIES.find(policy) if isinstance(policy, str) else policy
    if isinstance(found, Policy) or (inspect.isclass(found) and issubclass(found, Policy)):
        return found.space
    return PRIMITIVES


def _make_policy(policy: Any, space: str) -> Policy:
    made: Policy = POLICIES.make(policy, **space_option(POLICIES, policy, space))
    check_declaration(made)
    if made.space != space:
        raise ArgumentError(
            f"Agent: expected plans in {plan_space(space).words}, but policy {type(made.unwrapped).__name__} makes "
            f"plans of {plan_space(made.space).words}"
        )
    return made


def _make_imaginer(model: Any, space: str) -> Imaginer:
    if model is None or isinstance(model, Imaginer):
        return model or NoModel()
    made = WORLD_MODELS.make(model, **space_option(WORLD_MODELS, model, space))
    return NoModel() if made is None else as_imaginer(made)


def space_option(registry: Registry, what: Any, space: str) -> dict[str, str]:
    """Return the plan space as an option, for a name whose factory builds parts for several spaces."""
    found = registry.find(what) if isinstance(what, str) else what
    if not (inspect.isclass(found) or inspect.isfunction(found)):
        return {}
    return {"space": space} if "space" in inspect.signature(found).parameters else {}
