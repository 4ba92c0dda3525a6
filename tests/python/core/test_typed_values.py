# SPDX-License-Identifier: Apache-2.0
"""Values by name are held to declared types: what fits, what becomes of it, and what is said of the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

from wiw.errors import ArgumentError
from wiw.typed_values import read_values, require_positive


@dataclass
class Declared:
    count: int = 0
    share: float = 0.0
    flag: bool = False
    title: str = ""
    file: Path | str | None = None
    size: tuple[int, int] | None = None
    sizes: tuple[int, ...] = ()
    mode: Literal["near", "far"] = "near"
    most: int | Literal["all"] = 1
    names: Sequence[str] = ()
    options: Mapping[str, Any] | None = None
    anything: Any = None


@pytest.mark.parametrize(
    ("name", "given", "read"),
    [
        ("count", 3, 3),
        ("share", 1, 1.0),
        ("share", "1e-5", 1e-5),
        ("flag", True, True),
        ("file", "a.yaml", "a.yaml"),
        ("file", None, None),
        ("size", [2, 3], (2, 3)),
        ("sizes", [1, 2, 3], (1, 2, 3)),
        ("most", "all", "all"),
        ("names", ["a"], ["a"]),
        ("options", {"a": 1}, {"a": 1}),
        ("anything", object, object),
    ],
)
def test_what_fits_is_read_in_its_declared_type(name: str, given: Any, read: Any) -> None:
    (found,) = read_values(Declared, {name: given}, "here").values()
    assert found == read and type(found) is type(read)


@pytest.mark.parametrize(
    ("name", "given", "expected"),
    [
        ("count", True, "a whole number"),
        ("count", 2.0, "a whole number"),
        ("share", "0.5x", "a number"),
        ("share", "nan", "a number"),
        ("share", False, "a number"),
        ("share", 10**400, "a number"),
        ("flag", 1, "true or false"),
        ("title", 3, "text"),
        ("file", 3, "a path or text or null"),
        ("size", [2], "[a whole number, a whole number] or null"),
        ("size", [2, True], "[a whole number, a whole number] or null"),
        ("sizes", [1, "2"], "[a whole number, ...]"),
        ("mode", "by", "one of near, far"),
        ("most", "some", "a whole number or all"),
        ("names", "a", "a list, each text"),
        ("options", [], "`name: value` lines or null"),
    ],
)
def test_what_does_not_fit_is_refused_in_words(name: str, given: Any, expected: str) -> None:
    with pytest.raises(ArgumentError) as refused:
        read_values(Declared, {name: given}, "here.yaml")
    assert str(refused.value) == f"here.yaml: {name}: expected {expected}, got {given!r}"


def test_an_unknown_name_is_refused_with_what_is_like_it() -> None:
    with pytest.raises(
        ArgumentError, match=r"^here: unknown rule 'size_'; expected one of count, .*\. Did you mean sizes? or"
    ):
        read_values(Declared, {"count": 1, "size_": 1}, "here", "rule")


def test_settings_below_one_are_named() -> None:
    require_positive("here", Declared(count=1, sizes=(1, 2)), "count", "sizes")
    with pytest.raises(ArgumentError, match=r"^here: count must be positive, got 0$"):
        require_positive("here", Declared(sizes=(1,)), "sizes", "count")
    with pytest.raises(ArgumentError, match=r"^here: sizes must be positive, got \(1, -2\)$"):
        require_positive("here", Declared(sizes=(1, -2)), "sizes")
