# SPDX-License-Identifier: Apache-2.0
"""The ground truth as a labeller: categories and states of the simulator's instances, for real views alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.perception.scene_labels import STATES, Labeller, SceneLabels, merge_category


class OracleLabeller(Labeller):
    """Look up each pixel's instance in the scene's table; confidence 1 wherever something is hit.

    Args:
        instances: `scene.instances`.
        categories: the names to use, "" first; others are labelled 0. None means those of the scene, in
            alphabetical order.

    Raises:
        ArgumentError: categories that do not start with "", are repeated or are more than 256.
    """

    needs = ("ids",)
    privileged = True

    def __init__(self, instances: Sequence[Mapping[str, Any]], categories: Sequence[str] | None = None) -> None:
        names = {int(each["id"]): merge_category(each["category"]) for each in instances}
        self.categories = ("", *sorted(set(names.values()))) if categories is None else tuple(categories)
        if self.categories[:1] != ("",) or len(set(self.categories)) != len(self.categories):
            raise ArgumentError(f"OracleLabeller: expected '' followed by distinct names, got {self.categories}")
        if len(self.categories) > 256:
            raise ArgumentError(f"OracleLabeller: expected at most 256 categories, got {len(self.categories)}")
        numbers = {name: i for i, name in enumerate(self.categories)}
        states = {int(each["id"]): each["attributes"].get("state", "") for each in instances}
        self._category, self._state = np.zeros((2, max(names, default=0) + 1), np.uint8)
        for instance, name in names.items():
            self._category[instance] = numbers.get(name, 0)
            self._state[instance] = STATES.index(states[instance]) if states[instance] in STATES else 0

    def compute_labels(
        self,
        images: NDArray[np.uint8],
        hfov_deg: float,
        ids: NDArray[np.uint32] | None,
        depth: NDArray[np.float32] | None,
    ) -> SceneLabels:
        """Look up each pixel's instance."""
        assert ids is not None
        if ids.size and int(ids.max()) >= len(self._category):
            raise ArgumentError(
                f"OracleLabeller: expected ids up to {len(self._category) - 1}, got {int(ids.max())}: these views are "
                "of another scene than the labeller's"
            )
        category = self._category[ids]
        return SceneLabels(category, (category > 0).astype(np.float32), self._state[ids])
