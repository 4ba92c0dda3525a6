# SPDX-License-Identifier: Apache-2.0
"""`wiw serve`."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from wiw.cli.options import Options
from wiw.wire.address_book import ServerAddress, announce_server, find_token, name_reachable, require_announcement

SHOWN, LOGGED = 1.0, 10.0
"""Seconds between status lines, on a terminal and elsewhere."""
WATCH = 1.0
"""Seconds between two looks whether the model hangs."""


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
    announce: Annotated[Path | None, arg(metavar="FILE")] = None,
    idle: Annotated[float | None, arg(metavar="SECONDS")] = None,
    await_first: Annotated[float | None, arg(metavar="SECONDS")] = None,
    clients: Annotated[int, arg(metavar="N")] = 256,
    stall: Annotated[float | None, arg(metavar="SECONDS")] = None,
) -> int:
    """Serve a world model to runs in other processes or on other machines.

    $ wiw serve warp
    $ wiw run imagenav --world-model remote:ws://127.0.0.1:8765 --workers 4 --live 8

    $ WIW_TOKEN=secret wiw serve my_model.py:MyModel --host 0.0.0.0
    $ WIW_TOKEN=secret wiw run imagenav --world-model remote:ws://gpu-machine:8765

    $ wiw serve svd --host 0.0.0.0 --port 0 --announce servers/1.json --idle 1800
    $ wiw run imagenav --arms none,svd=remote:servers

    The server batches rows across all episodes of all clients. If it is killed, clients wait for it to come back, as
    long as their deadlines allow, and repeat unanswered requests. On SIGTERM or Ctrl-C it finishes the accepted rows
    and exits; a second signal makes it exit at once. Run `wiw check-model MODEL` first to see whether the model keeps
    its contract; docs/serving.md describes the protocol.

    Args:
        model: Name, path.py:Class or package.module:Class. See `wiw list`.
        world_model_option: An option of the model, such as weights=FOLDER or steps=30; may be repeated.
        host: Address to listen on; any but the loopback address requires a token.
        port: Port to listen on; 0 picks a free one.
        token: Secret that clients must send. Default: the environment variable WIW_TOKEN, which other users of the
            machine cannot see.
        queue: Rows that may wait before clients are asked to retry. Default: eight full batches, and at least 64.
        window: How long an incomplete batch waits for idle clients, as a fraction of a batch's run time.
        certificate: PEM file of the certificate, for wss.
        key: PEM file of the certificate's key, if separate.
        grace: Time limit in seconds for finishing the accepted rows.
        announce: File (.json) that announces address and token while the server is up; clients are given its folder.
            Only its owner can read it. Without --token a random one is used.
        idle: Seconds without any client after which the server exits. Default: never.
        await_first: Seconds that it waits for its first client, where --idle is given. Default: as --idle.
        clients: Maximum number of connections at a time: each worker of a run has one.
        stall: Seconds that the model may take for one call. After that it counts as hung, and the server exits with
            code 2, so that what started it can start it again; `inf` never does. Default: four times the longest
            deadline of a client, and at least 1200.
    """
    from wiw.registry import WORLD_MODELS
    from wiw.runs.part_options import parse_options
    from wiw.serving.server import Server, Settings
    from wiw.serving.watchdog import Watchdog

    require_announcement(announce)
    secret = find_token(token, announce)
    settings = Settings(host, port, secret, queue, window, certificate, key, grace, clients)
    options = parse_options(world_model_option, WORLD_MODELS.find_here(model), "--world-model-option")
    server = Server(WORLD_MODELS.make_here(model, **options), settings)  # here: this process holds no simulator
    patience = None if idle is None else (idle if await_first is None else await_first, idle)
    asyncio.run(_live(server, model, announce, patience, Watchdog(server, stall)))
    return 0


async def _live(
    server: Any, name: str, announce: Path | None, patience: tuple[float, float] | None, watchdog: Any
) -> None:
    """Serve until a signal arrives, the server has been idle for too long, or its model hangs; announce it and print
    status lines. `patience` is how long it waits for its first client, and later for another one.
    """
    loop, signals = asyncio.get_running_loop(), 0
    ready = asyncio.Event()
    announcing = ExitStack()

    def begin() -> None:
        if announce is not None:
            reached = ServerAddress(name_reachable(server.address), server.settings.token)
            announcing.enter_context(announce_server(reached, announce))
        ready.set()

    serving = asyncio.ensure_future(server.run(begin))

    def stop() -> None:
        nonlocal signals
        signals += 1
        if signals == 1:
            left = f"finishing {server.pending_rows} accepted rows" if server.pending_rows else "ending"
            print(f"\nwiw serve: {left}", file=sys.stderr, flush=True)
            server.end()
        else:
            serving.cancel()

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR2):
        loop.add_signal_handler(number, stop)
    beside = [asyncio.ensure_future(_show(server, name, ready))]
    beside += [] if patience is None else [asyncio.ensure_future(_end_if_idle(server, *patience, ready))]
    beside += [asyncio.ensure_future(_end_if_hung(watchdog, announcing))]
    try:
        await serving
    except asyncio.CancelledError:
        pass
    finally:
        announcing.close()
        for task in beside:
            task.cancel()
        await asyncio.gather(*beside, return_exceptions=True)


async def _end_if_idle(server: Any, at_first: float, later: float, ready: asyncio.Event) -> None:
    """Stop a server once it has had no client for so many seconds: before the first one, and after one."""
    await ready.wait()
    last, limit = time.monotonic(), at_first
    while time.monotonic() - last < limit:
        await asyncio.sleep(min(1.0, later / 4))
        if server.clients:
            last, limit = time.monotonic(), later
    server.end()


async def _end_if_hung(watchdog: Any, announcing: ExitStack) -> None:
    """End the process once its model hangs; a shutdown in order would wait for the model."""
    while not (cause := watchdog.find_hang()):
        await asyncio.sleep(WATCH)
    announcing.close()
    print(f"\nwiw serve: {cause}", file=sys.stderr, flush=True)
    os._exit(2)


async def _show(server: Any, name: str, ready: asyncio.Event) -> None:
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from wiw.serving.status import Status

    await ready.wait()
    console = Console(highlight=False, soft_wrap=True, markup=False)
    accepts = server.model.accepts
    height, width = accepts.size
    console.print(f"serving  {name}: {accepts.view} {height}x{width}, control {accepts.control}, up to", end=" ")
    console.print(f"{accepts.best_batch} rows a batch")
    console.print(f"run      wiw run imagenav --world-model remote:{server.address}")
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
