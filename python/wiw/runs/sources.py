# SPDX-License-Identifier: Apache-2.0
"""Track the user's source files that a run depends on, so that a run never mixes two versions of a model or policy."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from wiw.errors import StoreError
from wiw.isolation.child import Host
from wiw.isolation.source import Isolated
from wiw.source_files import digest_source, find_imported_files, find_source_file
from wiw.world_models.function import Function


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
        file = find_source_file(each)
        if file is None:
            continue
        if each.__module__ == "__main__":
            found |= _digest_script(file, each)
        else:
            found |= {str(path): digest_source(path.read_bytes()) for path in find_imported_files(file)}
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
    now = {path: digest_source(file.read_bytes()) for path, file in files.items() if file.is_file()}
    require_sources(Path("this run"), {path: begun_with[path] for path in files}, now)


def file_exists(path: str) -> bool:
    """Return whether the file of a digest still exists."""
    return Path(path.partition(SCRIPT)[0]).is_file()


SCRIPT = "::"
"""Between the path of a script and the name of its class."""


def _digest_script(file: Path, thing: Any) -> dict[str, str]:
    try:
        return {f"{file}{SCRIPT}{thing.__qualname__}": digest_source(inspect.getsource(thing).encode())}
    except (OSError, TypeError):
        return {}
