# SPDX-License-Identifier: Apache-2.0
"""How true each arm's imagination was, next to how often the agent succeeded with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from wiw.runs.run import Run


@dataclass(frozen=True)
class Column:
    """Of the table."""

    title: str
    about: str
    name: str
    """Of the figure in `ArmFidelity`."""
    form: str


COLUMNS = (
    Column("SR %", "Success rate.", "success", ".1f"),
    Column(
        "rank",
        "Kendall's tau: how far imagined futures put the plans into the order that the true ones give.",
        "rank",
        ".2f",
    ),
    Column("best chosen %", "Decisions for the plan whose true future scores best.", "best", ".0f"),
    Column("regret", "By how much the chosen plan's true future scores less than the best one.", "regret", ".3f"),
    Column(
        "PSNR dB",
        "Of imagined frames against what would have been seen, open loop, at the size the reviser sees.",
        "psnr",
        ".1f",
    ),
    Column("SSIM", "The same, structural similarity.", "ssim", ".3f"),
    Column("LPIPS", "The same of perspective views of 256x256: perceptual distance, lower is truer.", "lpips", ".3f"),
)


@dataclass(frozen=True)
class ArmFidelity:
    """Means over an arm's decisions; NaN where no decision says."""

    arm: str
    decisions: int
    """That were replayed."""
    success: float
    """Percent of the judged episodes."""
    rank: float
    best: float
    """Percent."""
    regret: float
    psnr: float
    ssim: float
    lpips: float

    def cells(self, columns: Sequence[Column]) -> list[str]:
        """Columns of the table, in words."""
        return [_shown(getattr(self, column.name), column.form) for column in columns]

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def fidelity(run: Run) -> list[ArmFidelity]:
    """One line for each arm that imagined and was replayed, in the order of the run's table."""
    return [line for arm in run.arms if (line := _arm(run, arm)) is not None]


def shown_columns(lines: Sequence[ArmFidelity]) -> list[Column]:
    """All columns but LPIPS where no arm has it."""
    return [column for column in COLUMNS if column.name != "lpips" or not all(math.isnan(o.lpips) for o in lines)]


def _arm(run: Run, arm: str) -> ArmFidelity | None:
    found = [row["fidelity"] for row in run.store.decisions(arm) if row["fidelity"] is not None]
    if not found:
        return None
    judged = [e["metrics"].get("success") for e in run.episodes if e["arm"] == arm and e["status"] == "done"]
    best = [float(one["best"]) for one in found if one["best"] is not None]
    return ArmFidelity(
        arm,
        len(found),
        100 * _mean(judged),
        _mean([one["rank"] for one in found]),
        100 * _mean(best),
        _mean([one["regret"] for one in found]),
        _mean([value for one in found for value in one["psnr"]]),
        _mean([value for one in found for value in one["ssim"]]),
        _mean([value for one in found for value in one.get("lpips", ())]),
    )


def _mean(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None and math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def _shown(value: float, form: str) -> str:
    return "–" if math.isnan(value) else f"{value:{form}}"
