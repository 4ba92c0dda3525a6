# SPDX-License-Identifier: Apache-2.0
"""Wall time by stage."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Clock:
    """`with clock("stage"): ...` adds the block's wall time to that stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        begin, token = time.perf_counter(), _RUNNING.set((self, stage))
        try:
            yield
        finally:
            _RUNNING.reset(token)
            self.seconds[stage] += time.perf_counter() - begin

    def share(self, count: int) -> dict[str, float]:
        """Return the seconds by stage, divided over `count` episodes that shared the work."""
        return {stage: seconds / count for stage, seconds in self.seconds.items()}


_RUNNING: ContextVar[tuple[Clock, str] | None] = ContextVar("wiw_running_stage", default=None)


@contextmanager
def time_separately(stage: str) -> Iterator[None]:
    """Add the block's wall time to `stage` instead of the stage that is being timed, if any."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        running = _RUNNING.get()
        if running is not None:
            clock, around = running
            clock.seconds[stage] += time.perf_counter() - begin
            clock.seconds[around] -= time.perf_counter() - begin
