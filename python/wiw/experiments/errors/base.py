# SPDX-License-Identifier: Apache-2.0
"""Errors in imagined futures, and the notation for one of a known dose: KIND@DOSE, such as `blur@16`."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.loop.imagination import Answer
from wiw.types import GRIPPER_POSES, PRIMITIVES, Conditioning, Control
from wiw.world_models.base import WorldModel

Family = Literal["looks", "flicker", "control", "content"]
_PURPOSE = 0x6572726F
"""Separates these draws from all other draws of a rollout."""


class Degradation(ABC):
    """An error of a known dose in imagined futures. A dose of 0 changes nothing.

    All draws are derived from the rollout's seed, and are nested: what a dose changes, a larger one changes too.

    Args:
        dose: from 0, in `unit`.

    Raises:
        ArgumentError: a dose out of range.
    """

    kind: ClassVar[str]
    family: ClassVar[Family]
    about: ClassVar[str]
    """The effect of a dose on a future, as a sentence that begins with a verb."""
    unit: ClassVar[str]
    """Unit of the dose."""
    doses: ClassVar[Mapping[str, tuple[float, ...]]]
    """Doses of a study, from small to large, by plan space; the error makes no sense in other plan spaces."""
    most: ClassVar[float] = np.inf
    """Largest dose."""
    draws_future: ClassVar[bool] = False
    """Whether something is drawn once per future, so that futures cannot share the frames of a common beginning."""
    needs_simulator: ClassVar[bool] = True
    """Whether it acts on the simulator's fork, which only the oracle is given."""

    def __init__(self, dose: float) -> None:
        if not (0 <= dose <= self.most and np.isfinite(dose)):
            largest = "" if np.isinf(self.most) else f" to {self.most:g}"
            raise ArgumentError(f"error '{self.kind}': expected a dose from 0{largest} ({self.unit}), got {dose:g}")
        self.dose = float(dose)

    def __str__(self) -> str:
        return f"{self.kind}@{self.dose:g}"

    def rollout(
        self,
        model: WorldModel,
        observations: Conditioning,
        controls: Sequence[Control],
        seeds: NDArray[np.uint64],
    ) -> NDArray[np.uint8]:
        """Return the frames of a model that is asked with this error; see `WorldModel.rollout`. Default: without."""
        return model.rollout(observations, controls, seeds)

    def retouch(self, answer: Answer) -> NDArray[np.uint8]:
        """Return the frames of an answer with this error, which the model itself does not see. Default: as they are."""
        return answer.frames

    def misplace(self, simulator: object, actions: NDArray[np.generic], seed: int) -> NDArray[np.float64]:
        """Return how far each frame is from where it should have been taken, float64 [K, 2]: metres and degrees.

        This concerns the camera in plans of primitives, the gripper in plans of poses. Default: no displacement.

        Args:
            simulator: fork of the environment from which the plan is imagined.
            actions: the plan, K actions.
            seed: of the rollout.
        """
        return np.zeros((len(actions), 2))


def per_space(primitives: tuple[float, ...], poses: tuple[float, ...] | None = None) -> Mapping[str, tuple[float, ...]]:
    """Return doses by plan space: `poses` None means the same, and empty that the error makes no sense there."""
    found = {PRIMITIVES: primitives, GRIPPER_POSES: primitives if poses is None else poses}
    return {space: doses for space, doses in found.items() if doses}


def make_generator(seed: int, *parts: int) -> np.random.Generator:
    """Return the generator of a rollout's draws; `parts` distinguish several of one rollout."""
    return np.random.Generator(np.random.Philox(key=core.fold_key([int(seed), _PURPOSE, *parts])))
