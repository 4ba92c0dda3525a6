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
    """Serve a vision-language model to this machine, in the way of OpenAI and vLLM, for tests and trials.

      $ wiw serve-vlm
      $ wiw serve-vlm --model my_script.py:answer --port 8001

    Then, in another terminal:  wiw run ar --policy vlm --vlm http://localhost:8000/v1

    Args:
        model: tiny, a model of random weights made on the spot; mock, which draws its answers; a folder or hub name for
            transformers; or a function that is given each call and returns text or a probability for each first token.
        port: On 127.0.0.1; 0 takes a free one.
        seed: Of the random weights.
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
