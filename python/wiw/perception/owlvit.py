# SPDX-License-Identifier: Apache-2.0
"""OWL-ViT and OWLv2 (Minderer et al. 2022, 2023) as detectors, through the classes of `transformers`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.networks import memory_guard, resolve_device
from wiw.perception import pretrained
from wiw.perception.detection import Detections, Detector, suppress_duplicates

MODEL_TYPES = {"owlvit": "OwlViT", "owlv2": "Owlv2"}
"""`model_type` of a configuration, and the prefix of the class names."""


class OwlViT(Detector):
    """Compares every patch of an image with the text of each name; a patch's score is that of its best name.

    Args:
        weights: of OWL-ViT or OWLv2: a folder written by `save_pretrained`, or a name on the Hugging Face hub.
        revision: of the hub's repository.
        device: of torch; the GPU if there is one.
        threshold: lower scores are not reported.
        overlap: of boxes with one name and a higher IoU than this, only the one with the highest score is reported.
        template: text of a query; {} is the name.
        batch: images in one call of the network.

    Raises:
        DependencyError: torch or transformers is not installed.
        WeightsError: the weights cannot be loaded or belong to another network; its `kind` says why.
        ArgumentError: there is no such device, or a batch below 1.
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
        pretrained.require_batch("OwlViT", batch)
        pretrained.import_transformers()
        self.threshold, self.overlap, self.template, self.batch = threshold, overlap, template, batch
        self.device = resolve_device(device)
        loader = "AutoModelForZeroShotObjectDetection"
        self._model = pretrained.load_network(loader, tuple(MODEL_TYPES), weights, revision, self.device)
        self._tokenizer = pretrained.load_component("AutoTokenizer", weights, revision)
        kind = self._model.config.model_type
        self._padded = kind == "owlv2"
        self._prepare = pretrained.load_image_processor(MODEL_TYPES[kind], weights, revision)

    def find(
        self, images: Sequence[NDArray[np.uint8]], names: Sequence[str], ids: Sequence[NDArray[np.uint32]]
    ) -> list[Detections]:
        """Return the detections above the threshold, without duplicates."""
        found = []
        for first in range(0, len(images), self.batch):
            some = images[first : first + self.batch]
            with memory_guard(type(self).__name__, "give a smaller batch"):
                logits, boxes = self._run_network(some, names)
            for image, rows, places in zip(some, logits, boxes, strict=True):
                found.append(self._decode(rows, places * self._compute_scale(image), names))
        return found

    def _run_network(
        self, images: Sequence[NDArray[np.uint8]], names: Sequence[str]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return logits [B, patches, names] and boxes [B, patches, 4] (centre and size) relative to the network's
        image.
        """
        import torch

        length = self._model.config.text_config.max_position_embeddings
        texts = [self.template.format(name) for name in names] * len(images)
        tokens = self._tokenizer(
            texts, padding="max_length", truncation=True, max_length=length, return_tensors="pt"
        ).to(self.device)
        pixels = self._prepare(list(images), input_data_format="channels_last", return_tensors="pt").pixel_values
        with torch.inference_mode():
            output: Any = self._model(
                input_ids=tokens.input_ids, attention_mask=tokens.attention_mask, pixel_values=pixels.to(self.device)
            )
        return output.logits.cpu().numpy(), output.pred_boxes.cpu().numpy()

    def _compute_scale(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the size of the network's whole image in pixels: OWLv2 pads to a square, at the right or below."""
        height, width = image.shape[:2]
        longest = max(height, width)
        return np.array([longest] * 4 if self._padded else [width, height] * 2, np.float32)

    def _decode(self, logits: NDArray[np.float32], places: NDArray[np.float32], names: Sequence[str]) -> Detections:
        best = logits.argmax(axis=1)
        scores = 1 / (1 + np.exp(-logits[np.arange(len(best)), best]))
        rows = np.flatnonzero(scores >= self.threshold)
        corners = to_corners(places[rows])
        return suppress_duplicates(
            Detections(corners, scores[rows], tuple(names[name] for name in best[rows])), self.overlap
        )


def to_corners(places: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert boxes [N, 4] from centre and size to corners."""
    middle, half = places[:, :2], places[:, 2:] / 2
    return np.concatenate([middle - half, middle + half], axis=1)
