# SPDX-License-Identifier: Apache-2.0
"""The child's side of `wiw.scenes.isolated`: one job from standard input, one reply to standard output."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from typing import Any

from wiw.errors import Error
from wiw.process_limits import end_with_parent, limit_memory, limit_time


def answer_job(read: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Read the job, limit this process, write what `read` makes of the job.

    Problems with the file become part of the reply: an error of wiw's as it is, anything else that a reader raises as a
    FileError that names the file.
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
