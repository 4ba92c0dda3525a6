# SPDX-License-Identifier: Apache-2.0
"""Limits that every agent of a run is built with; none of them changes an agent's decisions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.errors import ArgumentError
from wiw.loop.limits import BUDGET_GB, DEADLINE

NO_DEADLINE = 1e12
"""Seconds that stand for no deadline where a number has to be written down."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of an agent's world model, and whether fidelity is measured.

    Raises:
        ArgumentError: a number out of range.
    """

    deadline: Annotated[float, arg(metavar="SECONDS")] = DEADLINE
    """Most seconds for a call of the world model; it is asked three times before the episode is recorded as an
    infrastructure error, which is excluded from scores."""
    cache: Annotated[str | Path, arg(metavar="auto|off|DIR")] = "auto"
    """Where rollouts are cached, so that no question is put to a model twice: auto for models that declare themselves
    cacheable, in ~/.cache/wiw/rollouts; a folder for every model; or off."""
    cache_gb: Annotated[float, arg(metavar="N")] = BUDGET_GB
    """Most gigabytes of that folder; the least recently used rollouts go first."""
    fidelity: bool = False
    """Whether every imagined plan is also replayed in the simulator, to measure how true imagination was. Changes no
    decision, but takes about as long as the oracle."""
    fidelity_share: Annotated[float, arg(metavar="SHARE")] = 1.0
    """Share of the decisions that fidelity is measured at, drawn by their keys."""
    lpips: Annotated[str | Path | None, arg(metavar="auto|DIR")] = None
    """Folder with the weights of LPIPS, to measure fidelity by it as well (auto: ~/.cache/wiw/weights). Where they are
    not there, it says which files are needed."""

    def __post_init__(self) -> None:
        for name in ("deadline", "cache_gb"):
            if not getattr(self, name) > 0:
                raise ArgumentError(f"expected a {name} above 0, got {getattr(self, name)}")
        if not 0 < self.fidelity_share <= 1:
            raise ArgumentError(f"expected a fidelity_share above 0 and up to 1, got {self.fidelity_share}")

    @property
    def measures_fidelity(self) -> bool:
        """Whether plans are replayed in the simulator."""
        return self.fidelity or self.lpips is not None

    def to_json(self) -> dict[str, Any]:
        """Return the limits for the run store, the same in any folder; `Limits(**...)` is the way back."""
        own = {name: getattr(self, name) for name in Limits.__dataclass_fields__}
        own["deadline"] = min(self.deadline, NO_DEADLINE)
        own["cache"], own["lpips"] = _make_absolute(self.cache), _make_absolute(self.lpips)
        return own


def _make_absolute(folder: str | Path | None) -> str | None:
    """Return a folder so that it means the same anywhere, and words that stand for one as they are."""
    if folder is None or str(folder) in ("auto", "off"):
        return None if folder is None else str(folder)
    return str(Path(folder).expanduser().resolve())
