# SPDX-License-Identifier: Apache-2.0
"""The send queue of one client, bounded so that a client that does not read cannot fill the memory."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from typing import Any

UNSENT_BYTES = 256 * 2**20
"""Maximum size in bytes of a client's waiting messages; one beyond that is not queued, and must be requested again."""


class Outbox:
    """Sends a client's messages one after another: each is handed over once the one before has been sent.

    Args:
        client: a `websockets` connection.
        most: messages that may wait before no more is read from the client.
    """

    def __init__(self, client: Any, most: int) -> None:
        self._client, self._most = client, most
        self._messages: deque[tuple[bytes, Callable[[], None]]] = deque()
        self._filled, self._room = asyncio.Event(), asyncio.Event()
        self._room.set()
        self._ended = False
        self._sent, self._sent_before, self._buffered_before = 0, 0, 0
        self._progress_at = time.monotonic()
        self.unsent_bytes = 0
        """Bytes of messages that have not been sent yet, including the current one."""

    def __len__(self) -> int:
        """Return how many messages have not left."""
        return len(self._messages)

    def takes(self, size: int) -> bool:
        """Return whether a message of so many bytes may wait; one alone always may."""
        return not self._messages or self.unsent_bytes + size <= UNSENT_BYTES

    def put(self, message: bytes, sent: Callable[[], None] = lambda: None) -> None:
        """Queue a message; `sent` is called once it has left. Once the connection has ended, nothing is queued."""
        if self._ended:
            return
        self._messages.append((message, sent))
        self.unsent_bytes += len(message)
        self._filled.set()
        if len(self._messages) >= self._most or self.unsent_bytes >= UNSENT_BYTES:
            self._room.clear()

    async def room(self) -> None:
        """Wait until more may be queued."""
        await self._room.wait()

    async def run(self) -> None:
        """Send until the connection ends.

        Raises:
            ConnectionClosed: it has ended.
        """
        try:
            while True:
                await self._filled.wait()
                message, sent = self._messages[0]
                await self._client.send(message)
                self._messages.popleft()
                self.unsent_bytes -= len(message)
                self._sent += 1
                sent()
                if not self._messages:
                    self._filled.clear()
                if len(self._messages) < self._most and self.unsent_bytes < UNSENT_BYTES:
                    self._room.set()
        finally:
            self._ended = True
            self._room.set()  # whoever waits finds that the connection has ended

    def stalled_seconds(self) -> float:
        """Return how long messages have waited without a byte being sent; to be called regularly."""
        buffered = self._client.transport.get_write_buffer_size()  # grows by pings
        if not self._messages or self._sent != self._sent_before or buffered < self._buffered_before:
            self._progress_at = time.monotonic()
        self._sent_before, self._buffered_before = self._sent, buffered
        return time.monotonic() - self._progress_at
