# SPDX-License-Identifier: Apache-2.0
"""Segmentation of objects in boxes: the interface of segmenters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.errors import ArgumentError, ContractError
from wiw.perception.detection import Ids, Images, check_images


class Segmenter(ABC):
    """Fills boxes with masks. Subclasses implement `predict_masks`; callers use `segment`."""

    needs: tuple[str, ...] = ()
    """"ids" where images must come with the simulator's instance ids."""

    @abstractmethod
    def predict_masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        boxes: Sequence[NDArray[np.float32]],
        ids: Sequence[NDArray[np.uint32]],
    ) -> list[NDArray[np.bool_]]:
        """Return masks bool [N, H, W] for each image's boxes [N, 4]; `ids` is empty unless the segmenter needs it."""

    def segment(self, images: Images, boxes: Sequence[ArrayLike], ids: Ids = None) -> list[NDArray[np.bool_]]:
        """Return the pixels of the object in each box, bool [N, H, W] per image.

        Args:
            images: as for `Detector.detect`.
            boxes: for each image [N, 4] (left, top, right, bottom), e.g. `Detections.boxes`; N may be 0.
            ids: the simulator's instance ids of the images, for segmenters that need them; others never see them.

        Raises:
            ArgumentError: arrays of other shapes, boxes without area or across the seam of a panorama, or missing ids.
            ContractError: the segmenter's result has another shape or type.
        """
        seen, pointed = check_images("segment", images, ids, "ids" in self.needs)
        if len(boxes) != len(seen):
            raise ArgumentError(f"segment: expected one array of boxes per image, got {len(boxes)} for {len(seen)}")
        asked = [_check_boxes(given) for given in boxes]
        if not seen:
            return []
        found = self.predict_masks(seen, asked, pointed)
        expected = [(len(given), *image.shape[:2]) for given, image in zip(asked, seen, strict=True)]
        if [mask.shape for mask in found] != expected or any(mask.dtype != bool for mask in found):
            came = [(str(mask.dtype), mask.shape) for mask in found]
            raise ContractError(f"{type(self).__name__}: expected masks bool {expected}, got {came}", "shape")
        return found


def _check_boxes(given: ArrayLike) -> NDArray[np.float32]:
    boxes = np.asarray(given, np.float32)
    boxes = boxes.reshape(0, 4) if boxes.size == 0 else boxes
    if boxes.ndim != 2 or boxes.shape[1] != 4:
        raise ArgumentError(f"segment: expected boxes [N, 4], got {boxes.shape}")
    if not (boxes[:, 2:] > boxes[:, :2]).all():
        raise ArgumentError(
            f"segment: expected boxes with left < right and top < bottom, got {boxes.tolist()}; rotate a panorama "
            "(wiw.panorama.rotate) until its seam crosses no box"
        )
    return boxes
