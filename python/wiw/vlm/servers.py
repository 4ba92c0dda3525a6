# SPDX-License-Identifier: Apache-2.0
"""The server that a client asks: the one at an address, or one of those announced in a folder."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path

from wiw.wire.address_book import ServerAddress, choose_server

ANNOUNCED = "remote:"
"""Beginning of the address of servers that announce themselves, before their folder or file."""
UNKNOWN_TOKEN = (401, 403)
"""Status codes of a server that is not the one announced."""


class Servers:
    """One server that is always asked, or several of the same model: another one when that in use is lost.

    Args:
        address: "http://HOST:PORT/v1", or "remote:FOLDER", in which servers announce themselves (`wiw serve-vlm
            --announce`).
        key: the server's; announced servers have their own.
    """

    def __init__(self, address: str, key: str | None) -> None:
        self._given = ServerAddress(address, key)
        self._turn, self._turning = os.getpid(), threading.Lock()  # clients spread over the servers

    @property
    def are_announced(self) -> bool:
        """Whether there may be others, or the same at another address later."""
        return self._given.address.startswith(ANNOUNCED)

    def choose(self) -> ServerAddress:
        """Return the server to ask.

        Raises:
            ConnectionError: none is announced.
        """
        if not self.are_announced:
            return self._given
        return choose_server(Path(self._given.address.removeprefix(ANNOUNCED)).expanduser(), self._turn)

    def pass_over(self, server: ServerAddress) -> None:
        """Note that a server is lost: the next one is asked, unless that has already been decided."""
        with self._turning, suppress(ConnectionError):
            if server == self.choose():
                self._turn += 1
