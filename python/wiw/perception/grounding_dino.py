# SPDX-License-Identifier: Apache-2.0
"""Grounding DINO (Liu et al. 2023) and MM Grounding DINO as detectors, through the classes of `transformers`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.networks import memory_guard, resolve_device
from wiw.perception import pretrained
from wiw.perception.detection import Detections, Detector, suppress_duplicates
from wiw.perception.owlvit import to_corners

MODEL_TYPES = ("grounding-dino", "mm-grounding-dino")


class GroundingDino(Detector):
    """Reads all names as one text, "chair. coffee table."; a box's score for a name is that of its best token.

    Names that exceed the text's length are split over several texts.

    Args:
        weights: a folder written by `save_pretrained`, or a name on the Hugging Face hub.
        revision: of the hub's repository.
        device: of torch; the GPU if there is one.
        threshold: lower scores are not reported.
        overlap: of boxes with one name and a higher IoU than this, only the one with the highest score is reported.
        batch: images in one call of the network.

    Raises:
        DependencyError: torch or transformers is not installed.
        WeightsError: the weights cannot be loaded or belong to another network; its `kind` says why.
        ArgumentError: there is no such device, or a batch below 1.
    """

    def __init__(
        self,
        weights: str | Path = "IDEA-Research/grounding-dino-tiny",
        revision: str | None = None,
        device: str | None = None,
        threshold: float = 0.25,
        overlap: float = 0.5,
        batch: int = 4,
    ) -> None:
        pretrained.require_batch("GroundingDino", batch)
        pretrained.import_transformers()
        self.threshold, self.overlap, self.batch = threshold, overlap, batch
        self.device = resolve_device(device)
        loader = "AutoModelForZeroShotObjectDetection"
        self._model = pretrained.load_network(loader, MODEL_TYPES, weights, revision, self.device)
        self._tokenizer = pretrained.load_component("AutoTokenizer", weights, revision)
        self._prepare = pretrained.load_image_processor("GroundingDino", weights, revision)

    def find(
        self, images: Sequence[NDArray[np.uint8]], names: Sequence[str], ids: Sequence[NDArray[np.uint32]]
    ) -> list[Detections]:
        """Return the detections above the threshold, without duplicates."""
        texts = list(self._split_into_texts(names))
        found = []
        for some in self._split_into_batches(images):
            with memory_guard(type(self).__name__, "give a smaller batch"):
                answers = [self._run_network(some, text) for text in texts]
            found += [
                suppress_duplicates(_join_detections(parts), self.overlap) for parts in zip(*answers, strict=True)
            ]
        return found

    def _split_into_batches(self, images: Sequence[NDArray[np.uint8]]) -> Iterator[list[NDArray[np.uint8]]]:
        """Batch neighbouring images of one size: padding beside a larger image would change the network's output."""
        for _, group in groupby(images, key=lambda image: image.shape):
            alike = list(group)
            yield from (alike[first : first + self.batch] for first in range(0, len(alike), self.batch))

    def _split_into_texts(self, names: Sequence[str]) -> Iterator[dict[str, list[int]]]:
        """Yield the names' tokens by name, as many names at a time as fit into the text."""
        room = self._model.config.max_text_len - 2  # the first and the last token are none of a name's
        text: dict[str, list[int]] = {}
        for name in names:
            tokens = self._tokenizer(name.replace(".", " ").lower(), add_special_tokens=False).input_ids
            if not 0 < len(tokens) < room:
                raise ArgumentError(f"GroundingDino: '{name}' has {len(tokens)} tokens, expected 1 to {room - 1}")
            if sum(len(known) + 1 for known in text.values()) + len(tokens) + 1 > room:
                yield text
                text = {}
            text[name] = tokens
        yield text

    def _run_network(self, images: Sequence[NDArray[np.uint8]], text: dict[str, list[int]]) -> list[Detections]:
        """Return the detections in each image of the names in one text."""
        import torch

        tokens, places = self._lay_out_tokens(text)
        pixels = self._prepare(list(images), input_data_format="channels_last", return_tensors="pt").to(self.device)
        line = torch.tensor([tokens] * len(images), device=self.device)
        with torch.inference_mode():
            output: Any = self._model(
                pixel_values=pixels.pixel_values,
                pixel_mask=pixels.pixel_mask,
                input_ids=line,
                attention_mask=torch.ones_like(line),
                token_type_ids=torch.zeros_like(line),
            )
        chances = output.logits.sigmoid().cpu().numpy()
        scores = np.stack([chances[..., place].max(axis=-1) for place in places], axis=-1)
        boxes = output.pred_boxes.cpu().numpy()
        rows = zip(scores, boxes, images, strict=True)
        return [self._decode(score, box, image, list(text)) for score, box, image in rows]

    def _lay_out_tokens(self, text: dict[str, list[int]]) -> tuple[list[int], list[slice]]:
        """Return the tokens of "[CLS] name. name. [SEP]", and each name's slice of them."""
        stop = self._tokenizer.convert_tokens_to_ids(".")
        line, places = [self._tokenizer.cls_token_id], []
        for tokens in text.values():
            places.append(slice(len(line), len(line) + len(tokens)))
            line += [*tokens, stop]
        return [*line, self._tokenizer.sep_token_id], places

    def _decode(
        self, scores: NDArray[np.float32], boxes: NDArray[np.float32], image: NDArray[np.uint8], names: Sequence[str]
    ) -> Detections:
        best = scores.argmax(axis=1)
        sure = scores[np.arange(len(best)), best]
        rows = np.flatnonzero(sure >= self.threshold)
        height, width = image.shape[:2]
        corners = to_corners(boxes[rows]) * np.array([width, height] * 2, np.float32)
        return Detections(corners, sure[rows], tuple(names[name] for name in best[rows]))


def _join_detections(parts: Sequence[Detections]) -> Detections:
    return Detections(
        np.concatenate([part.boxes for part in parts]),
        np.concatenate([part.scores for part in parts]),
        tuple(label for part in parts for label in part.labels),
    )
