# SPDX-License-Identifier: Apache-2.0
"""A store that is written on a local disk and copied as a whole to its own folder, which any disk may hold.

The copy is made as episodes begin to be run, then at most once a minute, and when the store is closed: at the run's
end, or when it is stopped. So a machine that is lost takes the episodes of a minute with it. A copy is complete or
absent, and needs no log beside it, so it can be read anywhere. Where the last one fails, or the process is killed, the
store on the local disk stays, and whoever resumes the run on that machine takes its rows in.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

from wiw.errors import FileError, StoreError
from wiw.runs.faults import explain_faults, write_resume_command
from wiw.runs.store_log import replace_store_file

PERIOD = 60.0
"""Seconds between two copies."""
RECORDED = ("outcome", "decision", "lost")
"""Tables with rows once a run has recorded anything."""
_log = logging.getLogger("wiw.runs")


class ScratchCopy:
    """The store at `path`, on a local disk, whose own place is `home`."""

    def __init__(self, home: Path, scratch: Path) -> None:
        own = home.expanduser().resolve()
        digest = blake2b(str(own).encode(), digest_size=6).hexdigest()
        self.home = home
        self.folder = choose_local_folder(scratch).expanduser().resolve()
        self.given = "auto" if str(scratch) == "auto" else str(self.folder)
        self.path = self.folder / f"{own.parent.name}-{digest}" / own.name
        self._copied = time.monotonic()

    @property
    def resume_command(self) -> str:
        """Command that resumes the run here."""
        return write_resume_command(self.home.parent, self.given)

    def holds_run(self) -> bool:
        """Return whether an earlier process has left a store here.

        Raises:
            StoreError: it cannot be read.
        """
        return self._count_left() is not None

    def require_no_rows(self) -> None:
        """Check that no earlier process has left rows here, which a new run would replace.

        Raises:
            StoreError: there are some, or what is here cannot be read.
        """
        left = self._count_left()
        if left is not None and left.rows:
            raise StoreError(
                f"{self.path} has rows of a run that were not copied to {self.home.parent}; expected none where a run "
                f"begins: continue that run with `{self.resume_command}`, or delete {self.path.parent}"
            )

    def fetch_store(self) -> None:
        """Fetch the store from its home, unless an earlier process has left more of the same run here, or all of it.

        The caller holds the locks of both, and has taken in the log at home (`take_in_log`).

        Raises:
            StoreError: the store at home cannot be read, the one here cannot be written, or has rows of another run.
        """
        if not self.home.exists() and self.holds_run():
            return
        with explain_faults(self.home), closing(_open(self.home, "ro")) as source:
            if self._has_more_than(source):
                return
            self.discard()
            with explain_faults(self.path, self.home), closing(sqlite3.connect(self.path)) as target:
                source.backup(target)

    def bring_home(self) -> None:
        """Copy home what an earlier process has left here, if it is more of the same run, and remove it here.

        The caller holds the locks of both, and has taken in the log at home.

        Raises:
            StoreError: one of them cannot be read, or the one here has rows of another run.
            FileError: home cannot be written.
        """
        with explain_faults(self.home), closing(_open(self.home, "ro")) as home:
            has_more = self._has_more_than(home)
        if has_more:
            with explain_faults(self.path, self.home), closing(_open(self.path, "rw")) as left:
                self.copy(left)
        self.remove()

    def copy_if_due(self, connection: sqlite3.Connection) -> None:
        """Copy the store home if the last time was long enough ago; where that fails, warn, and try again later."""
        if time.monotonic() - self._copied < PERIOD:
            return
        try:
            self.copy(connection)
        except (FileError, StoreError) as error:  # the rows are here, and home may have room again before the end
            _log.warning("the run goes on in %s, but cannot be copied home now: %s", self.path, error.__cause__)
            self._copied = time.monotonic()

    def copy(self, connection: sqlite3.Connection) -> None:
        """Copy the store home.

        Raises:
            StoreError: there is no room for a second file here, or another program has written the one at home.
            FileError: it cannot be written at home; the store here is whole.
        """
        draft = self.path.with_name(f"{self.path.name}.copy")
        with explain_faults(draft, self.home):
            write_whole(connection, draft)
        try:
            replace_store_file(self.home, draft)
        except (FileError, StoreError) as error:
            raise type(error)(
                f"{error}. Everything recorded is in {self.path}; once the cause is fixed, `{self.resume_command}` "
                "continues with it"
            ) from error
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
        left, kept = self._count_left(), _count_rows(home)
        if left is None:
            return False
        if left.begun != kept.begun and left.rows:
            raise StoreError(
                f"{self.path} has rows of another run that were not copied to {self.home.parent}; expected rows of "
                f"the run that is there: delete {self.path.parent}, or give another folder with --scratch (scratch=)"
            )
        return left.begun == kept.begun and (left.done, left.rows) > (kept.done, kept.rows)

    def _count_left(self) -> _Count | None:
        """Return how far the store is that an earlier process has left here; None if there is no whole one."""
        if not self.path.is_file():
            return None
        with explain_faults(self.path, self.home):
            try:
                with closing(_open(self.path, "rw")) as left:  # takes in what is in its log
                    return _count_rows(left)
            except sqlite3.OperationalError as error:
                if "no such table" not in str(error):  # the disk may be full
                    raise
            except sqlite3.DatabaseError:
                pass
        return None  # cut off while it was created or fetched


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


class _Count(NamedTuple):
    """How far a store is."""

    begun: str
    """When its run began."""
    done: int
    """Number of episodes that have ended without an error."""
    rows: int
    """Number of all rows that its run recorded."""


def _count_rows(store: sqlite3.Connection) -> _Count:
    (begun,) = store.execute("SELECT created FROM run").fetchone()
    (done,) = store.execute("SELECT count(*) FROM outcome WHERE status = 'done'").fetchone()
    return _Count(begun, done, sum(store.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in RECORDED))


def _open(path: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True)
