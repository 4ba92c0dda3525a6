# SPDX-License-Identifier: Apache-2.0
"""A world model that another process or machine computes; `wiw serve` is the other end."""

from __future__ import annotations

import dataclasses
import math
import os
import time
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, RemoteError
from wiw.types import Conditioning, Control
from wiw.wire.address_book import find_announcements
from wiw.wire.rows import pack_row
from wiw.world_models.base import Accepts, WorldModel, seconds_left
from wiw.world_models.remote.declaration import parse_declaration, parse_description
from wiw.world_models.remote.limits import most_bytes
from wiw.world_models.remote.link import Link
from wiw.world_models.remote.links import Links

TOKEN = "WIW_TOKEN"
"""Environment variable with the server's token."""
DEADLINE = 300.0
"""Seconds that a call may take where the caller sets no limit."""
PATIENCE, PATIENCE_FOR_JOBS = 15.0, 270.0
"""Seconds that the first connection may take; a server that is a job loads its weights first."""
OVERHEAD = 1024
"""Bytes of a message beside its row."""
MARGIN = 0.05
"""Share of the caller's time limit reserved for reporting why there is no answer."""


class Remote(WorldModel):
    """A world model served by `wiw serve MODEL` at "remote:ws://HOST:PORT".

    Args:
        address: "ws://HOST:PORT", or "wss://..." for a server behind TLS; several with commas between them share the
            rows of each call, begin as soon as one of them answers, and continue without one that dies. Or a folder in
            which servers of the same model announce themselves (`wiw serve --announce FOLDER/NAME.json`).
        token: the server's; None means that of the environment variable WIW_TOKEN. Announced servers say theirs.
        patience: seconds that the first connection may take; 15 if not given, 270 for servers that are announced.

    Raises:
        ArgumentError: no such address, or one twice.
        RemoteError: nobody answers there, or another version, or the token is wrong; of several servers, one serves
            another model than the first.
    """

    def __init__(self, address: str, token: str | None = None, patience: float | None = None) -> None:
        self._arguments = (address, token, patience)
        folder, key = find_announcements(address), token if token is not None else os.environ.get(TOKEN)
        if patience is None:
            patience = PATIENCE if folder is None else PATIENCE_FOR_JOBS
        links = [Link(each, key) for each in (_check_addresses(address) if folder is None else [folder])]
        self._link = links[0] if len(links) == 1 else Links(links)
        self._close = weakref.finalize(self, self._link.close)
        try:
            self._welcome = self._link.welcome(patience)
            served = parse_declaration(self._welcome.accepts)
            self._described = parse_description(self._welcome.model)
        except RemoteError:
            self._close()
            raise
        self._accepts = dataclasses.replace(served, best_batch=max(served.best_batch, self._welcome.in_flight))

    def __reduce__(self) -> Any:
        return type(self), self._arguments

    @property
    def accepts(self) -> Accepts:  # type: ignore[override]
        """As the served model declares it, but for `best_batch`: more rows per call keep the server busy while others
        travel.
        """
        return self._accepts

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return the served model's frames; those that nobody reads (shared ones, padding) are left unwritten.

        Raises:
            RemoteError: no answer in time; see its `kind`.
            ContractError: the served model broke its contract.
        """
        left = seconds_left()
        give_up = time.monotonic() + (DEADLINE if math.isinf(left) else (1 - MARGIN) * left)
        rows = [
            pack_row(observations, row, control, int(seed))
            for row, (control, seed) in enumerate(zip(controls, seeds, strict=True))
        ]
        if (longest := max(map(len, rows))) > (most := most_bytes(self.accepts) - OVERHEAD):
            raise RemoteError(
                f"a row of {longest} bytes exceeds the {most} that a server of this model accepts; use a smaller size, "
                "or a shorter history if it needs one",
                "row",
            )
        frames = np.empty((len(controls), 1 + len(controls[0].actions), *observations.image.shape[1:]), np.uint8)
        frames[:, 0] = observations.image
        for own, control, answer in zip(frames, controls, self._link.ask(rows, give_up), strict=True):
            wanted = own[1 + control.shared : 1 + control.length]
            if answer.shape != wanted.shape or answer.dtype != wanted.dtype:
                raise RemoteError(f"expected frames {wanted.shape}, got {answer.dtype} {answer.shape}", "message")
            wanted[:] = answer
        return frames

    def describe(self) -> dict[str, Any]:
        """Return what is served, wherever that is: a run may continue with the same model at another address."""
        return {"name": "Remote", "model": self._described, "fingerprint": self._welcome.fingerprint or None}

    def fingerprint(self) -> str:
        """Return the served model's own; empty if it declares no version."""
        return self._welcome.fingerprint

    def close(self) -> None:
        """End the connection; the model cannot be asked any more."""
        self._close()


class ServedModel(Remote):
    """A world model that the run itself serves: it describes itself as the model would in the run's own process."""

    def describe(self) -> dict[str, Any]:
        """Return what the served model says of itself, less its source files: the run's manifest has them."""
        return {name: value for name, value in self._described.items() if name != "sources"}


def _check_addresses(text: str) -> list[str]:
    addresses = [_check_address(each.strip()) for each in text.split(",")]
    if len(set(addresses)) < len(addresses):
        raise ArgumentError(f"remote: expected different addresses, got '{text}'")
    return addresses


def _check_address(address: str) -> str:
    from websockets.exceptions import InvalidURI
    from websockets.uri import parse_uri

    try:
        uri = parse_uri(address)
    except (InvalidURI, ValueError):
        raise ArgumentError(
            "remote: expected an address such as ws://127.0.0.1:8765, or a folder of `wiw serve --announce`, "
            f"got '{address}'"
        ) from None
    if uri.username or uri.query:
        raise ArgumentError(f"remote: the address is stored in records; put the token into {TOKEN} instead")
    return address
