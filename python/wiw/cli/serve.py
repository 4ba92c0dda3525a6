# SPDX-License-Identifier: Apache-2.0
"""`wiw serve`."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from wiw.cli.options import Options, model_options

SHOWN, LOGGED = 1.0, 10.0
"""Seconds between status lines, on a terminal and elsewhere."""


def serve(
    model: Positional[Annotated[str, arg(metavar="MODEL")]],
    /,
    *,
    world_model_option: Options = (),
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, arg(metavar="N")] = 8765,
    token: Annotated[str | None, arg(metavar="SECRET")] = None,
    queue: Annotated[int | None, arg(metavar="ROWS")] = None,
    window: Annotated[float, arg(metavar="SHARE")] = 0.05,
    certificate: Annotated[Path | None, arg(metavar="FILE")] = None,
    key: Annotated[Path | None, arg(metavar="FILE")] = None,
    grace: Annotated[float, arg(metavar="SECONDS")] = 30.0,
) -> int:
    """Serve a world model to runs in other processes or on other machines.

    $ wiw serve warp
    $ wiw run imagenav --world-model remote:ws://127.0.0.1:8765 --workers 4 --live 8

    $ WIW_TOKEN=secret wiw serve my_model.py:MyModel --host 0.0.0.0
    $ WIW_TOKEN=secret wiw run imagenav --world-model remote:ws://gpu-machine:8765

    The server batches the rows of all episodes of all clients. If it is killed, clients wait for it to come back, as
    long as their deadlines allow, and repeat unanswered requests. On SIGTERM or Ctrl-C it finishes the accepted rows
    and ends; a second signal ends it at once. Run `wiw check-model MODEL` first to see whether the model keeps its
    contract; docs/serving.md has the protocol.

    Args:
        model: Name, path.py:Class or package.module:Class. See `wiw list`.
        world_model_option: An option of the model, such as weights=FOLDER or steps=30; may be given again.
        host: Address to listen on; any but the loopback address requires a token.
        port: Port to listen on; 0 picks a free one.
        token: Secret that clients must send; WIW_TOKEN if not given, which other users of the machine cannot see.
        queue: Rows that may wait before clients are asked to retry; eight full batches, and at least 64, if not given.
        window: How long a batch that is not full waits for idle clients, as a share of a batch's time.
        certificate: PEM file, for wss.
        key: PEM file of the certificate's key, if it is not in the same file.
        grace: Time limit in seconds for finishing the accepted rows.
    """
    from wiw.registry import world_model
    from wiw.serving.server import Server, Settings

    settings = Settings(host, port, token or os.environ.get("WIW_TOKEN"), queue, window, certificate, key, grace)
    server = Server(world_model(model, **model_options(model, world_model_option)), settings)
    asyncio.run(_live(server, model))
    return 0


async def _live(server: Any, name: str) -> None:
    """Serve until a signal arrives, and print status lines."""
    loop, signals = asyncio.get_running_loop(), 0
    ready = asyncio.Event()
    serving = asyncio.ensure_future(server.run(ready.set))

    def stop() -> None:
        nonlocal signals
        signals += 1
        if signals == 1:
            left = f"finishing {server.pending_rows} rows that were taken" if server.pending_rows else "ending"
            print(f"\nwiw serve: {left}", file=sys.stderr, flush=True)
            server.end()
        else:
            serving.cancel()

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR2):
        loop.add_signal_handler(number, stop)
    showing = asyncio.ensure_future(_show(server, name, ready))
    try:
        await serving
    except asyncio.CancelledError:
        pass
    finally:
        showing.cancel()
        await asyncio.gather(showing, return_exceptions=True)


async def _show(server: Any, name: str, ready: asyncio.Event) -> None:
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from wiw.serving.status import Status

    await ready.wait()
    console = Console(highlight=False, soft_wrap=True)
    accepts = server.model.accepts
    height, width = accepts.size
    console.print(f"serving  {name}: {accepts.view} {height}x{width}, control {accepts.control}, up to", end=" ")
    console.print(f"{accepts.best_batch} rows a batch")
    console.print(f"run      wiw run imagenav --world-model remote:{server.address}", markup=False)
    status = Status(server)
    if console.is_terminal:
        with Live(console=console, auto_refresh=False) as live:
            while True:
                live.update(Text(status.line()), refresh=True)
                await asyncio.sleep(SHOWN)
    while True:
        await asyncio.sleep(LOGGED)
        if status.changed:
            print(status.line(), flush=True)
