# SPDX-License-Identifier: Apache-2.0
"""The record of a training, a JSON object a line: loss and rate of each step, and what validations found."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_file
from wiw.training.post_training.trackers import RUN_ID, Tracker

LOG, BEST = "metrics.jsonl", "best"
"""Names in `OUT.log`: of the file of lines, and of the folder of the weights that are best in validation so far."""
_OWN = re.compile(rf"{re.escape(LOG)}|{RUN_ID}|step-[0-9]{{7,}}\.png|\..+\.part")
"""Names of what a training writes there."""
_OF_TENSORBOARD = re.compile(r"events\.out\.tfevents.*|hparams\.yml")


def require_own_log(folder: Path, run: str, resumes: bool) -> None:
    """Check that a training may write its log into a folder, which it empties first unless it resumes.

    Args:
        folder: of the log; need not be there.
        run: name of the training, under which tensorboard writes.
        resumes: whether it resumes, and keeps what is there.

    Raises:
        ArgumentError: it is a file, or would be emptied and holds what no training has written.
    """
    remedy = "move it away, or choose another --out"
    if folder.exists() and not folder.is_dir():
        raise ArgumentError(f"{folder}: expected a folder for the log, new or of a training, got a file; {remedy}")
    if resumes or not folder.exists():
        return
    if others := sorted(path.name for path in folder.iterdir() if not _is_own(path, run)):
        raise ArgumentError(
            f"{folder}: expected a folder for the log, new or of a training, as it is emptied, but it has "
            f"{', '.join(others[:3])}; {remedy}"
        )


def remove_log(folder: Path, run: str) -> None:
    """Delete the log of a training of before, with its pictures and best weights.

    Raises:
        ArgumentError: see `require_own_log`.
    """
    require_own_log(folder, run, resumes=False)
    shutil.rmtree(folder, ignore_errors=True)


def _is_own(path: Path, run: str) -> bool:
    """Return whether a training, or tensorboard for it, has written what is there."""
    if path.is_dir() and path.name == BEST:
        return path.with_name(LOG).is_file()  # lines come before the best weights
    if path.is_dir() and path.name == run:
        return all(_OF_TENSORBOARD.fullmatch(each.name) for each in path.rglob("*") if not each.is_dir())
    return _OWN.fullmatch(path.name) is not None


class TrainingLog:
    """A file of JSON lines, and trackers that receive the same values.

    Args:
        path: of the file.
        trackers: receives every line's numbers.
    """

    def __init__(self, path: Path, trackers: Sequence[Tracker] = ()) -> None:
        self.path, self._trackers = path, trackers
        self._began = time.monotonic()
        self.step = 0
        """Step of the last line."""

    def rewind(self, step: int) -> list[dict[str, Any]]:
        """Drop what was written after a step, and return the rest: the training resumes there, and writes it again.

        Raises:
            FileError: the file cannot be read or written.
        """
        kept = [line for line in self.read() if line["step"] <= step]
        with atomic_file(self.path) as draft:
            draft.write_text("".join(f"{json.dumps(line)}\n" for line in kept), encoding="utf-8")
        self.step = kept[-1]["step"] if kept else 0
        return kept

    def read(self) -> list[dict[str, Any]]:
        """Return the lines, without one that a killed process has left unfinished.

        Raises:
            FileError: the file cannot be read, or is of another kind.
        """
        if not self.path.exists():
            return []
        try:
            whole, newline, _ = self.path.read_text(encoding="utf-8").rpartition("\n")
            return [json.loads(line) for line in whole.splitlines()] if newline else []
        except (OSError, ValueError) as error:
            raise FileError(f"{self.path}: expected one JSON object per line, got {error}; delete it") from error

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Add a line of numbers.

        Raises:
            FileError: it cannot be written.
        """
        line = {"step": step, "seconds": round(time.monotonic() - self._began, 3), **values}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            _append(self.path, f"{json.dumps(line)}\n".encode())
        except OSError as error:
            raise FileError(
                f"{self.path}: cannot be written ({error.strerror}); expected a writable file and free space: make room"
            ) from error
        self.step = step
        for tracker in self._trackers:
            tracker.log(dict(values), step=step)

    def finish(self) -> None:
        """Tell the trackers that the training has ended."""
        for tracker in self._trackers:
            tracker.finish()


def _append(path: Path, line: bytes) -> None:
    """Add a line without a buffer: one that failed half-way would be written again, after its own first half."""
    with path.open("ab", buffering=0) as file:
        if file.write(line) != len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
