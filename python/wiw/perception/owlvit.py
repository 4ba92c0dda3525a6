# SPDX-License-Identifier: Apache-2.0
"""OWL-ViT and OWLv2 (Minderer et al. 2022, 2023) as detectors, through the classes of `transformers`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.networks import device as usable
from wiw.networks import memory_guard
from wiw.perception import pretrained
from wiw.perception.detection import Detections, Detector, without_duplicates

KINDS = {"owlvit": "OwlViT", "owlv2": "Owlv2"}
"""`model_type` of a configuration, and what names of classes begin with."""


class OwlViT(Detector):
    """Compares every patch of an image with the text of each name; a patch's score is the best of its names'.

    Args:
        weights: of OWL-ViT or OWLv2: a folder as `save_pretrained` writes it, or a name on the Hugging Face hub.
        revision: of the hub's repository.
        device: of torch; the GPU if there is one.
        threshold: what scores less is not reported.
        overlap: of boxes of one name that share more than this part of their union, only the surest is reported.
        template: what is asked for in place of a name.
        batch: images in one call of the network.

    Raises:
        DependencyError: torch or transformers is not installed.
        WeightsError: the weights cannot be had or are another network's; its `kind` says why.
        ArgumentError: there is no such device.
    """

    def __init__(
        self,
        weights: str | Path = "google/owlv2-base-patch16-ensemble",
        revision: str | None = None,
        device: str | None = None,
        threshold: float = 0.1,
        overlap: float = 0.5,
        template: str = "a photo of a {}",
        batch: int = 4,
    ) -> None:
        pretrained.library()
        self.threshold, self.overlap, self.template, self.batch = threshold, overlap, template, batch
        self.device = usable(device)
        loader = "AutoModelForZeroShotObjectDetection"
        self._model = pretrained.network(loader, tuple(KINDS), weights, revision, self.device)
        self._tokenizer = pretrained.part("AutoTokenizer", weights, revision)
        kind = self._model.config.model_type
        self._padded = kind == "owlv2"
        self._prepare = pretrained.image_processor(KINDS[kind], weights, revision)

    def find(
        self, images: Sequence[NDArray[np.uint8]], names: Sequence[str], ids: Sequence[NDArray[np.uint32]]
    ) -> list[Detections]:
        """What the network is sure enough of, without duplicates."""
        found = []
        for first in range(0, len(images), self.batch):
            some = images[first : first + self.batch]
            with memory_guard(type(self).__name__, "give a smaller batch"):
                logits, boxes = self._outputs(some, names)
            for image, rows, places in zip(some, logits, boxes, strict=True):
                found.append(self._read(rows, places * self._scale(image), names))
        return found

    def _outputs(
        self, images: Sequence[NDArray[np.uint8]], names: Sequence[str]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Logits [B, patches, names] and boxes [B, patches, 4] (middle and size) in parts of the network's image."""
        import torch

        length = self._model.config.text_config.max_position_embeddings
        texts = [self.template.format(name) for name in names] * len(images)
        tokens = self._tokenizer(
            texts, padding="max_length", truncation=True, max_length=length, return_tensors="pt"
        ).to(self.device)
        pixels = self._prepare(list(images), input_data_format="channels_last", return_tensors="pt").pixel_values
        with torch.inference_mode():
            said: Any = self._model(
                input_ids=tokens.input_ids, attention_mask=tokens.attention_mask, pixel_values=pixels.to(self.device)
            )
        return said.logits.cpu().numpy(), said.pred_boxes.cpu().numpy()

    def _scale(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Pixels of the network's whole image: OWLv2 sees a square, padded at the right or below."""
        height, width = image.shape[:2]
        longest = max(height, width)
        return np.array([longest] * 4 if self._padded else [width, height] * 2, np.float32)

    def _read(self, logits: NDArray[np.float32], places: NDArray[np.float32], names: Sequence[str]) -> Detections:
        best = logits.argmax(axis=1)
        scores = 1 / (1 + np.exp(-logits[np.arange(len(best)), best]))
        rows = np.flatnonzero(scores >= self.threshold)
        corners = corners_of(places[rows])
        return without_duplicates(
            Detections(corners, scores[rows], tuple(names[name] for name in best[rows])), self.overlap
        )


def corners_of(places: NDArray[np.float32]) -> NDArray[np.float32]:
    """Boxes [N, 4] by their corners from boxes by middle and size."""
    middle, half = places[:, :2], places[:, 2:] / 2
    return np.concatenate([middle - half, middle + half], axis=1)
