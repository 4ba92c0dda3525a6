# SPDX-License-Identifier: Apache-2.0
"""The file of a run store: its path, its schema, its lock, and connections to it."""

from __future__ import annotations

import fcntl
import os
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from wiw.errors import StoreError
from wiw.file_systems import find_network
from wiw.runs.faults import explain_faults, explain_shortage
from wiw.runs.scratch import ScratchCopy
from wiw.runs.store_log import has_log

FILE_NAME = "run.sqlite"
SCHEMA = Path(__file__).with_name("schema.sql")
_TYPES: dict[str, tuple[type, ...]] = {"TEXT": (str,), "INTEGER": (int,), "REAL": (float, int), "BLOB": (bytes,)}
"""Python types by SQLite's names."""


def store_path(run: str | Path) -> Path:
    """Return the store's file, from a run's folder or the file itself."""
    path = Path(run).expanduser()
    return path if path.suffix == ".sqlite" else path / FILE_NAME


class Column(NamedTuple):
    """A column as the schema declares it."""

    kind: str
    """SQLite's name of the type."""
    types: tuple[type, ...]
    """Python types of its values."""


@cache
def list_columns() -> dict[str, dict[str, Column]]:
    """Return the columns of each table of a store by name, as its schema declares them."""
    with closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript(SCHEMA.read_text())
        tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {table: dict(_read_columns(connection, table)) for table in tables}


def _read_columns(connection: sqlite3.Connection, table: str) -> Iterator[tuple[str, Column]]:
    for _, name, kind, required, _, key in connection.execute(f"PRAGMA table_info({table})"):
        yield name, Column(kind, _TYPES[kind] + (() if required or key else (type(None),)))


def remove_store(path: Path) -> None:
    """Remove a store, and its folder if nothing else is in it."""
    for name in ("", "-wal", "-shm"):
        path.with_name(path.name + name).unlink(missing_ok=True)
    path.with_suffix(".lock").unlink(missing_ok=True)
    with suppress(OSError):  # other files are in it
        path.parent.rmdir()


def make_folder(path: Path) -> None:
    """Create the folder of a store.

    Raises:
        StoreError: it cannot be created.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(
            f"cannot create the run's folder {path.parent} ({error.strerror}); expected a writable place with free "
            "space: make room, or choose another with out= or --out"
        ) from error


def connect(path: Path, lock: Any = None) -> sqlite3.Connection:
    """Connect; a connection that may write is for the holder of the lock, which is released if connecting fails.

    Raises:
        StoreError: the file cannot be opened.
    """
    try:
        with explain_faults(path):
            return _open_file(path, writing=lock is not None)
    except StoreError:
        if lock is not None:
            lock.close()
        raise


def _open_file(path: Path, writing: bool) -> sqlite3.Connection:
    uri = f"{path.absolute().as_uri()}?mode={'rwc' if writing else 'ro'}"
    connection = _open_uri(uri)
    if writing:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute("PRAGMA foreign_keys = ON")
        return connection
    try:
        connection.execute("SELECT 1 FROM sqlite_master")
    except sqlite3.OperationalError:
        connection.close()
        if has_log(path):
            raise
        return _open_uri(uri + "&immutable=1")  # a reader makes a small file too, for which a full disk has no room
    return connection


def _open_uri(uri: str) -> sqlite3.Connection:
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=30)
    connection.row_factory = sqlite3.Row
    return connection


def is_blank(path: Path, writing: bool = True) -> bool:
    """Return whether a creation was cut off before anything was written: the schema and the run are one transaction.

    One that was cut off with a log may need a writer, who takes that in.
    """
    with explain_faults(path):
        connection = _open_file(path, writing)
        (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        connection.close()
    return bool(tables == 0)


def lock_store(path: Path) -> Any:
    """Take an advisory lock that the kernel drops when its holder dies, so that a run never has two writers.

    Raises:
        StoreError: another process holds it, or the folder is on a network file system or cannot be written.
    """
    if kind := find_network(path):
        raise StoreError(
            f"{path.parent} is on a network file system ({kind}), on which SQLite's log is not safe; expected a local "
            "disk: give a folder on this machine's own disk, as in --scratch /tmp (scratch=), so that the store is "
            "written there and copied here; or give a local folder with --out (out=), and `wiw merge` it to here "
            "afterwards"
        )
    try:
        handle = path.with_suffix(".lock").open("w")
    except OSError as error:
        remedy = explain_shortage() or (
            "expected a writable folder with free space: make room, or choose another with out= or --out"
        )
        raise StoreError(f"cannot write to the run's folder {path.parent} ({error.strerror}); {remedy}") from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        handle.close()
        raise StoreError(f"{path} is being written by another process; wait for it to end, or stop it") from None
    if os.fstat(handle.fileno()).st_nlink == 0:  # its last holder has just removed it: others would lock another file
        handle.close()
        return lock_store(path)
    return handle


def lock_both(copy: ScratchCopy) -> ExitStack:
    """Lock a store on a local disk, and its own file where that is on one too: somebody may write it there."""
    with ExitStack() as locks:
        for path in (copy.path, copy.home):
            if path is copy.path or find_network(path) is None:
                make_folder(path)
                locks.enter_context(lock_store(path))
        return locks.pop_all()
