# SPDX-License-Identifier: Apache-2.0
"""One line on the state of a server."""

from __future__ import annotations

import time

from wiw.serving.server import Server


class Status:
    """The numbers of the line; rates are over the time since the previous line."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._began = self._last = time.monotonic()
        self._before = (0, 0, 0.0)
        self._rates = ""

    @property
    def changed(self) -> bool:
        """Whether a batch was computed since the line before."""
        return self._server.worker.batches != self._before[0]

    def line(self) -> str:
        """Return clients, rows waiting, batches, and how busy the model was."""
        server, worker = self._server, self._server.worker
        parts = [
            _count(server.clients, "client"),
            f"{len(server.queue)} waiting",
            _count(worker.batches, "batch", "es"),
        ]
        parts += [self._rate()] if self.changed else [self._rates] if self._rates else []
        if (since := worker.busy_since) is not None and time.monotonic() - since > 10:
            parts.append(f"working on a batch for {time.monotonic() - since:.0f} s")
        if server.refused:
            parts.append(f"{server.refused} refused")
        return ", ".join(parts)

    def _rate(self) -> str:
        worker, now = self._server.worker, time.monotonic()
        batches, rows, busy = worker.batches, worker.rows, worker.busy_seconds
        count, since = batches - self._before[0], now - self._last
        more, work = rows - self._before[1], busy - self._before[2]
        self._before, self._last = (batches, rows, busy), now
        self._rates = (
            f"{more / count:.1f} rows and {work / count:.2g} s each, {more / since:.1f} rows/s, "
            f"busy {min(1.0, work / since):.0%}"
        )
        return self._rates


def _count(number: int, name: str, plural: str = "s") -> str:
    return f"{number} {name}{'' if number == 1 else plural}"
