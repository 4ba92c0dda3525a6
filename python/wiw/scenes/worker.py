# SPDX-License-Identifier: Apache-2.0
"""The child process of `wiw.scenes.isolated`: one job from standard input, one reply to standard output."""

from __future__ import annotations

import json
import os
import resource
import sys
from typing import Any

from wiw import _core
from wiw.errors import Error


def limit_memory() -> int:
    """Lets this process take three quarters of the machine's memory, no more; returns that in bytes."""
    most = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 3 // 4
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
    return most


def answer(job: dict[str, Any]) -> dict[str, Any]:
    """Runs one job: imports, writes the cache file, names the files read. Errors become part of the answer."""
    most = limit_memory()
    try:
        scene, read, absent = _core.scene.import_scene(job["path"], **job["options"])
        _core.scene.write_cache(scene, job["out"])
    except Error as error:
        return {"error": type(error).__name__, "message": str(error)}
    except MemoryError:
        message = f"{job['path']}: importing it takes more than {most / 1e9:.1f} GB of memory (damaged file?)"
        return {"error": "FileError", "message": message}
    return {"read": [str(path) for path in read], "absent": [str(path) for path in absent]}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(answer(json.load(sys.stdin))))
