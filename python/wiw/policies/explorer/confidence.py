# SPDX-License-Identifier: Apache-2.0
"""The confidence of an answer: its support by the map, as the share of answers so supported that are right."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np

CURVES = Path(__file__).with_name("confidence.json")
"""Curves by answer type, and under "" of all; measured on val questions by `wiw.analysis.answer_confidence`."""


@cache
def load_curves() -> Mapping[str, Mapping[str, Sequence[float]]]:
    """Return the curves that the package ships."""
    curves: Mapping[str, Mapping[str, Sequence[float]]] = json.loads(CURVES.read_text(encoding="utf-8"))
    return curves


def estimate_confidence(answer_type: str, support: float) -> float:
    """Return the probability that an answer of a type is right; 0 for one that nothing observed supports."""
    if support <= 0:
        return 0.0
    curves = load_curves()
    curve = curves.get(answer_type, curves[""])
    return float(np.interp(support, curve["support"], curve["right"]))
