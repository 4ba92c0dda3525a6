# SPDX-License-Identifier: Apache-2.0
"""Visual quality and controllability of imagined frames, next to success (paper, "Fine-grained controllability").

An arm's value is the mean over its episodes of their frames' mean, so that no episode counts for more because more of
its frames were drawn. Success is that of all episodes that are scored in every arm, whether they kept pictures or not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.analysis.rank_correlation import FEW, LEAST, Correlation, correlate
from wiw.analysis.statistics import Estimate, estimate_mean
from wiw.metrics.image_quality import paper_quality
from wiw.metrics.metric import Metric

PAPER_SCORES = {"aesthetic": (1.0, 10.0), "musiq": (0.0, 100.0)}
"""Scores that the paper's quality is made of, with the ranges that a scorer must announce for them."""
PAPER_QUALITY = "q"
CONTROL_BY_LPIPS, CONTROL_BY_SSIM = "1 - LPIPS", "SSIM"
CONTROL = (CONTROL_BY_LPIPS, CONTROL_BY_SSIM)
"""Measures of controllability, the paper's first."""
PLAIN = ("sharpness", "colourfulness")
"""Measures by formula; any other score of a single frame is a better measure of quality."""
BOUNDS = {
    CONTROL_BY_LPIPS: (-math.inf, 1.0),
    CONTROL_BY_SSIM: (-1.0, 1.0),
    PAPER_QUALITY: (5.0, 100.0),
    **dict.fromkeys(PLAIN, (0.0, math.inf)),
}
"""Ends that intervals keep to, besides the ranges that scorers announce."""
FEW_ARMS = 8
"""Arms below which a page says how little an order proves."""


@dataclass(frozen=True)
class Sample:
    """Measurements of one arm."""

    arm: str
    success: Mapping[int, float]
    """By episode, 0 to 1."""
    scores: Mapping[str, Mapping[int, float]]
    """By measure, then by episode."""
    frames: int


@dataclass(frozen=True)
class ArmQuality:
    """One line of the table."""

    arm: str
    success: Estimate
    """Percent."""
    scores: Mapping[str, Estimate]
    """By measure; without those that were not measured in this arm."""
    frames: int


@dataclass(frozen=True)
class QualityTable:
    """The numbers of `wiw quality`."""

    arms: tuple[ArmQuality, ...]
    correlations: tuple[Correlation, ...]
    measures: tuple[str, ...]
    outcome: str
    """Measure of success: "SR", or "Score" where answers have marks."""
    episodes: int
    """Scored in every arm; success is over these."""
    pictured: int
    """Episodes that frames were drawn from."""
    scenes: int
    frames: int
    """Number of frames of each arm."""
    notes: tuple[str, ...] = ()
    scorers: tuple[Mapping[str, Any], ...] = field(default=())
    """Cards of the scorers, with "command"."""

    @property
    def control(self) -> str | None:
        """The measure of controllability, if the true frames are known."""
        return next((name for name in CONTROL if name in self.measures), None)

    @property
    def quality(self) -> str:
        """The measure of visual quality that is drawn: the paper's q, else a predictor's score, else sharpness."""
        single = [name for name in self.measures if name not in CONTROL]
        chosen = [name for name in single if name == PAPER_QUALITY] or [name for name in single if name not in PLAIN]
        return (chosen or single)[0]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


def summarise_quality(
    samples: Sequence[Sample],
    scenes: Mapping[int, str],
    metric: Metric,
    *,
    notes: Sequence[str] = (),
    scorers: Sequence[Mapping[str, Any]] = (),
    seed: int = 0,
) -> QualityTable:
    """Return means with intervals, and rank correlations with success over the arms.

    Args:
        samples: one an arm.
        scenes: of each episode.
        metric: what counts as success.
        notes: what the reader must know besides.
        scorers: their cards.
        seed: of the draws of the intervals.
    """
    episodes = sorted(set.intersection(*(set(sample.success) for sample in samples)))
    labels = [scenes[episode] for episode in episodes]
    measures = tuple(dict.fromkeys(name for sample in samples for name in sample.scores))
    spans = {name: span for card in scorers for name, span in card["scores"].items() if span} | BOUNDS
    lines = tuple(_summarise_arm(sample, episodes, scenes, metric, spans, seed) for sample in samples)
    found = tuple(_correlate(name, samples, episodes, labels, seed) for name in measures)
    pictured = {episode for sample in samples for own in sample.scores.values() for episode in own}
    return QualityTable(
        lines,
        found,
        measures,
        metric.label,
        len(episodes),
        len(pictured),
        len(set(labels)),
        min(sample.frames for sample in samples),
        (*notes, *_list_caveats(found)),
        tuple(scorers),
    )


def add_paper_quality(
    scores: Mapping[str, Mapping[int, float]], ranges: Mapping[str, Any]
) -> dict[str, Mapping[int, float]]:
    """Return an arm's scores with the paper's q first, where both of its parts are there on their published scales.

    Args:
        scores: by name, then by episode.
        ranges: by name, as announced.
    """
    if not all(name in scores and ranges.get(name) == span for name, span in PAPER_SCORES.items()):
        return dict(scores)
    aesthetic, musiq = (scores[name] for name in PAPER_SCORES)
    q = {episode: float(paper_quality(aesthetic[episode], musiq[episode])) for episode in aesthetic if episode in musiq}
    return {PAPER_QUALITY: q, **scores}


def _summarise_arm(
    sample: Sample,
    episodes: Sequence[int],
    scenes: Mapping[int, str],
    metric: Metric,
    spans: Mapping[str, Sequence[float]],
    seed: int,
) -> ArmQuality:
    def estimate(values: Mapping[int, float], of: Metric) -> Estimate:
        return estimate_mean(list(values.values()), [scenes[episode] for episode in values], of, seed=seed)

    common = {
        name: {episode: own[episode] for episode in episodes if episode in own} for name, own in sample.scores.items()
    }
    scores = {
        name: _clip(estimate(own, Metric(name, name, "length", True)), spans.get(name, (-math.inf, math.inf)))
        for name, own in common.items()
        if own
    }
    success = estimate({episode: sample.success[episode] for episode in episodes}, metric)
    return ArmQuality(sample.arm, success, scores, sample.frames)


def _clip(found: Estimate, span: Sequence[float]) -> Estimate:
    """Return the estimate with its interval inside a range, and never without its mean."""
    return replace(
        found, low=max(found.low, min(span[0], found.value)), high=min(found.high, max(span[1], found.value))
    )


def _correlate(
    name: str, samples: Sequence[Sample], episodes: Sequence[int], labels: Sequence[str], seed: int
) -> Correlation:
    """Return the correlation over the arms in which a measure was taken, on the episodes that are scored in all."""
    measured = [sample for sample in samples if sample.scores.get(name)]
    success = np.array([[sample.success[episode] for episode in episodes] for sample in measured], np.float64)
    return correlate(name, success, _arrange_scores(measured, name, episodes), labels, seed)


def _arrange_scores(samples: Sequence[Sample], name: str, episodes: Sequence[int]) -> NDArray[np.float64]:
    return np.array([[sample.scores[name].get(episode, math.nan) for episode in episodes] for sample in samples])


def _list_caveats(found: Sequence[Correlation]) -> list[str]:
    """Return in plain words what so few arms can show."""
    arms = max((one.arms for one in found), default=0)
    if arms < LEAST:
        return [f"A rank correlation needs at least {LEAST} arms with imagined frames; this table has {arms}."]
    if arms >= FEW_ARMS:
        return [_explain_draws(found)]
    least = min(1.0, 2 / math.factorial(arms))
    chance = f"{100 * least:.2g} % of the time"
    weak = " Nothing can be significant at 5 % here, whatever the numbers." if least > 0.05 else ""
    return [
        f"{arms} arms prove little: a random order of {arms} arms is perfect, increasing or decreasing, "
        f"{chance}.{weak}",
        _explain_draws(found),
    ]


def _explain_draws(found: Sequence[Correlation]) -> str:
    """Return what the intervals of the coefficients speak of."""
    one = max(found, key=lambda each: each.arms)
    if one.units < FEW:
        return f"No intervals for rank correlations: {one.units} {one.unit} are too few; at least {FEW} are needed."
    left = [each.defined for each in found if not math.isnan(each.rho)]
    equal = 100 * (1 - min(left, default=1.0))
    out = f" In up to {equal:.0f} % of the resamples the arms cannot be ranked; these are left out."
    out = out if equal >= 0.5 else ""
    return (
        f"Intervals for rank correlations come from resampling the {one.units} {one.unit}, with these arms fixed.{out} "
        "They say nothing about other models, and are too narrow with fewer than about thirty scenes."
    )
