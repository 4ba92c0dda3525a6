# SPDX-License-Identifier: Apache-2.0
"""Imports run in a process of their own.

Readers of 3D formats are large programs that trust their input: a damaged file can make one crash, hang or eat all
memory. In a child process each of these becomes a FileError, and a run of many scenes goes on.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import wiw
from wiw import errors
from wiw.errors import FileError
from wiw.scenes.store import Sources

TIMEOUT = 600.0
"""Seconds after which an import is given up; a file of two million triangles takes a few."""


def import_to(path: Path, options: dict[str, Any], out: Path) -> Sources:
    """Imports `path` in a child process, which writes the scene to the cache file `out`.

    Raises:
        FileError: the file is damaged, also where that ends the child: a crash, a time-out, no memory left.
        ArgumentError: an option is none.
    """
    job = {"path": str(path), "out": str(out), "options": options}
    try:
        child = subprocess.run(
            [sys.executable, "-m", "wiw.scenes.worker"],
            input=json.dumps(job),
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
            env=_environment(),
        )
    except subprocess.TimeoutExpired:
        raise FileError(f"{path}: importing took more than {TIMEOUT:.0f} s and was given up (damaged file?)") from None
    if child.returncode < 0:
        name = signal.Signals(-child.returncode).name
        raise FileError(f"{path}: the importer crashed on it with {name} (damaged file)")
    if child.returncode > 0:
        raise errors.InfrastructureError(f"{path}: the importing process failed: {child.stderr.strip()[-2000:]}")
    reply = json.loads(child.stdout)
    if "error" in reply:
        raise getattr(errors, reply["error"])(reply["message"])
    return Sources(tuple(map(Path, reply["read"])), tuple(map(Path, reply["absent"])))


def _environment() -> dict[str, str]:
    """Our own, with this very package first on the child's path."""
    here = str(Path(wiw.__file__).parents[1])
    paths = [here, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
