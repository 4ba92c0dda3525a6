# SPDX-License-Identifier: Apache-2.0
"""Serves PathDreamer or SE3DS from the environment of its official code, as `wiw serve` would (docs/serving.md).

    python shim.py pathdreamer --code ~/pathdreamer --weights ~/pathdreamer/data
    python shim.py se3ds --code ~/se3ds --weights ~/se3ds/data --port 8766

Copy this folder to that environment's machine, or run it where wiw is installed; it needs NumPy, msgpack and websockets
(10 or later) beside the official code's own packages, and Python 3.8 or later. The README of `panoramic`
has the commands that make the environments.

It listens at 127.0.0.1. Another --host asks for a token, in WIW_TOKEN or --token, which wiw sends from WIW_TOKEN.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hmac
import ipaddress
import json
import logging
import os
import signal
import sys
import time
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from hashlib import blake2b
from http import HTTPStatus
from pathlib import Path
from typing import Any

import websockets
from messages import VIEW, RefusedError, decode, encode, pack_array, unpack_row  # type: ignore[import-not-found]
from networks import NETWORKS, MissingError, Network, RowError  # type: ignore[import-not-found]

PORT = 8765
IN_FLIGHT = 4
"""Rows of a client that may be unanswered: one is computed, others travel."""
QUEUE = 64
"""Rows of all clients that may wait."""
KNOWN_BYTES = 256 * 2**20
"""Maximum size in bytes of answers kept for clients that ask again because they never got them."""
_log = logging.getLogger("shim.connections")
_log.addHandler(logging.NullHandler())
_log.propagate = False  # every stranger who connects would write a line
HEARTBEAT, SILENCE, HANDSHAKE = 10.0, 30.0, 10.0
POLICY_VIOLATION = 1008


class Job:
    """A row that waits, is computed, or has its answer."""

    def __init__(self, row: dict[str, Any], seconds: float) -> None:
        self.row, self.expires = row, time.monotonic() + seconds
        self.askers = 0
        self.answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()


class Server:
    """Answers clients, one row at a time; the network works in a thread of its own, so connections stay alive."""

    def __init__(self, network: Network, token: str) -> None:
        self._network, self._token = network, token
        model = json.dumps(network.describe())
        self._welcome = encode(
            "welcome",
            accepts=accepts(network),
            model=model,
            fingerprint=network.fingerprint(),
            unknown="",
            in_flight=IN_FLIGHT,
        )
        self._thread = ThreadPoolExecutor(1)
        self._jobs: dict[bytes, Job] = {}
        """Jobs that wait or are being computed."""
        self._known: OrderedDict[bytes, bytes] = OrderedDict()
        self._waiting: asyncio.Queue[bytes] = asyncio.Queue()

    async def run(self, host: str, port: int) -> None:
        """Serve until it is cancelled."""
        height, width = VIEW
        async with websockets.serve(
            self._meet,
            host,
            port,
            process_request=self._admit,
            origins=[None],  # a browser names the page that connects; no page has business here
            compression=None,
            max_size=11 * height * width + 2**20,
            ping_interval=HEARTBEAT,
            ping_timeout=SILENCE,
            close_timeout=1,
            logger=_log,
        ) as listener:
            port = next(iter(listener.sockets)).getsockname()[1]
            name = f"[{host}]" if ":" in host else host
            print(f"{self._network.name} is served at ws://{name}:{port}", flush=True)
            await self._work()

    async def _work(self) -> None:
        """Compute rows in the order in which they came."""
        loop = asyncio.get_running_loop()
        while True:
            name = await self._waiting.get()
            job = self._jobs[name]
            try:
                if not job.askers or job.expires < time.monotonic():
                    raise RefusedError("deadline", "the row was not started in time")
                answer = await loop.run_in_executor(self._thread, self._compute, name, job.row)
                self._keep(name, answer)
            except RefusedError as error:
                answer = refusal(name, error)
            del self._jobs[name]
            job.answer.set_result(answer)

    def _keep(self, name: bytes, answer: bytes) -> None:
        self._known[name] = answer
        while sum(map(len, self._known.values())) > KNOWN_BYTES:
            self._known.popitem(last=False)

    def _compute(self, name: bytes, row: dict[str, Any]) -> bytes:
        begin = time.monotonic()
        first, end = row["shared"], row["length"]
        try:
            frames = self._network.rollout(
                row["image"], row["depth"], row["semantic"], row["viewpoints"][:end], row["seed"]
            )
        except RowError as error:
            raise RefusedError("row", str(error)) from error
        except Exception as error:  # the server goes on, and the client is told
            raise RefusedError("raised", f"{type(error).__name__}: {' '.join(str(error).split())}") from error
        print(f"{end} frames in {time.monotonic() - begin:.1f} s", flush=True)
        return encode("answer", id=name, frames=pack_array(frames[first:]))

    def _admit(self, connection: Any, request: Any) -> Any:
        """Return None to let a client in. Older versions of websockets hand over path and headers."""
        headers = getattr(request, "headers", request)
        tokens = headers.get_all("Authorization")
        if not self._token or (len(tokens) == 1 and _same(tokens[0], f"Bearer {self._token}")):
            return None
        text = "the token is missing or wrong\n"
        status = HTTPStatus.UNAUTHORIZED
        return connection.respond(status, text) if hasattr(connection, "respond") else (status, [], text.encode())

    async def _meet(self, client: Any) -> None:
        """Serve one client, from its first message to its last."""
        tasks: dict[bytes, asyncio.Task[None]] = {}
        try:
            kind, _ = decode(await asyncio.wait_for(client.recv(), HANDSHAKE))
            if kind != "hello":
                raise RefusedError("message", f"expected a hello first, got {kind}")
            await client.send(self._welcome)
            async for data in client:
                kind, said = decode(data)
                name = said.get("id", b"")
                if kind != "ask" or name != blake2b(said["row"], digest_size=16).digest():
                    raise RefusedError("message", "expected an ask whose id is the digest of its row")
                if name in tasks:
                    raise RefusedError("message", "a row was requested twice on one connection")
                reason = self._full(tasks)
                if reason:
                    await client.send(encode("wait", id=name, seconds=0.5, reason=reason))
                    continue
                self._begin(client, said, tasks)
        except RefusedError as error:
            with contextlib.suppress(websockets.ConnectionClosed):
                await client.send(refusal(b"", error))
                await client.close(POLICY_VIOLATION, error.kind)
        except (websockets.ConnectionClosed, asyncio.TimeoutError):
            pass
        finally:
            for task in list(tasks.values()):
                task.cancel()

    def _begin(self, client: Any, said: dict[str, Any], tasks: dict[bytes, asyncio.Task[None]]) -> None:
        name = said["id"]
        task = tasks[name] = asyncio.ensure_future(self._answer(client, said))
        task.add_done_callback(lambda _: tasks.pop(name, None))

    def _full(self, tasks: dict[bytes, Any]) -> str:
        """Return why no row of a client is taken now; empty if one is."""
        if len(tasks) >= IN_FLIGHT:
            return "too many rows unanswered"
        return "the queue is full" if len(self._jobs) >= QUEUE else ""

    async def _answer(self, client: Any, said: dict[str, Any]) -> None:
        name = said["id"]
        answer = self._known.get(name)
        if answer is None:
            try:
                answer = await self._result(name, said)
            except RefusedError as error:
                answer = refusal(name, error)
        with contextlib.suppress(websockets.ConnectionClosed):
            await client.send(answer)

    async def _result(self, name: bytes, said: dict[str, Any]) -> bytes:
        """Return the answer to a row, which may be asked for, or computed, already."""
        job = self._jobs.get(name)
        if job is None:
            job = self._jobs[name] = Job(unpack_row(said["row"], self._network.needs), said["seconds"])
            self._waiting.put_nowait(name)
        job.expires = max(job.expires, time.monotonic() + said["seconds"])
        job.askers += 1
        try:
            return await asyncio.shield(job.answer)
        finally:
            job.askers -= 1


def refusal(name: bytes, error: RefusedError) -> bytes:
    """Return the message that refuses a row or, without a name, a connection."""
    return encode("refusal", id=name, kind=error.kind, text=str(error))


def _same(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(), other.encode())


def accepts(network: Network) -> str:
    """Return JSON of what the model takes, as `wiw.Accepts`.

    Frames that plans share are only the same without noise.
    """
    return json.dumps(
        {
            "control": "viewpoint",
            "space": "discrete",
            "view": "panorama",
            "size": VIEW,
            "frames": 0,
            "needs": network.needs,
            "causal": not network.noise,
            "best_batch": 1,
            "vocabulary": None,
            "null_first": False,
            "template": None,
            "cacheable": True,
        }
    )


# -- command line ------------------------------------------------------------------------------------------------------


def main() -> int:
    """Load the networks and serve them until SIGINT or SIGTERM."""
    options = _options()
    token = options.token or os.environ.get("WIW_TOKEN", "")
    if not token and not _is_loopback(options.host):
        return _fail(f"{options.host} can be reached from other machines: set WIW_TOKEN to a secret")
    try:
        network = NETWORKS[options.model](options.code.expanduser(), options.weights.expanduser(), options.noise)
    except MissingError as error:
        return _fail(str(error))
    try:
        asyncio.run(_serve(network, token, options.host, options.port))
    except OSError as error:
        return _fail(f"cannot listen at {options.host} port {options.port}: {error}")
    except (KeyboardInterrupt, asyncio.CancelledError):
        pass
    os._exit(0)  # a network that is at work in its thread cannot be interrupted; clients ask again


async def _serve(network: Network, token: str, host: str, port: int) -> None:
    task = asyncio.ensure_future(Server(network, token).run(host, port))
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    await task


def _options() -> argparse.Namespace:
    about, _, details = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        description=about, epilog=details, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", choices=sorted(NETWORKS))
    parser.add_argument("--code", type=Path, required=True, help="folder of the official repository")
    parser.add_argument("--weights", type=Path, required=True, help="folder with its checkpoints")
    parser.add_argument("--noise", action="store_true", help="sample what cannot be known, using the row's seed")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=PORT, help="port to listen on; 0 picks a free one")
    parser.add_argument("--token", default="", help="secret that clients must send; better given as WIW_TOKEN")
    return parser.parse_args()


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _fail(text: str) -> int:
    print(f"shim: {text}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
