# SPDX-License-Identifier: Apache-2.0
"""`wiw serve-vlm`."""

from __future__ import annotations

import signal
import threading
from contextlib import ExitStack
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from wiw.wire.address_book import ServerAddress, announce_server, find_token, name_reachable, require_announcement

if TYPE_CHECKING:
    from wiw.serving.vlm_server import VlmServer

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR2)
GLANCE = 1.0
"""Seconds between two looks at whether a server has been idle for too long."""


def serve_vlm(
    *,
    model: Annotated[str, arg(metavar="tiny|mock|PATH|FILE.py:FUNCTION")] = "tiny",
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, arg(metavar="N")] = 8000,
    token: Annotated[str | None, arg(metavar="SECRET")] = None,
    announce: Annotated[Path | None, arg(metavar="FILE")] = None,
    idle: Annotated[float | None, arg(metavar="SECONDS")] = None,
    await_first: Annotated[float | None, arg(metavar="SECONDS")] = None,
    seed: Annotated[int, arg(metavar="N")] = 0,
) -> int:
    """Serve a vision-language model, with the API of OpenAI and vLLM, for tests.

    $ wiw serve-vlm
    $ wiw serve-vlm --model my_script.py:answer --port 8001

    Then, in another terminal:  wiw run ar --policy vlm --vlm http://localhost:8000/v1

    $ wiw serve-vlm --model PATH --host 0.0.0.0 --port 0 --announce servers/1.json --idle 1800
    $ wiw run ar --policy vlm --vlm remote:servers

    It exits on SIGTERM or Ctrl-C. Clients repeat what it has not answered, at another announced server if there is one.

    Args:
        model: tiny, a model with random weights, built on the spot; mock, with random answers; a folder or hub name for
            transformers; or a function that takes a call and returns a text, or a probability for each first token.
        host: Address to listen on; any but the loopback address requires a token.
        port: Port to listen on; 0 picks a free one.
        token: Secret that clients must send as OPENAI_API_KEY. Default: the environment variable WIW_TOKEN.
        announce: File (.json) that announces address and token while the server is up; clients are given its folder.
            Only its owner can read it. Without --token a random one is used.
        idle: Seconds without any request after which the server exits. Default: never.
        await_first: Seconds that it waits for its first request, where --idle is given. Default: as --idle.
        seed: Seed of the random weights.
    """
    import tempfile

    require_announcement(announce)
    secret = find_token(token, announce)
    with (
        tempfile.TemporaryDirectory() as folder,
        _make_server(_make_client(model, seed, folder), port, host, secret) as server,
        ExitStack() as announcing,
    ):
        print(f"{server.model} at {server.url}", flush=True)
        if announce is not None:
            announcing.enter_context(announce_server(ServerAddress(name_reachable(server.url), secret), announce))
        _wait_for_end(server, None if idle is None else (idle if await_first is None else await_first, idle))
    return 0


def _wait_for_end(server: VlmServer, patience: tuple[float, float] | None) -> None:
    """Wait until a signal arrives or the server has been idle for too long; `patience` is how long it waits for its
    first request, and later for another one.
    """
    ended = threading.Event()
    before = {number: signal.signal(number, lambda *_: ended.set()) for number in SIGNALS}
    try:
        while not ended.wait(GLANCE if patience is None else min(GLANCE, patience[1] / 4)):
            if patience is not None and server.idle_seconds >= patience[server.was_asked]:
                return
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _make_server(client: Any, port: int, host: str, secret: str | None) -> VlmServer:
    """Return the server of a model, whose name tells its weights: answers are kept by it, wherever it is served."""
    from wiw.serving.vlm_server import VlmServer
    from wiw.vlm.transformers import TransformersClient

    if not isinstance(client, TransformersClient):
        return VlmServer(client, port, host, secret)
    digest = blake2b(client.manner.encode(), digest_size=4).hexdigest()
    return VlmServer(client, port, host, secret, f"{client.model}-{digest}")


def _make_client(model: str, seed: int, folder: str) -> Any:
    from wiw.registry import Registry
    from wiw.vlm.mock import MockClient
    from wiw.vlm.tiny import make_tiny
    from wiw.vlm.transformers import TransformersClient

    if model == "mock":
        return MockClient(record=False)
    if ".py:" in model:
        script = Registry("script", "", {}).find(model)
        file, _, function = model.rpartition(":")
        digest = blake2b(
            Path(file).expanduser().read_bytes(), digest_size=4
        ).hexdigest()  # answers are kept by this name
        return MockClient(script, model=f"{function}-{digest}", record=False)
    return TransformersClient(make_tiny(Path(folder) / f"tiny-{seed}", seed) if model == "tiny" else model)
