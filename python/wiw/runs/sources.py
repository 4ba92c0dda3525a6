# SPDX-License-Identifier: Apache-2.0
"""Track the user's source files that a run depends on, so that a run never mixes two versions of a model or policy."""

from __future__ import annotations

import ast
import inspect
import sysconfig
from collections.abc import Iterator, Mapping
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any

import wiw
from wiw.errors import StoreError
from wiw.isolation.child import Host
from wiw.isolation.source import Isolated
from wiw.world_models.function import Function

LIBRARIES = (
    Path(wiw.__file__).resolve().parent,
    *(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")),
)
"""Folders of code whose versions are recorded elsewhere."""


def source_digests(part: Any) -> dict[str, str]:
    """Return the digests, by path, of the files that define a class or function, or the class of an instance.

    This includes its base classes and the files next to them that they import, also inside functions, but not installed
    packages. For a class in the main script, only the class counts; for one in a notebook there is no file.
    """
    own = part if inspect.isclass(part) else type(part)
    if issubclass(own, Isolated):
        return dict(own.source.ask(_digest_loaded))
    while isinstance(part, partial):
        part = part.func
    part = part.function if isinstance(part, Function) else part
    thing = part if inspect.isclass(part) or inspect.isroutine(part) else type(part)
    found: dict[str, str] = {}
    for each in thing.__mro__ if inspect.isclass(thing) else (thing,):
        file = _find_source_file(each)
        if file is None:
            continue
        if each.__module__ == "__main__":
            found |= _digest_script(file, each)
        else:
            found |= {str(path): _digest(path.read_bytes()) for path in _with_imports(file)}
    return found


def _digest_loaded(host: Host) -> dict[str, str]:
    """Return the digests of what a separate process has loaded."""
    return source_digests(host.thing)


def require_sources(run: Path, begun_with: Mapping[str, str] | None, now: Mapping[str, str]) -> None:
    """Check that a run's source files are those it was started with; a run without a record of them passes.

    Raises:
        StoreError: a file has been changed, added or removed.
    """
    changed = [] if begun_with is None else [path for path in begun_with if begun_with[path] != now.get(path)]
    changed += [] if begun_with is None else [path for path in now if path not in begun_with]
    if changed:
        raise StoreError(
            f"{run}: source files have changed since the run was started: {', '.join(sorted(changed))}. Results of two "
            "versions must not be mixed: start a new run in another folder, or restore the files"
        )


def require_unchanged(begun_with: Mapping[str, str]) -> None:
    """Check that the source files of a run in progress have not changed, as agents that are built later read them
    again.

    Raises:
        StoreError: a file has been changed or removed.
    """
    files = {path: Path(path) for path in begun_with if SCRIPT not in path}
    now = {path: _digest(file.read_bytes()) for path, file in files.items() if file.is_file()}
    require_sources(Path("this run"), {path: begun_with[path] for path in files}, now)


def file_exists(path: str) -> bool:
    """Return whether the file of a digest still exists."""
    return Path(path.partition(SCRIPT)[0]).is_file()


SCRIPT = "::"
"""Between the path of a script and the name of its class."""


def _digest_script(file: Path, thing: Any) -> dict[str, str]:
    try:
        return {f"{file}{SCRIPT}{thing.__qualname__}": _digest(inspect.getsource(thing).encode())}
    except (OSError, TypeError):
        return {}


def _digest(content: bytes) -> str:
    return blake2b(content, digest_size=16).hexdigest()


def _find_source_file(thing: Any) -> Path | None:
    """Return the user's file that defines a class or function."""
    try:
        name = inspect.getsourcefile(thing)
    except (OSError, TypeError):
        return None
    path = None if name is None else Path(name).resolve()
    return path if path is not None and path.is_file() and not _is_library(path) else None


def _is_library(path: Path) -> bool:
    return any(path.is_relative_to(folder) for folder in LIBRARIES)


def _with_imports(file: Path) -> set[Path]:
    """Return a file and the user's files that it imports, directly or not."""
    found, waiting = set[Path](), [file]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _list_imports(path)
    return found


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
