# SPDX-License-Identifier: Apache-2.0
"""The log beside a run store, which SQLite applies to whatever file lies there: it belongs to one file alone."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

from wiw.errors import StoreError
from wiw.file_systems import find_network
from wiw.files import atomic_file
from wiw.runs.faults import explain_faults


def has_log(path: Path) -> bool:
    """Return whether transactions lie in the log beside the file."""
    with suppress(FileNotFoundError):  # another process may just remove it
        return path.with_name(path.name + "-wal").stat().st_size > 0
    return False


def take_in_log(path: Path) -> None:
    """Move the transactions of the log into the file, so that another file may replace it; the caller holds its lock.

    Raises:
        StoreError: another program has the file open in the middle of something, or it is on a network file system.
    """
    if not has_log(path):
        return
    if kind := find_network(path):
        raise StoreError(
            f"{path} has transactions in the log beside it, which cannot be moved into it on a network file system "
            f"({kind}); expected a store without a log: copy {path.parent} to a local disk, continue the run there, "
            "and `wiw merge` it to another folder here"
        )
    with explain_faults(path), closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True)) as store:
        store.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    if has_log(path):
        raise StoreError(_describe_use(path))


def remove_log(path: Path) -> None:
    """Remove what is left of an earlier log, before another file takes the place of `path`.

    Programs that read the earlier file have it open, so they go on to see it.

    Raises:
        StoreError: the file has transactions in it, which would be lost.
    """
    if path.exists() and has_log(path):
        raise StoreError(_describe_use(path))
    for end in ("-wal", "-shm"):
        path.with_name(path.name + end).unlink(missing_ok=True)


def replace_store_file(path: Path, source: Path) -> None:
    """Replace a store's file by a copy of another one, atomically and without the log of the earlier file.

    Raises:
        StoreError: the earlier file has transactions in its log, which would be lost.
        FileError: it cannot be written.
    """
    with atomic_file(path) as draft:
        shutil.copyfile(source, draft)
        remove_log(path)  # else SQLite would apply it to the copy


def _describe_use(path: Path) -> str:
    return (
        f"{path} has transactions in the log beside it that another program holds there; expected a store that no "
        "other program has open: close it, then try again"
    )
