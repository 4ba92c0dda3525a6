# SPDX-License-Identifier: Apache-2.0
"""The images shown to a language model: the present observation, and strips of imagined views."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw import annotate
from wiw.panorama import to_perspective
from wiw.perception.boxes import find_box
from wiw.perception.tracking import Track
from wiw.perception.views import cut_target_views
from wiw.policies.vlm.plans import describe_actions
from wiw.types import Box, Observation, Proposal, Rollout

VIEW = 384
"""Side of frames in pixels, as in the paper."""
Image = NDArray[np.uint8]


def render_observation(observation: Observation, side: int | None = None) -> tuple[Image, Image]:
    """Return front view, this many pixels a side, and panorama, with the target's box where there is a target."""
    return resize_view(observation.mark_target("front"), side), observation.mark_target("panorama")


def resize_view(view: Image, side: int | None) -> Image:
    """Return a square view with this many pixels a side; as it is where none are given."""
    if side is None or view.shape[:2] == (side, side):
        return view
    return np.asarray(cv2.resize(view, (side, side), interpolation=_choose_interpolation(view, side)), np.uint8)


def _choose_interpolation(view: Image, side: int) -> int:
    return cv2.INTER_AREA if side < view.shape[0] else cv2.INTER_CUBIC


def arrange_frames(frames: Image, titles: Sequence[str] | None, strip: bool) -> list[Image]:
    """Return frames [N, H, W, 3], each under a bar with its title where there are titles, in one image or in N."""
    groups = [slice(None)] if strip else [slice(k, k + 1) for k in range(len(frames))]
    if titles is None:
        return [np.ascontiguousarray(np.concatenate(list(frames[group]), axis=1)) for group in groups]
    return [annotate.strip(frames[group], titles[group]) for group in groups]


def render_plan_frames(plan: Proposal, rollout: Rollout, track: Track | None = None) -> tuple[Image, list[str]]:
    """Return front views along a plan, with the target's box, and a title for each: its action and number."""
    fronts, masks = _cut_front_views(rollout, track)
    heads = ["Imagined"] * len(fronts)
    if track is not None and masks is not None:
        boxes = [find_box(mask) for mask in masks]
        heads = [_describe_box(*frame) for frame in zip(boxes, ~track.visible & ~rollout.real, strict=True)]
        fronts = np.stack([_draw_box(*frame) for frame in zip(fronts, boxes, strict=True)])
    words = describe_actions(plan.actions[: len(fronts)])
    return fronts, [f"{head} action {k}: {word}" for k, (head, word) in enumerate(zip(heads, words, strict=True), 1)]


def _describe_box(box: Box | None, lost: bool) -> str:
    """Begin a frame's title: without a box, the tracker has lost the target, or it is elsewhere around the agent."""
    return "Imagined" if box is not None else "Target lost," if lost else "Target not in view,"


def _draw_box(view: Image, box: Box | None) -> Image:
    return view if box is None else annotate.box(view, box, outside=True)


def render_target(observation: Observation) -> Image | None:
    """Return the view centred on the target, boxed; None if it is out of sight."""
    assert observation.target is not None
    views = cut_target_views(observation.panorama[None], observation.target.mask[None], (VIEW, VIEW))
    return views.images[0] if len(views.images) else None


def render_target_frames(rollout: Rollout, track: Track) -> tuple[Image, list[str]]:
    """Return views centred on the target, boxed, of the imagined frames that show it, and a title for each.

    Front views, which is all that a perspective model gives, are shown as they are.
    """
    wanted = np.flatnonzero(track.visible & ~rollout.real)
    if not len(wanted):
        return rollout.frames[:0], []
    if rollout.view == "panorama":
        images = cut_target_views(rollout.frames[wanted], track.masks[wanted], (VIEW, VIEW)).images
    else:
        images = np.stack([_draw_box(rollout.frames[k], track.boxes[k]) for k in wanted])
    return images, [f"Imagined view {k + 1}" for k in range(len(images))]


def _cut_front_views(rollout: Rollout, track: Track | None) -> tuple[Image, NDArray[np.bool_] | None]:
    masks = None if track is None else track.masks
    if rollout.view != "panorama":
        return rollout.frames, masks
    fronts = to_perspective(rollout.frames, 90.0, (VIEW, VIEW))
    if masks is None:
        return fronts, None
    moved = to_perspective(masks[..., None].astype(np.uint8), 90.0, (VIEW, VIEW), interpolation="nearest")
    return fronts, moved[..., 0] > 0
