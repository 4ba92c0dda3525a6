# SPDX-License-Identifier: Apache-2.0
"""The messages of docs/serving.md, as far as the models here need them.

Apart from `wiw.wire` since this file needs NumPy and msgpack alone, and Python 3.8.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import msgpack
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

VERSION = 1
"""Version of the protocol."""
VIEW = (576, 1024)
"""Height and width of wiw's panoramas."""
ITEMS = 32
"""Maximum number of entries in a map or list, and of maps and lists in a message."""
ACTIONS = 128
"""Maximum size of a row, so that its answer can be sent."""
DTYPES = frozenset(("|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8"))
MESSAGES: dict[str, dict[str, type]] = {
    "hello": {"software": str},
    "ask": {"id": bytes, "row": bytes, "seconds": float, "rest": int},
}
ROW = {
    "image": ("|u1", (*VIEW, 3)),
    "depth": ("<f4", VIEW),
    "semantic": ("<u4", VIEW),
    "history": None,
    "actions": ("|i1", (-1,)),
    "trajectory": ("<f8", (-1, 3)),
    "viewpoints": ("<f8", (-1, 4, 4)),
    "ids": None,
    "text": str,
    "length": int,
    "shared": int,
    "seed": int,
}
"""Type, or dtype and shape, of each field of a row; -1: as many as actions, None: what no model here takes."""


class RefusedError(Exception):
    """A refusal that is sent to a client, with its kind."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


def encode(kind: str, /, **values: Any) -> bytes:
    """Return a message in bytes."""
    return bytes(msgpack.packb({"v": VERSION, "type": kind, **values}))


def decode(data: Any) -> tuple[str, dict[str, Any]]:
    """Return type and fields of a message.

    Raises:
        RefusedError: another version of the protocol, or no message of it.
    """
    values = unpack("message", data)
    version, kind = values.pop("v", None), values.pop("type", None)
    if version != VERSION or type(version) is not int:
        raise RefusedError("version", f"this side speaks version {VERSION} of the protocol, the other a different one")
    if not isinstance(kind, str) or kind not in MESSAGES:
        raise RefusedError("message", f"expected a message of type {' or '.join(MESSAGES)}")
    fields = MESSAGES[kind]
    if set(values) != set(fields) or any(type(values[name]) is not fields[name] for name in fields):
        raise RefusedError("message", f"{kind}: expected the fields {', '.join(fields)}")
    if kind == "ask" and (values["rest"] < 0 or not math.isfinite(values["seconds"]) or values["seconds"] < 0):
        raise RefusedError("message", "ask: expected rest and seconds of at least 0")
    return kind, values


def unpack(what: str, data: Any) -> dict[Any, Any]:
    """Return a msgpack map of few parts, none larger than the bytes that came.

    Raises:
        RefusedError: anything else.
    """
    left = ITEMS

    def count(value: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise ValueError("too many maps and lists")
        return value

    if not isinstance(data, bytes):
        raise RefusedError("message", f"{what}: expected msgpack in a binary frame")
    limits = {"max_array_len": ITEMS, "max_map_len": ITEMS, "max_ext_len": 0}
    try:
        values = msgpack.unpackb(data, raw=False, list_hook=count, object_hook=count, **limits)
    except Exception as error:  # msgpack raises ValueError and others besides
        raise RefusedError("message", f"{what}: not valid msgpack: {type(error).__name__}: {error}") from None
    if not isinstance(values, dict):
        raise RefusedError("message", f"{what}: expected a map")
    return values


def unpack_row(data: bytes, needs: tuple[str, ...]) -> dict[str, Any]:
    """Return what one future is asked for with, as arrays and numbers.

    Raises:
        RefusedError: malformed, or not what a model of these needs takes.
    """
    values = unpack("row", data)
    if set(values) != set(ROW):
        raise RefusedError("message", f"row: expected the fields {', '.join(ROW)}")
    row = {name: _field(name, values[name], needs) for name in ROW}
    count = len(row["actions"])
    if not 1 <= count <= ACTIONS or len(row["trajectory"]) != count or len(row["viewpoints"]) != count:
        raise RefusedError(
            "row", f"row: expected 1 to {ACTIONS} actions, each with its pose and viewpoint, got {count}"
        )
    if not np.isfinite(row["viewpoints"]).all() or not np.isfinite(row["depth"]).all():
        raise RefusedError("row", "row: expected finite depth and viewpoints")
    if not 0 <= row["shared"] <= row["length"] <= count or not 0 <= row["seed"] < 2**64:
        raise RefusedError("message", f"row: expected 0 <= shared <= length <= {count}, and a seed of 64 bits")
    return row


def _field(name: str, value: Any, needs: tuple[str, ...]) -> Any:
    expected: Any = ROW[name]
    if expected is None or (name in ("depth", "semantic") and name not in needs):
        if value is not None:
            raise RefusedError("row", f"row.{name}: the model does not take it")
        return None
    if isinstance(expected, type):
        if type(value) is not expected:
            raise RefusedError("message", f"row.{name}: expected {expected.__name__}, got {type(value).__name__}")
        return value
    if value is None:
        raise RefusedError("row", f"row.{name}: missing")
    array, (dtype, shape) = unpack_array(name, value), expected
    fits = len(shape) == array.ndim and all(side in (-1, own) for side, own in zip(shape, array.shape))  # noqa: B905
    if array.dtype.str != dtype or not fits:
        raise RefusedError("row", f"row.{name}: expected {np.dtype(dtype)} {shape}, got {array.dtype} {array.shape}")
    return array


def unpack_array(name: str, value: Any) -> NDArray[Any]:
    """Return the array of a map of dtype, shape and data.

    Raises:
        RefusedError: no such map, or bytes that are not as many as it says.
    """
    if not isinstance(value, dict) or set(value) != {"dtype", "shape", "data"}:
        raise RefusedError("message", f"row.{name}: expected an array (dtype, shape, data)")
    dtype, shape, data = value["dtype"], value["shape"], value["data"]
    whole = isinstance(shape, list) and len(shape) < 6 and all(type(side) is int and side >= 0 for side in shape)
    if not isinstance(dtype, str) or dtype not in DTYPES or not whole or not isinstance(data, bytes):
        raise RefusedError("message", f"row.{name}: expected a dtype, a shape of counts, and bytes")
    size = np.dtype(dtype).itemsize
    for side in shape:
        size *= side
    if len(data) != size:
        raise RefusedError("message", f"row.{name}: {dtype} {shape} takes {size} bytes, got {len(data)}")
    return np.frombuffer(data, dtype).reshape(shape)


def pack_array(array: NDArray[Any]) -> dict[str, Any]:
    """Return a map of dtype, shape and bytes."""
    return {"dtype": array.dtype.str, "shape": list(array.shape), "data": array.tobytes()}
