# SPDX-License-Identifier: Apache-2.0
"""Configurations of runs, held against each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from wiw.errors import StoreError
from wiw.runs.rows import to_json


def drop_new_arms(stored: dict[str, Any], wanted: dict[str, Any]) -> dict[str, Any]:
    """Return the wanted configuration with none but the stored one's arms, in its order."""
    arms = {arm["name"]: arm for arm in wanted["arms"]}
    return {**wanted, "arms": [arms[arm["name"]] for arm in stored["arms"] if arm["name"] in arms]}


def require_same(path: Path, stored: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Check that a run at `path` was started with the wanted configuration.

    Raises:
        StoreError: it was started with another; says in what they differ.
    """
    if stored == wanted:
        return
    detail = "; ".join(_list_differences(stored, wanted))
    raise StoreError(
        f"{path} holds a run with a different configuration ({detail}); resume it with its own configuration, or give "
        "another folder"
    )


def _list_differences(stored: dict[str, Any], wanted: dict[str, Any], prefix: str = "") -> list[str]:
    """Return where two configurations differ, by dotted names; of arms with unlike names the names alone."""
    found = []
    for name in sorted(stored.keys() | wanted.keys()):
        values = [_by_name(each.get(name)) for each in (stored, wanted)]
        if values[0] == values[1]:
            continue
        both = isinstance(values[0], dict) and isinstance(values[1], dict)
        if both and (name != "arms" or values[0].keys() == values[1].keys()):
            found += _list_differences(values[0], values[1], f"{prefix}{name}.")
        else:
            shown = [", ".join(value) if both else to_json(value) for value in values]
            found.append(f"{prefix}{name}: the run has {shown[0]}, now {shown[1]}")
    return found


def _by_name(value: Any) -> Any:
    """Return the descriptions of arms by their names, and anything else as it is."""
    items = value if isinstance(value, list) else []
    is_arms = all(isinstance(item, dict) and item.keys() == {"name", "agent"} for item in items)
    return {item["name"]: item["agent"] for item in items} if items and is_arms else value
