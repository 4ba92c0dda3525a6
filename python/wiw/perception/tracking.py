# SPDX-License-Identifier: Apache-2.0
"""Trackers, which locate the target in imagined frames: their interface, and the one that only needs geometry.

`Reprojection` shows where the target would be if a frame showed what its plan asked for: for world models that take
poses. `wiw.perception.frame_tracking` has those that look at the frames.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.action import to_viewpoints
from wiw.errors import ArgumentError
from wiw.perception.boxes import find_box
from wiw.reproject import warp
from wiw.types import Box, Observation, Proposal, Rollout, Target

FRONT_HFOV = 90.0
"""Horizontal field of view of every front view, in degrees."""


@dataclass(frozen=True)
class Track:
    """A target in the K frames of one imagined plan."""

    masks: NDArray[np.bool_]
    """bool [K, H, W], in the frames' size; empty if the target is lost."""
    boxes: tuple[Box | None, ...]
    """K boxes in the frames' pixels, None if the target is lost; across a panorama's seam left > right."""

    @property
    def visible(self) -> NDArray[np.bool_]:
        """Bool [K]: where the target is in sight."""
        return np.array([box is not None for box in self.boxes], bool)


class Tracker(ABC):
    """Follows the target of real observations into frames imagined from them."""

    needs: tuple[str, ...] = ()
    """"depth" where observations must carry it; a policy that tracks passes this on."""
    follows: Literal["frames", "poses"]
    """Whether it looks at the frames, or takes them for what the poses were to show."""

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity: what tracks depend on beside images and poses."""
        return {"name": type(self).__name__, "follows": self.follows}

    @abstractmethod
    def predict_masks(
        self,
        observations: Sequence[Observation],
        viewpoints: Sequence[NDArray[np.float64]],
        frames: Sequence[NDArray[np.uint8]],
        panoramic: bool,
        real: Sequence[int],
    ) -> list[NDArray[np.bool_]]:
        """Return the target's visible pixels in each frame, bool [K, H, W] per plan; `track` documents the
        arguments.
        """

    def track(
        self,
        observations: Sequence[Observation],
        viewpoints: Sequence[NDArray[np.float64]],
        frames: Sequence[NDArray[np.uint8]],
        panoramic: bool = True,
        real: Sequence[int] | None = None,
    ) -> list[Track]:
        """Follow the targets of B observations into as many imagined plans.

        Args:
            observations: what each plan begins with; the same one may occur several times.
            viewpoints: float64 [K, 4, 4] each: T_start_camera of every frame (`wiw.action.to_viewpoints`).
            frames: uint8 [K, H, W, 3] each, panoramas or, with `panoramic=False`, front views (HFOV 90).
            panoramic: which of the two.
            real: number of each plan's leading frames that are not imagined: turns of the real panorama; None means
                that all are imagined.

        Raises:
            ArgumentError: an observation without a target, or without what the tracker needs; arrays of other shapes.
        """
        _check_arguments(self, observations, viewpoints, frames)
        counts = [0] * len(frames) if real is None else real
        predicted = self.predict_masks(observations, viewpoints, frames, panoramic, counts)
        found = [remove_specks(masks) for masks in predicted]
        return [Track(masks, tuple(find_box(mask, wraps=panoramic) for mask in masks)) for masks in found]


def track_rollouts(
    tracker: Tracker,
    observations: Sequence[Observation],
    proposals: Sequence[Sequence[Proposal]],
    rollouts: Sequence[Sequence[Rollout]],
) -> list[list[Track]]:
    """Return tracks [episode][candidate] of the reviser's rollouts, by one call of the tracker.

    Raises:
        ArgumentError: rollouts in several views; ask for "panorama" or "front" (`Policy.frames`).
    """
    flat = [
        (observation, proposal, rollout)
        for observation, plans, futures in zip(observations, proposals, rollouts, strict=True)
        for proposal, rollout in zip(plans, futures, strict=True)
    ]
    views = {rollout.view for _, _, rollout in flat}
    if len(views) > 1 or not views <= {"panorama", "front"}:
        raise ArgumentError(f"track_rollouts: expected frames all 'panorama' or all 'front', got {sorted(views)}")
    tracks = iter(
        tracker.track(
            [observation for observation, _, _ in flat],
            [to_viewpoints(proposal.actions) for _, proposal, _ in flat],
            [rollout.frames for _, _, rollout in flat],
            panoramic=views != {"front"},
            real=[int(rollout.real.sum()) for _, _, rollout in flat],
        )
    )
    return [[next(tracks) for _ in plans] for plans in proposals]


class Reprojection(Tracker):
    """Moves the target's mask with the depth mesh of the real panorama, without using frames or learning.

    Parts hidden behind other surfaces in the new view are not marked, as the mesh is drawn with a depth test. Parts
    that the real observation did not show are unknown: boxes enclose only what was visible.
    """

    needs = ("depth",)
    follows = "poses"

    def predict_masks(
        self,
        observations: Sequence[Observation],
        viewpoints: Sequence[NDArray[np.float64]],
        frames: Sequence[NDArray[np.uint8]],
        panoramic: bool,
        real: Sequence[int],
    ) -> list[NDArray[np.bool_]]:
        """Return the warped masks, without regions that no observation showed."""
        return [mask for mask, _ in self.reproject_with_holes(observations, viewpoints, frames, panoramic)]

    def reproject_with_holes(
        self,
        observations: Sequence[Observation],
        viewpoints: Sequence[NDArray[np.float64]],
        frames: Sequence[NDArray[np.uint8]],
        panoramic: bool,
    ) -> list[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
        """Return for each plan the warped mask and what the observation did not show, both bool [K, H, W]."""
        found: list[Any] = [None] * len(frames)
        for rows in _group_rows(observations, frames):
            poses = np.concatenate([viewpoints[row] for row in rows])
            moved = _reproject_target(observations[rows[0]], poses, _get_size(frames[rows[0]]), panoramic)
            cuts = np.cumsum([len(viewpoints[row]) for row in rows])[:-1]
            for row, *parts in zip(rows, *(np.split(images, cuts) for images in moved), strict=True):
                found[row] = tuple(parts)
        return found


def _reproject_target(
    observation: Observation, poses: NDArray[np.float64], size: tuple[int, int], panoramic: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the target's mask as seen from K poses, and what the observation did not show, both bool [K, H, W]."""
    depth, mask = observation.depth, get_target(observation).mask
    assert depth is not None
    if not len(poses) or not mask.any():
        return np.zeros((len(poses), *size), bool), np.ones((len(poses), *size), bool)
    seen, hole = reproject_masks(mask[None], depth, poses, size, None if panoramic else FRONT_HFOV)
    return seen[0], hole


def reproject_masks(
    masks: NDArray[np.bool_],
    depth: NDArray[np.float32],
    poses: NDArray[np.float64],
    size: tuple[int, int],
    hfov_deg: float | None = None,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks of a panorama as seen from other poses, bool [T, K, h, w]; three take as long as one.

    Also returns what the panorama did not show of the new views, bool [K, h, w].

    Args:
        masks: bool [T, H, W], T >= 1.
        depth: float32 [H, W], distance along the ray.
        poses: float64 [K, 4, 4], K >= 1, in the frame of the panorama.
        size: (h, w) of the results.
        hfov_deg: of perspective results; None for panoramas.
    """
    seen = np.empty((len(masks), len(poses), *size), bool)
    for first in range(0, len(masks), 3):
        some = masks[first : first + 3]
        painted = np.zeros((1, *depth.shape, 3), np.uint8)
        painted[0, ..., : len(some)] = np.moveaxis(some, 0, -1) * np.uint8(255)
        shown = warp(painted, depth[None], poses[None], size=size, target_hfov_deg=hfov_deg, outputs=("color", "hole"))
        hole = shown["hole"][0]
        marked = (shown["color"][0, ..., : len(some)] > 127) & ~hole[..., None]
        seen[first : first + 3] = np.moveaxis(marked, -1, 0)
    return seen, hole


def get_target(observation: Observation) -> Target:
    """Return the observation's target.

    Raises:
        ArgumentError: it has none.
    """
    if observation.target is None:
        raise ArgumentError("expected an observation with a target, which only tasks such as ar provide")
    return observation.target


def _group_rows(observations: Sequence[Observation], frames: Sequence[NDArray[np.uint8]]) -> list[list[int]]:
    """Group rows that share an observation and a size, so that its mesh is built once."""
    groups: dict[tuple[int, tuple[int, int]], list[int]] = {}
    for row, (observation, images) in enumerate(zip(observations, frames, strict=True)):
        groups.setdefault((id(observation), _get_size(images)), []).append(row)
    return list(groups.values())


def _get_size(frames: NDArray[np.uint8]) -> tuple[int, int]:
    return int(frames.shape[1]), int(frames.shape[2])


def remove_specks(masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Empty masks without any 2 x 2 block: specks at the rims of objects do not show the target."""
    wide = masks[:, :, :-1] & masks[:, :, 1:]
    seen = np.asarray((wide[:, :-1] & wide[:, 1:]).any(axis=(1, 2)))
    return masks & seen[:, None, None]


def _check_arguments(
    tracker: Tracker,
    observations: Sequence[Observation],
    viewpoints: Sequence[NDArray[np.float64]],
    frames: Sequence[NDArray[np.uint8]],
) -> None:
    if not len(observations) == len(viewpoints) == len(frames):
        raise ArgumentError(
            "track: expected one observation, one array of viewpoints and one of frames per plan, got "
            f"{len(observations)}, {len(viewpoints)} and {len(frames)}"
        )
    for observation, poses, images in zip(observations, viewpoints, frames, strict=True):
        get_target(observation)
        if "depth" in tracker.needs and observation.depth is None:
            raise ArgumentError(f"{type(tracker).__name__} needs depth: create the environment with depth=True")
        if images.ndim != 4 or images.shape[3] != 3 or np.shape(poses) != (len(images), 4, 4):
            raise ArgumentError(
                f"track: expected frames [K, H, W, 3] and viewpoints [K, 4, 4], got {images.shape}, {np.shape(poses)}"
            )
