# SPDX-License-Identifier: Apache-2.0
"""Metrics: a number per episode, and how a run's tables summarise it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Literal

from wiw.errors import ArgumentError, ContractError


@dataclass(frozen=True)
class Metric:
    """One column of a run's tables: the mean of a number over episodes, with its interval.

    A package adds its own with an entry point in "wiw.metrics":

        NEAR = wiw.Metric("near", "Near", "rate", True, of=lambda metrics: metrics["distance_to_goal"] < 1.5)
    """

    name: str
    """Key in `EpisodeResult.metrics`, also for the value that `of` computes."""
    label: str
    """Title of the column."""
    kind: Literal["rate", "length"]
    """"rate": episode values in [0, 1], shown as percent. "length": any number."""
    higher_is_better: bool
    of: Callable[[Mapping[str, float]], float] | None = None
    """Computes an episode's value from its other metrics if the task does not measure it; raises KeyError if one that
    it needs is missing, in which case the episode has no value."""
    about: str = ""
    """One line for `wiw list`."""
    least: float = -math.inf
    """Smallest possible value, where intervals of the mean end."""
    paper_name: str = ""
    """Name of the metric in the World-in-World paper, if it differs from the label."""
    partial: bool = False
    """Whether episodes may lack a value, with the mean over those that have one. Otherwise every episode needs one."""

    def __post_init__(self) -> None:
        if self.kind not in ("rate", "length"):
            raise ArgumentError(f"metric '{self.name}': expected kind 'rate' or 'length', got {self.kind!r}")

    @property
    def scale(self) -> float:
        """Factor from episode values to the numbers in tables."""
        return 100.0 if self.kind == "rate" else 1.0

    @property
    def unit(self) -> str:
        """Unit in the column's title."""
        return "%" if self.kind == "rate" else ""

    def add_to(self, metrics: Mapping[str, float]) -> Mapping[str, float]:
        """Return an episode's metrics with this one's value, if it can be computed from them.

        Raises:
            ContractError: `of` raised, or its value is not finite, or a rate is outside [0, 1]. NaN is a value where a
                metric that `of` was given is NaN: it was not measured, and neither is what follows from it.
        """
        if self.of is None or self.name in metrics:
            return metrics
        try:
            value = float(self.of(metrics))
        except KeyError:
            return metrics
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            raise ContractError(f"metric '{self.name}': {message}; it was given {dict(metrics)}") from error
        if math.isnan(value) and any(map(math.isnan, metrics.values())):
            return {**metrics, self.name: value}
        if not math.isfinite(value) or (self.kind == "rate" and not 0 <= value <= 1):
            expected = "a number from 0 to 1" if self.kind == "rate" else "a finite number"
            raise ContractError(f"metric '{self.name}': expected {expected}, got {value} of {dict(metrics)}")
        return {**metrics, self.name: value}


def is_success(metrics: Mapping[str, float]) -> bool:
    """Return whether an episode counts as a success; a part of one, which a task of one's own may give, does not."""
    return metrics.get("success", 0) >= 1


def name_column(metric: str, taken: Collection[str]) -> str:
    """Return a metric's column in an exported table: "metric_NAME" where one of the table's own has its name."""
    return f"metric_{metric}" if metric in taken else metric


SUCCESS = Metric("success", "SR", "rate", True, about="Success rate: percent of episodes that succeeded.")
SPL = Metric("spl", "SPL", "rate", True, about="Success weighted by path length, in percent.")
SPL_RULE = (
    "SPL: the mean of success * l / max(l, p), as in the paper; p is the path walked, l the shortest path to the goal "
    "point itself (in primitives instead of metres where the rules say so). Success only requires coming within its "
    "radius, so a detour of about that length costs nothing."
)
"""The formula for paths that lead to a goal point."""
ANSWER_SCORE = Metric(
    "answer_score", "Score", "rate", True, about="Mean mark of the answers, 1 to 5 mapped to 0 to 100."
)
ANSWERED = Metric("answered", "Answered", "rate", True, about="Percent of questions that were answered in time.")
GROUNDED = Metric(
    "grounded",
    "Grounded",
    "rate",
    True,
    about="Percent of episodes in which the object of the question was in sight.",
    partial=True,
)
PATH_LENGTH = Metric(
    "path_length",
    "Metres",
    "length",
    False,
    about="Mean length of the path in metres. Mean Traj of A-EQA in the paper.",
    least=0.0,
    paper_name="Mean Traj",
)
MEAN_TRAJECTORY = Metric(
    "actions",
    "Actions",
    "length",
    False,
    about="Mean number of executed actions per episode; for manipulation, of decisions. Mean Traj in the paper.",
    least=0.0,
    paper_name="Mean Traj",
)
REFUSED = Metric(
    "refused", "Refused", "length", False, about="Mean number of gripper motions that ended early.", least=0.0
)
