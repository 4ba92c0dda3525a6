# SPDX-License-Identifier: Apache-2.0
"""Wall time by stage."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """`with clock("stage"): ...` adds the block's wall time to that stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - begin

    def move(self, seconds: float, origin: str, target: str) -> None:
        """Books part of a stage's time under another."""
        if seconds:
            self.seconds[origin] -= seconds
            self.seconds[target] += seconds

    def share(self, count: int) -> dict[str, float]:
        """Seconds by stage, divided over `count` episodes that shared the work."""
        return {stage: seconds / count for stage, seconds in self.seconds.items()}
