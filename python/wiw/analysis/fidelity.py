# SPDX-License-Identifier: Apache-2.0
"""Fidelity: how accurate each arm's imagination was, next to its success rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from wiw.runs.run import Run


@dataclass(frozen=True)
class Column:
    """A column of the table."""

    title: str
    about: str
    name: str
    """Field of `ArmFidelity`."""
    form: str


COLUMNS = (
    Column("SR %", "Success rate.", "success", ".1f"),
    Column(
        "rank",
        "Kendall's tau between the ranks of the plans by imagined and by true futures.",
        "rank",
        ".2f",
    ),
    Column("best chosen %", "Decisions that chose the plan whose true future scores best.", "best", ".0f"),
    Column("regret", "Score of the best true future minus that of the chosen plan's.", "regret", ".3f"),
    Column(
        "PSNR dB",
        "Imagined against true frames, open loop, at the resolution that the reviser sees.",
        "psnr",
        ".1f",
    ),
    Column("SSIM", "Structural similarity of the same frames.", "ssim", ".3f"),
    Column("LPIPS", "Perceptual distance of perspective views of 256x256; lower is better.", "lpips", ".3f"),
    Column("n", "Decisions whose plans were replayed, the basis of all but SR.", "decisions", "d"),
    Column("n rank", "Those whose plans can be ranked.", "ranked", "d"),
    Column("n regret", "Those that chose one of the replayed plans, so that it has a regret.", "chosen", "d"),
)


@dataclass(frozen=True)
class ArmFidelity:
    """Means over an arm's decisions; NaN where none was measured."""

    arm: str
    decisions: int
    """Decisions that were replayed."""
    success: float
    """Percent of the scored episodes."""
    rank: float
    best: float
    """Percent."""
    regret: float
    psnr: float
    ssim: float
    lpips: float
    ranked: int
    """Replayed decisions that have a rank."""
    chosen: int
    """Replayed decisions that have a regret."""

    def cells(self, columns: Sequence[Column]) -> list[str]:
        """Return the cells of the table."""
        return [_format(getattr(self, column.name), column.form) for column in columns]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


def fidelity(run: Run) -> list[ArmFidelity]:
    """Return one line per arm whose imagined plans were replayed, in the order of the run's table."""
    return [line for arm in run.arms if (line := _summarise_arm(run, arm)) is not None]


def choose_columns(lines: Sequence[ArmFidelity]) -> list[Column]:
    """Return all columns, without LPIPS where no arm has it."""
    return [column for column in COLUMNS if column.name != "lpips" or not all(math.isnan(o.lpips) for o in lines)]


def _summarise_arm(run: Run, arm: str) -> ArmFidelity | None:
    found = [row["fidelity"] for row in run.store.decisions(arm) if row["fidelity"] is not None]
    if not found:
        return None
    judged = [e["metrics"].get("success") for e in run.episodes if e["arm"] == arm and e["status"] == "done"]
    best = [float(one["best"]) for one in found if one["best"] is not None]
    return ArmFidelity(
        arm,
        len(found),
        100 * _average(judged),
        _average([one["rank"] for one in found]),
        100 * _average(best),
        _average([one["regret"] for one in found]),
        _average([value for one in found for value in one["psnr"]]),
        _average([value for one in found for value in one["ssim"]]),
        _average([value for one in found for value in one.get("lpips", ())]),
        _count_known([one["rank"] for one in found]),
        _count_known([one["regret"] for one in found]),
    )


def _average(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None and math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def _count_known(values: Sequence[float | None]) -> int:
    return sum(value is not None and math.isfinite(value) for value in values)


def _format(value: float, form: str) -> str:
    return "–" if math.isnan(value) else f"{value:{form}}"
