# SPDX-License-Identifier: Apache-2.0
"""Fill a user's templates in a child process (`template_worker.py`) with limits on time and memory."""

from __future__ import annotations

import json
import pickle
import signal
import subprocess
import sys
import weakref
from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from typing import Any

from wiw.errors import PromptError
from wiw.vlm import template_worker


class TemplateFiller:
    """Fills templates in a child process, started with the first template and restarted after one exceeds a limit."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = Lock()

    def fill(self, path: Path, source: str, slots: Mapping[str, Any], check: bool = False) -> str:
        """Return the template of a file with its slots filled; `check` looks at its syntax and slots before.

        Raises:
            PromptError: it cannot be filled, or not within the limits on time, memory and length.
        """
        limit = template_worker.SECONDS
        job = pickle.dumps({"source": source, "slots": dict(slots), "check": check, "seconds": limit})
        with self._lock:
            reply = self._ask(job, path)
        if "unknown" in reply:
            raise PromptError(f"{path}: unknown slot '{reply['unknown']}'; the slots are {', '.join(slots)}")
        if "error" in reply:
            raise PromptError(f"{path}: {reply['error']}")
        return str(reply["text"])

    def _ask(self, job: bytes, path: Path) -> dict[str, str]:
        process = self._start_process()
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(job)
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = b""
        if line:
            return dict(json.loads(line))
        self._process = None
        code = process.wait()
        if code == -signal.SIGPROF:
            raise PromptError(
                f"{path}: expected a prompt that takes at most {template_worker.SECONDS:g} s to fill; it takes more"
            )
        raise PromptError(f"{path}: the process that fills it ended with {code}; it takes too much memory or recursion")

    def _start_process(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, template_worker.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
            weakref.finalize(self, _end, self._process)
        return self._process


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
