# SPDX-License-Identifier: Apache-2.0
"""Tell whether the process that writes a run is still there."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def describe_process() -> dict[str, Any]:
    """Return what tells this process from all others: host, number, and when it was started, in ticks since boot."""
    return {"host": platform.node(), "process": os.getpid(), "started": _read_start(os.getpid())}


def is_here(session: Mapping[str, Any]) -> bool:
    """Return whether a process that was described belongs to this machine."""
    return bool(session["host"] == platform.node())


def is_running(session: Mapping[str, Any]) -> bool:
    """Return whether a process of this machine that was described is still there: numbers are used again."""
    return is_here(session) and session["started"] is not None and _read_start(session["process"]) == session["started"]


def _read_start(process: int) -> int | None:
    """Return field 22 of /proc/PID/stat (proc(5)); None if there is no such process, or a zombie."""
    try:
        state, *fields = Path("/proc", str(process), "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if state in ("Z", "X") else int(fields[18])
