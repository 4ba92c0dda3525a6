# SPDX-License-Identifier: Apache-2.0
"""Answers on disk, so that no question to a model is asked, and paid for, twice.

One SQLite file, in WAL mode on a local disk, which any number of processes may share, and a `ReplyCache` any number of
threads. Answers are named by everything that they depend on (`Client.name_of`, `Client.manner`). When the file outgrows
its budget, the least recently used answers are deleted first.
"""

from __future__ import annotations

import json
import logging
import os
import sqlite3
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError
from wiw.file_systems import choose_journal_mode
from wiw.vlm.messages import Completion

_log = logging.getLogger("wiw.vlm")
BUDGET_GB = 1.0
"""Default limit of the cache in gigabytes; an answer takes about a kilobyte."""
LONGEST_WAIT = 30.0
"""Seconds to wait while another process writes."""
_SCHEMA = "CREATE TABLE IF NOT EXISTS reply (name TEXT PRIMARY KEY, data TEXT NOT NULL, used REAL NOT NULL)"


def default_folder() -> Path:
    """Return the default folder: `$WIW_CACHE/replies`, or `~/.cache/wiw/replies`. It can be deleted at any time."""
    root = os.environ.get("WIW_CACHE")
    return (Path(root).expanduser() if root else Path.home() / ".cache/wiw") / "replies"


def open_reply_cache(where: str | Path) -> ReplyCache | None:
    """Open the cache in a folder; "auto" for the default one, "off" for none."""
    return None if str(where) == "off" else ReplyCache(default_folder() if str(where) == "auto" else where)


class ReplyCache:
    """A folder of answers. Where it cannot be read or written, it logs a warning, and models are asked.

    Args:
        folder: where; created when the first answer is stored.
        budget_gb: limit in gigabytes.
    """

    def __init__(self, folder: str | Path, budget_gb: float = BUDGET_GB) -> None:
        if not budget_gb > 0:
            raise ArgumentError(f"vlm cache: expected a budget above 0 GB, got {budget_gb}")
        self.folder, self.budget_gb = Path(folder).expanduser(), budget_gb
        self._connection: sqlite3.Connection | None = None
        self._process = 0
        self._broken = False
        self._lock = threading.Lock()

    def __reduce__(self) -> Any:
        return ReplyCache, (self.folder, self.budget_gb)

    def get(self, name: str) -> Completion | None:
        """Return the answer of that name; None if there is none."""
        if self._broken or not (self.folder / "replies.sqlite").exists():
            return None
        try:
            with self._lock, self._open() as connection:
                row = connection.execute("SELECT data FROM reply WHERE name = ?", (name,)).fetchone()
                if row is None:
                    return None
                self._mark_used(connection, name)
            return Completion.from_json(json.loads(row[0]))
        except (sqlite3.Error, OSError) as error:
            self._handle(error)
        except (ValueError, KeyError, TypeError) as error:
            _log.warning("cached answer %s is damaged (%s); it is requested again", name, error)
        return None

    def put(self, answers: Mapping[str, Completion]) -> None:
        """Store answers by name."""
        if self._broken or not answers:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            rows = [(name, json.dumps(answer.to_json()), time.time()) for name, answer in answers.items()]
            with self._lock, self._open() as connection:
                connection.executemany("INSERT OR REPLACE INTO reply VALUES (?, ?, ?)", rows)
                self._trim(connection)
        except (sqlite3.Error, OSError) as error:
            self._handle(error)

    def _mark_used(self, connection: sqlite3.Connection, name: str) -> None:
        """Note when an answer was used; not while another process writes for long: the answer is there all the same."""
        try:
            connection.execute("UPDATE reply SET used = ? WHERE name = ?", (time.time(), name))
        except sqlite3.OperationalError as error:
            if not _is_locked(error):
                raise

    def _open(self) -> sqlite3.Connection:
        if self._connection is None or self._process != os.getpid():
            connection = sqlite3.connect(self.folder / "replies.sqlite", timeout=LONGEST_WAIT, check_same_thread=False)
            connection.execute(f"PRAGMA journal_mode = {choose_journal_mode(self.folder)}")
            connection.execute("PRAGMA synchronous = NORMAL")
            connection.execute(_SCHEMA)
            self._connection, self._process = connection, os.getpid()
        return self._connection

    def _trim(self, connection: sqlite3.Connection) -> None:
        """Reduce the cache to nine tenths of its budget where its pages have outgrown it.

        Pages are counted at once; the lengths of all answers, only where some are to be deleted.
        """
        budget = self.budget_gb * 2**30
        size, pages, free = (
            connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_size", "page_count", "freelist_count")
        )
        occupied = size * (pages - free)
        if occupied <= budget:
            return
        total = connection.execute("SELECT total(length(data)) FROM reply").fetchone()[0]
        connection.execute(
            "DELETE FROM reply WHERE name IN (SELECT name FROM (SELECT name, length(data) AS own,"
            " sum(length(data)) OVER (ORDER BY used, name) AS freed FROM reply) WHERE freed - own < ?)",
            (total * (1 - 0.9 * budget / occupied),),
        )

    def _handle(self, error: Exception) -> None:
        """Log why the cache was not reached, and use it no more unless that passes."""
        if _is_locked(error):
            _log.warning("%s: not reached for one answer: another process wrote there for long", self.folder)
            return
        self._broken = True
        _log.warning("answers are no longer cached: %s; free some disk space or choose another folder", error)


def _is_locked(error: Exception) -> bool:
    """Return whether another connection held SQLite's lock for longer than this one waits."""
    return isinstance(error, sqlite3.OperationalError) and "locked" in str(error)
