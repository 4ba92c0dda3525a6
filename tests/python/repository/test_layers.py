# SPDX-License-Identifier: Apache-2.0
"""Every edge between rooms points down, in C++ and in Python."""

from __future__ import annotations

import ast
import re
import sys
from functools import cache
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import Any

import pytest
from locations import ROOT

CPP_ROWS = [
    {"core"},
    {"panorama", "scene", "action", "metrics"},
    {"apartment", "render", "nav", "physics", "planner", "reproject", "annotate"},
    {"env"},
]
FACES = {
    "types",
    "typed_values",
    "weight_file",
    "errors",
    "benchmark",
    "file_systems",
    "files",
    "gymnasium_ids",
    "json_text",
    "mapping_files",
    "registry",
    "source_files",
    "suggestions",
    "networks",
    "process_limits",
    "ray_cluster",
    "panorama",
    "scenes",
    "render",
    "nav",
    "physics",
    "action",
    "annotate",
    "reproject",
}
PYTHON_ROWS = [
    {"_core"},
    FACES,
    {"wire"},
    {"datasets", "mapping", "metrics", "perception", "tabletop", "vlm"},
    {"envs", "judging", "policies", "scorers", "world_models"},
    {"isolation"},
    {"tasks", "loop", "training"},
    {"experiments"},
    {"runs"},
    {"analysis"},
    {"report"},
    {"viz", "serving", "studies"},
    {"cli"},
]


def row_of(room: str, rows: list[set[str]]) -> int:
    return next(i for i, row in enumerate(rows) if room in row)


def cpp_edges() -> set[tuple[str, str]]:
    edges = set()
    for file in (ROOT / "cpp/wiw").rglob("*.[ch]pp"):
        room = file.relative_to(ROOT / "cpp/wiw").parts[0]
        edges |= {(room, other) for other in re.findall(r'#include "wiw/(\w+)/', file.read_text()) if other != room}
    return edges


def load_structure() -> Any:
    """Load the script that measures a checkout; it finds imports and circles."""
    loader = SourceFileLoader("structure", str(ROOT / "scripts/structure"))
    module = module_from_spec(spec_from_loader("structure", loader))
    written, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # no cache beside the scripts
    try:
        loader.exec_module(module)
    finally:
        sys.dont_write_bytecode = written
    return module


STRUCTURE = load_structure()


@cache
def file_edges() -> dict[str, set[str]]:
    """Imports of each module, wherever they stand in the file: lazy ones and those for type checkers count."""
    package = ROOT / "python/wiw"
    return STRUCTURE.imports(package, {file: ast.parse(file.read_text()) for file in package.rglob("*.py")})


def python_edges() -> set[tuple[str, str]]:
    pairs = {(a.split(".")[0], b.split(".")[0]) for a, others in file_edges().items() for b in others}
    return {(a, b) for a, b in pairs if a != b}


@pytest.mark.parametrize("edge", sorted(cpp_edges()), ids="->".join)
def test_cpp_edges_point_down(edge: tuple[str, str]) -> None:
    assert row_of(edge[0], CPP_ROWS) > row_of(edge[1], CPP_ROWS)


def cpp_files() -> list[tuple[str, Path]]:
    """The C++ files of the core, each with the room it is in."""
    folder = ROOT / "cpp/wiw"
    return [(file.relative_to(folder).parts[0], file) for file in sorted(folder.rglob("*.[ch]pp"))]


def type_names(text: str) -> set[str]:
    """Return the types that a C++ text defines: classes, structs and enumerations, and aliases at namespace scope."""
    text = re.sub(r"//[^\n]*", "", text)
    definition = r"^\s*(?:class|struct|enum(?: class)?)\s+(?:alignas\(\w+\)\s+)?(\w+)[^;{()]*\{"
    defined = re.findall(definition, text, re.MULTILINE)
    return {*defined, *re.findall(r"^using (\w+) =", text, re.MULTILINE)}


def test_type_names_are_found() -> None:
    text = (
        "struct A;\nclass alignas(64) B final : public C {\n  enum class D { kE };\n};\nusing F = int;\nstruct G* g();"
    )
    assert type_names(text) == {"B", "D", "F"}


def test_each_room_has_its_namespace() -> None:
    for room, file in cpp_files():
        own = "wiw" if room == "core" else f"wiw::{room}"
        names = set(re.findall(r"^namespace (wiw[\w:]*) \{", file.read_text(), re.MULTILINE))
        assert all(name == own or (room != "core" and name.startswith(own + "::")) for name in names), (file, names)


def test_no_type_name_is_in_two_rooms() -> None:
    rooms: dict[str, set[str]] = {}
    for room, file in cpp_files():
        for name in type_names(file.read_text()):
            rooms.setdefault(name, set()).add(room)
    assert {name: found for name, found in rooms.items() if len(found) > 1} == {}


def test_python_edges_point_down() -> None:
    edges = python_edges()
    assert ("cli", "studies") in edges and len(edges) > 50
    wrong = {edge for edge in edges if row_of(edge[0], PYTHON_ROWS) <= row_of(edge[1], PYTHON_ROWS)}
    # faces speak each other's types, and all know the errors
    assert {(above, below) for above, below in wrong if not (above in FACES and below in FACES)} == set()


def test_the_core_knows_no_python() -> None:
    for file in (ROOT / "cpp/wiw").rglob("*.[ch]pp"):
        assert "pybind11" not in file.read_text(), file


def test_a_circle_of_files_is_found() -> None:
    assert STRUCTURE.circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [("a", "b", "c")]


def test_no_files_import_each_other_in_a_circle() -> None:
    assert STRUCTURE.circles(file_edges()) == []


def test_packages_have_their_code_in_modules() -> None:
    """An `__init__.py` holds a docstring and re-exports at most; some are lazy (`__getattr__`)."""
    package, found = ROOT / "python/wiw", set()
    for file in package.rglob("__init__.py"):
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("__"):
                found.add(str(file.parent.relative_to(package)))
    assert not found


@pytest.mark.parametrize(
    ("argument", "code", "said"), [("--help", 0, "usage: "), ("no/such/folder", 2, "expected a checkout of wiw")]
)
def test_the_script_explains_itself_and_refuses_other_folders(
    argument: str, code: int, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["structure", argument])
    with pytest.raises(SystemExit) as stopped:
        STRUCTURE.main()
    assert stopped.value.code == code
    assert said in "".join(capsys.readouterr())
