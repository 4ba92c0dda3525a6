# SPDX-License-Identifier: Apache-2.0
"""What a full disk or a damaged file means to whoever runs `wiw`, and how no file is ever left half-written."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from wiw.errors import FileError, StoreError

_UNWRITTEN = ("full", "disk I/O", "unable to open")
_DAMAGED = ("malformed", "not a database", "no such table", "no such column", "unsupported file format")


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turns what SQLite raises on the run store at `path` into a `StoreError` that says what to do."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        raise StoreError(f"{path}: {error}; {remedy(path, str(error))}") from error


def remedy(path: Path, error: str) -> str:
    """What was expected of the run store at `path`, and what to do, after SQLite's `error`."""
    if any(words in error for words in _UNWRITTEN):
        return (
            f"expected free space, and the right to write, in {path.parent}. What was recorded before is kept: "
            f"make room, then `wiw resume {path.parent}`"
        )
    if any(words in error for words in _DAMAGED):
        return (
            f"expected a whole, undamaged run store; bring back {path.name} (and {path.name}-wal, where there is one) "
            "from a copy, or begin a new run in another folder"
        )
    return "expected a run store that can be read and written; see that no other program holds it, then try again"


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file beside `path` to write to; it takes the place of `path` only once it is written whole.

    Raises:
        FileError: it cannot be written, for instance because the disk is full; `path` is as it was.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    with _written(path, draft):
        path.parent.mkdir(parents=True, exist_ok=True)
        _sweep(path)
        yield draft
        _sync(draft)
        draft.replace(path)


@contextmanager
def whole_folder(path: Path, replace: Callable[[Path], bool] = lambda folder: False) -> Iterator[Path]:
    """The same for a folder: an empty one beside `path` that becomes `path` once all is in it.

    Args:
        path: a folder that is not there yet, is empty, or that `replace` says may be replaced.
        replace: told what `path` holds.

    Raises:
        FileError: `path` holds something already, or cannot be written.
    """
    if path.exists() and (not path.is_dir() or (any(path.iterdir()) and not replace(path))):
        raise FileError(f"{path} holds something already; expected a folder that is new or empty: name another")
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    with _written(path, draft):
        path.parent.mkdir(parents=True, exist_ok=True)
        _sweep(path)
        draft.mkdir()
        yield draft
        if path.is_dir() and any(path.iterdir()):
            path.rename(_old(path))
        draft.replace(path)
        _remove(_old(path))


@contextmanager
def _written(path: Path, draft: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FileError(
            f"{path}: cannot be written ({error.strerror or error}); expected a folder with free space and the right "
            "to write: make room or name another place. Nothing half-written is left"
        ) from error
    finally:
        _remove(draft)


def _old(path: Path) -> Path:
    """Where a folder that is replaced stays until the new one is in its place."""
    return path.with_name(f".{path.name}.old.{os.getpid()}.part")


def _sweep(path: Path) -> None:
    """Takes away what writers that were killed have left."""
    for draft in path.parent.glob(f".{path.name}.*.part"):
        pid = draft.name.removesuffix(".part").rpartition(".")[2]
        if not (pid.isdigit() and Path("/proc", pid).exists()):
            _remove(draft)


def _remove(draft: Path) -> None:
    if draft.is_dir():
        shutil.rmtree(draft, ignore_errors=True)
    else:
        draft.unlink(missing_ok=True)


def _sync(file: Path) -> None:
    with file.open("rb") as written:
        os.fsync(written.fileno())
