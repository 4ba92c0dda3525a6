# SPDX-License-Identifier: Apache-2.0
"""Scorers of images: built in, by a network, or any command in a separate process."""

from wiw.scorers.laion import LaionScorer
from wiw.scorers.make import make_scorer
from wiw.scorers.pixels import PixelScorer
from wiw.scorers.process import ProcessScorer
from wiw.scorers.scorer import Range, Scorer, ScorerCard

__all__ = ["LaionScorer", "PixelScorer", "ProcessScorer", "Range", "Scorer", "ScorerCard", "make_scorer"]
