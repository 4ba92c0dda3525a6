# SPDX-License-Identifier: Apache-2.0
"""A server in a thread, for notebooks, tests and benchmarks."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from wiw.registry import WORLD_MODELS
from wiw.serving.server import Server, Settings
from wiw.typed_values import read_values


@contextmanager
def serve_in_background(model: Any, **settings: Any) -> Iterator[Server]:
    """Serve a world model (name, class or instance) while the block runs, at a free port: `server.address`.

        with serve_in_background(MyModel()) as server:
            model = wiw.world_model(f"remote:{server.address}")

    Raises:
        ArgumentError: the model cannot be served, or a setting is unknown or out of range.
        InfrastructureError: the address cannot be listened at.
    """
    given = read_values(Settings, settings, "serve_in_background", "setting")
    server = Server(WORLD_MODELS.make_here(model), Settings(**{"port": 0, **given}))
    ready, failures = threading.Event(), list[BaseException]()
    loop = asyncio.new_event_loop()

    def live() -> None:
        try:
            loop.run_until_complete(server.run(ready.set))
        except BaseException as error:
            failures.append(error)
        finally:
            ready.set()
            loop.close()

    thread = threading.Thread(target=live, daemon=True, name="wiw server")
    thread.start()
    ready.wait()
    if failures:
        raise failures[0]
    try:
        yield server
    finally:
        with suppress(RuntimeError):  # it has already ended
            loop.call_soon_threadsafe(server.end)
        thread.join(server.settings.grace + 10)
