# SPDX-License-Identifier: Apache-2.0
"""Scores of frames, in a SQLite file beside the run: what is scored stays scored, whatever happens next.

A score is stored under the digest of the frame's pixels and that of the scorer's card, in a transaction of its own.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from wiw.errors import StoreError
from wiw.file_systems import choose_journal_mode

FILE_NAME = "quality.sqlite"
APPLICATION_ID = 0x77697771
"""Marks the file as scores of frames (SQLite's application_id)."""
VERSION = 1
_SCHEMA = """
CREATE TABLE scorer (               -- who scored
    digest TEXT PRIMARY KEY,        -- of the card
    card TEXT NOT NULL,             -- JSON: scorer, version, licence, scores with their ranges
    command TEXT NOT NULL,          -- how it was named
    created TEXT NOT NULL           -- ISO 8601, UTC
) WITHOUT ROWID;
CREATE TABLE score (
    scorer TEXT NOT NULL REFERENCES scorer (digest),
    frame TEXT NOT NULL,            -- SHA-256 of size and pixels; of two frames that are compared, both with ":"
    scores TEXT NOT NULL,           -- JSON: name to number
    PRIMARY KEY (scorer, frame)
) WITHOUT ROWID;
"""


class FrameScores:
    """The scores of a run's frames. Works as a context manager.

    Args:
        folder: of the run.

    Raises:
        StoreError: the file cannot be written, is damaged, or is another.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE_NAME
        with self._explain():
            self._connection = sqlite3.connect(self.path, isolation_level=None, timeout=30)
        try:
            with self._explain():
                self._prepare()
        except BaseException:
            self._connection.close()
            raise

    def add_scorer(self, digest: str, card: Mapping[str, Any], command: str) -> None:
        """Store who a scorer is."""
        now = datetime.now(timezone.utc).isoformat(timespec="seconds")
        with self._explain():
            self._connection.execute(
                "INSERT OR IGNORE INTO scorer VALUES (?, ?, ?, ?)", (digest, json.dumps(card), command, now)
            )

    def write(self, scorer: str, frame: str, scores: Mapping[str, float]) -> None:
        """Store the scores of a frame; those of the same scorer and frame stay."""
        with self._explain():
            self._connection.execute(
                "INSERT OR IGNORE INTO score VALUES (?, ?, ?)", (scorer, frame, json.dumps(dict(scores)))
            )

    def read(self, scorer: str, frames: Iterable[str]) -> dict[str, dict[str, float]]:
        """Return the scores that a scorer has given, by frame."""
        wanted = set(frames)
        with self._explain():
            rows = self._connection.execute("SELECT frame, scores FROM score WHERE scorer = ?", (scorer,)).fetchall()
            return {frame: json.loads(scores) for frame, scores in rows if frame in wanted}

    def scorers(self) -> list[dict[str, Any]]:
        """Return the cards of all that have scored, with "command"."""
        with self._explain():
            rows = self._connection.execute("SELECT card, command FROM scorer ORDER BY created, digest").fetchall()
            return [{**json.loads(card), "command": command} for card, command in rows]

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def __enter__(self) -> FrameScores:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _prepare(self) -> None:
        self._connection.execute(f"PRAGMA journal_mode = {choose_journal_mode(self.path)}")
        self._connection.execute("PRAGMA synchronous = NORMAL")
        self._connection.execute("BEGIN IMMEDIATE")
        (tables,) = self._connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        if tables == 0:
            for statement in _SCHEMA.split(";\n")[:-1]:
                self._connection.execute(statement)
            self._connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            self._connection.execute(f"PRAGMA user_version = {VERSION}")
        self._connection.execute("COMMIT")
        found = tuple(self._connection.execute(f"PRAGMA {name}").fetchone()[0] for name in _MARKS)
        if found != (APPLICATION_ID, VERSION):
            raise StoreError(
                f"{self.path}: expected scores of frames (application id {APPLICATION_ID:#x}, version {VERSION}), got "
                f"{found[0]:#x}, version {found[1]}; move the file away to have them computed again"
            )

    @contextmanager
    def _explain(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, ValueError) as error:
            raise StoreError(
                f"{self.path}: {error}; expected scores of frames in a writable folder with free space. The file "
                "contains nothing else: move it away to have the scores computed again"
            ) from error


_MARKS = ("application_id", "user_version")
