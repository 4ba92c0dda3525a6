# SPDX-License-Identifier: Apache-2.0
"""Configurations of runs, held against each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from wiw.errors import StoreError
from wiw.runs.rows import to_json

_CONTENT = "content"
"""Name of the digest of what is in a scene's files, among what a scene is used with (`Task.require`)."""


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


def require_same_inputs(path: Path, begun_with: dict[str, Any], now: dict[str, Any]) -> None:
    """Check settings or scenes, by name, against those that a run at `path` was started with.

    The "content" of a scene, a digest, is compared only where both have one: older runs recorded none.

    Raises:
        StoreError: they differ; says in what, and what to do.
    """
    require_same(path, _drop_content(begun_with), _drop_content(now))
    changed = [name for name in now if _has_changed(begun_with[name], now[name])]
    if changed:
        some = ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if changed[3:] else "")
        raise StoreError(
            f"{path}: the files of {some} have changed since the run was started (a scene itself, or the navigation "
            "mesh, labels, materials, textures or models that belong to it), and results of two versions of a scene "
            "must not be mixed; put back the files that the run was started with, or start a new run in another folder"
        )


def _has_changed(scene: Any, now: Any) -> bool:
    """Return whether what is in a scene's files is known to be another than it was; never of a setting."""
    if not isinstance(scene, dict) or not isinstance(now, dict):
        return False
    return _CONTENT in scene and _CONTENT in now and bool(scene[_CONTENT] != now[_CONTENT])


def _drop_content(values: dict[str, Any]) -> dict[str, Any]:
    """Return settings or scenes without the digests of scenes."""
    return {
        name: {key: each for key, each in value.items() if key != _CONTENT} if isinstance(value, dict) else value
        for name, value in values.items()
    }


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
