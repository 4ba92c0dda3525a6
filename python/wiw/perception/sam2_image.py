# SPDX-License-Identifier: Apache-2.0
"""SAM 2 (Ravi et al. 2024) as a segmenter of single images; `wiw.perception.sam2` tracks objects through videos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wiw.networks import memory_guard, resolve_device
from wiw.perception import pretrained
from wiw.perception.segmentation import Segmenter


class Sam2Image(Segmenter):
    """One mask for each box.

    Args:
        weights: a folder written by `save_pretrained`, or a name on the Hugging Face hub; the video model's work, too.
        revision: of the hub's repository.
        device: of torch; the GPU if there is one.
        batch: images encoded in one call of the network.

    Raises:
        DependencyError: torch or transformers is not installed.
        WeightsError: the weights cannot be loaded or belong to another network; its `kind` says why.
        ArgumentError: there is no such device, or a batch below 1.
    """

    def __init__(
        self,
        weights: str | Path = "facebook/sam2.1-hiera-tiny",
        revision: str | None = None,
        device: str | None = None,
        batch: int = 4,
    ) -> None:
        pretrained.require_batch("Sam2Image", batch)
        pretrained.import_transformers()
        self.batch, self.device = batch, resolve_device(device)
        kinds = ("sam2", "sam2_video")
        self._model = pretrained.load_network("Sam2Model", kinds, weights, revision, self.device)

    def predict_masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        boxes: Sequence[NDArray[np.float32]],
        ids: Sequence[NDArray[np.uint32]],
    ) -> list[NDArray[np.bool_]]:
        """Encode each image once, and query all of its boxes."""
        found = [np.zeros((len(given), *image.shape[:2]), bool) for given, image in zip(boxes, images, strict=True)]
        asked = [row for row, given in enumerate(boxes) if len(given)]
        for first in range(0, len(asked), self.batch):
            rows = asked[first : first + self.batch]
            with memory_guard(type(self).__name__, "give a smaller batch"):
                filled = self._segment_batch([images[row] for row in rows], [boxes[row] for row in rows])
            for row, masks in zip(rows, filled, strict=True):
                found[row] = masks
        return found

    def _segment_batch(
        self, images: Sequence[NDArray[np.uint8]], boxes: Sequence[NDArray[np.float32]]
    ) -> list[NDArray[np.bool_]]:
        import torch

        side, masks = int(self._model.config.vision_config.image_size), []
        with torch.inference_mode():
            encoded = self._model.get_image_embeddings(pretrained.to_square_batch(images, side, self.device))
            for row, (image, given) in enumerate(zip(images, boxes, strict=True)):
                height, width = image.shape[:2]
                corners = given * (side / np.array([width, height] * 2, np.float32))
                logits = self._model(
                    image_embeddings=[level[row : row + 1] for level in encoded],
                    input_boxes=torch.from_numpy(corners)[None].to(self.device),
                    multimask_output=False,
                ).pred_masks[0]
                whole = torch.nn.functional.interpolate(logits, (height, width), mode="bilinear", align_corners=False)
                masks.append((whole[:, 0] > 0).cpu().numpy())
        return masks
