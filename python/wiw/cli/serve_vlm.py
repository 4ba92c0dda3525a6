# SPDX-License-Identifier: Apache-2.0
"""`wiw serve-vlm`."""

from __future__ import annotations

from typing import Annotated, Any

from tyro.conf import arg


def serve_vlm(
    *,
    model: Annotated[str, arg(metavar="tiny|mock|PATH|FILE.py:FUNCTION")] = "tiny",
    port: Annotated[int, arg(metavar="N")] = 8000,
    seed: Annotated[int, arg(metavar="N")] = 0,
) -> int:
    """Serve a vision-language model on this machine, with the API of OpenAI and vLLM, for tests.

      $ wiw serve-vlm
      $ wiw serve-vlm --model my_script.py:answer --port 8001

    Then, in another terminal:  wiw run ar --policy vlm --vlm http://localhost:8000/v1

    Args:
        model: tiny, a model with random weights, built on the spot; mock, with random answers; a folder or hub name for
            transformers; or a function that takes each call and returns text, or a probability for each first token.
        port: Port on 127.0.0.1; 0 picks a free one.
        seed: Seed of the random weights.
    """
    import tempfile

    from wiw.serving.vlm_server import VlmServer

    with tempfile.TemporaryDirectory() as folder:
        server = VlmServer(_client(model, seed, folder), port)
        print(f"{server.client.model} at {server.url}", flush=True)
        server.serve()
    return 0


def _client(model: str, seed: int, folder: str) -> Any:
    from hashlib import blake2b
    from pathlib import Path

    from wiw.registry import Registry
    from wiw.vlm.mock import MockClient
    from wiw.vlm.tiny import make_tiny
    from wiw.vlm.transformers import TransformersClient

    if model == "mock":
        return MockClient()
    if ".py:" in model:
        script = Registry("script", "", {}).find(model)
        file, _, function = model.rpartition(":")
        digest = blake2b(
            Path(file).expanduser().read_bytes(), digest_size=4
        ).hexdigest()  # answers are kept by this name
        return MockClient(script, model=f"{function}-{digest}")
    return TransformersClient(make_tiny(Path(folder) / f"tiny-{seed}", seed) if model == "tiny" else model)
