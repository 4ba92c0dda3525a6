# SPDX-License-Identifier: Apache-2.0
"""Labellers without weights, for tests that name perception as `path.py:Class`."""

from __future__ import annotations

from typing import Any

import numpy as np

from wiw.perception.scene_labels import CATEGORIES, Labeller, SceneLabels


class Blindfold(Labeller):
    """Recognises nothing."""

    categories = CATEGORIES

    def compute_labels(self, images: np.ndarray, hfov_deg: float, ids: Any, depth: Any) -> SceneLabels:
        empty = np.zeros(images.shape[:3], np.uint8)
        return SceneLabels(empty, empty.astype(np.float32), empty.copy())


class RedIsASofa(Blindfold):
    """Takes what is red for a sofa, and recognises nothing else."""

    def compute_labels(self, images: np.ndarray, hfov_deg: float, ids: Any, depth: Any) -> SceneLabels:
        red, green, blue = np.moveaxis(images.astype(np.int16), -1, 0)
        sofa = (red > 60) & (red > 2 * green) & (red > 2 * blue)
        category = np.where(sofa, CATEGORIES.index("sofa"), 0).astype(np.uint8)
        return SceneLabels(category, sofa.astype(np.float32), np.zeros_like(category))
