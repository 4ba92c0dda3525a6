# SPDX-License-Identifier: Apache-2.0
"""A store that is written on a local disk and copied as a whole to its own folder, which any disk may hold.

The copy is made as episodes begin to be run, then at most once a minute, and when the store is closed: at the run's
end, or when it is stopped. So a machine that is lost takes the episodes of a minute with it. A copy is complete or
absent, and needs no log beside it, so it can be read anywhere.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from hashlib import blake2b
from pathlib import Path

from wiw.errors import FileError
from wiw.files import atomic_file
from wiw.runs.faults import explain_faults
from wiw.runs.store_log import remove_log

PERIOD = 60.0
"""Seconds between two copies."""


class ScratchCopy:
    """The store at `path`, on a local disk, whose own place is `home`."""

    def __init__(self, home: Path, scratch: Path) -> None:
        own = home.expanduser().resolve()
        digest = blake2b(str(own).encode(), digest_size=6).hexdigest()
        self.home = home
        self.path = choose_local_folder(scratch).expanduser().resolve() / f"{own.parent.name}-{digest}" / own.name
        self._copied = time.monotonic()

    def fetch_store(self) -> None:
        """Fetch the store from its home, unless a killed process has left more of the same run here.

        The caller holds the locks of both, and has taken in the log at home (`take_in_log`).

        Raises:
            StoreError: the store at home cannot be read, or the one here cannot be written.
        """
        with explain_faults(self.home), closing(_open(self.home, "ro")) as source:
            if self._has_more_than(source):
                return
            self.discard()
            with explain_faults(self.path, self.home), closing(sqlite3.connect(self.path)) as target:
                source.backup(target)

    def copy_if_due(self, connection: sqlite3.Connection) -> None:
        """Copy the store home if the last time was long enough ago."""
        if time.monotonic() - self._copied >= PERIOD:
            self.copy(connection)

    def copy(self, connection: sqlite3.Connection) -> None:
        """Copy the store home.

        Raises:
            StoreError: there is no room for a second file here, or another program has written the one at home.
            FileError: it cannot be written at home; the store here is whole.
        """
        draft = self.path.with_name(f"{self.path.name}.copy")
        with explain_faults(draft, self.home):
            write_whole(connection, draft)
        with atomic_file(self.home) as file:
            shutil.copyfile(draft, file)
            remove_log(self.home)  # else SQLite would apply it to the copy
        draft.unlink()
        self._copied = time.monotonic()

    def discard(self) -> None:
        """Remove what an earlier process has left here; the caller holds the lock."""
        for end in ("", "-wal", "-shm", ".copy"):
            self.path.with_name(self.path.name + end).unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove the store here, and its folder."""
        self.discard()
        self.path.with_suffix(".lock").unlink(missing_ok=True)
        with suppress(OSError):  # other files are in it
            self.path.parent.rmdir()

    def _has_more_than(self, home: sqlite3.Connection) -> bool:
        if not self.path.is_file():
            return False
        try:
            with closing(_open(self.path, "rw")) as left:  # takes in what is in its log
                (begun, ended), (begun_here, ended_here) = _count_ended(home), _count_ended(left)
        except sqlite3.DatabaseError:  # cut off while it was fetched
            return False
        return begun_here == begun and ended_here > ended


def choose_local_folder(given: str | Path) -> Path:
    """Return the given folder; of "auto", where temporary files belong.

    That is the folder of the SLURM job where the cluster makes one, else $TMPDIR.
    """
    return Path(os.environ.get("SLURM_TMPDIR") or tempfile.gettempdir()) if str(given) == "auto" else Path(given)


@contextmanager
def make_local_folder(parent: str | Path | None) -> Iterator[Path]:
    """Yield a new folder that is removed at the end, in `parent`, by default that of "auto" (`choose_local_folder`).

    Raises:
        FileError: it cannot be made.
    """
    own = choose_local_folder("auto" if parent is None else parent)
    try:
        own.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(prefix="wiw-", dir=own)
    except OSError as error:
        raise FileError(
            f"{own}: cannot create a folder there ({error.strerror}); expected a writable local disk with free space: "
            "make room, or choose another with --scratch (scratch=)"
        ) from error
    with folder as path:
        yield Path(path)


def write_whole(connection: sqlite3.Connection, path: Path) -> None:
    """Write a store as one file that needs no log beside it."""
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as target:
        connection.backup(target)
        target.execute("PRAGMA journal_mode = DELETE")


def _count_ended(store: sqlite3.Connection) -> tuple[str, int]:
    """Return when the run began, and how many episodes have ended without an error."""
    (begun,) = store.execute("SELECT created FROM run").fetchone()
    (ended,) = store.execute("SELECT count(*) FROM outcome WHERE status = 'done'").fetchone()
    return begun, ended


def _open(path: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True)
