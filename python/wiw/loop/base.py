# SPDX-License-Identifier: Apache-2.0
"""The interface of agents that runs rely on, whatever the method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from typing import Any

from wiw.loop.memory import Query
from wiw.loop.privileged import LiveEnvironments
from wiw.types import Decision, Key


class BaseAgent(ABC):
    """Decides what to do. `wiw.Agent` is the paper's; derive from this one to evaluate another method."""

    needs: tuple[str, ...] = ()
    """What observations must carry beyond images: "depth"."""

    @abstractmethod
    def decide_batch(self, queries: Sequence[Query]) -> list[Decision]:
        """Decide once for each live episode."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity for the run's manifest."""

    def grant(self, environments: LiveEnvironments) -> None:  # noqa: B027 - most need no privilege
        """Take the environments that episodes are run in, for parts that are privileged."""

    def forget(self, key: Key) -> None:  # noqa: B027 - most keep nothing
        """Drop what is kept of an episode that has ended."""

    def count_spent(self) -> Counter[str]:
        """Return what models have been asked for so far."""
        return Counter()
