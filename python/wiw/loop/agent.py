# SPDX-License-Identifier: Apache-2.0
"""The inner loop: propose, imagine, revise (paper, "Unified Strategy for Closed-Loop Online Planning")."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from wiw.loop.agent_spec import AgentSpec
from wiw.loop.base import BaseAgent
from wiw.loop.config import AgentConfig, set_numbers
from wiw.loop.decision_pass import DecisionPass
from wiw.loop.memory import Query, read_observation
from wiw.loop.observers import Observer
from wiw.loop.privileged import ForkedEnvironment, LiveEnvironments
from wiw.policies.base import Policy
from wiw.types import Decision, Goal, Key
from wiw.world_models.base import WorldModel


class Agent(BaseAgent):
    """A policy, with or without a world model.

        agent = wiw.Agent("matcher", "warp", candidates=3)
        decision = agent.decide(observation, goal, key)

    Args:
        policy: base and proposal policy (name or instance).
        model: world model (name, class or instance), or an `Imaginer` that calls one; None runs the same loop without
            imagination.
        reviser: policy that scores imagined futures; None means the policy itself, or its default reviser.
        config: parameters of the search; open ones are taken from the task, or from the paper's ImageNav.
        observers: measure decisions without changing them.
        numbers: parameters of `AgentConfig` that override the config's, such as candidates=3 and horizon=5.

    Raises:
        ArgumentError: a number out of range; parts that do not fit together, such as a model that takes other plans
            than the policy makes.
    """

    def __init__(
        self,
        policy: Any,
        model: Any = None,
        reviser: Any = None,
        config: AgentConfig | None = None,
        *,
        observers: Sequence[Observer] = (),
        **numbers: Any,
    ) -> None:
        self.spec = AgentSpec(policy, model, reviser, set_numbers(config or AgentConfig(), numbers), tuple(observers))
        self.parts = self.spec.build()
        self.config = self.parts.config

    def decide_batch(self, queries: Sequence[Query]) -> list[Decision]:
        """Decide once for each live episode; model and reviser see all candidates of all of them at once."""
        step = DecisionPass(self.parts, queries)
        search = step.propose()
        futures = step.imagine(search)
        scores = step.score(search, futures)
        for _ in range(1, self.config.depth):
            step.extend(search, futures, scores)
            futures = step.imagine(search)
            scores = step.score(search, futures)
        return step.revise(search, futures, scores)

    def decide(self, observation: Any, goal: Goal, key: Key, simulator: Any = None) -> Decision:
        """Decide for one episode.

        Args:
            observation: an `Observation`, or the environment's dict.
            goal: what the agent is asked to do.
            key: identifies the decision for all randomness; `info["key"]` of the environment.
            simulator: fork of the environment, for the oracle only.

        Raises:
            ArgumentError: a dict whose images have boxes drawn on them, which world models must not see, or a
                manipulator's, which lacks what policies need.
        """
        query = Query(read_observation(observation), goal, key)
        if simulator is None:
            return self.decide_batch([query])[0]
        environments = LiveEnvironments()
        environments.add(key, ForkedEnvironment(simulator))
        self.grant(environments)
        try:
            return self.decide_batch([query])[0]
        finally:
            environments.remove(key)  # the next decision is made at another place

    @property
    def policy(self) -> Policy:
        """The policy that proposes."""
        return self.parts.policy

    @property
    def model(self) -> WorldModel | None:
        """The world model in use; None without one."""
        return self.parts.imaginer.model

    @property
    def reviser(self) -> Policy:
        """The policy that scores and decides."""
        return self.parts.reviser

    @property
    def needs(self) -> tuple[str, ...]:  # type: ignore[override]
        """Inputs that observations must have besides images, such as "depth"."""
        return self.parts.needs

    def count_spent(self) -> Counter[str]:
        """Return what the agent's model and policies have used so far."""
        return self.parts.count_spent()

    def grant(self, environments: LiveEnvironments) -> None:
        """Give the privileged parts the environments in which episodes run."""
        self.parts.grant(environments)

    def forget(self, key: Key) -> None:
        """Drop what is kept of a finished episode."""
        self.parts.memories.forget(key)
        self.parts.imaginer.forget(key)

    def replace(self, **changes: Any) -> Agent:
        """Return the same agent with other parts or parameters, e.g. `agent.replace(model="oracle")`."""
        names = {name: changes.pop(name) for name in ("policy", "model", "reviser", "observers") if name in changes}
        spec = replace(self.spec, **names)
        config = set_numbers(changes.pop("config", spec.config), changes)
        return Agent(spec.policy, spec.model, spec.reviser, config, observers=spec.observers)

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity for the run's manifest."""
        return {
            "policy": self.policy.describe(),
            "revision": self.reviser.describe(),
            **self.parts.describe_model(),
            **self.spec.config.describe(),
        }

    def __repr__(self) -> str:
        model = "none" if self.model is None else type(self.model.unwrapped).__name__
        return f"Agent({type(self.policy.unwrapped).__name__}, {model}, {self.config})"
