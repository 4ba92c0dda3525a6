# SPDX-License-Identifier: Apache-2.0
"""What the tables of a run show of its episodes: one column a metric."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from wiw.errors import ContractError


@dataclass(frozen=True)
class Headline:
    """One column: the mean of a number over episodes, with its interval.

    A package adds its own by an entry point in "wiw.metrics":

        NEAR = wiw.Headline("near", "Near", "rate", True, of=lambda metrics: metrics["distance_to_goal"] < 1.5)
    """

    metric: str
    """Name in `EpisodeResult.metrics`, and of `of`'s value among them."""
    label: str
    kind: Literal["rate", "length"]
    """"rate": episode values in [0, 1], shown as percent. "length": any number."""
    higher_is_better: bool
    of: Callable[[Mapping[str, float]], float] | None = None
    """An episode's value from its metrics, where the task does not measure it; with a KeyError it has none."""
    about: str = ""
    """One line for `wiw list`."""
    least: float = -math.inf
    """What no episode's value is below, so that intervals of their mean end there."""

    @property
    def scale(self) -> float:
        """From episode values to what is shown."""
        return 100.0 if self.kind == "rate" else 1.0

    @property
    def unit(self) -> str:
        """Sign behind the number."""
        return "%" if self.kind == "rate" else ""

    def added(self, metrics: Mapping[str, float]) -> Mapping[str, float]:
        """An episode's metrics, with this one's value if it can be told.

        Raises:
            ContractError: `of` raised, or its value is not finite, or a rate's is outside [0, 1].
        """
        if self.of is None or self.metric in metrics:
            return metrics
        try:
            value = float(self.of(metrics))
        except KeyError:
            return metrics
        except Exception as error:
            said = f"{type(error).__name__}: {error}"
            raise ContractError(f"metric '{self.metric}': {said}; it was given {dict(metrics)}") from error
        if not math.isfinite(value) or (self.kind == "rate" and not 0 <= value <= 1):
            expected = "a number from 0 to 1" if self.kind == "rate" else "a finite number"
            raise ContractError(f"metric '{self.metric}': expected {expected}, got {value} of {dict(metrics)}")
        return {**metrics, self.metric: value}


SUCCESS = Headline("success", "SR", "rate", True, about="Success rate: percent of episodes that succeeded.")
SPL = Headline("spl", "SPL", "rate", True, about="Success weighted by path length, in percent.")
MEAN_TRAJECTORY = Headline(
    "actions",
    "Mean Traj",
    "length",
    False,
    about="Mean number of executed primitives; of a manipulator's decisions.",
    least=0.0,
)
REFUSED = Headline(
    "refused", "Refused", "length", False, about="Mean number of a gripper's ways that ended early.", least=0.0
)
