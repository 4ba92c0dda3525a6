# SPDX-License-Identifier: Apache-2.0
"""Turn SQLite's errors into messages that say what is wrong with a run store and what to do."""

from __future__ import annotations

import errno
import os
import resource
import shlex
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from wiw.errors import StoreError

_UNWRITTEN = ("full", "disk I/O", "unable to open")
_FILES = 3
"""Files that an open store takes: its own, the log and the log's index."""
_DAMAGED = ("malformed", "not a database", "no such table", "no such column", "unsupported file format")


@contextmanager
def explain_faults(path: Path, home: Path | None = None) -> Iterator[None]:
    """Turn an error of SQLite about the run store at `path` into a `StoreError` that says what to do.

    Args:
        path: the file that is written or read.
        home: the file in the run's own folder, where `path` is another.
    """
    try:
        yield
    except sqlite3.DatabaseError as error:
        raise StoreError(f"{path}: {error}; {find_remedy(path, str(error), home)}") from error
    except UnicodeDecodeError as error:  # of SQLite's own message, which quotes the file
        raise StoreError(f"{path}: {error}; {find_remedy(path, 'malformed', home)}") from error


def write_resume_command(run: Path, scratch: str | Path | None = None) -> str:
    """Return the command that resumes the run in a folder, written on a local disk as it was before."""
    return shlex.join(["wiw", "resume", str(run), *([] if scratch is None else ["--scratch", str(scratch)])])


def find_remedy(path: Path, error: str, home: Path | None = None) -> str:
    """Return what was expected of the run store at `path` and what to do, given the text of an SQLite error."""
    if any(words in error for words in _UNWRITTEN):
        if shortage := explain_shortage():
            return shortage
        scratch = None if home in (None, path) else path.parent.parent
        return (
            f"expected {path.parent} to be writable, with free space. Everything recorded so far is kept: make room, "
            f"then `{write_resume_command((home or path).parent, scratch)}`"
        )
    if any(words in error for words in _DAMAGED):
        return (
            f"expected a complete, undamaged run store; restore {path.name} (and {path.name}-wal, if there is one) "
            "from a backup, or start a new run in another folder"
        )
    return (
        "expected a run store that can be read and written; make sure that no other program has it open, then try again"
    )


def explain_shortage() -> str:
    """Return what to do if this process can open too few files for a store; empty if it can open enough.

    SQLite reports this like a file that cannot be opened for any other reason.
    """
    try:
        with ExitStack() as files:
            for _ in range(_FILES):
                files.enter_context(Path(os.devnull).open("rb"))
    except OSError as error:
        if error.errno == errno.EMFILE:
            most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            return (
                f"expected to open {_FILES} more files, but this process has as many open as it may, {most}. "
                "Everything recorded so far is kept: close runs that are no longer needed, or raise the limit, as in "
                f"`ulimit -n {4 * most}`, then try again"
            )
    return ""
