# SPDX-License-Identifier: Apache-2.0
"""Child processes: their environment, their end with that of their parent, and limits of time and memory."""

from __future__ import annotations

import ctypes
import math
import os
import resource
import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_ROOT = Path("/")
"""Root folder of the system's files."""


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
    """Return three quarters of the least of the memory in bytes of the machine, the container and the batch job."""
    most = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for file in _list_limit_files():
        with suppress(OSError, ValueError):  # no limit: the file is absent, or says "max"
            most = min(most, int(file.read_text()))
    return most * 3 // 4


def _list_limit_files() -> Iterator[Path]:
    """Yield the files that may limit this process's memory: of its control groups and of all above them.

    A batch system limits a group far below the root, whose own files say nothing of that; see cgroups(7).
    """
    groups = {kind: path for line in _read_lines("proc/self/cgroup") for kind, path in [_parse_group(line)]}
    mounts = list(_list_hierarchies()) or [("cgroup2", "/", "/sys/fs/cgroup"), ("cgroup", "/", "/sys/fs/cgroup/memory")]
    for kind, root, mount in mounts:
        place, own = _ROOT / mount.lstrip("/"), Path(groups.get(kind, "/"))
        below = own.relative_to(root) if own.is_relative_to(root) and ".." not in own.parts else Path()
        name = "memory.max" if kind == "cgroup2" else "memory.limit_in_bytes"
        yield from (place / folder / name for folder in (below, *below.parents))


def _parse_group(line: str) -> tuple[str, str]:
    """Return the kind of hierarchy that a line of /proc/self/cgroup is of, "" if not of memory, and the group in it."""
    number, controllers, path = (*line.split(":", 2), "", "")[:3]
    if number == "0" and not controllers:
        return "cgroup2", path
    return "cgroup" if "memory" in controllers.split(",") else "", path


def _list_hierarchies() -> Iterator[tuple[str, str, str]]:
    """Yield kind, group at its root, and folder of the mounted hierarchies of groups that may limit memory."""
    for line in _read_lines("proc/self/mountinfo"):
        before, _, after = line.partition(" - ")
        kind, options = after.partition(" ")[0], after.rpartition(" ")[2]
        if kind == "cgroup2" or (kind == "cgroup" and "memory" in options.split(",")):
            root, mount = before.split()[3:5]
            yield kind, root, mount


def _read_lines(name: str) -> list[str]:
    """Return the lines of one of the system's files; none where it cannot be read."""
    with suppress(OSError):
        return (_ROOT / name).read_text().splitlines()
    return []


def limit_memory() -> int:
    """Let this process take what `find_memory_limit` returns; return that in bytes.

    The kernel counts each process separately: each one that this process starts may take as much again.
    """
    most = find_memory_limit()
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
    return most
