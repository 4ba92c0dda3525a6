# SPDX-License-Identifier: Apache-2.0
"""Files in which servers announce where they listen, for clients whose command was written before.

A file holds the server's token too, so its owner alone may read it. A server that comes back elsewhere replaces its
file; one that was killed leaves it, and clients try the next.
"""

from __future__ import annotations

import json
import os
import platform
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import urlsplit, urlunsplit

from wiw.errors import ArgumentError
from wiw.files import atomic_file
from wiw.json_text import parse_json


@dataclass(frozen=True)
class ServerAddress:
    """Where a server listens."""

    address: str
    """"ws://HOST:PORT", "wss://...", or of a language model "http://HOST:PORT/v1"."""
    token: str | None = None


def name_reachable(address: str) -> str:
    """Return an address with this machine's name in place of 0.0.0.0 or ::, at which others cannot ask it."""
    split = urlsplit(address)
    if split.hostname not in ("0.0.0.0", "::"):
        return address
    return urlunsplit(split._replace(netloc=f"{platform.node()}:{split.port}"))


def find_announcements(address: str) -> str | None:
    """Return the folder or file in which servers announce themselves, from the root on; None for addresses."""
    path = Path(address).expanduser()
    return str(path.resolve()) if "://" not in address and (os.sep in address or path.is_dir()) else None


def choose_server(place: Path, turn: int) -> ServerAddress:
    """Return one of the servers that are announced in a file or folder; the next `turn` gives the next one.

    Raises:
        ConnectionError: none is announced.
    """
    servers = read_addresses(place)
    if not servers:
        raise ConnectionError(f"no server is announced in {place} yet")
    return servers[turn % len(servers)]


def find_token(given: str | None, announcement: Path | None) -> str | None:
    """Return the secret of a server: the given one, that of the environment, or a random one if it is announced."""
    return given or os.environ.get("WIW_TOKEN") or (secrets.token_urlsafe() if announcement is not None else None)


def require_announcement(file: Path | None) -> None:
    """Check that clients will find an announcement.

    Raises:
        ArgumentError: in a folder they read .json files alone, and this is none.
    """
    if file is not None and file.suffix != ".json":
        raise ArgumentError(f"--announce: expected a file such as {file}.json, got {file}: clients read .json files")


@contextmanager
def announce_server(server: ServerAddress, file: Path) -> Iterator[None]:
    """Announce a server in a file as long as the context lasts.

    Raises:
        FileError: it cannot be written.
    """
    with atomic_file(file) as draft:
        draft.touch(mode=0o600)
        draft.write_text(json.dumps(asdict(server)))
    try:
        yield
    finally:
        if read_addresses(file) == [server]:  # and not one that has come in its place
            file.unlink(missing_ok=True)


def read_addresses(place: Path) -> list[ServerAddress]:
    """Return the servers that are announced in a file, or in the .json files of a folder; none if there are none."""
    files = sorted(place.glob("*.json")) if place.is_dir() else [place]
    found = []
    for file in files:
        with suppress(OSError, ValueError, TypeError):  # gone just now, or no announcement
            server = ServerAddress(**parse_json(file.read_text()))
            if isinstance(server.address, str) and isinstance(server.token, str | None):
                found.append(server)
    return found
