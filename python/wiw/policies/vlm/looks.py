# SPDX-License-Identifier: Apache-2.0
"""The pictures that a language model is shown: what is seen now, and strips of what was imagined."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from wiw import annotate
from wiw.panorama import PerspectivePlan
from wiw.perception.boxes import find_box
from wiw.perception.tracking import Track
from wiw.perception.views import cut_target_views
from wiw.policies.vlm.plans import in_words
from wiw.types import Observation, Proposal, Rollout

VIEW = 384
"""Pixels of the sides of frames, the paper's."""
Image = NDArray[np.uint8]


def now(observation: Observation) -> tuple[Image, Image]:
    """Front view and panorama, with the target's box where something is pointed out."""
    shown = observation.as_dict()
    return shown["front"], shown["panorama"]


def plan_strip(plan: Proposal, rollout: Rollout, track: Track | None = None) -> Image:
    """Front views along a plan, side by side; each under a bar with its action and number, with the target's box."""
    fronts, masks = _fronts(rollout, track)
    if masks is not None:
        boxes = [find_box(mask) for mask in masks]
        fronts = np.stack(
            [
                front if box is None else annotate.box(front, box, outside=True)
                for front, box in zip(fronts, boxes, strict=True)
            ]
        )
    titles = [f"Imagined action {k}: {word}" for k, word in enumerate(in_words(plan.actions[: len(fronts)]), 1)]
    return annotate.strip(fronts, titles)


def target_now(observation: Observation) -> Image | None:
    """The view centred on the target, boxed; None where it is out of sight."""
    assert observation.target is not None
    views = cut_target_views(observation.panorama[None], observation.target.mask[None], (VIEW, VIEW))
    return views.images[0] if len(views.images) else None


def target_strip(rollout: Rollout, track: Track) -> Image | None:
    """Views centred on the target, boxed, of the imagined frames that show it; None where none does.

    Front views, which is all that a perspective model gives, are shown as they are.
    """
    wanted = np.flatnonzero(track.visible & ~rollout.real)
    if not len(wanted):
        return None
    if rollout.view == "panorama":
        images = cut_target_views(rollout.frames[wanted], track.masks[wanted], (VIEW, VIEW)).images
    else:
        boxes = [track.boxes[k] for k in wanted]
        images = np.stack(
            [annotate.box(rollout.frames[k], box or (), outside=True) for k, box in zip(wanted, boxes, strict=True)]
        )
    return annotate.strip(images, _numbered(len(images))) if len(images) else None


def _numbered(count: int) -> Sequence[str]:
    return [f"Imagined view {k + 1}" for k in range(count)]


def _fronts(rollout: Rollout, track: Track | None) -> tuple[Image, NDArray[np.bool_] | None]:
    masks = None if track is None else track.masks
    if rollout.view != "panorama":
        return rollout.frames, masks
    plan = _plan(rollout.frames.shape[1:3])
    fronts = np.asarray(plan(rollout.frames, 0.0))
    if masks is None:
        return fronts, None
    moved = plan(masks[..., None].astype(np.uint8), 0.0, interpolation="nearest")
    return fronts, np.asarray(moved)[..., 0] > 0


@cache
def _plan(size: tuple[int, int]) -> PerspectivePlan:
    return PerspectivePlan(size, (VIEW, VIEW), 90.0)
