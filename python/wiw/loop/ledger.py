# SPDX-License-Identifier: Apache-2.0
"""The cost of decisions: wall time by stage, and the requests to models and policies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from wiw.loop.clock import Clock


class Ledger:
    """Costs of one batch of decisions, shared equally by its episodes.

    Args:
        count_spent: returns what has been asked for so far (`Agent.count_spent`).
        episodes: how many share the batch.
    """

    def __init__(self, count_spent: Callable[[], Counter[str]], episodes: int) -> None:
        self.clock = Clock()
        self._count, self._episodes, self._before = count_spent, episodes, count_spent()

    def close(self) -> Mapping[str, Any]:
        """Return `seconds` and `spent` of each of the decisions."""
        spent = {name: (count - self._before[name]) / self._episodes for name, count in self._count().items()}
        return {"seconds": self.clock.share(self._episodes), "spent": spent}
