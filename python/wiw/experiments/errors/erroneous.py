# SPDX-License-Identifier: Apache-2.0
"""World models with an error of a known dose in their futures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import count_leading_turns
from wiw.envs.navigation import NavigationEnv
from wiw.errors import ArgumentError
from wiw.experiments.errors.base import Degradation
from wiw.experiments.errors.forks import WorldFork
from wiw.loop.imagination import Imagination, ImaginationWrapper, ModelInput, Request
from wiw.loop.imagine import seed_of
from wiw.loop.model_imaginer import ModelImaginer
from wiw.loop.model_wrapper import ModelWrapper
from wiw.types import PRIMITIVES, Conditioning, Control
from wiw.world_models.base import Accepts, WorldModel


class ErroneousModel(ModelWrapper):
    """A world model with an error in its rollouts."""

    def __init__(self, model: WorldModel, error: Degradation) -> None:
        super().__init__(model)
        self.error = error

    @property
    def accepts(self) -> Accepts:  # type: ignore[override]
        """The model's declaration, with seeds.

        If something is drawn once per future, plans of primitives share no frames; those of poses never do.
        """
        own = self.model.accepts
        if not self.error.dose:
            return own
        keeps = own.space != PRIMITIVES or not self.error.draws_future
        return replace(own, seeded=True, causal=own.causal and keeps)

    def describe(self) -> dict[str, Any]:
        """Describe the model and the error."""
        return {**super().describe(), "error": str(self.error)}

    def fingerprint(self) -> str:
        """Return nothing, as only the rollouts of the model itself are cached."""
        return ""

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return the model's frames with the error, unless that is one of looks, which is added to them later."""
        if not self.error.dose:
            return self.model.rollout(observations, controls, seeds)
        model = self.model if self.model.accepts.seeded else _Unseeded(self.model)
        return self.error.rollout(model, observations, controls, seeds)


class _Unseeded(ModelWrapper):
    """A model without seeds, whose rollouts are those that it gives without an error."""

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Ask the model; the seeds are the error's."""
        return self.model.rollout(observations, controls, np.zeros_like(seeds))


class Erroneous(ModelImaginer):
    """Asks a world model to imagine the plans, and adds an error to the futures.

    Args:
        model: any for errors of looks and flicker; the oracle for those that act in the simulator.
        error: with its dose.

    Raises:
        ArgumentError: an error that acts in the simulator, of a model that has none; or one that makes no sense for
            the model's plans.
    """

    def __init__(self, model: WorldModel, error: Degradation) -> None:
        require_error(error, model.accepts.space, "simulator" in model.accepts.needs)
        super().__init__(ErroneousModel(model, error))
        self.error = error

    def imagine(self, request: Request) -> Imagination:
        """Imagine all plans of all episodes, with the error."""
        if self.error.dose:
            request = replace(request, retouch=self.error.retouch)
        if "simulator" not in self.accepts.needs:
            return super().imagine(request)
        pairs = zip(request.keys, request.inputs, strict=True)
        forked = replace(request, inputs=[replace(own, simulator=self._fork(key, own)) for key, own in pairs])
        return MisplacedImagination(super().imagine(forked), forked, self.error)

    def _fork(self, key: Any, shown: ModelInput) -> Any:
        """Return a fork of an episode's simulator, together with its world if an agent walks in it."""
        env = self._environments.find(key)
        fork = env.fork() if shown.simulator is None else shown.simulator
        if self.accepts.space != PRIMITIVES or not self.error.needs_simulator:
            return fork
        if not isinstance(env, NavigationEnv):
            raise ArgumentError(
                f"error '{self.error}' moves the camera in the episode's world: expected an environment of "
                f"wiw.envs.NavigationEnv, got {type(env).__name__}; run it with wiw.evaluate"
            )
        world = env.state.world
        if fork.renderer is not world.renderer.core:
            raise ArgumentError(
                f"error '{self.error}' acts in the scene of the episode, but its future is imagined in another one, as "
                "placebo-swapped does: expected episodes of one scene, or blur, noise, tint, resolution or flicker"
            )
        return WorldFork(fork, world, env.task.motion == "slide")


class MisplacedImagination(ImaginationWrapper):
    """Imagined futures that know how far from the right places their frames were taken."""

    def __init__(self, inner: Imagination, request: Request, error: Degradation) -> None:
        super().__init__(inner)
        self._request, self._error = request, error

    @cached_property
    def pose_errors(self) -> list[NDArray[np.float64]]:  # type: ignore[override]
        """Mean over the imagined frames of each plan, float64 [M, 2] per episode: metres and degrees."""
        return [self._measure_episode(episode) for episode in range(len(self._request.keys))]

    def _measure_episode(self, episode: int) -> NDArray[np.float64]:
        request, found = self._request, []
        first: dict[bytes, int] = {}
        for plan, origin in zip(request.plans[episode], request.origins[episode], strict=True):
            number = first.setdefault(plan.actions.tobytes(), origin)  # equal plans are one rollout
            seed = seed_of(request.keys[episode], number)
            found.append(self._measure_plan(request.inputs[episode].simulator, plan.actions, seed))
        return np.stack(found)

    def _measure_plan(self, simulator: Any, actions: NDArray[Any], seed: int) -> NDArray[np.float64]:
        turns = count_leading_turns(actions) if actions.ndim == 1 else 0
        if turns == len(actions):
            return np.full(2, np.nan)
        start = simulator.fork() if turns else simulator
        for action in actions[:turns]:
            start.step(int(action))
        if not self._error.dose:
            return np.zeros(2)
        return np.asarray(self._error.misplace(start, actions[turns:], seed).mean(axis=0))


def require_error(error: Degradation, space: str, has_simulator: bool) -> None:
    """Check that an error makes sense for plans of a space and a world model.

    Raises:
        ArgumentError: it does not; says why.
    """
    if space not in error.doses:
        raise ArgumentError(
            f"error '{error.kind}' is not defined for plans of space '{space}': expected {' or '.join(error.doses)}"
        )
    if error.needs_simulator and not has_simulator:
        raise ArgumentError(
            f"error '{error.kind}' acts in the simulator, which only the oracle is given: expected error-{error}, "
            "without another model; blur, noise, tint, resolution and flicker work with any model"
        )
