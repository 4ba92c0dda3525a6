# SPDX-License-Identifier: Apache-2.0
"""Options and checks shared by the small networks, which train in one process, on the CPU, into one file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.cli.stop import announce_resume
from wiw.errors import ArgumentError
from wiw.training.launcher import require_single_process

VAL_SCENES = "apartments:val:20"
Count = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
"""A number for which the recipe has a default."""


def drop_none(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def check_counts(**counts: int | None) -> None:
    """Refuse counts below 1, by the names of their options."""
    for name, count in drop_none(counts).items():
        if count < 1:
            raise ArgumentError(f"--{name}: expected 1 or more, got {count}")


def check_seed(seed: int | None) -> None:
    """Refuse seeds that are out of range."""
    if seed is not None and not 0 <= seed < 2**63:
        raise ArgumentError(f"--seed: expected 0 to 2**63 - 1, got {seed}")


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How long training may take, and its seed.

    Raises:
        ArgumentError: a number out of range.
    """

    minutes: Annotated[float | None, arg(metavar="MIN")] = None
    """Time limit in minutes: train fewer epochs if all of them would take longer."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of the training data and of the weights."""

    def __post_init__(self) -> None:
        if self.minutes is not None and not (self.minutes > 0 and math.isfinite(self.minutes)):
            raise ArgumentError(f"--minutes: expected a number above 0, got {self.minutes}")
        check_seed(self.seed)


NO_LIMITS = Limits()


@contextmanager
def write_weights(name: str, out: Path) -> Iterator[None]:
    """Train one network into a file: check that this can be done first, and report the file's size at the end.

    Raises:
        ArgumentError: there are several processes, which would all train the same way and write the same file.
        FileError: the file cannot be written, which is checked before spending minutes on training.
    """
    require_single_process(name, "run the command without torchrun")
    _check_out(out)
    with announce_resume():
        yield
    print(f"weights   {out} ({out.stat().st_size / 2**20:.2f} MB)")


def _check_out(out: Path) -> None:
    from wiw.errors import FileError

    if not out.absolute().parent.is_dir() or out.is_dir():
        raise FileError(f"{out}: cannot be written; choose a file in an existing folder with --out")


def to_percent(share: float | None) -> str:
    """Return a share as text, "-" if there is none."""
    return "-" if share is None else f"{100 * share:.1f} %"
