# SPDX-License-Identifier: Apache-2.0
"""A detector and a segmenter as a labeller: the masks of named objects, the surest on top."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.perception.detection import Detections, Detector
from wiw.perception.scene_labels import CATEGORIES, STRUCTURE, Labeller, SceneLabels
from wiw.perception.segmentation import Segmenter
from wiw.registry import DETECTORS, SEGMENTERS

OBJECTS = tuple(name for name in CATEGORIES if name and name not in STRUCTURE)
"""Names to find where no others are given."""


class DetectorLabeller(Labeller):
    """Label the masks of detected objects; where masks overlap, the object of the highest score counts.

    Detectors name no states: `SceneLabels.state` is 0 everywhere.

    Args:
        detector: a name of `wiw.registry.DETECTORS`, or a `Detector`.
        segmenter: a name of `wiw.registry.SEGMENTERS`, or a `Segmenter`.
        names: the objects to find.
        least_score: detections below it are ignored.

    Raises:
        ArgumentError: names that are empty, repeated or more than 255.
    """

    def __init__(
        self,
        detector: str | Detector = "grounding-dino",
        segmenter: str | Segmenter = "sam2",
        names: Sequence[str] = OBJECTS,
        least_score: float = 0.3,
    ) -> None:
        distinct = not isinstance(names, str) and all(name.strip() for name in names) and len(set(names)) == len(names)
        if not distinct or not 0 < len(names) < 256:
            raise ArgumentError(f"DetectorLabeller: expected 1 to 255 distinct names, got {names!r}")
        self.categories = ("", *names)
        self.detector: Detector = DETECTORS.make(detector)
        self.segmenter: Segmenter = SEGMENTERS.make(segmenter)
        self.least_score = least_score
        self.needs = tuple(sorted({*self.detector.needs, *self.segmenter.needs}))
        self.privileged = bool(self.needs)

    def compute_labels(
        self,
        images: NDArray[np.uint8],
        hfov_deg: float,
        ids: NDArray[np.uint32] | None,
        depth: NDArray[np.float32] | None,
    ) -> SceneLabels:
        """Detect, segment and paint."""
        detections = [
            found.take(np.flatnonzero(found.scores >= self.least_score))
            for found in self.detector.detect(images, self.categories[1:], ids)
        ]
        masks = self.segmenter.segment(images, [found.boxes for found in detections], ids)
        category = np.zeros(images.shape[:3], np.uint8)
        confidence = np.zeros(images.shape[:3], np.float32)
        for view, (found, covers) in enumerate(zip(detections, masks, strict=True)):
            self._paint(found, covers, category[view], confidence[view])
        return SceneLabels(category, confidence, np.zeros_like(category))

    def describe(self) -> dict[str, Any]:
        """Return the names of detector and segmenter, and of the objects to find."""
        parts = {"detector": type(self.detector).__name__, "segmenter": type(self.segmenter).__name__}
        return {**super().describe(), **parts, "names": list(self.categories[1:]), "least_score": self.least_score}

    def _paint(
        self,
        found: Detections,
        masks: NDArray[np.bool_],
        category: NDArray[np.uint8],
        confidence: NDArray[np.float32],
    ) -> None:
        """Write one view's masks, the lowest score first."""
        for row in range(len(found) - 1, -1, -1):
            category[masks[row]] = self.categories.index(found.labels[row])
            confidence[masks[row]] = min(1.0, max(0.0, float(found.scores[row])))
