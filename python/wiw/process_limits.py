# SPDX-License-Identifier: Apache-2.0
"""Child processes: their environment, their end with that of their parent, and limits of time and memory."""

from __future__ import annotations

import ctypes
import math
import os
import resource
import signal
import sys
from contextlib import suppress
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def make_child_environment() -> dict[str, str]:
    """Return our own environment, with this very package first on the child's path."""
    here = str(Path(__file__).parents[1])
    paths = [here, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def end_with_parent(parent: int) -> None:
    """Have the kernel kill this process when its parent ends, also where the parent is killed; end if it is gone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(1)


def limit_time(seconds: float) -> None:
    """End this process after some seconds of wall-clock time, or of time on all processors together."""
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
    """Let this process take three quarters of the machine's or the container's memory; return that in bytes.

    The kernel counts each process separately: each one that this process starts may take as much again.
    """
    most = find_memory_limit()
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
    return most
