# SPDX-License-Identifier: Apache-2.0
"""Requests to imagine plans, and their results.

An `Imaginer` is a world model as the loop asks it: `ModelImaginer` asks the model for the very plans from the very
observations. Experiments wrap one to request something else (`wiw.experiments`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.loop.clock import Clock
from wiw.loop.history import Frame
from wiw.loop.privileged import LiveEnvironments, Privileged
from wiw.policies.base import FrameSpec
from wiw.types import Key, Proposal, Rollout, View
from wiw.world_models.base import Accepts, WorldModel


@dataclass(frozen=True)
class ModelInput:
    """Inputs of a world model for one episode; placebos may take them from another episode."""

    observation: Any
    """`Observation` or `ArmObservation`."""
    simulator: Any = None
    """Fork of the environment, for the oracle alone."""
    semantic: NDArray[np.uint32] | None = None
    """uint32 [H, W]: category of each pixel of the panorama, for models that need it."""
    history: tuple[Frame, ...] | None = None
    """The episode's latest observations with this one, for models that need them; None stands for its first moment."""


@dataclass(frozen=True)
class Answer:
    """Frames with which a model has answered one call."""

    frames: NDArray[np.uint8]
    """[B, 1 + K, H, W, 3]; frame 0 is what the call began with."""
    seeds: NDArray[np.uint64]
    """[B], of the futures."""
    first: int
    """Frames of the plans that earlier calls imagined."""
    lengths: Sequence[int]
    """[B]: frames after frame 0; the rest is padding."""
    shared: Sequence[int]
    """[B]: frames after frame 0 that are not read, as another row answers them."""
    view: View


@dataclass(frozen=True)
class Request:
    """Plans to be imagined, one entry per episode in every list."""

    space: Any
    """`wiw.loop.plan_space.PlanSpace` that the plans are of."""
    keys: Sequence[Key]
    observations: Sequence[Any]
    """The episodes' own: leading turns of a plan are shown as the real panorama, turned."""
    inputs: Sequence[ModelInput]
    """What the model is shown."""
    plans: Sequence[Sequence[Proposal]]
    origins: Sequence[Sequence[int]]
    """Number of the first-level proposal that each plan began as; it names the plan's seed."""
    frames: FrameSpec
    """How the reviser wants the frames."""
    clock: Clock
    wordless: bool = False
    """Whether a model with control "text" is given an empty prompt."""
    retouch: Callable[[Answer], NDArray[np.uint8]] | None = None
    """Changes the frames of answers before they are shown; calls that continue a plan begin with the model's own."""


class Imagination(ABC):
    """Imagined futures of the plans of one request."""

    rollouts: Sequence[Sequence[Rollout] | None]
    """[episode][candidate]; None for an episode of which nothing was imagined."""
    costs: Sequence[Mapping[str, int]]
    """Requests of each episode: consultations, rows and frames."""
    view: View = "perspective"
    """That the model imagines."""
    source_size: tuple[int, int] | None = None
    """(height, width) requested from a model with a range of sizes; None for a model with only one size."""
    pose_errors: Sequence[NDArray[np.float64] | None] | None = None
    """float64 [M, 2] by episode, metres and degrees: how far from their places each plan's frames were taken, on
    average; NaN for a plan without imagined frames. None if nobody knows, as for most models."""

    @abstractmethod
    def show(self, frames: FrameSpec) -> list[list[Rollout]]:
        """Return the rollouts in other views than the reviser's."""

    def ends(self, chosen: Sequence[tuple[int, int]]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return the panoramas and front views that (episode, candidate) plans end with, as they would be observed.

        Raises:
            NotImplementedError: plans of this space end in no place from which more could be proposed.
        """
        raise NotImplementedError(f"{type(self).__name__} has no places at the ends of plans")


class ImaginationWrapper(Imagination):
    """Base of imaginations that add something to another one."""

    def __init__(self, inner: Imagination) -> None:
        self.inner, self.rollouts, self.costs, self.view = inner, inner.rollouts, inner.costs, inner.view
        self.source_size = inner.source_size

    def show(self, frames: FrameSpec) -> list[list[Rollout]]:
        """Return what the wrapped imagination shows."""
        return self.inner.show(frames)

    def ends(self, chosen: Sequence[tuple[int, int]]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return the ends of the wrapped imagination."""
        return self.inner.ends(chosen)


class NoImagination(Imagination):
    """The result where nothing is imagined: no rollouts."""

    def __init__(self, episodes: int) -> None:
        self.rollouts: list[None] = [None] * episodes
        self.costs: list[Mapping[str, int]] = [{}] * episodes

    def show(self, frames: FrameSpec) -> list[list[Rollout]]:
        """Show nothing."""
        return [[] for _ in self.rollouts]


class Imaginer(ABC):
    """A world model as the loop asks it, or one that an experiment has changed."""

    @property
    @abstractmethod
    def model(self) -> WorldModel | None:
        """The world model that is asked in the end; None without one."""

    @abstractmethod
    def imagine(self, request: Request) -> Imagination:
        """Imagine all plans of all episodes."""

    @property
    def accepts(self) -> Accepts:
        """Declaration of the model."""
        assert self.model is not None
        return self.model.accepts

    @property
    def needs(self) -> frozenset[str]:
        """Inputs that observations must carry beyond images: "depth"."""
        return frozenset() if self.model is None else frozenset(self.model.accepts.needs) & {"depth"}

    @property
    def gives(self) -> frozenset[str]:
        """Inputs of the model beside its observations: "semantic"."""
        return frozenset()

    @property
    def spent(self) -> Mapping[str, float]:
        """Requests to the model so far, for the cost ledger."""
        return {} if self.model is None else self.model.spent

    def consults(self, key: Key) -> bool:
        """Return whether the model is consulted for this decision."""
        return self.model is not None

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity for the run's manifest: the model's, under "model", and what changes it."""
        return {"model": None if self.model is None else self.model.describe()}

    def forget(self, key: Key) -> None:  # noqa: B027 - most keep nothing
        """Drop what is kept of an episode that has ended."""


class NoModel(Imaginer):
    """Imagines nothing, so that the same loop measures the policy alone."""

    model = None

    def imagine(self, request: Request) -> Imagination:
        """Return no rollouts."""
        return NoImagination(len(request.keys))


class ImaginerWrapper(Imaginer, Privileged):
    """Base of imaginers that change the requests to another one."""

    def __init__(self, inner: Imaginer) -> None:
        self.inner = inner

    def grant(self, environments: LiveEnvironments) -> None:
        """Pass the environments on."""
        if isinstance(self.inner, Privileged):
            self.inner.grant(environments)

    @property
    def model(self) -> WorldModel | None:
        """The wrapped imaginer's."""
        return self.inner.model

    @property
    def needs(self) -> frozenset[str]:
        """The wrapped imaginer's."""
        return self.inner.needs

    @property
    def gives(self) -> frozenset[str]:
        """The wrapped imaginer's."""
        return self.inner.gives

    def imagine(self, request: Request) -> Imagination:
        """Pass the request on."""
        return self.inner.imagine(request)

    def consults(self, key: Key) -> bool:
        """Return what the wrapped imaginer says."""
        return self.inner.consults(key)

    def describe(self) -> dict[str, Any]:
        """Describe the wrapped imaginer."""
        return self.inner.describe()

    def forget(self, key: Key) -> None:
        """Pass the call on."""
        self.inner.forget(key)
