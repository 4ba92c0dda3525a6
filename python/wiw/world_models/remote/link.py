# SPDX-License-Identifier: Apache-2.0
"""A connection that reconnects: its own thread maintains it and repeats unanswered questions.

Rows are asked under ids made of their content, so a row that is sent again, after the connection broke or by a caller
that tries once more, is answered from what the server knows or is computing.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as LateError
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

import wiw
from wiw.errors import ContractError, RemoteError
from wiw.wire.address_book import ServerAddress, choose_server, read_addresses
from wiw.wire.loopback import is_loopback
from wiw.wire.messages import MOST_BYTES, Answer, Ask, Hello, Refusal, Wait, Welcome, decode, encode
from wiw.wire.rows import row_id

FIRST_PAUSE, LONGEST_PAUSE = 0.1, 5.0
"""Seconds before a connection is tried again; each failure doubles them."""
HANDSHAKE = 10.0
HEARTBEAT, SILENCE = 10.0, 30.0
"""Seconds between pings, and without an answer to one until the connection counts as lost."""
BREACHES = frozenset({"type", "dtype", "nan", "shape", "frames", "frame 0", "channels", "scale", "contract"})
"""Kinds of `ContractError`."""
FROM_MODEL = BREACHES | {"raised"}
"""Kinds of refusals that say that the model has returned; the others come from a server whose model hangs, too."""

MOST_REASON = 500
"""Bytes of a server's words that an error shows."""

Frames = NDArray[np.uint8]


@dataclass
class Question:
    """A row that waits for its answer."""

    id: bytes
    row: bytes
    give_up: float
    rest: int
    answer: Future[Frames] = field(default_factory=Future)
    askers: int = 1


class Link:
    """A connection to the server at an address, or to one of those announced in a folder: the next when it is lost, or
    when a deadline has passed without any answer from it.

    Any number of threads may use it.
    """

    def __init__(self, address: str, token: str | None) -> None:
        self.address = address
        self._given = ServerAddress(address, token)
        self._turn = os.getpid()  # clients spread over the servers
        self._open: dict[bytes, Question] = {}
        self._welcome: Future[Welcome] = Future()
        self.last_error = "not connected yet"
        """Why the latest connection ended."""
        self._closed = False
        self._loop = asyncio.new_event_loop()
        self._wanted = asyncio.Event()
        self._outbox: asyncio.Queue[Question] | None = None
        self._lost_at = time.monotonic()
        self.alive_at = self._lost_at
        """When the model last returned something, or the connection began, as `time.monotonic()` tells it."""
        self._leaves = asyncio.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="wiw remote")
        self._thread.start()

    # -- called from any thread ----------------------------------------------------------------------------------------

    def welcome(self, seconds: float) -> Welcome:
        """Return what is served.

        Raises:
            RemoteError: nobody has answered in time, or the server refuses.
        """
        try:
            return self.greet().result(seconds)
        except LateError:
            raise RemoteError(
                f"nobody serves a world model at {self.address}: {self.last_error}", "connection"
            ) from None

    def greet(self) -> Future[Welcome]:
        """Connect, for as long as that takes, and return what is served, once the server has said it."""
        self._call_soon(self._wanted.set)
        return self._welcome

    @property
    def is_connected(self) -> bool:
        """Whether questions reach the server at present."""
        return self._outbox is not None

    @property
    def lost_seconds(self) -> float:
        """Seconds without a connection; 0 if there is one."""
        return 0.0 if self.is_connected else time.monotonic() - self._lost_at

    def wake(self) -> None:
        """Connect again where the connection was lost; nobody waits for it."""
        self._call_soon(self._wanted.set)

    def ask(self, rows: Sequence[bytes], give_up: float) -> list[Frames]:
        """Return the frames of each row, in order.

        Args:
            rows: as `pack_row` packs them.
            give_up: when to wait no longer, as `time.monotonic()` tells it.

        Raises:
            RemoteError: not all are there in time ("connection" if there is none), or the server refuses one.
            ContractError: the served model broke its contract.
        """
        asked_at, questions = time.monotonic(), self.submit(rows, give_up)
        try:
            return [question.answer.result(max(0.0, give_up - time.monotonic())) for question in questions]
        except LateError:
            late = self._build_deadline_error()
            self._call_soon(lambda: self._leave_silent(asked_at))
            raise late from None
        except RemoteError as error:
            if error.kind == "deadline":  # the server has seen first that the time is over
                self._call_soon(lambda: self._leave_silent(asked_at))
            raise
        finally:
            self.drop(questions)

    def submit(self, rows: Sequence[bytes], give_up: float) -> list[Question]:
        """Ask for rows, as `ask` does, and return the questions without waiting for their answers.

        Raises:
            RemoteError: the connection was closed on this side, or the time is over.
        """
        if self._closed:
            raise self._build_closed_error()
        questions = [Question(row_id(row), row, give_up, len(rows) - place) for place, row in enumerate(rows, start=1)]
        asked: Future[list[Question]] = Future()
        self._call_soon(lambda: asked.set_result([self._submit(question) for question in questions]))
        try:
            return asked.result(max(0.0, give_up - time.monotonic()))
        except LateError:
            self.drop(questions)
            raise self._build_deadline_error() from None

    def drop(self, questions: Sequence[Question]) -> None:
        """Drop questions that the caller waits for no more."""
        self._call_soon(lambda: self._drop_questions(questions))

    def close(self) -> None:
        """End the connection and the thread, and fail the calls that still wait."""
        self._closed = True
        if self._thread.is_alive():
            self._call_soon(self._loop.stop)
            self._thread.join(5)

    def _build_closed_error(self) -> RemoteError:
        return RemoteError(
            f"the connection to {self.address} was closed on this side; create the model again", "connection"
        )

    def _build_deadline_error(self) -> RemoteError:
        if self._outbox is None:
            return RemoteError(f"{self.address} could not be reached in time: {self.last_error}", "connection")
        return RemoteError(f"no answer from {self.address} in time; the server is up, but busy or hung", "deadline")

    def _call_soon(self, work: Any) -> None:
        with contextlib.suppress(RuntimeError):  # closed: callers find out by their deadlines
            self._loop.call_soon_threadsafe(work)

    # -- in the thread -------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        main = self._loop.create_task(self._maintain_connection())
        self._loop.run_forever()
        main.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            self._loop.run_until_complete(main)
        self._fail_all(self._build_closed_error())
        self._loop.close()

    async def _maintain_connection(self) -> None:
        """Connect when there is a question, and reconnect until it is answered."""
        pause = FIRST_PAUSE
        while True:
            await self._wanted.wait()
            try:
                async with self._connection() as connection:
                    await self._shake_hands(connection)
                    pause = FIRST_PAUSE
                    await self._exchange_messages(connection)
                self._turn += 1
                continue
            except RemoteError as error:
                self._fail_all(error)
            except InvalidStatus as error:
                if error.response.status_code in (401, 403) and self._given.address == self.address:
                    self._fail_all(
                        RemoteError(f"{self.address} expects a different token: set WIW_TOKEN to it", "token")
                    )
                self.last_error = f"{self.address}: {error}{_read_reason(error)}"
            except Exception as error:  # whatever it is, those who ask wait no longer than their deadlines
                self.last_error = f"{type(error).__name__}: {error}"
            if not self._open and self._welcome.done():
                self._wanted.clear()
                continue
            self._turn += 1
            await asyncio.sleep(pause * random.uniform(0.8, 1.2))
            pause = min(2 * pause, LONGEST_PAUSE)

    def _connection(self) -> connect:
        server = self._choose_server()
        self.address = server.address
        direct = self._is_announced or is_loopback(urlsplit(server.address).hostname or "")
        return connect(
            server.address,
            additional_headers={} if server.token is None else {"Authorization": f"Bearer {server.token}"},
            proxy=None if direct else True,
            compression=None,
            max_size=MOST_BYTES,
            open_timeout=HANDSHAKE,
            ping_interval=HEARTBEAT,
            ping_timeout=SILENCE,
            close_timeout=1,
        )

    @property
    def _is_announced(self) -> bool:
        return "://" not in self._given.address

    def _choose_server(self) -> ServerAddress:
        if not self._is_announced:
            return self._given
        return choose_server(Path(self._given.address), self._turn)

    async def _shake_hands(self, connection: ClientConnection) -> None:
        await connection.send(encode(Hello(f"wiw {wiw.__version__}")))
        message = decode(await asyncio.wait_for(connection.recv(), HANDSHAKE))
        if isinstance(message, Refusal):
            raise RemoteError(f"{self.address}: {message.text}", message.kind)
        if not isinstance(message, Welcome):
            raise RemoteError(f"{self.address}: expected a welcome, got {type(message).__name__}", "message")
        if not self._welcome.done():
            self._welcome.set_result(message)
        elif message != (first := self._welcome.result()):
            what = "weights or options" if (message.accepts, message.model) == (first.accepts, first.model) else "model"
            raise RemoteError(
                f"{self.address} has come back with different {what} than this run started with; serve the same model "
                "again",
                "model",
            )

    async def _exchange_messages(self, connection: ClientConnection) -> None:
        """Send questions and receive answers until the server is to be left.

        Raises:
            ConnectionError: the connection has ended; and whatever else ends it.
        """
        outbox: asyncio.Queue[Question] = asyncio.Queue()
        room = asyncio.Semaphore(self._welcome.result().in_flight)
        asked: set[bytes] = set()
        again = [question for question in self._open.values() if not question.answer.done()]
        for place, question in enumerate(again, start=1):
            question.rest = len(again) - place
            outbox.put_nowait(question)
        self._outbox, self.alive_at = outbox, time.monotonic()
        self._leaves.clear()
        tasks = [
            asyncio.ensure_future(self._leaves.wait()),
            asyncio.ensure_future(self._send_questions(connection, outbox, room, asked)),
            asyncio.ensure_future(self._receive_answers(connection, outbox, room, asked)),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            self._outbox, self._lost_at = None, time.monotonic()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _send_questions(
        self,
        connection: ClientConnection,
        outbox: asyncio.Queue[Question],
        room: asyncio.Semaphore,
        asked: set[bytes],
    ) -> None:
        """Send the questions in the outbox, except those that wait for an answer on this connection already."""
        while True:
            question = await outbox.get()
            await room.acquire()
            left = question.give_up - time.monotonic()
            if left <= 0 or question.id in asked or self._open.get(question.id) is not question:
                room.release()
                continue
            asked.add(question.id)
            await connection.send(encode(Ask(question.id, question.row, left, question.rest)))

    async def _receive_answers(
        self,
        connection: ClientConnection,
        outbox: asyncio.Queue[Question],
        room: asyncio.Semaphore,
        asked: set[bytes],
    ) -> None:
        while True:
            try:
                message = decode(await connection.recv())
            except ConnectionClosed as error:
                raise ConnectionError(f"the connection was lost ({error})") from None
            if isinstance(message, Refusal) and not message.id:
                raise RemoteError(f"{self.address}: {message.text}", message.kind)
            if not isinstance(message, Answer | Wait | Refusal):
                raise RemoteError(f"{self.address}: unexpected {type(message).__name__}", "message")
            room.release()
            asked.discard(message.id)
            if isinstance(message, Answer) or (isinstance(message, Refusal) and message.kind in FROM_MODEL):
                self.alive_at = time.monotonic()
            question = self._open.get(message.id)
            if question is None or question.answer.done():
                continue
            if isinstance(message, Refusal) and message.kind == "deadline" and question.give_up > time.monotonic():
                outbox.put_nowait(question)  # that was the deadline of one who asked before and has gone
            elif isinstance(message, Wait):
                question.rest = 0  # those that followed it have gone on
                self._loop.call_later(message.seconds, outbox.put_nowait, question)
            elif isinstance(message, Answer):
                question.answer.set_result(message.frames)
            else:
                question.answer.set_exception(_error(message))

    def _leave_silent(self, asked_at: float) -> None:
        """Leave a server that has answered nothing since a question was asked, if another one is announced.

        The next one then gets the open questions.
        """
        is_silent = self.is_connected and self.alive_at <= asked_at
        if is_silent and self._is_announced and len(read_addresses(Path(self._given.address))) > 1:
            self.last_error = f"{self.address} was left: it did not answer in time"
            self._leaves.set()

    def _submit(self, question: Question) -> Question:
        """Open a question, or return the same one that is open already."""
        same = self._open.get(question.id)
        if same is not None and not same.answer.done():
            same.askers += 1
            same.give_up = max(same.give_up, question.give_up)
            return same
        self._open[question.id] = question
        if self._outbox is not None:
            self._outbox.put_nowait(question)
        self._wanted.set()
        return question

    def _drop_questions(self, questions: Sequence[Question]) -> None:
        """Drop questions that nobody waits for any more."""
        for question in questions:
            question.askers -= 1
            if question.askers <= 0 and self._open.get(question.id) is question:
                del self._open[question.id]

    def _fail_all(self, error: RemoteError) -> None:
        """Raise the error in all waiting callers."""
        self.last_error = str(error)
        if not self._welcome.done():
            self._welcome.set_exception(error)
        for question in self._open.values():
            if not question.answer.done():
                question.answer.set_exception(error)


def _read_reason(error: InvalidStatus) -> str:
    """Return what a server says of its refusal to connect, in its first line."""
    said = (error.response.body or b"")[:MOST_REASON].decode("utf-8", "replace").strip().partition("\n")[0]
    return f": {''.join(filter(str.isprintable, said))}" if said else ""


def _error(refusal: Refusal) -> Exception:
    if refusal.kind in BREACHES:
        return ContractError(refusal.text, refusal.kind)
    return RemoteError(refusal.text, refusal.kind)
