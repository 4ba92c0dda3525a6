# SPDX-License-Identifier: Apache-2.0
"""`wiw serve-vlm`."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.wire.address_book import ServerAddress, announce_server


def serve_vlm(
    *,
    model: Annotated[str, arg(metavar="tiny|mock|PATH|FILE.py:FUNCTION")] = "tiny",
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, arg(metavar="N")] = 8000,
    token: Annotated[str | None, arg(metavar="SECRET")] = None,
    announce: Annotated[Path | None, arg(metavar="FILE")] = None,
    seed: Annotated[int, arg(metavar="N")] = 0,
) -> int:
    """Serve a vision-language model, with the API of OpenAI and vLLM, for tests.

    $ wiw serve-vlm
    $ wiw serve-vlm --model my_script.py:answer --port 8001

    Then, in another terminal:  wiw run ar --policy vlm --vlm http://localhost:8000/v1

    Args:
        model: tiny, a model with random weights, built on the spot; mock, with random answers; a folder or hub name for
            transformers; or a function that takes a call and returns a text, or a probability for each first token.
        host: Address to listen on; any but the loopback address requires a token.
        port: Port to listen on; 0 picks a free one.
        token: Secret that clients must send as OPENAI_API_KEY. Default: the environment variable WIW_TOKEN.
        announce: File (.json) that announces address and token while the server is up.
        seed: Seed of the random weights.
    """
    import tempfile

    from wiw.serving.vlm_server import VlmServer

    secret = token or os.environ.get("WIW_TOKEN")
    with tempfile.TemporaryDirectory() as folder, ExitStack() as announcing:
        server = VlmServer(_make_client(model, seed, folder), port, host, secret)
        print(f"{server.client.model} at {server.url}", flush=True)
        if announce is not None:
            announcing.enter_context(announce_server(ServerAddress(server.url, secret), announce))
        server.serve()
    return 0


def _make_client(model: str, seed: int, folder: str) -> Any:
    from hashlib import blake2b

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
