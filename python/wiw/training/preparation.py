# SPDX-License-Identifier: Apache-2.0
"""Options for preparing training data: the number of processes, and the cache."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.errors import ArgumentError

ProgressBar = Callable[[Iterable[Any], str, int], Iterable[Any]]
"""Wraps an iterable of a given number of items in a progress bar: (items, text, total)."""


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """Options for preparing training data.

    Raises:
        ArgumentError: no workers.
    """

    workers: Annotated[int, arg(metavar="N")] = 2
    """Number of processes that prepare the training data."""
    cache: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder for prepared training data, which can be deleted at any time. Default: $WIW_CACHE/looks."""

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ArgumentError(f"--workers: expected 1 or more, got {self.workers}")

    @property
    def folder(self) -> Path:
        """Folder of prepared training data."""
        from wiw.scenes.store import folder

        return self.cache or folder().parent / "looks"

    def list_arguments(self, bar: ProgressBar) -> dict[str, Any]:
        """Return the keyword arguments of the functions of `wiw.training.gather`."""
        return {"folder": self.folder, "workers": self.workers, "bar": bar}


PREPARATION = Preparation()


def show_no_bar(items: Iterable[Any], text: str, total: int) -> Iterable[Any]:
    """Return the items as they are, in place of a progress bar."""
    return items
