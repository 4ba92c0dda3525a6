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
from wiw.networks import device as usable
from wiw.networks import memory_guard
from wiw.perception import pretrained
from wiw.perception.detection import Detections, Detector, without_duplicates
from wiw.perception.owlvit import corners_of

KINDS = ("grounding-dino", "mm-grounding-dino")


class GroundingDino(Detector):
    """Reads all names as one text, "chair. coffee table." A box's score for a name is that of its surest token.

    More names than the text has room for are asked for in several texts.

    Args:
        weights: a folder as `save_pretrained` writes it, or a name on the Hugging Face hub.
        revision: of the hub's repository.
        device: of torch; the GPU if there is one.
        threshold: what scores less is not reported.
        overlap: of boxes of one name that share more than this part of their union, only the surest is reported.
        batch: images in one call of the network.

    Raises:
        DependencyError: torch or transformers is not installed.
        WeightsError: the weights cannot be had or are another network's; its `kind` says why.
        ArgumentError: there is no such device.
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
        pretrained.library()
        self.threshold, self.overlap, self.batch = threshold, overlap, batch
        self.device = usable(device)
        loader = "AutoModelForZeroShotObjectDetection"
        self._model = pretrained.network(loader, KINDS, weights, revision, self.device)
        self._tokenizer = pretrained.part("AutoTokenizer", weights, revision)
        self._prepare = pretrained.image_processor("GroundingDino", weights, revision)

    def find(
        self, images: Sequence[NDArray[np.uint8]], names: Sequence[str], ids: Sequence[NDArray[np.uint32]]
    ) -> list[Detections]:
        """What the network is sure enough of, without duplicates."""
        texts = list(self._texts(names))
        found = []
        for some in self._batches(images):
            with memory_guard(type(self).__name__, "give a smaller batch"):
                answers = [self._asked(some, text) for text in texts]
            found += [without_duplicates(_joined(parts), self.overlap) for parts in zip(*answers, strict=True)]
        return found

    def _batches(self, images: Sequence[NDArray[np.uint8]]) -> Iterator[list[NDArray[np.uint8]]]:
        """Neighbours of one size: beside a larger image one would be padded, and the network sees that."""
        for _, group in groupby(images, key=lambda image: image.shape):
            alike = list(group)
            yield from (alike[first : first + self.batch] for first in range(0, len(alike), self.batch))

    def _texts(self, names: Sequence[str]) -> Iterator[dict[str, list[int]]]:
        """The names' tokens by name, as many names at a time as the text has room for."""
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

    def _asked(self, images: Sequence[NDArray[np.uint8]], text: dict[str, list[int]]) -> list[Detections]:
        """What is found in each image of the names in one text."""
        import torch

        tokens, places = self._laid_out(text)
        pixels = self._prepare(list(images), input_data_format="channels_last", return_tensors="pt").to(self.device)
        line = torch.tensor([tokens] * len(images), device=self.device)
        with torch.inference_mode():
            said: Any = self._model(
                pixel_values=pixels.pixel_values,
                pixel_mask=pixels.pixel_mask,
                input_ids=line,
                attention_mask=torch.ones_like(line),
                token_type_ids=torch.zeros_like(line),
            )
        chances = said.logits.sigmoid().cpu().numpy()
        scores = np.stack([chances[..., place].max(axis=-1) for place in places], axis=-1)
        boxes = said.pred_boxes.cpu().numpy()
        rows = zip(scores, boxes, images, strict=True)
        return [self._read(score, box, image, list(text)) for score, box, image in rows]

    def _laid_out(self, text: dict[str, list[int]]) -> tuple[list[int], list[slice]]:
        """Tokens of "[CLS] name. name. [SEP]", and where each name's are."""
        stop = self._tokenizer.convert_tokens_to_ids(".")
        line, places = [self._tokenizer.cls_token_id], []
        for tokens in text.values():
            places.append(slice(len(line), len(line) + len(tokens)))
            line += [*tokens, stop]
        return [*line, self._tokenizer.sep_token_id], places

    def _read(
        self, scores: NDArray[np.float32], boxes: NDArray[np.float32], image: NDArray[np.uint8], names: Sequence[str]
    ) -> Detections:
        best = scores.argmax(axis=1)
        sure = scores[np.arange(len(best)), best]
        rows = np.flatnonzero(sure >= self.threshold)
        height, width = image.shape[:2]
        corners = corners_of(boxes[rows]) * np.array([width, height] * 2, np.float32)
        return Detections(corners, sure[rows], tuple(names[name] for name in best[rows]))


def _joined(parts: Sequence[Detections]) -> Detections:
    return Detections(
        np.concatenate([part.boxes for part in parts]),
        np.concatenate([part.scores for part in parts]),
        tuple(label for part in parts for label in part.labels),
    )
