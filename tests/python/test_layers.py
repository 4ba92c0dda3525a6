# SPDX-License-Identifier: Apache-2.0
"""Every edge between rooms points down, in C++ and in Python."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CPP_ROWS = [
    {"core"},
    {"panorama", "scene", "action", "metrics"},
    {"render", "nav", "physics", "planner", "reproject", "annotate"},
    {"env"},
]
FACES = {
    "types",
    "weight_file",
    "errors",
    "files",
    "json_text",
    "registry",
    "networks",
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
    {"datasets", "metrics", "perception", "tabletop", "vlm", "wire"},
    {"envs", "policies", "world_models"},
    {"tasks", "loop", "training"},
    {"evaluation"},
    {"viz", "serving"},
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


def imported(tree: ast.AST) -> set[str]:
    rooms = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "wiw":
            parts = node.module.split(".")
            rooms |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            rooms |= {a.name.split(".")[1] for a in node.names if a.name.startswith("wiw.")}
    return rooms


def python_edges() -> set[tuple[str, str]]:
    package = ROOT / "python/wiw"
    edges = set()
    for file in package.rglob("*.py"):
        room = file.relative_to(package).parts[0].removesuffix(".py")
        if room != "__init__":
            edges |= {(room, other) for other in imported(ast.parse(file.read_text())) if other != room}
    return edges


@pytest.mark.parametrize("edge", sorted(cpp_edges()), ids="->".join)
def test_cpp_edges_point_down(edge: tuple[str, str]) -> None:
    assert row_of(edge[0], CPP_ROWS) > row_of(edge[1], CPP_ROWS)


@pytest.mark.parametrize("edge", sorted(python_edges()), ids="->".join)
def test_python_edges_point_down(edge: tuple[str, str]) -> None:
    above, below = edge
    if above in FACES and below in FACES:  # faces speak each other's types, and all know the errors
        return
    assert row_of(above, PYTHON_ROWS) > row_of(below, PYTHON_ROWS)


def test_the_core_knows_no_python() -> None:
    for file in (ROOT / "cpp/wiw").rglob("*.[ch]pp"):
        assert "pybind11" not in file.read_text(), file
