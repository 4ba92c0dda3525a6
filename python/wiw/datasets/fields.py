# SPDX-License-Identifier: Apache-2.0
"""Fields of episode files: each reader returns a field's value, or raises a ValueError that names the field."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray


def text(value: Any, name: str) -> str:
    """Return a string."""
    if not isinstance(value, str):
        raise ValueError(f"{name}: expected text, got {value!r:.80}")
    return value


def name_of(value: Any, name: str) -> str:
    """Return a string, also of an integer that stands for one."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else text(value, name)


def number(value: Any, name: str) -> float:
    """Return a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{name}: expected a finite number, got {value!r:.80}")
    return float(value)


def length(value: Any, name: str) -> float:
    """Return a finite number of at least 0."""
    if number(value, name) < 0:
        raise ValueError(f"{name}: expected a number of at least 0, got {value!r:.80}")
    return float(value)


def positive(value: Any, name: str) -> float:
    """Return a finite number above 0."""
    if number(value, name) <= 0:
        raise ValueError(f"{name}: expected a number above 0, got {value!r:.80}")
    return float(value)


def integer(value: Any, name: str) -> int:
    """Return an integer of at least 0."""
    if number(value, name) != int(value) or value < 0:
        raise ValueError(f"{name}: expected an integer of at least 0, got {value!r:.80}")
    return int(value)


def to_position(point: NDArray[Any] | Sequence[float]) -> tuple[float, float, float]:
    """Return [x, y, z] as Python's floats, as episodes have them."""
    return float(point[0]), float(point[1]), float(point[2])


def point(value: Any, name: str) -> tuple[float, float, float]:
    """Return [x, y, z] of finite numbers as a tuple."""
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError(f"{name} must be [x, y, z] in metres, got {value!r:.80}")
    x, y, z = (number(each, name) for each in value)
    return x, y, z
