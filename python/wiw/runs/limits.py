# SPDX-License-Identifier: Apache-2.0
"""Limits shared by all agents of a run; none of them changes an agent's decisions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.errors import ArgumentError
from wiw.loop.limits import BUDGET_GB, DEADLINE

NO_DEADLINE = 1e12
"""Seconds that stand for no deadline where a number must be stored."""
STALL_DEADLINES = 24
"""Deadlines that pass without news before a worker counts as hung: a decision may make many calls."""
LEAST_STALL = 7200.0
"""Seconds without news that are allowed by default: not everything that takes long has a deadline."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of an agent's world model, and whether fidelity is measured.

    Raises:
        ArgumentError: a number out of range.
    """

    deadline: Annotated[float, arg(metavar="SECONDS")] = DEADLINE
    """Time limit in seconds for a call to the world model. After three attempts the episode is recorded as an
    infrastructure error, which is excluded from scores."""
    stall: Annotated[float | None, arg(metavar="SECONDS")] = None
    """Time in seconds without news from a worker process or Ray actor, such as a decision, after which it is stopped as
    hung, and its episodes begin again; more than a model takes to load. Default: 2 hours, or 24 times --deadline. A run
    of --workers 1 has no such process, and so no such limit."""
    cache: Annotated[str | Path, arg(metavar="auto|off|DIR")] = "auto"
    """Where rollouts are cached, so that a model never computes the same one twice: auto (~/.cache/wiw/rollouts, or
    $WIW_CACHE/rollouts, for models that declare themselves cacheable), a folder (for all that have a version, but never
    the oracle), or off."""
    cache_gb: Annotated[float, arg(metavar="N")] = BUDGET_GB
    """Maximum size of that folder in gigabytes; the least recently used rollouts are dropped first."""
    fidelity: bool = False
    """Whether to replay every imagined plan in the simulator, to measure how faithful imagination is. Changes no
    decision, but takes about as long as the oracle."""
    fidelity_share: Annotated[float, arg(metavar="SHARE")] = 1.0
    """Share of the decisions, sampled by their keys, at which fidelity is measured."""
    lpips: Annotated[str | Path | None, arg(metavar="auto|DIR")] = None
    """Folder with the weights of LPIPS, to measure fidelity with it as well (auto: ~/.cache/wiw/weights, or
    $WIW_CACHE/weights). If they are missing, the error says which files are needed."""

    def __post_init__(self) -> None:
        for name in ("deadline", "stall", "cache_gb"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ArgumentError(f"expected a {name} above 0, got {value}")
        if not 0 < self.fidelity_share <= 1:
            raise ArgumentError(f"expected a fidelity_share above 0 and up to 1, got {self.fidelity_share}")

    @property
    def patience(self) -> float:
        """Seconds without news after which a worker counts as hung; infinite in one with no deadline for its calls."""
        patience = max(LEAST_STALL, STALL_DEADLINES * self.deadline) if self.stall is None else self.stall
        return patience if patience < NO_DEADLINE else math.inf

    @property
    def measures_fidelity(self) -> bool:
        """Whether plans are replayed in the simulator."""
        return self.fidelity or self.lpips is not None

    def to_json(self) -> dict[str, Any]:
        """Return the limits for the run store, independent of the working directory; `Limits(**...)` is the inverse."""
        own = {name: getattr(self, name) for name in Limits.__dataclass_fields__}
        own["deadline"] = min(self.deadline, NO_DEADLINE)
        own["stall"] = None if self.stall is None else min(self.stall, NO_DEADLINE)
        own["cache"], own["lpips"] = _make_absolute(self.cache), _make_absolute(self.lpips)
        return own


def _make_absolute(folder: str | Path | None) -> str | None:
    """Return a folder as an absolute path, and words that stand for a folder unchanged."""
    if folder is None or str(folder) in ("auto", "off"):
        return None if folder is None else str(folder)
    return str(Path(folder).expanduser().resolve())
