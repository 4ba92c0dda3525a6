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
