# SPDX-License-Identifier: Apache-2.0
"""Imagination for a share of all decisions only (paper, "Inference-time scaling")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.loop.imagination import Imagination, ImaginerWrapper, NoImagination, Request
from wiw.loop.model_imaginer import as_imaginer
from wiw.policies.base import FrameSpec
from wiw.types import Key, Rollout

_CONSULT = 0x636F6E73
"""Separates the draw of whether to consult from all other draws of the decision."""


class Gated(ImaginerWrapper):
    """A world model that is consulted for a share of all decisions; for the others the proposer's preference decides.

    The draw depends only on the decision's key: decisions consulted with a smaller share are also consulted with a
    larger one.

    Args:
        model: a world model, or an imaginer.
        fraction: of the decisions, 0 to 1.

    Raises:
        ArgumentError: a fraction out of range.
    """

    def __init__(self, model: Any, fraction: float) -> None:
        super().__init__(as_imaginer(model))
        if not 0 <= fraction <= 1:
            raise ArgumentError(f"expected an imagine_fraction from 0 to 1, got {fraction}")
        self.fraction = fraction

    def consults(self, key: Key) -> bool:
        """Return whether the model is consulted for this decision."""
        return super().consults(key) and is_consulted(key, self.fraction)

    def imagine(self, request: Request) -> Imagination:
        """Imagine the plans of the episodes whose decisions consult the model."""
        places = [place for place, key in enumerate(request.keys) if self.consults(key)]
        if not places:
            return NoImagination(len(request.keys))
        return PartialImagination(super().imagine(select(request, places)), places, len(request.keys))

    def describe(self) -> dict[str, Any]:
        """Describe the model, and the share where it is less than all."""
        return super().describe() | ({} if self.fraction == 1 else {"imagine_fraction": self.fraction})


class PartialImagination(Imagination):
    """The imagination of some episodes of a request."""

    def __init__(self, inner: Imagination, places: Sequence[int], episodes: int) -> None:
        self._inner, self._places, self.view = inner, list(places), inner.view
        self.source_size = inner.source_size
        self.rollouts: list[Sequence[Rollout] | None] = [None] * episodes
        self.costs: list[Mapping[str, int]] = [{}] * episodes
        for place, own, cost in zip(places, inner.rollouts, inner.costs, strict=True):
            self.rollouts[place], self.costs[place] = own, cost
        if inner.pose_errors is not None:
            known = dict(zip(places, inner.pose_errors, strict=True))
            self.pose_errors = [known.get(place) for place in range(episodes)]

    def show(self, frames: FrameSpec) -> list[list[Rollout]]:
        """Return the rollouts in other views, none for an episode of which nothing was imagined."""
        shown = dict(zip(self._places, self._inner.show(frames), strict=True))
        return [shown.get(place, []) for place in range(len(self.rollouts))]

    def ends(self, chosen: Sequence[tuple[int, int]]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return what (episode, candidate) plans end with."""
        return self._inner.ends([(self._places.index(episode), candidate) for episode, candidate in chosen])


def select(request: Request, places: Sequence[int]) -> Request:
    """Return the request of some of its episodes."""
    return replace(
        request,
        keys=[request.keys[place] for place in places],
        observations=[request.observations[place] for place in places],
        inputs=[request.inputs[place] for place in places],
        plans=[request.plans[place] for place in places],
        origins=[request.origins[place] for place in places],
    )


def is_consulted(key: Key, fraction: float) -> bool:
    """Return whether a world model that is consulted for a share of all decisions is consulted for this one."""
    return bool(core.uniform(core.fold_key([key.seed, key.episode, key.decision, _CONSULT]), 1)[0] < fraction)
