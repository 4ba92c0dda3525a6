# SPDX-License-Identifier: Apache-2.0
"""Options of policies that are all numbers, declared as a dataclass with defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from wiw.errors import ArgumentError

T = TypeVar("T")


def read_numbers(policy: str, declared: type[T], given: Mapping[str, Any]) -> T:
    """Return the declared options with the given ones in their place.

    Args:
        policy: its name, for messages.
        declared: a dataclass whose fields are numbers with defaults.
        given: by name.

    Raises:
        ArgumentError: an unknown option, or no number.
    """
    known = [each.name for each in fields(declared)]  # type: ignore[arg-type]
    for name, value in given.items():
        if name not in known:
            raise ArgumentError(f"policy {policy}: unknown option '{name}'; there are {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ArgumentError(f"policy {policy}: expected a number for {name}, got {value!r}")
    return declared(**given)
