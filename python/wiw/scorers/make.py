# SPDX-License-Identifier: Apache-2.0
"""Make a scorer from what the user wrote."""

from __future__ import annotations

from wiw.errors import ArgumentError
from wiw.scorers.laion import LaionScorer
from wiw.scorers.pixels import PixelScorer
from wiw.scorers.process import DEADLINE, ProcessScorer
from wiw.scorers.scorer import Scorer


def make_scorer(spec: str, deadline: float = DEADLINE) -> Scorer:
    """Return a scorer.

    Args:
        spec: "pixels" (sharpness and colourfulness), "laion" or "laion:FOLDER" (LAION's aesthetic predictor), else a
            command as in a shell, without pipes.
        deadline: seconds that a command may be silent.

    Raises:
        ArgumentError: nothing is named, or a deadline out of range.
        WeightsError: weights of LAION's predictor are missing.
        ScorerError: the command cannot be run, or does not say who it is.
    """
    name, _, folder = spec.strip().partition(":")
    if not name:
        raise ArgumentError("scorer: expected pixels, laion, laion:FOLDER or a command, got nothing")
    if name == "pixels" and not folder:
        return PixelScorer()
    if name == "laion":
        return LaionScorer(folder or "auto")
    return ProcessScorer(spec, deadline)
