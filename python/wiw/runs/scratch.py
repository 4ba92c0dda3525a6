# SPDX-License-Identifier: Apache-2.0
"""A store that is written on a local disk and copied as a whole to its own folder, which any disk may hold.

The copy is made as episodes begin to be run, then at most once a minute, and when the store is closed: at the run's
end, or when it is stopped. So a machine that is lost takes the episodes of a minute with it. A copy is complete or
absent, and needs no log beside it, so it can be read anywhere. Where the last one fails, or the process is killed, the
store on the local disk stays, and whoever resumes the run on that machine takes its rows in.

The process that began its session last is the one that copies: an earlier one, such as one on a node that could not be
reached while its job was started elsewhere, finds the other's session at home, and stops instead of replacing it.
"""

from __future__ import annotations

import itertools
import logging
import os
import shutil
import sqlite3
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

from wiw.errors import FileError, StoreError
from wiw.files import atomic_file
from wiw.runs.faults import explain_faults, write_resume_command
from wiw.runs.store_log import remove_log

PERIOD = 60.0
"""Seconds between two copies."""
STOP_VARIABLE = "WIW_STOP_SECONDS"
"""Environment variable with the seconds that a process which is told to stop has for copying its store."""
RECORDED = ("outcome", "decision", "lost")
"""Tables with rows once a run has recorded anything."""
_log = logging.getLogger("wiw.runs")
_unclosed: set[ScratchCopy] = set()
"""Stores that this process writes on a local disk."""


class SupersededError(StoreError):
    """Another process has gone on with the run: the store in its own folder is that one's now."""


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
        self._known: _Claim | None = None
        """Whose store is at home, as this process has last read or written it; None if none was there."""
        self._turn = threading.RLock()
        """Held by the thread that copies or closes the store."""

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

        What is left here stays beside it under another name where each of the two has episodes that the other lacks.
        The caller holds the locks of both, and has taken in the log at home (`take_in_log`).

        Raises:
            StoreError: the store at home cannot be read, the one here cannot be written, or has rows of another run.
        """
        if not self.home.exists() and self.holds_run():
            return
        with explain_faults(self.home), closing(_open(self.home, "ro")) as source:
            if self._find_more_than(source):
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
            has_more = self._find_more_than(home)
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
        except SupersededError:
            raise
        except (FileError, StoreError) as error:  # the rows are here, and home may have room again before the end
            _log.warning("the run goes on in %s, but cannot be copied home now: %s", self.path, error.__cause__)
            self._copied = time.monotonic()

    def copy(self, connection: sqlite3.Connection) -> None:
        """Copy the store home.

        Raises:
            SupersededError: another process has written the one at home since this one read or wrote it.
            StoreError: there is no room for a second file here, or another program has written the one at home.
            FileError: it cannot be written at home; the store here is whole.
        """
        with self._turn:
            _unclosed.add(self)
            draft = self.path.with_name(f"{self.path.name}.copy")
            with explain_faults(draft, self.home):
                write_whole(connection, draft)
                claim = _read_claim(connection)
            try:
                self._replace_home(draft, claim.begun)
            except SupersededError:
                raise
            except (FileError, StoreError) as error:
                raise type(error)(
                    f"{error}. Everything recorded is in {self.path}; once the cause is fixed, "
                    f"`{self.resume_command}` continues with it"
                ) from error
            draft.unlink()
            self._known = claim
            self._copied = time.monotonic()

    @contextmanager
    def ending(self) -> Iterator[None]:
        """Keep other threads from copying the store (`copy_unclosed`) while its own closes it."""
        with self._turn:
            try:
                yield
            finally:
                _unclosed.discard(self)

    def copy_in_place_of_writer(self) -> None:
        """Copy the store home from another thread than the one that writes it, unless that one closes it first.

        Raises:
            SupersededError, StoreError, FileError: as of `copy`.
        """
        with self._turn:
            if self in _unclosed:
                with explain_faults(self.path, self.home), closing(_open(self.path, "rw")) as own:
                    self.copy(own)

    def discard(self) -> None:
        """Remove what an earlier process has left here; the caller holds the lock."""
        for end in ("", "-wal", "-shm", ".copy"):
            self.path.with_name(self.path.name + end).unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove the store here, and its folder."""
        self.discard()
        _unclosed.discard(self)
        self.path.with_suffix(".lock").unlink(missing_ok=True)
        with suppress(OSError):  # other files are in it
            self.path.parent.rmdir()

    def _replace_home(self, draft: Path, begun: str) -> None:
        with atomic_file(self.home) as home:
            shutil.copyfile(draft, home)
            self._require_own_home(begun)  # last, and after a write to the folder, of which NFS may know an old state
            remove_log(self.home)  # else SQLite would apply it to the copy

    def _require_own_home(self, begun: str) -> None:
        """Check that the store at home is what this process has last read or written there, if there is one.

        Raises:
            SupersededError: another process has written it since.
            StoreError: it cannot be read now.
        """
        found = self._read_home()
        if found in (None, self._known, _Claim(begun)):
            return
        raise SupersededError(
            f"{self.home} has been written by another process ({found}); expected to be the only one that runs these "
            f"episodes, so this process stops. All that it has recorded is kept in {self.path}: once the other has "
            f"ended, `wiw merge {self.home.parent} {self.path} --out NEW` makes one run of both; or delete "
            f"{self.path.parent}"
        )

    def _read_home(self) -> _Claim | None:
        """Return whose store is at home; None if there is none, or a damaged one."""
        if not self.home.is_file():
            return None
        with explain_faults(self.home):
            try:
                with closing(_open(self.home, "ro&immutable=1")) as home:  # without locks, which a network may lack
                    return _read_claim(home)
            except sqlite3.OperationalError as error:
                if not any(words in str(error) for words in ("no such", "malformed")):
                    raise
            except sqlite3.DatabaseError:
                pass
        return None

    def _find_more_than(self, home: sqlite3.Connection) -> bool:
        """Return whether what is left here has all that is at home, and more; note whose store is at home.

        What is left here is set aside where it has episodes that the store at home lacks, and lacks others.
        """
        self._known = _read_claim(home)
        left, kept = self._count_left(), _count_rows(home)
        if left is None:
            return False
        if left.begun != kept.begun and left.rows:
            raise StoreError(
                f"{self.path} has rows of another run that were not copied to {self.home.parent}; expected rows of "
                f"the run that is there: delete {self.path.parent}, or give another folder with --scratch (scratch=)"
            )
        if left.begun != kept.begun or left.done < kept.done:
            return False
        if left.done >= kept.done:
            return (len(left.done), left.rows) > (len(kept.done), kept.rows)
        self._set_aside(len(left.done - kept.done))
        return False

    def _set_aside(self, count: int) -> None:
        """Rename what is left here, which has `count` episodes that the store at home lacks."""
        names = (self.path.with_name(f"{self.path.stem}-{number}{self.path.suffix}") for number in itertools.count(1))
        aside = next(path for path in names if not path.exists())
        self.path.rename(aside)
        _log.warning(
            "%s has %d finished episodes that %s lacks, and lacks others: two processes have run them. The run goes on "
            "from the latter; `wiw merge %s %s --out NEW` makes one run of both",
            aside,
            count,
            self.home,
            self.home.parent,
            aside,
        )

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


def has_unclosed() -> bool:
    """Return whether this process writes a store on a local disk that it has not closed."""
    return bool(_unclosed)


def copy_unclosed() -> None:
    """Copy home the stores that this process writes on a local disk, where their own thread does not get to it.

    Waits for copies that are being made. Call it in a process that is about to end, from another thread.

    Raises:
        SupersededError, StoreError, FileError: as of `ScratchCopy.copy`.
    """
    for copy in list(_unclosed):
        copy.copy_in_place_of_writer()


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
    done: frozenset[tuple[str, int]]
    """Episodes that have ended without an error, by arm and index."""
    rows: int
    """Number of all rows that its run recorded."""


def _count_rows(store: sqlite3.Connection) -> _Count:
    (begun,) = store.execute("SELECT created FROM run").fetchone()
    done = store.execute("SELECT arm, episode FROM outcome WHERE status = 'done'").fetchall()
    rows = sum(store.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in RECORDED)
    return _Count(begun, frozenset(map(tuple, done)), rows)


class _Claim(NamedTuple):
    """Whose a store is."""

    begun: str
    """When its run began."""
    session: str | None = None
    """The process that has last begun to run its episodes, as JSON; None before the first."""
    process: int | None = None
    host: str | None = None
    since: str | None = None

    def __str__(self) -> str:
        own = f"process {self.process} on {self.host}, since {self.since}"
        return f"of the run of {self.begun}" if self.session is None else own


def _read_claim(store: sqlite3.Connection) -> _Claim:
    parts = ", ".join(f"json_extract(info, '$.session{part}')" for part in ("", ".process", ".host", ".begun"))
    return _Claim(*store.execute(f"SELECT created, {parts} FROM run").fetchone() or ("",))


def _open(path: Path, mode: str) -> sqlite3.Connection:
    """Open a store; `mode` is SQLite's, and may have more parameters of its URIs after it."""
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True)
