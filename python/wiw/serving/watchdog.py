# SPDX-License-Identifier: Apache-2.0
"""A watchdog for a model that does not return, such as one in a GPU call that never ends.

Nothing in its process can stop such a call, so a server that hangs has to end, and what started it can start it again.
"""

from __future__ import annotations

import time

from wiw.errors import ArgumentError
from wiw.serving.server import Server

LEAST_STALL = 1200.0
"""Seconds that a call may take at least before the model counts as hung."""
STALL_WAITS = 4
"""Multiple of the longest wait that a client has stated; after three tries (`wiw.loop.attempts`) it waits no more."""


class Watchdog:
    """Tells whether a server's model hangs.

    Args:
        server: what is watched.
        stall: seconds that a call may take; `math.inf` never counts as hung. None means four times the longest wait
            that a client has stated, and at least 1200 s.

    Raises:
        ArgumentError: no time is left for any call.
    """

    def __init__(self, server: Server, stall: float | None = None) -> None:
        if stall is not None and not stall > 0:
            raise ArgumentError(f"serve: expected a stall of more than 0 seconds (inf never ends it), got {stall}")
        self._server, self._stall = server, stall

    @property
    def stall(self) -> float:
        """Seconds that a call may take at present."""
        waits = STALL_WAITS * self._server.longest_wait
        return max(LEAST_STALL, waits) if self._stall is None else self._stall

    def find_hang(self) -> str:
        """Return why the model counts as hung; empty if it does not."""
        since = self._server.worker.busy_since
        seconds = 0.0 if since is None else time.monotonic() - since
        if seconds <= self.stall:
            return ""
        return (
            f"{type(self._server.model.unwrapped).__name__} has not returned from a call for {seconds:.0f} s, expected "
            f"at most {self.stall:.0f} s; nothing can stop the call, so this server ends. Start it again; if calls may "
            "take that long, give a longer time (--stall)"
        )
