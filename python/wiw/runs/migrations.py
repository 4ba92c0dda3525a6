# SPDX-License-Identifier: Apache-2.0
"""Older schemas of the run store: how a writer updates the file, and how a reader sees it without writing."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping
from typing import Any

OLDEST_READABLE = 7
"""Schema version of the oldest store that can be opened."""

_CURRENT_OUTCOMES = (
    "SELECT arm, episode, CASE status WHEN 'failed' THEN 'error' ELSE status END AS status, "
    "metrics, seconds, error, kind, '{}' AS details FROM main.outcome"
)
"""Version 7 called an infrastructure error "failed"; version 9 had no details."""
_OUTCOME_TABLE = """CREATE TABLE outcome_10 (
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


_TABLES_OF_11 = {
    "judge": """(
    digest TEXT PRIMARY KEY,
    description TEXT NOT NULL,
    created TEXT NOT NULL
) WITHOUT ROWID""",
    "judged": """(
    judge TEXT NOT NULL REFERENCES judge (digest),
    arm TEXT NOT NULL,
    episode INTEGER NOT NULL REFERENCES episode (episode),
    status TEXT NOT NULL CHECK (status IN ('done', 'error')),
    metrics TEXT NOT NULL,
    error TEXT NOT NULL,
    kind TEXT NOT NULL,
    details TEXT NOT NULL,
    PRIMARY KEY (judge, arm, episode)
) WITHOUT ROWID""",
}
"""Marks that judges gave later; version 10 had none."""
_PARTS_RENAMED_IN_9 = {"revision": "reviser", "swaps": "ground_truth"}
"""Parts of an agent's recipe, which is written as JSON, that version 8 called otherwise."""
_WRAPPED_STAGES = {"scoring": "revision", "proposals": "policy"}
"""Stages given the ground truth, and the part of a built agent that says so since version 9."""


def is_newer(table: str, column: str, version: int) -> bool:
    """Return whether a column was added after schema `version`, which is at least `OLDEST_READABLE`."""
    return (version < 11 and table in _TABLES_OF_11) or (version < 10 and (table, column) == ("outcome", "details"))


def migrate(connection: sqlite3.Connection, version: int) -> None:
    """Rewrite the tables of a store with schema `version`, inside the caller's transaction."""
    if version < 10:
        for statement in (
            _OUTCOME_TABLE,
            f"INSERT INTO outcome_10 {_CURRENT_OUTCOMES}",
            "DROP TABLE outcome",
            "ALTER TABLE outcome_10 RENAME TO outcome",
        ):
            connection.execute(statement)
    if version < 9:
        _rename_agent_parts(connection)
    for name, columns in _TABLES_OF_11.items():
        connection.execute(f"CREATE TABLE {name} {columns}")


def show_as_current(connection: sqlite3.Connection, version: int) -> None:
    """Let this connection see a store with schema `version` as if it were migrated; the file stays as it is."""
    if version < 10:  # a temporary view goes before the table of the same name
        connection.execute(f"CREATE TEMP VIEW outcome AS {_CURRENT_OUTCOMES}")
    if version < 9:  # so does a temporary table
        connection.execute("CREATE TEMP TABLE run AS SELECT * FROM main.run")
        _rename_agent_parts(connection)
    for name, columns in _TABLES_OF_11.items():
        connection.execute(f"CREATE TEMP TABLE {name} {columns}")


def _rename_agent_parts(connection: sqlite3.Connection) -> None:
    """Rename the parts of all agents in table `run` to those of version 9; text that is no JSON object stays."""
    connection.create_function("wiw_config_of_9", 1, _update_config, deterministic=True)
    connection.create_function("wiw_info_of_9", 1, _update_info, deterministic=True)
    connection.execute("UPDATE run SET config = wiw_config_of_9(config), info = wiw_info_of_9(info)")


def _update_config(text: Any) -> Any:
    config = _parse_object(text)
    if config is None or not isinstance(config.get("arms"), list):
        return text
    arms = [{**arm, "agent": _update_recipe(arm.get("agent"))} for arm in config["arms"] if isinstance(arm, dict)]
    return _to_text({**config, "arms": arms}) if len(arms) == len(config["arms"]) else text


def _update_info(text: Any) -> Any:
    info = _parse_object(text)
    if info is None:
        return text
    for column, update in (("agents", _update_recipe), ("built", _update_built)):
        if isinstance(info.get(column), dict):
            info[column] = {arm: update(agent) for arm, agent in info[column].items()}
    return _to_text(info)


def _update_recipe(agent: Any) -> Any:
    """Return a recipe with its parts renamed; what an agent in memory says of itself stays, it has other keys."""
    if not isinstance(agent, Mapping) or not isinstance(agent.get("policy"), str):
        return agent
    return {_PARTS_RENAMED_IN_9.get(name, name): value for name, value in agent.items()}


def _update_built(agent: Any) -> Any:
    """Return a built agent's description in which each part says itself that it is given the ground truth."""
    if not isinstance(agent, Mapping) or "swaps" not in agent:
        return agent
    updated = {name: value for name, value in agent.items() if name != "swaps"}
    for stage, part in _WRAPPED_STAGES.items():
        if stage in agent["swaps"] and isinstance(updated.get(part), Mapping):
            updated[part] = {**updated[part], "ground_truth": stage}
    return updated


def _parse_object(text: Any) -> dict[str, Any] | None:
    """Return the JSON object that a column holds; None if it holds something else, which its reader refuses."""
    try:
        value = json.loads(text)
    except (TypeError, ValueError):
        return None
    return value if isinstance(value, dict) else None


def _to_text(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))
