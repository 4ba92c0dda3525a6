# SPDX-License-Identifier: Apache-2.0
"""An explorer whose real views are labelled by the ground truth: what is left of its errors is not perception's.

It is privileged, and no agent to compare world models with: tables of runs name it as what it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from wiw.loop.privileged import LiveEnvironments, Privileged
from wiw.mapping.views import HFOV_DEG, Views, cut_labels
from wiw.perception.oracle_labeller import OracleLabeller
from wiw.perception.scene_labels import SceneLabels
from wiw.policies.base import Situation
from wiw.policies.explorer import Explorer


class OracleExplorer(Explorer, Privileged):
    """`Explorer` with true categories and states of what is in sight; imagined views are labelled as ever.

    Args:
        options: of `Explorer`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._environments = LiveEnvironments()

    def grant(self, environments: LiveEnvironments) -> None:
        """Take the environments whose instance ids label the views."""
        self._environments = environments

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity that says what is known."""
        return {**super().describe(), "privileged": "perception"}

    def label_real(self, situations: Sequence[Situation], cut: Sequence[Views]) -> SceneLabels:
        """Return the true labels of the real views."""
        found = [self._label_one(situation, views) for situation, views in zip(situations, cut, strict=True)]
        fields = ("category", "confidence", "state")
        return SceneLabels(*(np.concatenate([getattr(each, name) for each in found]) for name in fields))

    def _label_one(self, situation: Situation, views: Views) -> SceneLabels:
        env = self._environments.find(situation.key)
        ids, instances = env.instances()
        labeller = OracleLabeller(instances, self.labeller.categories)
        return labeller.label(views.images, HFOV_DEG, cut_labels(ids, views.size))
