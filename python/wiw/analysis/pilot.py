# SPDX-License-Identifier: Apache-2.0
"""Pilots: what a run, or a task as it was measured here, says of the next run's size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from wiw.analysis.intervals import Array, jackknife_covariance, sum_by_cluster
from wiw.analysis.summary import split_outcomes
from wiw.errors import ArgumentError
from wiw.metrics.metric import SUCCESS
from wiw.runs.run import Run

MOST_CORRELATION = 0.9


@dataclass(frozen=True)
class Pilot:
    """Two arms of a pilot, as `wiw.power` needs them."""

    base: float
    """Success rate of the arm compared with, percent."""
    losses: float
    """Percent of episodes that only the worse of the two arms succeeds in."""
    correlation: float
    """Between the differences of two episodes of a scene."""
    per_scene: int
    source: str

    def settings(self) -> dict[str, Any]:
        """Return the arguments of `wiw.power`."""
        return {name: getattr(self, name) for name in ("base", "losses", "correlation", "per_scene")}


PILOTS = {
    "imagenav": Pilot(45.7, 3.3, 0.05, 5, "oracle and warp, 210 test episodes of version 1: 21 won, 7 lost"),
    "imagenav-near": Pilot(
        67.2, 6.8, 0.05, 5, "warp and warpnet, preset foresight, 250 test episodes: 27 won, 17 lost"
    ),
    "imagenav-far": Pilot(40.8, 9.2, 0.05, 5, "warp and warpnet, preset foresight, 250 test episodes: 27 won, 23 lost"),
    "imagenav-beyond": Pilot(
        46.4, 4.0, 0.05, 5, "oracle and warp, preset foresight, 250 test episodes: 66 won, 10 lost"
    ),
    "ar": Pilot(84.4, 3.1, 0.05, 5, "warp and none, 225 test episodes: 7 won, 7 lost"),
    "ar-foresight": Pilot(62.0, 6.4, 0.05, 5, "warpnet and none, 250 test episodes: 26 won, 16 lost"),
    "aeqa": Pilot(68.3, 5.3, 0.05, 5, "oracle and none, 300 test questions: 22 won, 16 lost"),
    "manipulation": Pilot(74.5, 5.0, 0.0, 1, "armnet and none, 200 tables: 10 lost"),
}
"""By task, and tier or preset: two arms as `docs/results.md` has them.

Correlations within apartments were -0.06 to 0.06.
"""


def find_pilot(task: str) -> Pilot:
    """Return the pilot of a task.

    Raises:
        ArgumentError: none is known.
    """
    if task not in PILOTS:
        raise ArgumentError(
            f"power: no pilot for task '{task}'; choose from {', '.join(PILOTS)}, or give your own run with --pilot"
        )
    return PILOTS[task]


def read_pilot(run: Run, arm: str, base: str) -> Pilot:
    """Return what two arms of a run say of the next one's size.

    Raises:
        ArgumentError: an arm does not exist, or fewer than two episodes are scored in both.
    """
    for name in (arm, base):
        if name not in run.arms:
            raise ArgumentError(f"power: no arm '{name}' in {run.path}; it has {', '.join(run.arms)}")
    done, _ = split_outcomes([arm, base], [row for row in run.store.outcomes() if row["arm"] in (arm, base)])
    common = [i for i in sorted(set(done[arm]) & set(done[base])) if SUCCESS.name in done[arm][i]["metrics"]]
    if len(common) < 2:
        raise ArgumentError(
            f"power: expected a pilot with at least 2 episodes scored in {arm} and {base}, got {len(common)}"
        )
    ours, theirs = (np.array([done[name][i]["metrics"][SUCCESS.name] for i in common]) for name in (arm, base))
    scenes = np.array([done[arm][i]["scene"] for i in common])
    better, worse = (ours, theirs) if ours.mean() >= theirs.mean() else (theirs, ours)
    return Pilot(
        100 * float(theirs.mean()),
        100 * float(np.mean(np.maximum(worse - better, 0))),
        estimate_correlation(ours - theirs, scenes),
        max(1, round(len(common) / len(set(scenes.tolist())))),
        f"{arm} and {base}, {len(common)} episodes of {run.path}",
    )


def estimate_correlation(values: Array, scenes: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> float:
    """Return the correlation of the values of two episodes of a scene, from 0 to `MOST_CORRELATION`.

    From the design effect 1 + (m - 1) correlation, m being the size of the scene that a random episode is of.
    """
    sums, counts = sum_by_cluster(values, scenes)
    size = float(np.square(counts).sum() / counts.sum())
    variance = float(values.var()) / len(values)
    if len(counts) < 2 or size <= 1 or variance <= 0:
        return 0.0
    effect = float(jackknife_covariance(sums, sums, counts)) / variance
    return float(np.clip((effect - 1) / (size - 1), 0.0, MOST_CORRELATION))
