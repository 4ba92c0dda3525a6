# SPDX-License-Identifier: Apache-2.0
"""One demonstration: an expert at its table, and what was seen of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.demonstrations import Demonstration, Format, encoded_depth, encoded_image
from wiw.errors import ArgumentError, InfrastructureError
from wiw.render import Output
from wiw.tabletop.kind import Kind, Setup
from wiw.tabletop.workbench import Film, Workbench

Backend = Literal["auto", "cpu", "gpu"]
POSES = 15
"""That an expert may go to, as in an episode of the evaluation."""
ATTEMPTS = 20
"""Tables that are set for one demonstration before its expert is taken to be broken."""
FIRST_SEED = 2**31
"""Evaluation draws the seeds of its tables below it, so that no table is seen in both."""


@dataclass(frozen=True)
class Collection:
    """What is collected.

    Raises:
        ArgumentError: a number that is too small or too large.
    """

    episodes: int = 200
    """Of each task."""
    seed: int = 0
    size: int = 480
    """Pixels of a side of the front view."""
    frames: int = 150
    """Of each demonstration."""
    format: Format = "jpeg"
    depth: bool = False
    keep_failed: bool = False
    """Whether a demonstration that fails is kept as such; else another table takes the place of its own."""
    backend: Backend = "auto"
    """Renderer; pictures differ a little between them."""

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.seed < 0:
            raise ArgumentError(f"collect: expected 1 episode or more and a seed of 0 or more, got {self}")
        if not 16 <= self.size <= 4096:
            raise ArgumentError(f"collect: expected a size from 16 to 4096 pixels, got {self.size}")
        if self.frames <= POSES:
            raise ArgumentError(
                f"collect: expected over {POSES} frames, so that there is one for each action's end, got {self.frames}"
            )
        for name, given, known in (("format", self.format, Format), ("backend", self.backend, Backend)):
            if given not in get_args(known):
                raise ArgumentError(f"collect: expected a {name} among {', '.join(get_args(known))}, got {given}")


def demonstrated(kind: Kind, episode: int, collection: Collection) -> tuple[Demonstration, int]:
    """A demonstration by its number, and how many tables its expert failed at.

    Raises:
        InfrastructureError: it failed at too many.
    """
    variation = episode % kind.variations
    for attempt in range(ATTEMPTS):
        seed = table_seed(collection.seed, episode, attempt)
        setup = kind.setup(seed, variation)
        played = _Played(kind, setup, setup.bench(collection.backend))
        if played.success or collection.keep_failed:
            named = {"task": kind.name, "variation": variation, "seed": seed, "episode": episode}
            return played.demonstration(collection, named), attempt + (not played.success)
    raise InfrastructureError(
        f"collect: the expert of {kind.name} failed at {ATTEMPTS} tables in a row (demonstration {episode}, seed "
        f"{collection.seed}); tests/benchmark/expert_success.py measures how often it should"
    )


def table_seed(seed: int, episode: int, attempt: int) -> int:
    """The seed of a table, which is never one of evaluation's."""
    return FIRST_SEED + int(core.fold_key([seed, episode, attempt])) % FIRST_SEED


class _Played:
    """What an expert did at a table, every physics step of it."""

    def __init__(self, kind: Kind, setup: Setup, bench: Workbench) -> None:
        self._setup, self._start = setup, bench.fork()
        self._actions: list[NDArray[np.float64]] = []
        self._films: list[Film] = []
        self._after: list[Workbench] = []
        while len(self._actions) < POSES and not kind.succeeded(bench, setup):
            for pose in kind.expert(bench.places(setup.objects), setup.target)[: POSES - len(self._actions)]:
                self._actions.append(pose)
                self._films.append(bench.film(pose)[1])
                self._after.append(bench.fork())
                if kind.succeeded(bench, setup):
                    break
        self.success = kind.succeeded(bench, setup)

    def demonstration(self, collection: Collection, named: dict[str, Any]) -> Demonstration:
        """What was seen, in so many frames; `named`: the demonstration's other fields."""
        steps, keys, ended = self._sampled(collection.frames)
        outputs: tuple[Output, ...] = ("color", "depth") if collection.depth else ("color",)
        seconds, poses, images, depths = [], [], [], []
        for moment in self._moments(steps, keys, ended):
            seen = moment.picture("front", (collection.size, collection.size), outputs)
            seconds.append(moment.seconds - self._start.seconds)
            poses.append(moment.pose)
            images.append(encoded_image(seen["color"], collection.format))
            depths += [encoded_depth(seen["depth"])] if collection.depth else []
        return Demonstration(
            **named,
            instruction=self._setup.instruction,
            success=self.success,
            places=self._start.places(self._setup.objects),
            seconds=np.array(seconds),
            poses=np.stack(poses),
            actions=np.stack(self._actions)[np.maximum(keys, 1) - 1],
            keys=keys,
            ended=ended,
            encoded_images=tuple(images),
            encoded_depths=tuple(depths) if collection.depth else None,
        )

    def _sampled(self, frames: int) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.bool_]]:
        """[frames] each: steps of the action under way, its number, and whether it ends there."""
        ends = np.cumsum([0, *(len(film) - 1 for film in self._films)])
        at, shown = end_frames(ends, frames), np.arange(frames)
        steps = np.rint(np.interp(shown, at, ends)).astype(np.int64)
        keys = np.searchsorted(at, shown).astype(np.int32)
        return steps - ends[np.maximum(keys, 1) - 1], keys, np.isin(shown, at[1:])

    def _moments(
        self, steps: NDArray[np.int64], keys: NDArray[np.int32], ended: NDArray[np.bool_]
    ) -> Iterator[Workbench]:
        yield self._start
        for step, key, end in zip(steps[1:], keys[1:], ended[1:], strict=True):
            yield self._after[key - 1] if end else self._films[key - 1][step]


def end_frames(ends: NDArray[np.int64], frames: int) -> NDArray[np.int64]:
    """int64 [K + 1]: in which of the frames the steps `ends` [K + 1] are shown: in proportion, one apart at least."""
    last, order = frames - 1, np.arange(len(ends))
    wanted = np.rint(ends / max(1, ends[-1]) * last).astype(np.int64)
    wanted[-1] = last  # also where nothing has moved
    rising = np.maximum.accumulate(wanted - order) + order
    return np.minimum(rising, last - order[::-1])
