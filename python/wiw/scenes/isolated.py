# SPDX-License-Identifier: Apache-2.0
"""Read untrusted files in a child process.

Readers of 3D formats are large programs that trust their input: a damaged file can make one crash, hang or eat all
memory. In a child process each of these becomes a FileError, and a run of many scenes continues. The child ends with
its parent, and has its own limits of time and memory.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from wiw import errors
from wiw.errors import ArgumentError, DependencyError, FileError
from wiw.process_limits import make_child_environment
from wiw.scenes.store import Sources

TIMEOUT = 600.0
"""Seconds after which an import is given up; a file of two million triangles takes a few."""

_ERRORS = {error.__name__: error for error in (ArgumentError, DependencyError, FileError)}


def import_to(path: Path, options: dict[str, Any], out: Path) -> Sources:
    """Import `path` in a child process, which writes the scene to the cache file `out`.

    Raises:
        FileError: the file is damaged, also where that ends the child: a crash, a time-out, no memory left.
        ArgumentError: an option is none.
        DependencyError: a decoder of its textures is not installed.
    """
    reply = read_in_child("wiw.scenes.worker", {"path": str(path), "out": str(out), "options": options})
    return Sources(tuple(map(Path, reply["read"])), tuple(map(Path, reply["absent"])))


def read_in_child(module: str, job: dict[str, Any]) -> dict[str, Any]:
    """Run `python -m module`, which reads the file `job["path"]`, and return its reply (see `wiw.scenes.child`).

    Raises:
        FileError: the file is damaged, also where that ends the child: a crash, a time-out, no memory left.
        ArgumentError: an option of the job is not valid.
        InfrastructureError: the child could not do its work, whatever the file.
    """
    path = job["path"]
    # The thread that starts the child has to wait for it: the kernel takes the end of that thread for the parent's.
    message = json.dumps({"job": job, "parent": os.getpid(), "seconds": TIMEOUT})
    try:
        child = subprocess.run(
            [sys.executable, "-m", module],
            input=message.encode(),
            capture_output=True,
            timeout=TIMEOUT,
            check=False,
            env=make_child_environment(),
        )
    except subprocess.TimeoutExpired:
        raise _build_timeout_error(path) from None
    if child.returncode in (-signal.SIGALRM, -signal.SIGXCPU):
        raise _build_timeout_error(path)
    if child.returncode < 0:
        name = signal.Signals(-child.returncode).name
        raise FileError(
            f"{path}: the importer crashed on it with {name} (damaged file; export it again, or open it in another "
            "program to check it)"
        )
    return _reply(path, child)


def _reply(path: str, child: subprocess.CompletedProcess[bytes]) -> dict[str, Any]:
    """Return the child's answer; raise its errors here."""
    try:
        reply = json.loads(child.stdout) if child.returncode == 0 else None
    except ValueError:
        reply = None
    if not isinstance(reply, dict):
        end = child.stderr.decode(errors="replace").strip()[-2000:]
        raise errors.InfrastructureError(f"{path}: the importing process failed (exit code {child.returncode}): {end}")
    if "error" in reply:
        raise _ERRORS.get(reply["error"], errors.InfrastructureError)(reply["message"])
    return reply


def _build_timeout_error(path: str) -> FileError:
    return FileError(f"{path}: importing took more than {TIMEOUT:.0f} s and was aborted (damaged file?)")
