# SPDX-License-Identifier: Apache-2.0
"""The expected shapes of a run store's values, so that a store edited by hand raises an error that names the place, and
nothing is written that could not be read again.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from wiw.errors import StoreError
from wiw.json_text import parse_json

EDITED = "the run store was edited: restore it from a backup"
"""Ends messages about values that no version of wiw writes."""
MOST = sys.float_info.max
NUMBER = (int, float, type(None))
"""A number, or null for one that is not finite."""
TEXT, FLAG = (str,), (bool,)
WHOLE = (int,)
NONE = (type(None),)
FINITE = (int, float, bool)
NUMBERS = {str: (*NUMBER, bool)}
"""Names to numbers."""


class Either:
    """One of several shapes.

    A shape is a tuple of types, [shape of each item], {name: shape, ..., str: shape of all other values} with the names
    that must be there ("name?": that may be), or this.
    """

    def __init__(self, *shapes: Any) -> None:
        self.shapes = shapes


CONFIG: Any = {
    "task": {},
    "seed": WHOLE,
    "episodes": WHOLE,
    "arms": [{"name": TEXT, "agent": {}}],
}
INFO: Any = {
    "task": Either(NONE, {}),
    "agents": {str: Either(NONE, {})},
    "pictures": [WHOLE],
    "live": WHOLE,
    "workers": WHOLE,
    "limits": {},
    "benchmark?": WHOLE,
    "salt?": TEXT,
    "shard?": (str, type(None)),
    "stopped?": {"episodes": WHOLE},
    "built?": {str: {}},
    "departures?": [{"topic": TEXT, "found": TEXT, "reason": TEXT}],
    "tables?": {"kinds?": [TEXT], "judged?": [TEXT], "cuts?": [WHOLE], "kind?": TEXT},
}
ACTIONS = [Either((int, float), [NUMBER])]
"""A number or a vector for each action."""
COLUMNS: Mapping[str, Any] = {
    "config": CONFIG,
    "info": INFO,
    "episode.info": {},
    "description": {"judge": TEXT},
    "metrics": {"success?": FINITE, "decisions?": FINITE, **NUMBERS},
    "details": {},
    "world_to_pixel": [[NUMBER]],
    "actions": ACTIONS,
    "executed": ACTIONS,
    "scores": [NUMBER],
    "answer": Either(
        {"label": TEXT, "confidence": NUMBER, "probabilities": NUMBERS},
        {"label": TEXT, "confidence": NUMBER, "final": FLAG},
    ),
    "fidelity": {
        "scores": [NUMBER],
        "rank": NUMBER,
        "regret": NUMBER,
        "best": (bool, type(None)),
        "psnr": Either(NUMBER, [Either(NUMBER, [NUMBER])]),
        "ssim": Either(NUMBER, [Either(NUMBER, [NUMBER])]),
    },
    "exchanges": [{"purpose": TEXT, "model": TEXT, "said": [{}], "result": {}, "problem": TEXT, "instead": TEXT}],
    "proposals": [{"actions": ACTIONS, "prior": NUMBER, "note": TEXT}],
    "real_frames": [[FLAG]],
    "path": [[NUMBER]],
    "refused": [TEXT],
    "seconds": NUMBERS,
    "calls": NUMBERS,
    "spent": NUMBERS,
}
"""By column of the store."""


def parse_column(column: str, text: Any, where: str) -> Any:
    """Return the value of a column that holds JSON.

    Raises:
        StoreError: it is not JSON, or of another shape; names `where`.
    """
    try:
        return _read_column(column, text)
    except ValueError as error:
        raise StoreError(f"{where}: {error}; {EDITED}") from error


def _read_column(column: str, text: Any) -> Any:
    """Return the value of a column; raise ValueError where it has not the column's shape."""
    try:
        if not isinstance(text, str):
            raise ValueError(f"expected text, got {type(text).__name__}")
        value = parse_json(text)
        _check(value, COLUMNS[column], "")
    except ValueError as error:
        raise ValueError(f"{column.rpartition('.')[2]}: {error}") from error
    return value


def find_misfit(row: Mapping[str, Any]) -> str:
    """Return why readers would refuse a row that is about to be written, in words; empty if they take it.

    Args:
        row: columns of a decision or an outcome by name; those of `COLUMNS` hold JSON, or None where that is allowed.
    """
    try:
        read = {
            name: _read_column(name, value) if name in COLUMNS and value is not None else value
            for name, value in row.items()
        }
        if not isinstance(read.get("note", ""), str):
            raise ValueError(f"note: expected str, got {type(read['note']).__name__}")
        if "proposals" in read:
            _require_agreement(read)
    except ValueError as error:
        return str(error)
    return ""


def check_types(row: Mapping[str, Any], declared: Mapping[str, tuple[type, ...]], where: str) -> None:
    """Check a row against the declared types of its columns, which SQLite does not.

    Raises:
        StoreError: a value is of another type; names `where` and the column.
    """
    for name, value in row.items():
        if name in declared and not isinstance(value, declared[name]):
            raise StoreError(
                f"{where}: {name}: expected {declared[name][0].__name__}, got {type(value).__name__}; {EDITED}"
            )


def check_decision(row: Mapping[str, Any], where: str) -> None:
    """Check that a decision's columns agree: one score and one list of frames for each proposal.

    Raises:
        StoreError: they do not fit; names `where`.
    """
    try:
        _require_agreement(row)
    except ValueError as error:
        raise StoreError(f"{where}: {error}; {EDITED}") from error


def _require_agreement(row: Mapping[str, Any]) -> None:
    """Raise ValueError where a decision's columns do not fit together."""
    count = len(row["proposals"])
    fits = all(row[name] is None or len(row[name]) == count for name in ("scores", "real_frames"))
    chosen = row["chosen"] is None or 0 <= row["chosen"] < count
    lengths = {len(own) if isinstance(own, list) else None for own in (*row["actions"], *row["executed"])}
    fits = fits and len(row["actions"]) > 0 and len(lengths) == 1
    if not fits or not chosen or not row["path"] or any(len(place) != 3 for place in row["path"]):
        raise ValueError(
            f"expected actions of one kind, a score and frames for each of {count} proposals, one of them chosen, and "
            "a path of [x, y, z]"
        )


def _check(value: Any, shape: Any, place: str) -> None:
    if isinstance(shape, Either):
        _check_either(value, shape, place)
    elif isinstance(shape, tuple):
        if not isinstance(value, shape) or (isinstance(value, bool) and bool not in shape):
            raise ValueError(f"{place or 'value'}: expected {_list_names(shape)}, got {type(value).__name__}")
        if isinstance(value, int | float) and not -MOST <= value <= MOST:
            raise ValueError(f"{place or 'value'}: expected a finite number, got {str(value)[:20]}")
    elif isinstance(shape, list):
        _require(value, list, place)
        for index, item in enumerate(value):
            _check(item, shape[0], f"{place}[{index}]")
    else:
        _require(value, dict, place)
        _check_names(value, shape, place)


def _check_names(value: Mapping[str, Any], shape: Mapping[Any, Any], place: str) -> None:
    named = {name.rstrip("?"): inner for name, inner in shape.items() if name is not str}
    for name in named:
        if name in shape and name not in value:
            raise ValueError(f"{place or 'value'}: '{name}' is missing")
    for name, item in value.items():
        inner = named.get(name, shape.get(str))
        if inner is not None:
            _check(item, inner, f"{place}.{name}".lstrip("."))


def _check_either(value: Any, either: Either, place: str) -> None:
    errors = []
    for shape in either.shapes:
        try:
            return _check(value, shape, place)
        except ValueError as error:
            errors.append(str(error))
    raise ValueError(" or ".join(errors))


def _require(value: Any, kind: type, place: str) -> None:
    if not isinstance(value, kind):
        raise ValueError(f"{place or 'value'}: expected {kind.__name__}, got {type(value).__name__}")


def _list_names(types: Sequence[type]) -> str:
    return " or ".join("null" if kind is type(None) else kind.__name__ for kind in types)
