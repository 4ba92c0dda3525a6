# SPDX-License-Identifier: Apache-2.0
"""A question about the two rooms, as an episode file, and perception that goes by their colours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from wiw.datasets import episodes
from wiw.datasets.questions import Question
from wiw.perception.scene_labels import Labeller, SceneLabels
from wiw.types import Episode

QUESTION = Question("What color is the table?", "red", "attribute recognition", "color")


def make_episode(scene: str, question: Question = QUESTION, start: Any = (-3.0, 0.0, 1.0), yaw: float = 0.0) -> Episode:
    """A question asked in the western room, with the table 2 m ahead and a picture within reach on the left."""
    goal = (-1.6, 0.0, -1.2)
    return Episode("one", scene, start, yaw, goal, 0.0, 2.5, {"question": question.to_info()})


def a_file(folder: Path, scene: str) -> Path:
    """One episode in a file."""
    path = folder / "aeqa.json"
    episodes.save(path, [make_episode(scene)], "aeqa")
    return path


class ByColor(Labeller):
    """Takes red for a table, green for a shelf, and blue for a picture."""

    categories = ("", "table", "shelf", "picture")

    def compute_labels(self, images: Any, hfov_deg: float, ids: Any, depth: Any = None) -> SceneLabels:
        others = np.stack([images[..., [1, 2]], images[..., [0, 2]], images[..., [0, 1]]], -2).max(-1).astype(int)
        pure = images.astype(int) > others * 1.3 + 10
        category = np.where(pure.any(-1), pure.argmax(-1) + 1, 0).astype(np.uint8)
        return SceneLabels(category, (category > 0).astype(np.float32), np.zeros_like(category))
