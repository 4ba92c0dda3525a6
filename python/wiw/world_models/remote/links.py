# SPDX-License-Identifier: Apache-2.0
"""Several servers of one model: rows are spread over them, and those of a server that is gone go to the others.

A row's answer is a function of the row, so it does not matter who computes it, nor whether two do.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from wiw.errors import RemoteError
from wiw.wire.messages import Welcome
from wiw.world_models.remote.link import GLANCE, Frames, Link

LOST = 3.0
"""Seconds without a connection after which a server's rows are given to others."""


class Links:
    """Connections to servers of the same model; called as a `Link` is.

    Args:
        links: one for each server.
    """

    def __init__(self, links: Sequence[Link]) -> None:
        self._links = list(links)
        self._in_flight = [1] * len(self._links)
        self._threads = ThreadPoolExecutor(len(self._links), "wiw remote rows")

    def welcome(self, seconds: float) -> Welcome:
        """Return what all of them serve.

        Raises:
            RemoteError: one has not answered in time, or refuses; "model" where one serves another model than the
                first, or a model without a version, which cannot be distinguished from another.
        """
        give_up = time.monotonic() + seconds
        found = [link.welcome(max(0.0, give_up - time.monotonic())) for link in self._links]
        for link, welcome in zip(self._links, found, strict=True):
            if not welcome.fingerprint:
                raise RemoteError(
                    f"{link.address}: several servers can only be used for a model that can be identified: "
                    f"{welcome.unknown or 'it has no version'}; give one address, or use one server",
                    "model",
                )
            if (welcome.fingerprint, welcome.accepts) != (found[0].fingerprint, found[0].accepts):
                raise RemoteError(
                    f"{link.address} serves a different model than {self._links[0].address}: fingerprint "
                    f"{welcome.fingerprint}, expected {found[0].fingerprint}; serve the same weights and options",
                    "model",
                )
        self._in_flight = [welcome.in_flight for welcome in found]
        first = found[0]
        return Welcome(first.accepts, first.model, first.fingerprint, first.unknown, sum(self._in_flight))

    def ask(self, rows: Sequence[bytes], give_up: float) -> list[Frames]:
        """Return the frames of each row, in order.

        Raises:
            RemoteError, ContractError: as of `Link.ask`; a lost connection only where no server is left.
        """
        answers: dict[int, Frames] = {}
        left = deque(range(len(rows)))
        while left:
            alive = self._list_alive(give_up)
            share = -(-len(left) // len(alive))
            work = [self._threads.submit(self._work, each, share, rows, left, answers, give_up) for each in alive]
            for future in work:
                future.result()
        return [answers[place] for place in range(len(rows))]

    def close(self) -> None:
        """End the connections and the threads."""
        for link in self._links:
            link.close()
        self._threads.shutdown(wait=False)

    def _list_alive(self, give_up: float) -> list[int]:
        """Return the numbers of the servers that are connected, as soon as there are any.

        Raises:
            RemoteError: none has returned in time.
        """
        while True:
            for link in self._links:
                if not link.is_connected:
                    link.wake()
            if alive := [number for number, link in enumerate(self._links) if link.is_connected]:
                return alive
            if time.monotonic() >= give_up:
                reasons = "; ".join(f"{link.address}: {link.last_error}" for link in self._links)
                raise RemoteError(f"no server could be reached in time: {reasons}", "connection")
            time.sleep(GLANCE)

    def _work(
        self,
        number: int,
        share: int,
        rows: Sequence[bytes],
        left: deque[int],
        answers: dict[int, Frames],
        give_up: float,
    ) -> None:
        """Ask one server for rows until none are left, or it is gone and its rows are given back."""
        most = min(share, self._in_flight[number])
        while own := _take(left, most):
            try:
                found = self._links[number].ask([rows[place] for place in own], give_up, LOST)
            except RemoteError as error:
                if error.kind != "connection":
                    raise
                left.extend(own)
                return
            answers.update(zip(own, found, strict=True))


def _take(left: deque[int], most: int) -> list[int]:
    """Take up to this many places; several threads may do so at once."""
    own: list[int] = []
    while len(own) < most:
        try:
            own.append(left.popleft())
        except IndexError:
            break
    return own
