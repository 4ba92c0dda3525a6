# SPDX-License-Identifier: Apache-2.0
"""The messages of the protocol; `docs/serving.md` has them as a table.

    client                          server
    Hello                 ->
                          <-        Welcome, or Refusal
    Ask, Ask, Ask         ->
                          <-        Answer, Wait or Refusal, one for each Ask, in any order

Each is a msgpack map with the protocol's version, its type and its fields. A map with other fields, or fields of
another type, is malformed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from wiw.errors import RemoteError
from wiw.wire.arrays import pack_array, unpack_array

VERSION = 1
MOST_BYTES = 256 * 2**20
"""Maximum size of a message in bytes, in either direction; a server takes no more than a row of its model needs."""
MOST_ITEMS = 32
"""Most items of any map or list, and of maps and lists in a message: unpacked they take many times the bytes that they
came in, and msgpack makes room for as many items as are declared."""


@dataclass(frozen=True)
class Hello:
    """The first message of a client."""

    software: str


@dataclass(frozen=True)
class Welcome:
    """The server's description of the model it serves."""

    accepts: str
    """JSON of `wiw.Accepts`."""
    model: str
    """JSON of `WorldModel.describe()`."""
    fingerprint: str
    """`WorldModel.fingerprint()`, empty for a model without a version."""
    unknown: str
    """Why it is empty."""
    in_flight: int
    """Maximum number of rows of a client that may be unanswered at a time."""


@dataclass(frozen=True)
class Ask:
    """One row of a rollout."""

    id: bytes
    """`wiw.wire.rows.row_id(row)`: equal questions have equal ids."""
    row: bytes
    """`wiw.wire.rows.pack_row`."""
    seconds: float
    """For which the client will wait; a row that is not begun by then never is."""
    rest: int
    """Rows of the same call that follow at once, so that a batch waits for them."""


@dataclass(frozen=True)
class Answer:
    """The frames of a row that are its own: those after its shared ones, up to its length."""

    id: bytes
    frames: NDArray[np.uint8]
    """uint8 [length - shared, H, W, 3]."""


@dataclass(frozen=True)
class Wait:
    """The row was not taken: retry after this many seconds."""

    id: bytes
    seconds: float
    reason: str


@dataclass(frozen=True)
class Refusal:
    """The row was not answered and will not be. Without an id it is about all of the connection."""

    id: bytes
    kind: str
    """Kind of the `RemoteError` or `ContractError` that the client raises."""
    text: str


Message = Hello | Welcome | Ask | Answer | Wait | Refusal
KINDS: Mapping[str, type[Message]] = {
    kind.__name__.lower(): kind for kind in (Hello, Welcome, Ask, Answer, Wait, Refusal)
}


def encode(message: Message) -> bytes:
    """Return the message in bytes."""
    values = {field.name: getattr(message, field.name) for field in fields(message)}
    arrays = {name: pack_array(value) for name, value in values.items() if isinstance(value, np.ndarray)}
    return bytes(msgpack.packb({"v": VERSION, "type": type(message).__name__.lower(), **values, **arrays}))


def decode(data: Any) -> Message:
    """Return the message behind some bytes.

    Raises:
        RemoteError: another version of the protocol (kind "version"), or no message of it (kind "message").
    """
    values = unpack_map("message", data)
    version, name = values.pop("v", None), values.pop("type", None)
    if version != VERSION or type(version) is not int:
        raise RemoteError(
            f"this side speaks version {VERSION} of the protocol, the other {_quote(version)}; install the same "
            "version of wiw on both sides",
            "version",
        )
    kind = KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise RemoteError(f"expected a message of type {', '.join(KINDS)}, got {_quote(name)}", "message")
    return kind(**read_fields(f"{name}", values, {field.name: READERS[str(field.type)] for field in fields(kind)}))


def unpack_map(what: str, data: Any) -> dict[Any, Any]:
    """Return a msgpack map whose parts are not larger than the bytes that came.

    Raises:
        RemoteError: anything else.
    """
    if not isinstance(data, bytes):
        raise RemoteError(f"{what}: expected msgpack in a binary frame, got {type(data).__name__}", "message")
    count = _Count()
    limits = {"max_array_len": MOST_ITEMS, "max_map_len": MOST_ITEMS, "max_ext_len": 0}
    try:
        values = msgpack.unpackb(data, list_hook=count, object_hook=count, **limits)
    except Exception as error:  # msgpack raises ValueError and others besides
        raise RemoteError(f"{what}: not valid msgpack: {type(error).__name__}: {error}", "message") from None
    if not isinstance(values, dict):
        raise RemoteError(f"{what}: expected a map, got {type(values).__name__}", "message")
    return values


class _Count:
    """Sees every map and list of a message, and takes no more than a few."""

    def __init__(self) -> None:
        self.left = MOST_ITEMS

    def __call__(self, value: Any) -> Any:
        self.left -= 1
        if self.left < 0:
            raise ValueError(f"more than {MOST_ITEMS} maps and lists")
        return value


Reader = Callable[[str, Any], Any]


def read_fields(what: str, values: Mapping[Any, Any], readers: Mapping[str, Reader]) -> dict[str, Any]:
    """Return each value as its reader takes it.

    Raises:
        RemoteError: fields are missing, there are others, or one is of another type.
    """
    if set(values) != set(readers):
        missing, others = sorted(set(readers) - set(values)), len(set(values) - set(readers))
        raise RemoteError(f"{what}: missing fields {missing}, unknown fields {others}", "message")
    return {name: reader(f"{what}.{name}", values[name]) for name, reader in readers.items()}


def text(name: str, value: Any) -> str:
    """Read a string."""
    return str(_of_type(name, value, str))


def blob(name: str, value: Any) -> bytes:
    """Read bytes."""
    return bytes(_of_type(name, value, bytes))


def read_count(name: str, value: Any) -> int:
    """Read a number from 0 to 2**64 - 1."""
    if _of_type(name, value, int) < 0:
        raise RemoteError(f"{name}: expected a number of at least 0, got {value}", "message")
    return int(value)


def seconds(name: str, value: Any) -> float:
    """Read a finite number of at least 0."""
    if not math.isfinite(_of_type(name, value, float)) or value < 0:
        raise RemoteError(f"{name}: expected seconds of at least 0, got {value}", "message")
    return float(value)


READERS: Mapping[str, Reader] = {
    "str": text,
    "bytes": blob,
    "int": read_count,
    "float": seconds,
    "NDArray[np.uint8]": unpack_array,
}
"""By the annotation of a message's field."""


def _of_type(name: str, value: Any, kind: type) -> Any:
    if type(value) is not kind:
        raise RemoteError(f"{name}: expected {kind.__name__}, got {type(value).__name__}", "message")
    return value


def _quote(value: Any) -> str:
    shown = repr(value)
    return shown if len(shown) < 40 else f"{shown[:40]}..."
