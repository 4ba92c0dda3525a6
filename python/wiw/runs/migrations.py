# SPDX-License-Identifier: Apache-2.0
"""Older schemas of the run store: how a writer updates the file, and how a reader sees it without writing."""

from __future__ import annotations

import sqlite3

OLDEST_READABLE = 7
"""Schema version of the oldest store that can be opened."""

_CURRENT_OUTCOMES = (
    "SELECT arm, episode, CASE status WHEN 'failed' THEN 'error' ELSE status END AS status, "
    "metrics, seconds, error, kind, '{}' AS details FROM main.outcome"
)
"""Version 7 called an infrastructure error "failed"; version 8 had no details."""
_OUTCOME_TABLE = """CREATE TABLE outcome_9 (
    arm TEXT NOT NULL,
    episode INTEGER NOT NULL REFERENCES episode (episode),
    status TEXT NOT NULL CHECK (status IN ('done', 'error')),
    metrics TEXT NOT NULL,
    seconds REAL NOT NULL,
    error TEXT NOT NULL,
    kind TEXT NOT NULL,
    details TEXT NOT NULL,
    PRIMARY KEY (arm, episode)
) WITHOUT ROWID"""


def migrate(connection: sqlite3.Connection, version: int) -> None:
    """Rewrite the tables of a store with schema `version`, inside the caller's transaction."""
    if version < 9:
        for statement in (
            _OUTCOME_TABLE,
            f"INSERT INTO outcome_9 {_CURRENT_OUTCOMES}",
            "DROP TABLE outcome",
            "ALTER TABLE outcome_9 RENAME TO outcome",
        ):
            connection.execute(statement)


def show_as_current(connection: sqlite3.Connection, version: int) -> None:
    """Let this connection see a store with schema `version` as if it were migrated; the file stays as it is."""
    if version < 9:  # a temporary view goes before the table of the same name
        connection.execute(f"CREATE TEMP VIEW outcome AS {_CURRENT_OUTCOMES}")
