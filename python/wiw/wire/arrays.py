# SPDX-License-Identifier: Apache-2.0
"""Arrays as raw bytes with dtype and shape. Nothing is allocated for what a sender merely declares."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import RemoteError

DTYPES = frozenset({"|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8"})
DIMENSIONS = 5


def pack_array(array: NDArray[Any]) -> dict[str, Any]:
    """Return a map of dtype, shape and bytes (little-endian, C order).

    Raises:
        RemoteError: a dtype that cannot be sent.
    """
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    if little.dtype.str not in DTYPES or array.ndim > DIMENSIONS:
        raise RemoteError(f"an array of {array.dtype} {array.shape} cannot be sent: expected numbers", "message")
    data = little.reshape(-1).view(np.uint8).data if little.size else b""
    return {"dtype": little.dtype.str, "shape": list(array.shape), "data": data}


def unpack_array(name: str, value: Any) -> NDArray[Any]:
    """Return the array behind such a map: a read-only view of its bytes.

    Raises:
        RemoteError: no such map, an unknown dtype, or bytes that are not as many as dtype and shape say.
    """
    if not isinstance(value, dict) or set(value) != {"dtype", "shape", "data"}:
        raise RemoteError(f"{name}: expected an array (dtype, shape, data), got {type(value).__name__}", "message")
    dtype, shape, data = value["dtype"], value["shape"], value["data"]
    if not isinstance(dtype, str) or dtype not in DTYPES:
        raise RemoteError(f"{name}: expected a dtype among {', '.join(sorted(DTYPES))}", "message")
    if not isinstance(shape, list) or len(shape) > DIMENSIONS or not all(_is_count(side) for side in shape):
        raise RemoteError(f"{name}: expected a shape of at most {DIMENSIONS} counts", "message")
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if not isinstance(data, bytes) or len(data) != size:
        came = len(data) if isinstance(data, bytes) else type(data).__name__
        raise RemoteError(f"{name}: {dtype} {shape} takes {size} bytes, got {came}", "message")
    return np.frombuffer(data, dtype).reshape(shape)


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**31
