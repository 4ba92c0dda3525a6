# SPDX-License-Identifier: Apache-2.0
"""Object detection by name: the interface of detectors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, ContractError

Images = NDArray[np.uint8] | Sequence[NDArray[np.uint8]]
"""uint8 [B, H, W, 3], or B images of different sizes."""
Ids = NDArray[np.uint32] | Sequence[NDArray[np.uint32]] | None
"""uint32 [B, H, W], or one [H, W] per image: instance ids of the simulator."""


@dataclass(frozen=True)
class Detections:
    """The detections in one image, highest score first."""

    boxes: NDArray[np.float32]
    """float32 [N, 4]: left, top, right, bottom in pixels, as `wiw.types.Box`."""
    scores: NDArray[np.float32]
    """float32 [N] from 0 to 1; their meaning differs between detectors."""
    labels: tuple[str, ...]
    """N of the requested names."""

    def __len__(self) -> int:
        return len(self.labels)

    def take(self, rows: NDArray[np.integer]) -> Detections:
        """Return the given rows, in their order."""
        return Detections(self.boxes[rows], self.scores[rows], tuple(self.labels[row] for row in rows))


class Detector(ABC):
    """Finds objects by name. Subclasses implement `find`; callers use `detect`."""

    needs: tuple[str, ...] = ()
    """"ids" where images must come with the simulator's instance ids."""

    @abstractmethod
    def find(
        self, images: Sequence[NDArray[np.uint8]], names: Sequence[str], ids: Sequence[NDArray[np.uint32]]
    ) -> list[Detections]:
        """Return the detections in each image, in any order; `ids` is empty unless the detector needs it."""

    def detect(self, images: Images, names: Sequence[str], ids: Ids = None) -> list[Detections]:
        """Find the named objects in each image: boxes within the image, highest score first.

        Args:
            images: perspective views; an object across the seam of a panorama would be found in two halves.
            names: the objects to find, e.g. ["chair", "coffee table"]; an empty list finds nothing.
            ids: the simulator's instance ids of the images, for detectors that need them; others never see them.

        Raises:
            ArgumentError: arrays of other shapes or types, names that are empty or repeated, or missing ids.
            ContractError: the detector does not return one result per image, or returns names that were not requested.
        """
        if isinstance(names, str):
            raise ArgumentError(f"detect: expected a list of names, such as ['{names}'], got '{names}'")
        names = list(names)
        if any(not name.strip() for name in names) or len(set(names)) < len(names):
            raise ArgumentError(f"detect: expected distinct, non-empty names, got {names}")
        seen, pointed = check_images("detect", images, ids, "ids" in self.needs)
        if not seen or not names:
            return [no_detections() for _ in seen]
        answers = self.find(seen, names, pointed)
        if len(answers) != len(seen):
            raise ContractError(f"{type(self).__name__}: {len(seen)} images, but {len(answers)} answers")
        return [
            _clip_to_image(_check_answer(self, answer, names), image)
            for answer, image in zip(answers, seen, strict=True)
        ]


def no_detections() -> Detections:
    """Return an empty result."""
    return Detections(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), ())


def check_images(
    where: str, images: Images, ids: Ids, needed: bool
) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint32]]]:
    """Return the images one by one, and their ids where they are needed.

    Raises:
        ArgumentError: other shapes or types, or missing ids.
    """
    seen = list(images)
    for image in seen:
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            came = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise ArgumentError(f"{where}: expected images uint8 [H, W, 3], got {came}")
    if not needed:
        return seen, []
    if ids is None:
        raise ArgumentError(
            f"{where}: this one only knows the simulator's instance ids; pass ids=, one [H, W] per image"
        )
    pointed = [np.asarray(array) for array in ids]
    if [array.shape for array in pointed] != [image.shape[:2] for image in seen]:
        raise ArgumentError(
            f"{where}: expected ids of the images' sizes {[image.shape[:2] for image in seen]}, "
            f"got {[array.shape for array in pointed]}"
        )
    return seen, pointed


def suppress_duplicates(found: Detections, overlap: float) -> Detections:
    """Keep, of boxes with one name that overlap by more than `overlap` (IoU), the one with the highest score
    (greedily).
    """
    order = np.argsort(-found.scores, kind="stable")
    labels, kept = np.array(found.labels), []
    while len(order):
        best, rest = order[0], order[1:]
        kept.append(int(best))
        same = (labels[rest] == labels[best]) & (compute_iou(found.boxes[best], found.boxes[rest]) > overlap)
        order = rest[~same]
    return found.take(np.array(kept, np.int64))


def compute_iou(box: NDArray[np.float32], boxes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the intersection over union of one box [4] with each of [N, 4]; 0 for boxes without area."""
    sides = np.minimum(box[2:], boxes[:, 2:]) - np.maximum(box[:2], boxes[:, :2])
    shared = np.prod(np.maximum(sides, 0), axis=1)
    areas = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) + np.prod(box[2:] - box[:2])
    return np.asarray(shared / np.maximum(areas - shared, np.finfo(np.float32).tiny), np.float32)


def _check_answer(detector: Detector, answer: Detections, names: Sequence[str]) -> Detections:
    count = len(answer.labels)
    if answer.boxes.shape != (count, 4) or answer.scores.shape != (count,) or not set(answer.labels) <= set(names):
        raise ContractError(
            f"{type(detector).__name__}: expected boxes [N, 4], scores [N] and N labels among {list(names)}, got "
            f"{answer.boxes.shape}, {answer.scores.shape} and {answer.labels}"
        )
    if not (np.isfinite(answer.boxes).all() and np.isfinite(answer.scores).all()):
        raise ContractError(f"{type(detector).__name__}: boxes or scores are not finite", "nan")
    return answer


def _clip_to_image(found: Detections, image: NDArray[np.uint8]) -> Detections:
    """Sort by score and clip the boxes to the image; drop those outside."""
    height, width = image.shape[:2]
    boxes = np.clip(found.boxes, 0, np.array([width, height, width, height])).astype(np.float32)
    inside = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
    order = np.argsort(-found.scores, kind="stable")
    cut = Detections(boxes, found.scores.astype(np.float32), found.labels)
    return cut.take(order[inside[order]])
