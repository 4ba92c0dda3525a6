# SPDX-License-Identifier: Apache-2.0
"""Trackers that look at the imagined frames: where a frame does not show what the plan asked for, the box shows it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.action import ActionSpace
from wiw.panorama import rotate, to_perspective
from wiw.perception.boxes import box_width, find_box
from wiw.perception.tracking import FRONT_HFOV, Tracker, get_target
from wiw.types import Observation


class FrameTracker(Tracker):
    """Follows the target by the pixels of the frames; poses count for nothing but the real turns that a plan begins
    with.

    These turns are the real panorama, turned, and so is the target's mask. Imagined frames are followed from the real
    view after them. A front view without the target is preceded by real views: from the one that faces the target, turn
    by turn.
    """

    follows = "frames"

    @abstractmethod
    def follow(
        self, views: NDArray[np.uint8], masks: NDArray[np.bool_], frames: NDArray[np.uint8]
    ) -> NDArray[np.bool_]:
        """Return the target's visible pixels in each frame, bool [K, H, W]; none where it is lost.

        Args:
            views: uint8 [N, H, W, 3], N >= 1: real views, the last of which the frames follow.
            masks: bool [N, H, W]: the target in these; the first shows it.
            frames: uint8 [K, H, W, 3], K >= 1.
        """

    def predict_masks(
        self,
        observations: Sequence[Observation],
        viewpoints: Sequence[NDArray[np.float64]],
        frames: Sequence[NDArray[np.uint8]],
        panoramic: bool,
        real: Sequence[int],
    ) -> list[NDArray[np.bool_]]:
        """Track the target along each plan separately; masks are empty where it is out of sight all around."""
        follow = self._follow_panoramas if panoramic else self._follow_front_views
        found = []
        for observation, poses, images, count in zip(observations, viewpoints, frames, real, strict=True):
            masks = np.zeros(images.shape[:3], bool)
            if get_target(observation).mask.any():
                yaws = [0.0, *(_get_yaw(pose) for pose in poses[:count])]
                masks[:] = follow(observation, yaws, images)
            found.append(masks)
        return found

    def _follow_panoramas(
        self, observation: Observation, yaws: Sequence[float], frames: NDArray[np.uint8]
    ) -> NDArray[np.bool_]:
        """Turn everything so that the target of the last real view is in the middle, away from the seam."""
        size = frames.shape[1:3]
        mask = get_target(observation).mask.astype(np.uint8)
        known = np.stack([_resize_mask(rotate(mask, yaw) > 0, size) for yaw in yaws])
        imagined = frames[len(yaws) - 1 :]
        box = find_box(known[-1], wraps=True)
        if box is None or not len(imagined):  # a small size may leave nothing of a small target
            return np.concatenate([known[1:], np.zeros(imagined.shape[:3], bool)])
        shift = size[1] // 2 - round(box[0] + box_width(box, size[1]) / 2)
        view = _resize_view(rotate(observation.panorama, yaws[-1]), size)
        found = self.follow(
            np.roll(view, shift, axis=1)[None], np.roll(known[-1:], shift, axis=2), np.roll(imagined, shift, axis=2)
        )
        return np.concatenate([known[1:], np.roll(found, -shift, axis=2)])

    def _follow_front_views(
        self, observation: Observation, yaws: Sequence[float], frames: NDArray[np.uint8]
    ) -> NDArray[np.bool_]:
        size = (frames.shape[1], frames.shape[2])
        mask = get_target(observation).mask.astype(np.uint8)

        def cut_mask(yaw: float) -> NDArray[np.bool_]:
            return np.asarray(to_perspective(mask, FRONT_HFOV, size, yaw, interpolation="nearest")) > 0

        known, imagined = np.stack([cut_mask(yaw) for yaw in yaws]), frames[len(yaws) - 1 :]
        if not len(imagined):
            return known[1:]
        lead = [yaws[-1]] if known[-1].any() else _turn_from(_find_yaw(mask > 0), yaws[-1])
        masks = np.stack([cut_mask(yaw) for yaw in lead])
        if not masks[0].any():  # too high, too low or too small for any front view
            return np.concatenate([known[1:], np.zeros(imagined.shape[:3], bool)])
        views = to_perspective(observation.panorama, FRONT_HFOV, size, lead)
        return np.concatenate([known[1:], self.follow(views, masks, imagined)])


def _get_yaw(pose: NDArray[np.float64]) -> float:
    """Return the heading of T_start_camera in degrees, left positive."""
    return round(float(np.degrees(np.arctan2(pose[0, 2], pose[0, 0]))), 6)


def _find_yaw(mask: NDArray[np.bool_]) -> float:
    """Return the heading of a panorama's mask in degrees, left positive."""
    box = find_box(mask, wraps=True)
    assert box is not None
    columns = mask.shape[1]
    middle = (box[0] + box_width(box, columns) / 2) % columns
    return 180.0 - 360.0 * middle / columns


def _turn_from(first: float, last: float) -> list[float]:
    """Return headings from the first to the last, a turn apart, the shorter way round."""
    turn = float(np.degrees(ActionSpace().turn_rad))
    way = (last - first + 180.0) % 360.0 - 180.0
    count = max(1, int(np.ceil(abs(way) / turn)))
    return [first + way * k / count for k in range(count)] + [last]


def _resize_view(image: NDArray[np.uint8], size: Sequence[int]) -> NDArray[np.uint8]:
    """Resize a real view to the frames' size (H, W)."""
    if image.shape[:2] == tuple(size):
        return image
    return np.asarray(cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA), np.uint8)


def _resize_mask(mask: NDArray[np.bool_], size: Sequence[int]) -> NDArray[np.bool_]:
    if mask.shape == tuple(size):
        return mask
    return np.asarray(cv2.resize(mask.astype(np.uint8), (size[1], size[0]), interpolation=cv2.INTER_NEAREST_EXACT)) > 0
