# SPDX-License-Identifier: Apache-2.0
"""Scene specs: which scenes a text such as "apartments:val:40" names."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from wiw import _core
from wiw.errors import ArgumentError, Error, FileError
from wiw.scenes.scans import formats
from wiw.suggestions import did_you_mean

SPLIT_SIZE = 1000
"""Number of apartments in a spec without a number."""
MOST_DIGITS = 6
"""Digits of the greatest number in a spec: a list of more apartments would fill the memory."""
APARTMENTS = r"apartments:(train|val|test)(?:(?::([0-9]+))?:([1-9][0-9]*)|/([0-9]+))?"
"""Split, first, end, and number of a single one. A single one may be followed by "?" and edits, joined by "&"."""
_FORMS = (
    "apartments:{train,val,test}, apartments:val:40, apartments:val:40:60, apartments:val/7 or "
    "apartments:val/7?state:floor_lamp_1=off&color:sofa_1=blue"
)


def is_generated(spec: str) -> bool:
    """Return whether a scene spec names generated apartments rather than a file."""
    return spec.startswith("apartments:")


def strip_edits(spec: str) -> str:
    """Return the apartment that an edited one is a copy of: "apartments:val/7" for "apartments:val/7?remove:tv_1"."""
    return spec.partition("?")[0] if is_generated(spec) else spec


def absolute(spec: str | PathLike[str]) -> str:
    """Return the spec, made absolute if it is a path, so that it means the same in any folder.

    Raises:
        ArgumentError: it is neither text nor a path, or is in the home of a user who is not known.
        FileError: it cannot be looked for.
    """
    spec = _require_text(spec)
    with blame_path(spec):
        scan = formats.parse_spec(spec)
        if scan is not None:
            kind, folder, split = scan
            return ":".join(filter(None, [kind, str(folder.expanduser().absolute()), split]))
        return spec if is_generated(spec) or _resembles_generated(spec) else str(Path(spec).expanduser().absolute())


def resolve(spec: str | PathLike[str]) -> list[str]:
    """Return the single scenes that a scene spec names, in order, without loading them.

    "apartments:val" and "apartments:val:40" are the first 1000 or 40 apartments of a split, "apartments:val:40:60" are
    numbers 40 to 59, each named "apartments:val/7"; "hm3d:DIR:val" is each scan of a dataset's split, by its file (see
    `wiw.scenes.scans.formats.KINDS`); anything else is the path of a mesh or a Gazebo world. The edits of
    "apartments:val/7?state:floor_lamp_1=off&color:sofa_1=blue" are put into canonical order and spelling, as is the
    number, so that equal scenes have equal names; whether the apartment allows the edits is checked when it is opened.

    Raises:
        ArgumentError: the split, a number or an edit is invalid, or the home of a user who is not known is named.
        FileError: the file does not exist or cannot be looked for, or the folder has no scan.
    """
    spec = _require_text(spec)
    with blame_path(spec):
        return _resolve(spec)


@contextmanager
def blame_path(path: str | PathLike[str]) -> Iterator[None]:
    """Turn what the system says while it looks for a path into an error that names the path.

    Raises:
        ArgumentError: it is in the home of a user who is not known.
        FileError: it cannot be looked for, such as in a folder that may not be read.
    """
    try:
        yield
    except Error:
        raise
    except RuntimeError as error:
        raise ArgumentError(f"{path}: {error}") from error
    except OSError as error:
        raise FileError(f"{path}: {error.strerror or error}") from error


def _resolve(spec: str) -> list[str]:
    scan = formats.parse_spec(spec)
    if scan is not None:
        return [str(file) for file in formats.find_scans(*scan)]
    if not is_generated(spec):
        if not Path(spec).expanduser().is_file():
            raise FileError(
                f"{spec}: no such file; expected a mesh, a Gazebo world, apartments:{{train,val,test}}[:N], or scans "
                f"such as hm3d:DIR:val ({', '.join(formats.KINDS)}).{_did_you_mean(spec)}"
            )
        return [spec]
    base, mark, edits = spec.partition("?")
    match = re.fullmatch(APARTMENTS, base)
    if match is None:
        raise ArgumentError(f"scene spec '{spec}': expected {_FORMS}.{_did_you_mean(base)}")
    split, first, end, index = match.groups()
    numbers = range(_to_number(spec, first or "0"), _to_number(spec, end) if end else SPLIT_SIZE)
    if not numbers:
        raise ArgumentError(f"scene spec '{spec}': holds no scene; expected first < end, as in apartments:val:40:60.")
    if index is not None:
        single = f"apartments:{split}/{_to_number(spec, index)}"
        return [single + mark + "&".join(_parse_edits(spec, edits))] if mark else [single]
    if mark:
        raise ArgumentError(f"scene spec '{spec}': edits belong to a single apartment; expected {_FORMS}.")
    return [f"apartments:{split}/{i}" for i in numbers]


def _require_text(spec: Any) -> str:
    """Return a spec as text.

    Raises:
        ArgumentError: it is neither text nor a path.
    """
    if isinstance(spec, str | PathLike):
        return fspath(spec)
    raise ArgumentError(
        f"scene spec: expected text such as apartments:val:40:60, which names scenes 40 to 59, or a path, got {spec!r}"
        "; for scenes of your choice, give an episode file that names them (docs/how-to.md)"
    )


def _to_number(spec: str, digits: str) -> int:
    digits = digits.lstrip("0") or "0"
    if len(digits) > MOST_DIGITS:
        raise ArgumentError(f"scene spec '{spec}': expected numbers below {10**MOST_DIGITS}, got {digits}.")
    return int(digits)


def _resembles_generated(spec: str) -> bool:
    """Return whether a spec is not a file and looks like a misspelt `apartments:`, to be refused as typed."""
    kind, colon, _ = spec.partition(":")
    return bool(colon and did_you_mean(kind, ["apartments"])) and not Path(spec).expanduser().exists()


def _parse_edits(spec: str, edits: str) -> list[str]:
    """Return the edits of a spec in their canonical order."""
    try:
        return _core.scene.canonical_edits(edits.split("&"))
    except ArgumentError as error:
        raise ArgumentError(f"scene spec '{spec}': {error}") from None


def parse_single(spec: str) -> tuple[int, str, list[str]]:
    """Return seed, split and edits of a single apartment's spec."""
    base, mark, edits = spec.partition("?")
    match = re.fullmatch(APARTMENTS, base)
    if match is None or match[4] is None:
        raise ArgumentError(f"scene spec '{spec}': expected a single apartment, such as apartments:val/7.")
    return _to_number(spec, match[4]), match[1], _parse_edits(spec, edits) if mark else []


def _did_you_mean(spec: str) -> str:
    """Return a hint at a split, or at a similar file next to the missing one."""
    path = Path(spec).expanduser()
    kind, colon, rest = spec.partition(":")
    if did_you_mean(kind, ["apartments"]):
        split = re.split("[:/]", rest)[0]
        near = difflib.get_close_matches(split, ["train", "val", "test"], 1, 0.5) or ["val"]
        meant = f"apartments:{near[0]}{rest[len(split) :]}"
        return did_you_mean(spec, [meant]) if re.fullmatch(APARTMENTS, meant) else ""
    if colon or not path.parent.is_dir():
        return ""
    return did_you_mean(path.name, [file.name for file in path.parent.iterdir()])
