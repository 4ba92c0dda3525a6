# SPDX-License-Identifier: Apache-2.0
"""Calibrate the explorer's confidence: how often answers of each type are right, by how well they are supported.

Counted in a run on val questions whose explorers reported their support as it is (`calibrated=False`).
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import isotonic_regression

from wiw.datasets.questions import Question
from wiw.errors import ArgumentError
from wiw.files import atomic_file
from wiw.judging import make_judge
from wiw.judging.judge import HIGHEST_MARK
from wiw.runs.store import RunStore
from wiw.tasks.answer_record import make_reference

KNOTS = 6
"""Points of a curve at most."""
LEAST = 12
"""Episodes of an answer type that have a curve of their own."""
DOUBT = 2.0
"""Episodes that are added to each point as half right, so that few of them prove little."""
Sample = tuple[float, float, float]
"""Support, whether the answer was right (0 or 1), and weight."""


def calibrate_confidence(run: str | Path) -> dict[str, dict[str, list[float]]]:
    """Return the curve of each answer type, and under "" that of all types, by what explorers answered in a run.

    Each episode counts as much as any other, however many decisions it has.

    Returns:
        by answer type, {"support": ascending, "right": shares}; see `wiw.policies.explorer.confidence`.

    Raises:
        StoreError: the run cannot be read.
        ArgumentError: nothing was answered in it.
    """
    samples = defaultdict[str, list[Sample]](list)
    judge = make_judge("rules")
    with RunStore.read(run) as store:
        questions = [Question.from_info(episode.info["question"]) for episode in store.episodes()]
        rows = [(row["arm"], row["episode"], row["answer"]) for row in store.decisions() if row["answer"]]
    supported = [(arm, episode, answer) for arm, episode, answer in rows if answer["confidence"] > 0]
    counts = Counter((arm, episode) for arm, episode, _ in supported)
    for arm, episode, answer in supported:
        asked = questions[episode]
        right = float(judge.judge([make_reference(asked)], [answer["label"]])[0].mark == HIGHEST_MARK)
        for name in (asked.answer_type, ""):
            samples[name].append((answer["confidence"], right, 1 / counts[arm, episode]))
    episodes = Counter(questions[episode].answer_type for _, episode in counts)
    if not samples:
        raise ArgumentError(f"calibrate_confidence: expected a run of policy explorer, got {run}, which has no answers")
    return {name: fit_curve(found) for name, found in sorted(samples.items()) if not name or episodes[name] >= LEAST}


def fit_curve(samples: Sequence[Sample]) -> dict[str, list[float]]:
    """Return a curve that never falls through samples, at most `KNOTS` points: means of equal shares of the weight."""
    support, right, weight = np.array(samples).T
    levels, place = np.unique(support, return_inverse=True)
    held = np.bincount(place, weight, len(levels))  # equal support stays in one group
    share = (np.cumsum(held) - held / 2) / weight.sum()
    group = np.minimum((share * KNOTS).astype(int), KNOTS - 1)[place]
    total = np.bincount(group, weight, KNOTS)
    used = total > 0
    means = np.bincount(group, weight * support, KNOTS)[used] / total[used]
    rates = (np.bincount(group, weight * right, KNOTS)[used] + DOUBT / 2) / (total[used] + DOUBT)
    fitted = isotonic_regression(rates, weights=total[used]).x
    return {"support": means.round(4).tolist(), "right": fitted.round(4).tolist()}


def write_calibration(run: str | Path, path: str | Path) -> Mapping[str, Mapping[str, Sequence[float]]]:
    """Calibrate by a run and write the file that `wiw.policies.explorer.confidence` reads; return the curves."""
    found = calibrate_confidence(run)
    with atomic_file(Path(path)) as partial:
        partial.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found
