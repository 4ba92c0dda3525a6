# SPDX-License-Identifier: Apache-2.0
"""The client for an address."""

from __future__ import annotations

import inspect
from functools import partial
from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError
from wiw.vlm.base import Client


def connect(spec: Any, **options: Any) -> Client:
    """Create the client for an address.

    Args:
        spec: "http://host:port/v1" (any OpenAI-compatible server), "remote:FOLDER" (those announced there),
            "transformers:PATH" (a local model), "replay:RUN" (answers recorded by a run), "mock" (random answers), or a
            client, which is returned as it is.
        options: of that client's class, such as `model`, `cache`, `prices`, `top_logprobs`.

    Raises:
        ArgumentError: another address, or options that its client does not take.
    """
    if isinstance(spec, Client):
        return spec
    factory, given = _factory(str(spec))
    known = {**inspect.signature(factory).parameters, **inspect.signature(Client).parameters}
    unknown = sorted(set(options) - set(known))
    if unknown and not str(spec).startswith("replay:"):
        raise ArgumentError(f"vlm '{spec}': no option {', '.join(unknown)}; there are {', '.join(known)}")
    return factory(*given, **options)


def _factory(spec: str) -> tuple[Any, tuple[str, ...]]:
    kind, _, rest = spec.partition(":")
    if kind in ("http", "https") or (kind == "remote" and rest):
        from wiw.vlm.openai import OpenAIClient

        return OpenAIClient, (spec,)
    if kind == "transformers" and rest:
        from wiw.vlm.transformers import TransformersClient

        return TransformersClient, (rest,)
    if kind == "replay" and rest:
        from wiw.vlm.replay import ReplayClient

        return ReplayClient, (str(Path(rest).expanduser()),)
    if spec == "mock":
        from wiw.vlm.mock import MockClient

        return partial(MockClient, record=False), ()
    raise ArgumentError(
        f"vlm: expected http://HOST:PORT/v1, remote:FOLDER, transformers:PATH, replay:RUN or mock, got '{spec}'"
    )
