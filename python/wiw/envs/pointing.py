# SPDX-License-Identifier: Apache-2.0
"""Pointing out a target: the simulator's instance ids become a mask and boxes, and go no further."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.perception.boxes import Mask, find_box, keep_largest_part, scale_box
from wiw.types import Box, Target

IDS = ["panorama_ids", "front_ids"]
"""Images that the simulator adds where something is pointed out."""


@dataclass(frozen=True)
class Pointing:
    """How a task's target is boxed, and whether the episode ends when it is lost."""

    scale: float = 1.0
    """Scale of the box about its centre."""
    part: Literal["all", "largest"] = "all"
    """Whether the box holds all visible pixels or the largest piece of them."""
    lost: Literal["continue", "stop"] = "continue"
    """Whether the episode continues where neither panorama nor front view shows the target."""

    def target(self, panorama_ids: NDArray[np.uint32], front_ids: NDArray[np.uint32], instance: int) -> Target:
        """Return the instance as the agent sees it."""
        mask = panorama_ids == instance
        return Target(mask, self._box(mask, wraps=True), self._box(front_ids == instance, wraps=False))

    def split(self, images: dict[str, Any], instance: int) -> dict[str, Any]:
        """Return the simulator's images, with the ids made into `target`."""
        ids = [images[name] for name in IDS]
        plain = {name: image for name, image in images.items() if name not in IDS}
        return {**plain, "target": self.target(ids[0], ids[1], instance)}

    def ends(self, target: Target | None) -> bool:
        """Return whether the episode is over for want of a target."""
        return self.lost == "stop" and target is not None and target.panorama_box is None and target.front_box is None

    def _box(self, mask: Mask, wraps: bool) -> Box | None:
        box = find_box(keep_largest_part(mask, wraps) if self.part == "largest" and mask.any() else mask, wraps)
        return (
            box if box is None or self.scale == 1 else scale_box(box, self.scale, (mask.shape[0], mask.shape[1]), wraps)
        )
