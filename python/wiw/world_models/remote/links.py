# SPDX-License-Identifier: Apache-2.0
"""Several servers of one model: rows are spread over them, and those of one that is gone or hangs go to the others.

A row's answer is a function of the row, so it does not matter who computes it, nor whether two do. A server is *late*
when it has kept rows for half of a call's time and its model has returned nothing. Its threads may still answer pings,
as when a GPU call never ends, so only an answer or a new connection shows that it is back.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass

from wiw.errors import RemoteError
from wiw.wire.messages import Welcome
from wiw.world_models.remote.link import Frames, Link, Question

JOIN = 3.0
"""Seconds that servers have to answer once another one has, before the first call is made without them."""
LOST = 3.0
"""Seconds without a connection after which a server's rows are given to others."""
PATIENCE = 0.5
"""Share of a call's time after which a server that has answered nothing is late: the others have the rest for its rows,
and it may still answer them first."""
PROBE = 10.0
"""Seconds between two rows that a late server is asked for beside another, to find out whether it is back."""
GLANCE = 0.2
"""Seconds between two looks at which servers are there."""


@dataclass(eq=False)
class _Server:
    """A server, and what earlier calls have found out about it."""

    link: Link
    in_flight: int = 1
    is_admitted: bool = False
    """Whether it is known to serve what the others do."""
    refusal: str = ""
    """Why it is never asked, if it has joined with something else."""
    late_at: float = -math.inf
    """When it was last found late."""
    probed_at: float = -math.inf
    """When it was last asked for a row while it was late."""

    @property
    def is_reachable(self) -> bool:
        """Whether it can be asked at present."""
        return self.is_admitted and self.link.is_connected

    @property
    def fault(self) -> str:
        """Why it could not be asked last, with its address."""
        return self.refusal or f"{self.link.address}: {self.link.last_error}"

    @property
    def is_late(self) -> bool:
        """Whether its model has returned nothing since it was found late, on the same connection."""
        return self.link.alive_at <= self.late_at


class Links:
    """Connections to servers of the same model; called as a `Link` is. One server is enough to begin with: others join
    whenever they answer, and each is held to what the first one serves.

    Args:
        links: one for each server.
    """

    def __init__(self, links: Sequence[Link]) -> None:
        self._servers = [_Server(link) for link in links]
        self._first: tuple[str, Welcome] | None = None
        """Address and welcome of the server that the others are held to."""

    def welcome(self, seconds: float) -> Welcome:
        """Return what they serve, once one has answered; the others have `JOIN` more seconds to do so as well.

        Raises:
            RemoteError: none has answered in time; one refuses, or serves another model than the first ("model"), or a
                model without a version, which cannot be distinguished from another.
        """
        give_up = time.monotonic() + seconds
        greetings = [server.link.greet() for server in self._servers]
        if not wait(greetings, seconds, FIRST_COMPLETED).done:
            reasons = "; ".join(server.fault for server in self._servers)
            raise RemoteError(f"nobody serves a world model: {reasons}", "connection")
        wait(greetings, min(JOIN, max(0.0, give_up - time.monotonic())))
        for server in self._servers:
            self._admit(server)
        assert self._first is not None
        _, first = self._first
        in_flight = sum(server.in_flight if server.is_admitted else first.in_flight for server in self._servers)
        return Welcome(first.accepts, first.model, first.fingerprint, first.unknown, in_flight)

    def _admit(self, server: _Server) -> None:
        """Admit a server if it has answered.

        Raises:
            RemoteError: as of `welcome`.
        """
        if server.is_admitted or not (greeting := server.link.greet()).done():
            return
        self._check(server.link.address, greeting.result())
        server.in_flight, server.is_admitted = greeting.result().in_flight, True

    def _admit_late(self) -> None:
        """Admit the servers that have answered since the last call. One that serves something else is never asked, and
        that is said: the others go on.
        """
        for server in [server for server in self._servers if not server.refusal]:
            try:
                self._admit(server)
            except RemoteError as error:
                server.refusal = str(error)
                warnings.warn(f"{error}. It is not asked; the run goes on with the other servers", stacklevel=2)

    def _check(self, address: str, welcome: Welcome) -> None:
        """Check that a server serves the same model as the first.

        Raises:
            RemoteError: it does not, or cannot be held to it.
        """
        if not welcome.fingerprint:
            raise RemoteError(
                f"{address}: several servers can only be used for a model that can be identified: "
                f"{welcome.unknown or 'it has no version'}; give one address, or use one server",
                "model",
            )
        self._first = self._first or (address, welcome)
        other, first = self._first
        if (welcome.fingerprint, welcome.accepts) != (first.fingerprint, first.accepts):
            raise RemoteError(
                f"{address} serves a different model than {other}: fingerprint {welcome.fingerprint}, expected "
                f"{first.fingerprint}; serve the same weights and options",
                "model",
            )

    def ask(self, rows: Sequence[bytes], give_up: float) -> list[Frames]:
        """Return the frames of each row, in order.

        Raises:
            RemoteError, ContractError: as of `Link.ask`; a lost connection or a passed deadline only where no server
                is left that answers.
        """
        return _Call(self._servers, rows, give_up, self._admit_late).run()

    def close(self) -> None:
        """End the connections."""
        for server in self._servers:
            server.link.close()


class _Call:
    """One call: which of its rows are answered, and which servers have been asked for the others.

    Args:
        servers: those to ask.
        rows: as `pack_row` packs them.
        give_up: when to wait no longer, as `time.monotonic()` tells it.
        admit: admits servers that have come.
    """

    def __init__(
        self, servers: Sequence[_Server], rows: Sequence[bytes], give_up: float, admit: Callable[[], None]
    ) -> None:
        self._servers, self._rows, self._give_up, self._admit = servers, rows, give_up, admit
        self._patience = PATIENCE * (give_up - time.monotonic())
        self._share = 0
        """Rows that a server gets at a time, if it takes as many."""
        self._answers: dict[int, Frames] = {}
        self._asked: dict[_Server, dict[int, Question]] = {server: {} for server in servers}
        """Questions by the place of their row."""
        self._asked_at = dict.fromkeys(servers, -math.inf)

    def run(self) -> list[Frames]:
        """Return the frames of each row, in order.

        Raises:
            RemoteError, ContractError: as of `Links.ask`.
        """
        try:
            while len(self._answers) < len(self._rows):
                if time.monotonic() >= self._give_up:
                    raise self._build_error()
                self._admit()
                self._give_back_lost()
                self._note_late()
                self._hand_out()
                self._receive_answers()
            return [self._answers[place] for place in range(len(self._rows))]
        finally:
            for server in self._servers:
                self._drop(server)

    def _give_back_lost(self) -> None:
        for server in self._servers:
            if server.link.lost_seconds >= LOST:
                self._drop(server)

    def _drop(self, server: _Server) -> None:
        """Ask a server for nothing any more."""
        server.link.drop(list(self._asked[server].values()))
        self._asked[server].clear()

    def _note_late(self) -> None:
        """Note which servers have been silent for too long; what they were asked for stays open."""
        now = time.monotonic()
        for server in self._servers:
            silent_since = max(self._asked_at[server], server.link.alive_at)
            if self._asked[server] and not server.is_late and now - silent_since >= self._patience:
                server.late_at = now

    def _hand_out(self) -> None:
        """Ask servers that have answered all they were asked for, for rows that nobody computes.

        Rows of late servers count as such. Where all are late, as a slow model may be, each keeps what it has.
        """
        for server in self._servers:
            if not server.link.is_connected:
                server.link.wake()
        reachable = [server for server in self._servers if server.is_reachable]
        timely = [server for server in reachable if not server.is_late]
        chosen = timely or reachable
        if not chosen:
            return
        left = self._find_left([server for server in self._servers if not (timely and server.is_late)])
        self._share = max(self._share, -(-len(left) // len(chosen)))
        for server in chosen:
            if left and not self._asked[server]:
                most = min(self._share, server.in_flight)
                self._ask(server, left[:most])
                left = left[most:]
        if timely:
            self._probe([server for server in reachable if server.is_late])

    def _find_left(self, keepers: Collection[_Server]) -> list[int]:
        """Return the places of rows that are not answered, and that none of these servers has been asked for."""
        kept = set[int]().union(*(self._asked[server] for server in keepers))
        return [place for place in range(len(self._rows)) if place not in self._answers and place not in kept]

    def _ask(self, server: _Server, places: Sequence[int]) -> None:
        questions = server.link.submit([self._rows[place] for place in places], self._give_up)
        self._asked[server] = dict(zip(places, questions, strict=True))
        self._asked_at[server] = time.monotonic()

    def _probe(self, late: Sequence[_Server]) -> None:
        """Ask late servers for a row that another one computes."""
        now, rest = time.monotonic(), self._find_left(())
        for server in late:
            if rest and not self._asked[server] and now - server.probed_at >= PROBE:
                server.probed_at = now
                self._ask(server, rest[-1:])

    def _receive_answers(self) -> None:
        """Wait a little for answers, and take those that are there.

        Raises:
            RemoteError, ContractError: a server refuses a row for another reason than time.
        """
        seconds = max(0.0, min(GLANCE, self._give_up - time.monotonic()))
        waiting = {question.answer for asked in self._asked.values() for question in asked.values()}
        if not waiting:
            time.sleep(seconds)
        elif not wait(waiting, seconds, FIRST_COMPLETED).done:
            return
        for server, asked in self._asked.items():
            done = {place: question for place, question in asked.items() if question.answer.done()}
            server.link.drop(list(done.values()))
            for place, question in done.items():
                del asked[place]
                self._take(place, question)

    def _take(self, place: int, question: Question) -> None:
        try:
            self._answers.setdefault(place, question.answer.result())
        except RemoteError as error:
            if error.kind != "deadline":
                raise

    def _build_error(self) -> RemoteError:
        """Return why rows are missing at the end; servers that answered none of theirs are late from now on."""
        for server in self._servers:
            if self._asked[server] and server.link.alive_at <= self._asked_at[server]:
                server.late_at = time.monotonic()
        if not any(server.is_reachable for server in self._servers):
            reasons = "; ".join(server.fault for server in self._servers)
            return RemoteError(f"no server could be reached in time: {reasons}", "connection")
        missing = len(self._rows) - len(self._answers)
        asked = ", ".join(server.link.address for server in self._servers if self._asked[server])
        return RemoteError(
            f"{missing} of {len(self._rows)} rows were not answered in time; asked last: {asked or 'nobody'}; the "
            "servers are up, but busy or hung",
            "deadline",
        )
