# SPDX-License-Identifier: Apache-2.0
"""Perfect perception: the simulator's instance ids as a detector and as a segmenter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.perception.boxes import find_box
from wiw.perception.detection import Detections, Detector, compute_iou, no_detections
from wiw.perception.segmentation import Segmenter


def read_categories(scene: Any) -> dict[int, str]:
    """Return the category of each of a scene's instances, by id."""
    return {instance["id"]: instance["category"] for instance in scene.instances}


class TrueBoxes(Detector):
    """Boxes around the visible pixels of each instance, with score 1.

    Args:
        categories: id to category; `read_categories(scene)`. Names match regardless of case, with spaces or
            underscores.
        least_pixels: an instance with fewer visible pixels is not reported.
    """

    needs = ("ids",)

    def __init__(self, categories: Mapping[int, str], least_pixels: int = 1) -> None:
        self.categories, self.least_pixels = dict(categories), least_pixels

    def find(
        self, images: Sequence[NDArray[np.uint8]], names: Sequence[str], ids: Sequence[NDArray[np.uint32]]
    ) -> list[Detections]:
        """Return one detection per instance."""
        asked = {_normalise_name(name): name for name in names}
        labels = {number: asked.get(_normalise_name(category)) for number, category in self.categories.items()}
        return [self._find_boxes(array, labels) for array in ids]

    def _find_boxes(self, ids: NDArray[np.uint32], labels: Mapping[int, str | None]) -> Detections:
        boxes, found = [], []
        for number, pixels in zip(*np.unique(ids, return_counts=True), strict=True):
            label = labels.get(int(number))
            if label is not None and pixels >= self.least_pixels:
                boxes.append(find_box(ids == number))
                found.append(label)
        return (
            Detections(np.array(boxes, np.float32), np.ones(len(boxes), np.float32), tuple(found))
            if boxes
            else no_detections()
        )


class TrueMasks(Segmenter):
    """The visible pixels of the instance whose own box fits a box best; none where no box overlaps it."""

    needs = ("ids",)

    def predict_masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        boxes: Sequence[NDArray[np.float32]],
        ids: Sequence[NDArray[np.uint32]],
    ) -> list[NDArray[np.bool_]]:
        """Return one mask per box."""
        return [_match_masks(array, given) for array, given in zip(ids, boxes, strict=True)]


def _match_masks(ids: NDArray[np.uint32], boxes: NDArray[np.float32]) -> NDArray[np.bool_]:
    masks = np.zeros((len(boxes), *ids.shape), bool)
    numbers = [number for number in np.unique(ids) if number]
    around = np.array([find_box(ids == number) for number in numbers], np.float32).reshape(-1, 4)
    for mask, box in zip(masks, boxes, strict=True):
        fits = compute_iou(box, around)
        if fits.size and fits.max() > 0:
            mask[:] = ids == numbers[int(fits.argmax())]
    return masks


def _normalise_name(name: str) -> str:
    return name.strip().casefold().replace("_", " ")
