# SPDX-License-Identifier: Apache-2.0
"""The server: connections on one side, a queue of rows on the other, the model in its own thread."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import logging
import ssl
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any

from websockets.asyncio.server import Server as Listener
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from wiw.errors import ArgumentError, InfrastructureError, RemoteError
from wiw.runs.sources import source_digests
from wiw.serving.answer_cache import AnswerCache
from wiw.serving.outbox import Outbox
from wiw.serving.queue import Job, Queue
from wiw.serving.worker import Outcome, Worker
from wiw.wire.loopback import is_loopback
from wiw.wire.messages import Answer, Ask, Hello, Message, Refusal, Wait, Welcome, decode, encode
from wiw.wire.rows import row_id, unpack_row
from wiw.world_models.base import WorldModel
from wiw.world_models.remote.declaration import declaration
from wiw.world_models.remote.limits import check_row, most_bytes

PORT = 8765
KNOWN_BYTES = 512 * 2**20
"""Maximum size in bytes of answers kept for clients that ask again."""
AHEAD = 4
"""Full batches that one client may have unanswered, so that rows travel while others are computed."""
HEARTBEAT, SILENCE, HANDSHAKE = 10.0, 30.0, 10.0
"""Seconds: between pings, without an answer to one until a client counts as gone, and for a client's first message."""
UNREAD = 30.0
"""Seconds after which a client that receives nothing is disconnected."""
CLOSING = 1.0
"""Seconds that a client has to end the connection in order."""
TICK = 0.1
POLICY_VIOLATION = 1008
_log = logging.getLogger("wiw.serving.connections")
_log.addHandler(logging.NullHandler())
_log.propagate = False  # every stranger who connects would write a line


@dataclass(frozen=True)
class Settings:
    """Where and how a model is served.

    Args:
        host: address to listen on.
        port: port to listen on; 0 picks a free one.
        token: secret that clients must send; required unless `host` is a loopback address.
        queue: rows that may wait; None means eight full batches, and at least 64 rows.
        window: how long a batch that is not full waits for idle clients, as a share of a batch's time.
        certificate: PEM file, for wss.
        key: PEM file of its key, where that is not in `certificate`.
        grace: seconds for finishing the accepted rows once the server is to end.
        clients: maximum number of connections at a time.

    Raises:
        ArgumentError: a number out of range, a host beyond this machine without a token, a key without a certificate.
    """

    host: str = "127.0.0.1"
    port: int = PORT
    token: str | None = None
    queue: int | None = None
    window: float = 0.05
    certificate: Path | None = None
    key: Path | None = None
    grace: float = 30.0
    clients: int = 256

    def __post_init__(self) -> None:
        expectations = (
            (0 <= self.port < 2**16, f"a port from 0 to 65535, got {self.port}"),
            (self.queue is None or self.queue >= 1, f"a queue of at least 1, got {self.queue}"),
            (self.window >= 0, f"a window of at least 0, got {self.window}"),
            (self.grace >= 0, f"a grace of at least 0 seconds, got {self.grace}"),
            (self.clients >= 1, f"clients of at least 1, got {self.clients}"),
        )
        for holds, expected in expectations:
            if not holds:
                raise ArgumentError(f"serve: expected {expected}")
        if not self.token and not is_loopback(self.host):
            raise ArgumentError(
                f"serve: {self.host} can be reached from other machines: set WIW_TOKEN (or --token) to a secret that "
                "clients send, such as the output of `openssl rand -hex 16`"
            )
        if self.key is not None and self.certificate is None:
            raise ArgumentError("serve: got a key without a certificate: give both, or nothing would be encrypted")

    @property
    def tls(self) -> ssl.SSLContext | None:
        """TLS settings for wss.

        Raises:
            ArgumentError: the certificate or its key cannot be read.
        """
        if self.certificate is None:
            return None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            context.load_cert_chain(self.certificate, self.key)
        except OSError as error:
            named = " and ".join(str(file) for file in (self.certificate, self.key) if file is not None)
            raise ArgumentError(
                f"serve: expected PEM files of a certificate and its key, got {named}: {error.strerror or error}"
            ) from None
        return context


class Server:
    """Serves one world model.

    Raises:
        ArgumentError: the model cannot be served.
    """

    def __init__(self, model: Any, settings: Settings | None = None) -> None:
        if not isinstance(model, WorldModel):
            raise ArgumentError(f"serve: expected a world model, got {model!r}; see `wiw list`")
        if "simulator" in model.accepts.needs:
            raise ArgumentError(
                f"serve: {type(model).__name__} needs the simulator, which cannot leave the run's process; use it in "
                "the run itself: wiw run --world-model oracle"
            )
        self.model, self.settings = model, settings or Settings()
        self.address = ""
        """Once it listens."""
        accepts = model.accepts
        batch = accepts.best_batch
        self.queue = Queue(batch, self.settings.queue or max(8 * batch, 64), self.settings.window)
        self.worker = Worker(model, self.queue, self._report)
        self.refused = 0
        """Number of messages and connections that violated the protocol."""
        self.longest_wait = 0.0
        """Most seconds that a client has said it waits for a row."""
        self._welcome = _welcome(model, AHEAD * batch)
        self._jobs: dict[bytes, Job] = {}
        self._recent_answers = AnswerCache(KNOWN_BYTES)
        self._unanswered: Counter[ServerConnection] = Counter()
        """Rows of each client that wait, are computed, or whose answers have not left."""
        self._outboxes: dict[ServerConnection, Outbox] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ending = asyncio.Event()

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._unanswered)

    @property
    def pending_rows(self) -> int:
        """Rows that wait or are computed."""
        return len(self._jobs)

    @property
    def unsent_bytes(self) -> int:
        """Bytes of messages that clients have not taken yet."""
        return sum(outbox.unsent_bytes for outbox in self._outboxes.values())

    async def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Serve until `end` is called; then finish the rows it has accepted.

        Raises:
            InfrastructureError: the address cannot be listened at.
        """
        self._loop = asyncio.get_running_loop()
        try:
            listener = await self._listen()
        except OSError as error:
            raise InfrastructureError(
                f"cannot listen at {self.settings.host} port {self.settings.port}: {error.strerror or error}; choose "
                "another port (--port 0 takes a free one)"
            ) from None
        async with listener:
            port = next(iter(listener.sockets)).getsockname()[1]
            host = f"[{self.settings.host}]" if ":" in self.settings.host else self.settings.host
            self.address = f"{'ws' if self.settings.certificate is None else 'wss'}://{host}:{port}"
            self.worker.start()
            ready()
            ticking = asyncio.ensure_future(self._watch_timeouts())
            await self._ending.wait()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._finish_rows(), self.settings.grace)
            ticking.cancel()
            self.queue.end()

    def end(self) -> None:
        """Accept nothing more, finish, and let `run` return. Call it from the loop's thread."""
        self._ending.set()

    # -- connections ---------------------------------------------------------------------------------------------------

    async def _listen(self) -> Listener:
        return await serve(
            self._serve_client,
            self.settings.host,
            self.settings.port,
            ssl=self.settings.tls,
            process_request=self._admit,
            origins=[None],  # a browser names the page that connects; no page has business here
            compression=None,  # images hardly shrink
            max_size=most_bytes(self.model.accepts),
            ping_interval=HEARTBEAT,
            ping_timeout=SILENCE,
            open_timeout=HANDSHAKE,
            close_timeout=CLOSING,
            server_header=None,
            logger=_log,
        )

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the refusal of a client; None lets it in."""
        if len(self._unanswered) >= (most := self.settings.clients):
            said = f"{most} clients are already connected; start more servers, or this one with a greater --clients\n"
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, said)
        token = self.settings.token
        shown = request.headers.get_all("Authorization")
        if token and not (len(shown) == 1 and hmac.compare_digest(shown[0].encode(), f"Bearer {token}".encode())):
            self.refused += 1
            return connection.respond(HTTPStatus.UNAUTHORIZED, "the token is missing or wrong\n")
        return None

    async def _serve_client(self, client: ServerConnection) -> None:
        """Serve one client, from its first message to its last."""
        self._unanswered[client] = 0
        self.queue.join(client)
        outbox = self._outboxes[client] = Outbox(client, self._welcome.in_flight)
        sending = asyncio.ensure_future(outbox.run())
        try:
            hello = decode(await asyncio.wait_for(client.recv(), HANDSHAKE))
            if not isinstance(hello, Hello):
                raise RemoteError(f"expected a hello first, got {type(hello).__name__}", "message")
            await client.send(encode(self._welcome))
            async for data in client:
                await outbox.room()  # what is not read from the client waits on its own machine
                self._handle_ask(client, outbox, decode(data))
        except RemoteError as error:
            self.refused += 1
            await self._refuse_client(client, error)
        except (ConnectionClosed, asyncio.TimeoutError):
            pass
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            del self._unanswered[client], self._outboxes[client]
            for job in self.queue.leave(client):
                del self._jobs[job.id]
            for job in self._jobs.values():
                job.askers.discard(client)

    async def _refuse_client(self, client: ServerConnection, error: RemoteError) -> None:
        with contextlib.suppress(ConnectionClosed):
            await client.send(encode(Refusal(b"", error.kind, str(error))))
            await client.close(POLICY_VIOLATION, error.kind)

    async def _disconnect_client(self, client: ServerConnection, outbox: Outbox) -> None:
        reason = f"{len(outbox)} answers, {outbox.unsent_bytes} bytes, were not read for {UNREAD:g} s"
        with contextlib.suppress(ConnectionClosed, asyncio.TimeoutError):
            await asyncio.wait_for(client.close(POLICY_VIOLATION, reason), CLOSING)
        client.transport.abort()  # the farewell waits behind what is not read

    def _handle_ask(self, client: ServerConnection, outbox: Outbox, message: Message) -> None:
        if not isinstance(message, Ask):
            raise RemoteError(f"expected an ask, got {type(message).__name__}", "message")
        if message.id != row_id(message.row):
            raise RemoteError("ask.id is not the digest of ask.row", "message")
        answer, reason = self._recent_answers.get(message.id), self._explain_refusal(client)
        taken = answer is None and not reason and self._queue_row(client, message)
        self.queue.announce(client, message.rest)
        if answer is not None:
            outbox.put(answer)
        elif not taken:
            outbox.put(encode(Wait(message.id, self._estimate_wait(), reason or "the queue is full")))

    def _explain_refusal(self, client: ServerConnection) -> str:
        """Return why no row of this client is accepted now; empty if one is."""
        if self._ending.is_set():
            return "the server is shutting down"
        return "too many rows unanswered" if self._unanswered[client] >= self._welcome.in_flight else ""

    def _estimate_wait(self) -> float:
        """Estimate the seconds until there is room: half a batch."""
        return min(2.0, max(0.05, self.queue.batch_seconds / 2))

    def _queue_row(self, client: ServerConnection, ask: Ask) -> bool:
        """Queue a row, unless it is queued or computed already; False where the queue is full."""
        job = self._jobs.get(ask.id)
        now = time.monotonic()
        self.longest_wait = max(self.longest_wait, ask.seconds)
        if job is None:
            try:
                row = unpack_row(ask.row)
                check_row(row, self.model.accepts)
            except RemoteError as error:
                self.refused += 1
                self._outboxes[client].put(encode(Refusal(ask.id, error.kind, str(error))))
                return True
            job = Job(ask.id, row, now, now + ask.seconds)
            if not self.queue.put(job, client, ask.rest):
                return False
            self._jobs[ask.id] = job
        elif client in job.askers:
            raise RemoteError("a row was requested twice on one connection", "message")
        else:
            self.queue.share(client)
            job.expires = max(job.expires, now + ask.seconds)
        job.askers.add(client)
        self._unanswered[client] += 1
        return True

    # -- answers -------------------------------------------------------------------------------------------------------

    def _report(self, jobs: Sequence[Job], outcomes: Sequence[Outcome]) -> None:
        """Report outcomes from the model's thread; another thread encodes them, so that the model can continue."""
        assert self._loop is not None
        with contextlib.suppress(RuntimeError):  # the server has ended
            self._loop.call_soon_threadsafe(lambda: self._start_task(self._encode_answers(jobs, outcomes)))

    async def _encode_answers(self, jobs: Sequence[Job], outcomes: Sequence[Outcome]) -> None:
        for job, outcome in zip(jobs, outcomes, strict=True):
            if isinstance(outcome, Refusal):
                self._send_answer(job, encode(Refusal(job.id, outcome.kind, outcome.text)))
            else:
                answer = await asyncio.to_thread(encode, Answer(job.id, outcome))
                self._recent_answers.put(job.id, answer)
                self._send_answer(job, answer)

    def _send_answer(self, job: Job, answer: bytes) -> None:
        """Send an answer to every client that asked for the row."""
        self._jobs.pop(job.id, None)
        for client in [client for client in self._unanswered if client in job.askers]:  # others have gone
            self.queue.count_answer(client)
            outbox, message = self._outboxes[client], answer
            if not outbox.takes(len(answer)):
                message = encode(Wait(job.id, self._estimate_wait(), "earlier answers have not been read yet"))
            outbox.put(message, partial(self._release_slot, client))

    def _release_slot(self, client: ServerConnection) -> None:
        self._unanswered[client] -= 1

    def _start_task(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _watch_timeouts(self) -> None:
        """Refuse rows that were not begun in time, and disconnect clients that read nothing."""
        leaving = set[ServerConnection]()
        while True:
            await asyncio.sleep(TICK)
            leaving &= set(self._outboxes)
            for client, outbox in self._outboxes.items():
                if outbox.stalled_seconds() > UNREAD and client not in leaving:
                    leaving.add(client)
                    self.refused += 1
                    self._start_task(self._disconnect_client(client, outbox))
            for job in self.queue.take_expired():
                self._send_answer(
                    job, encode(Refusal(job.id, "deadline", "the row was not started in time: the queue is long"))
                )

    async def _finish_rows(self) -> None:
        while self._jobs or self._tasks or any(self._outboxes.values()):
            await asyncio.sleep(TICK)


def _welcome(model: WorldModel, in_flight: int) -> Welcome:
    fingerprint = model.fingerprint()
    lacks = "was made with an object that does not identify it" if model.unwrapped.version else "declares no version"
    unknown = "" if fingerprint else f"{type(model.unwrapped).__name__} {lacks}"
    described = json.dumps({**model.describe(), **_sources(model, fingerprint)}, default=str)
    return Welcome(declaration(model.accepts), described, fingerprint, unknown, in_flight)


def _sources(model: WorldModel, fingerprint: str) -> dict[str, Any]:
    """Return an identifier of the version of a model that declares none: digests of its source files, by name."""
    digests = {} if fingerprint else source_digests(model)
    return {"sources": {Path(path).name: digest for path, digest in digests.items()}} if digests else {}
