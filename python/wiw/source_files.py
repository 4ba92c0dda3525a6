# SPDX-License-Identifier: Apache-2.0
"""Find the user's source files: those of a class or function, and those that they import."""

from __future__ import annotations

import ast
import inspect
import sysconfig
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path
from typing import Any

LIBRARIES = (
    Path(__file__).resolve().parent,
    *(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")),
)
"""Folders of code whose versions are recorded elsewhere."""


def find_source_file(thing: Any) -> Path | None:
    """Return the user's file that defines a class or function; None for one of an installed package."""
    try:
        name = inspect.getsourcefile(thing)
    except (OSError, TypeError):
        return None
    path = None if name is None else Path(name).resolve()
    return path if path is not None and path.is_file() and not _is_library(path) else None


def find_imported_files(file: Path) -> set[Path]:
    """Return a file and the user's files that it imports, directly or not, also inside functions."""
    found, waiting = set[Path](), [file]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _list_imports(path)
    return found


def digest_source(content: bytes) -> str:
    """Return the digest of a source file's content."""
    return blake2b(content, digest_size=16).hexdigest()


def digest_imports(file: Path) -> str:
    """Return one digest of a file and the user's files that it imports: of their names and content, not their folder.

    Copies of a folder on several machines have the same digest.
    """
    found = sorted((path.name, digest_source(path.read_bytes())) for path in find_imported_files(file))
    return digest_source(repr(found).encode())


def _is_library(path: Path) -> bool:
    return any(path.is_relative_to(folder) for folder in LIBRARIES)


def _list_imports(file: Path) -> Iterator[Path]:
    """Return the user's files that a file imports."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):  # no Python, such as an extension's source
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _list_modules(_list_roots(file), alias.name)
        elif isinstance(node, ast.ImportFrom):
            roots = [file.parents[node.level - 1]] if node.level else _list_roots(file)
            for alias in node.names:
                yield from _list_modules(roots, ".".join(filter(None, (node.module, alias.name))))


def _list_roots(file: Path) -> list[Path]:
    """Return the folders from which a file imports: its own, as for a script, and that of its outermost package."""
    package = file.parent
    while (package / "__init__.py").is_file():
        package = package.parent
    return list(dict.fromkeys([file.parent, package]))


def _list_modules(roots: list[Path], name: str) -> Iterator[Path]:
    """Return the files that importing a dotted name runs: packages and module; the last part need not be a module."""
    parts = name.split(".")
    for root in roots:
        for count in range(1, len(parts) + 1):
            place = root.joinpath(*parts[:count])
            for path in (place.with_suffix(".py"), place / "__init__.py"):
                if path.is_file() and not _is_library(path.resolve()):
                    yield path.resolve()
