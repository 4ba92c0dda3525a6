# SPDX-License-Identifier: Apache-2.0
"""Per-pixel labels of views: category, state and confidence; the interface of labellers and their vocabulary."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, ContractError

STATES = ("", "on", "off", "open", "closed")
"""States by index; index 0 where the state is unknown or there is none."""
STRUCTURE = ("wall", "floor", "ceiling", "window", "opening")
"""Categories that are parts of the building and not in it."""
CATEGORIES = (
    "", *STRUCTURE,
    "door", "curtain", "picture", "photo", "mirror", "radiator", "clock", "rug",
    "ceiling lamp", "pendant lamp", "table lamp", "floor lamp", "candles",
    "chair", "office chair", "armchair", "sofa", "stool", "bench", "pouf", "bed", "bunk bed",
    "dining table", "coffee table", "side table", "console table", "desk", "nightstand", "tv stand",
    "bookshelf", "wardrobe", "dresser", "sideboard", "wall shelf", "shoe rack", "coat rack",
    "kitchen cabinet", "kitchen counter", "kitchen sink", "stove", "refrigerator", "microwave", "range hood", "kettle",
    "sink", "toilet", "bathtub", "shower", "towel rail", "washing machine", "laundry basket", "bin",
    "plant", "plant pot", "vase", "books", "bowl", "cup", "bottle", "box", "toy box",
    "television", "laptop", "speaker", "piano", "ball",
)  # fmt: skip
"""Categories of the built-in labellers, in the apartments' words; index 0 is everything else."""
MERGED = {"door frame": "opening", "passage": "opening"}
"""Categories of scenes that labels do not distinguish."""


@dataclass(frozen=True)
class SceneLabels:
    """Labels of N views."""

    category: NDArray[np.uint8]
    """uint8 [N, H, W]: index into the labeller's `categories`; 0 where nothing is known."""
    confidence: NDArray[np.float32]
    """float32 [N, H, W], 0 to 1: of the category."""
    state: NDArray[np.uint8]
    """uint8 [N, H, W]: index into `STATES`."""

    def __len__(self) -> int:
        return len(self.category)


class Labeller(ABC):
    """Labels each pixel of perspective views. Subclasses implement `compute_labels`; callers use `label`."""

    categories: tuple[str, ...]
    """Names of the categories; index 0 is ""."""
    needs: tuple[str, ...] = ()
    """"ids" where views must come with the simulator's instance ids."""
    privileged = False
    """Whether it uses information that no sensor of the agent measures."""
    least_confidence = 0.3
    """Confidence from which on a label is good enough for a map of objects."""

    @abstractmethod
    def compute_labels(
        self,
        images: NDArray[np.uint8],
        hfov_deg: float,
        ids: NDArray[np.uint32] | None,
        depth: NDArray[np.float32] | None,
    ) -> SceneLabels:
        """Return the labels of at least one view; `ids` is None unless the labeller needs it."""

    def label(
        self,
        images: NDArray[np.uint8],
        hfov_deg: float,
        ids: NDArray[np.uint32] | None = None,
        depth: NDArray[np.float32] | None = None,
    ) -> SceneLabels:
        """Label each pixel of each view. A view's labels do not depend on the other views.

        Args:
            images: uint8 [N, H, W, 3]: perspective views with square pixels, cameras level.
            hfov_deg: their horizontal field of view in degrees, between the outer edges of the outer pixels.
            ids: uint32 [N, H, W]: the simulator's instance ids, for labellers that need them; others never see them.
            depth: float32 [N, H, W]: planar depth in metres, 0 where it is unknown; None for views without, such as
                imagined ones. A labeller may do without.

        Raises:
            ArgumentError: arrays of other shapes or types, a field of view out of range, or missing ids.
            ContractError: the labeller's result has another shape or type, or numbers out of range.
        """
        ids = self._check_views(images, hfov_deg, ids)
        if depth is not None and (depth.dtype != np.float32 or depth.shape != images.shape[:3]):
            raise ArgumentError(f"label: expected depth float32 {images.shape[:3]}, got {depth.dtype} {depth.shape}")
        if not len(images):
            empty = np.zeros(images.shape[:3], np.uint8)
            return SceneLabels(empty, empty.astype(np.float32), empty.copy())
        found = self.compute_labels(images, float(hfov_deg), ids, depth)
        self._check_labels(found, images.shape[:3])
        return found

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity for the run's manifest."""
        return {"name": type(self).__name__}

    def _check_views(
        self, images: NDArray[np.uint8], hfov_deg: float, ids: NDArray[np.uint32] | None
    ) -> NDArray[np.uint32] | None:
        if not isinstance(images, np.ndarray) or images.dtype != np.uint8 or images.ndim != 4 or images.shape[3] != 3:
            came = f"{images.dtype} {images.shape}" if isinstance(images, np.ndarray) else type(images).__name__
            raise ArgumentError(f"label: expected images uint8 [N, H, W, 3], got {came}")
        if not 0 < hfov_deg < 180:
            raise ArgumentError(f"label: expected hfov_deg above 0 and below 180, got {hfov_deg}")
        if "ids" not in self.needs:
            return None
        if ids is None or ids.shape != images.shape[:3] or not np.issubdtype(ids.dtype, np.integer):
            provided = None if ids is None else f"{ids.dtype} {ids.shape}"
            raise ArgumentError(
                f"label: {type(self).__name__} reads the simulator's instance ids; expected ids uint32 "
                f"{images.shape[:3]}, got {provided}; imagined views have none, so use another labeller for these"
            )
        return ids

    def _check_labels(self, found: SceneLabels, shape: tuple[int, ...]) -> None:
        arrays = (found.category, found.confidence, found.state)
        if [(array.dtype, array.shape) for array in arrays] != [
            (np.dtype(dtype), shape) for dtype in (np.uint8, np.float32, np.uint8)
        ]:
            came = [(str(array.dtype), array.shape) for array in arrays]
            raise ContractError(
                f"{type(self).__name__}: expected category uint8, confidence float32 and state uint8 of {shape}, "
                f"got {came}",
                "shape",
            )
        least, most = found.confidence.min(initial=0), found.confidence.max(initial=0)
        largest = int(found.category.max(initial=0)), int(found.state.max(initial=0))
        counts = len(self.categories), len(STATES)
        if not (least >= 0 and most <= 1 + 1e-3 and largest[0] < counts[0] and largest[1] < counts[1]):
            raise ContractError(
                f"{type(self).__name__}: expected categories below {counts[0]}, states below {counts[1]} and "
                f"confidence from 0 to 1, got categories up to {largest[0]}, states up to {largest[1]} and confidence "
                f"from {least:g} to {most:g}"
            )


def merge_category(name: str) -> str:
    """Return the name under which labels have a scene's category."""
    return MERGED.get(name, name)
