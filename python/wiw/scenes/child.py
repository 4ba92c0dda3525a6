# SPDX-License-Identifier: Apache-2.0
"""The child's side of `wiw.scenes.isolated`: one job from standard input, one reply to standard output."""

from __future__ import annotations

import ctypes
import json
import math
import os
import resource
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from wiw.errors import Error

_PR_SET_PDEATHSIG = 1
_CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def answer_job(read: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Read the job, limit this process, write what `read` makes of the job.

    What goes wrong with the file becomes part of the reply: an error of wiw's as it is, anything else that a reader
    raises as a FileError that names the file.
    """
    with os.fdopen(os.dup(1), "w") as reply:
        os.dup2(2, 1)  # what a library prints is no part of the reply
        message = json.load(sys.stdin)
        end_with_parent(message["parent"])
        limit_time(message["seconds"])
        json.dump(_outcome(read, message["job"], limit_memory()), reply)


def _outcome(read: Callable[[dict[str, Any]], dict[str, Any]], job: dict[str, Any], most: int) -> dict[str, Any]:
    try:
        return read(job)
    except Error as error:
        return {"error": type(error).__name__, "message": str(error)}
    except MemoryError:
        cause = f"importing it takes more than {most / 1e9:.1f} GB of memory (damaged file?)"
    except Exception as error:
        cause = f"cannot be read: {type(error).__name__}: {error} (damaged file; export it again)"
    return {"error": "FileError", "message": f"{job['path']}: {cause}"}


def end_with_parent(parent: int) -> None:
    """Have the kernel kill this process when its parent ends, also where the parent is killed; end if it is gone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(1)


def limit_time(seconds: float) -> None:
    """End this process after so many seconds, or so many on all processors together."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(max(1, math.ceil(seconds)))
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    most = math.ceil(seconds) * (os.cpu_count() or 1)
    resource.setrlimit(resource.RLIMIT_CPU, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))


def find_memory_limit() -> int:
    """Return three quarters of the machine's or the container's memory in bytes."""
    most = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for file in _CGROUPS:
        with suppress(OSError, ValueError):  # "max": no limit
            most = min(most, int(Path(file).read_text()))
    return most * 3 // 4


def limit_memory() -> int:
    """Let this process take three quarters of the machine's or the container's memory; return that in bytes."""
    most = find_memory_limit()
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
    return most
