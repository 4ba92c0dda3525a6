# SPDX-License-Identifier: Apache-2.0
"""Write settings as command-line flags, so that a command can be run by hand or as a job."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any


def format_flags(settings: Any) -> list[str]:
    """Return the command-line flags for those settings of a dataclass that differ from its defaults."""
    plain = type(settings)()
    given = {field.name: getattr(settings, field.name) for field in fields(settings)}
    return [
        part
        for name, value in given.items()
        if value != getattr(plain, name)
        for part in _format_flag(name.replace("_", "-"), value)
    ]


def _format_flag(name: str, value: Any) -> Iterator[str]:
    if isinstance(value, bool):
        yield f"--{name}" if value else f"--no-{name}"
        return
    for each in value if isinstance(value, tuple) else (value,):
        yield from (f"--{name}", str(each))
