# SPDX-License-Identifier: Apache-2.0
"""Servers of a run as Ray actors: each starts `wiw serve` or `wiw serve-vlm`, and one that is lost is started again.

An actor gets its GPUs of Ray and starts the command as a separate process, which ends with the actor; a server that
crashes takes nothing else with it. A server comes back at its address where its node is still there, and clients repeat
what it has not answered; at another address the run's workers are told the new one. A server whose model hangs ends
itself (`wiw.serving.watchdog`).
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from wiw.errors import InfrastructureError
from wiw.runs.servers import ServerCommand
from wiw.wire.address_book import ServerAddress, read_addresses

TRIES = 3
"""How often a server is started while no episode ends with it serving."""
START_SECONDS = 1800.0
"""Time that a server has for loading its weights and announcing itself."""
PLACE_SECONDS = 600.0
"""Time that the cluster has for giving an actor its resources."""
GLANCE = 0.1
"""Seconds between two looks whether it has."""
SHOWN_BYTES = 2000
"""Bytes of a server's latest output that an error shows."""
_CHILD = (
    "import sys; from wiw.process_limits import end_with_parent; end_with_parent(int(sys.argv.pop(1))); "
    "from wiw.cli import run_process; sys.exit(run_process())"
)


class LostServersError(InfrastructureError):
    """No server of a kind is left."""


class ServerActor:
    """The side of a server: starts the command, and tells when it has ended."""

    def __init__(self, arguments: Sequence[str], host: str | None, token: str) -> None:
        """Note the command; `host` None stands for this node's address in the cluster."""
        self._arguments, self._token = list(arguments), token
        self._host = _find_node_address() if host is None else host
        self._output: Any = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the actor; nothing of it stays
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, port: int) -> tuple[str, str]:
        """Start the server on a port (0: a free one); return its address once it serves, and the id of the node.

        Raises:
            InfrastructureError: it has ended, or does not serve in time.
        """
        import ray

        with tempfile.TemporaryDirectory(prefix="wiw-server-") as folder:
            file = Path(folder) / "server.json"
            listen = ["--host", self._host, "--port", str(port), "--announce", str(file)]
            self._process = subprocess.Popen(
                [sys.executable, "-c", _CHILD, str(os.getpid()), *self._arguments, *listen],
                env={**os.environ, "WIW_TOKEN": self._token},
                stdout=self._output,
                stderr=subprocess.STDOUT,
            )
            server = self._await_announcement(file)
        return server.address, ray.get_runtime_context().get_node_id()

    def wait(self) -> str:
        """Return why the server has ended, once it has."""
        assert self._process is not None
        return f"exit code {self._process.wait()}; its last output: {self._read_output() or 'none'}"

    def _await_announcement(self, file: Path) -> ServerAddress:
        assert self._process is not None
        give_up = time.monotonic() + START_SECONDS
        while not (found := read_addresses(file)):
            if self._process.poll() is not None:
                raise InfrastructureError(self.wait())
            if time.monotonic() > give_up:
                self._process.kill()
                raise InfrastructureError(f"it did not start serving within {START_SECONDS:g} s; {self.wait()}")
            time.sleep(GLANCE)
        return found[0]

    def _read_output(self) -> str:
        size = self._output.seek(0, os.SEEK_END)
        self._output.seek(max(0, size - SHOWN_BYTES))
        return str(self._output.read().decode("utf-8", "replace").strip())


@dataclass
class _Server:
    """A server as the driver knows it."""

    command: ServerCommand
    actor: Any = None
    ref: Any = None
    """Reference to its start, and once it serves, to its end."""
    address: str | None = None
    """Where it serves, or did before it was lost."""
    node: str | None = None
    serves: bool = False
    asked_at: float = 0.0
    """When it was last asked to start, as `time.monotonic()` tells it."""
    lost: int = 0
    """How often it was lost since an episode has ended while it served."""

    @property
    def port(self) -> int:
        return urlsplit(self.address or "").port or 0


class ServerPool:
    """The driver's side: starts servers of one kind, and starts those again that are lost.

    Args:
        ray: the module.
        commands: of the servers.
        host: address that they listen on; None is that of their node in the cluster.
        token: secret that clients send.
    """

    def __init__(self, ray: Any, commands: Iterable[ServerCommand], host: str | None, token: str) -> None:
        self._ray, self._host, self._token = ray, host, token
        self._servers = [_Server(command) for command in commands for _ in range(command.count)]
        self._have_all_served = False

    def __len__(self) -> int:
        return len(self._servers)

    @property
    def addresses(self) -> list[str]:
        """Addresses of the servers, those included that are being started again."""
        return [server.address for server in self._servers if server.address is not None]

    @property
    def serving(self) -> list[str]:
        """Addresses of the servers that serve at present."""
        return [server.address for server in self._servers if server.serves and server.address is not None]

    @property
    def serves(self) -> bool:
        """Whether there is enough to work with: all servers at the beginning, and once all have served, any of them."""
        return not self._servers or len(self.serving) >= (1 if self._have_all_served else len(self._servers))

    @property
    def refs(self) -> list[Any]:
        """References to wait for: one that is ready is news of a server, which `update_servers` deals with."""
        return [server.ref for server in self._servers]

    def start(self) -> None:
        """Start all servers, at the same time; `update_servers` tells when they serve."""
        for server in self._servers:
            self._start(server)

    def update_servers(self, ready: Sequence[Any]) -> None:
        """Deal with servers that have begun to serve, are lost, or have not come back for too long.

        Raises:
            LostServersError: one was lost for the third time, and no other is left.
        """
        self._receive_news(ready)
        self._have_all_served |= all(server.serves for server in self._servers)
        if self._have_all_served and self.serving:
            self._give_up_absent()

    def _receive_news(self, ready: Sequence[Any]) -> None:
        for server in [server for server in self._servers if server.ref in ready]:
            try:
                found = self._ray.get(server.ref)
            except self._ray.exceptions.RayTaskError as error:
                self._restart(server, str(error.cause))
            except self._ray.exceptions.RayError as error:  # its actor is lost; without memory by no RayActorError
                self._ray.kill(server.actor)
                self._restart(server, describe_loss(error), is_gone=True)
            else:
                if server.serves:  # it has ended, and this is why
                    self._restart(server, found)
                else:
                    server.address, server.node = found
                    server.serves, server.ref = True, server.actor.wait.remote()

    def _give_up_absent(self) -> None:
        """Give up servers for which the cluster has had no place since they were lost: the others go on."""
        now = time.monotonic()
        for server in [server for server in self._servers if not server.serves]:
            if now - server.asked_at > START_SECONDS + PLACE_SECONDS:
                self._give_up(server)

    def note_progress(self) -> None:
        """Note that an episode has ended: servers that serve, and are lost from now on, have all their tries."""
        for server in self._servers:
            server.lost = 0 if server.serves else server.lost

    def stop(self) -> None:
        """End the servers."""
        for server in self._servers:
            if server.actor is not None:
                self._ray.kill(server.actor)

    def _start(self, server: _Server) -> None:
        if server.actor is None:
            server.actor = self._make_actor(server)
        server.serves, server.asked_at = False, time.monotonic()
        server.ref = server.actor.start.remote(server.port if server.lost < TRIES - 1 else 0)

    def _make_actor(self, server: _Server) -> Any:
        """Return an actor, on the node where the server was before if that exists."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        place: Any = "SPREAD" if server.node is None else NodeAffinitySchedulingStrategy(server.node, soft=True)
        options = {"num_cpus": 0, "num_gpus": server.command.gpus, "scheduling_strategy": place}  # placed by GPUs alone
        kind = self._ray.remote(max_restarts=0, max_task_retries=0, **options)(ServerActor)
        return kind.remote(server.command.arguments, self._host, self._token)

    def _restart(self, server: _Server, cause: str, is_gone: bool = False) -> None:
        server.lost += 1
        if is_gone:
            server.actor = None
        if server.lost < TRIES:
            self._start(server)
            return
        self._give_up(server)
        if not self._servers:
            command = shlex.join(["wiw", *server.command.arguments])
            raise LostServersError(
                f"the last server was lost {TRIES} times without any episode finishing: {command}: {cause}. Fix it, "
                "then `wiw resume`, with --retry-errors for the episodes that were using it"
            )

    def _give_up(self, server: _Server) -> None:
        if server.actor is not None:
            self._ray.kill(server.actor)
        self._servers.remove(server)


def describe_loss(error: Exception) -> str:
    """Return in a line why Ray has lost an actor."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def _find_node_address() -> str:
    import ray

    return str(ray.util.get_node_ip_address())
