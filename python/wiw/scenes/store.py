# SPDX-License-Identifier: Apache-2.0
"""Imported scenes on disk, mapped instead of read again.

A scene file is named by the content of everything it was made from: the files read, the options and the importer's
version. Beside it a small manifest remembers, for one source and its options, which files were read and which were
looked for in vain, so that an edited file or a texture that has turned up since makes the scene be built again. Files
appear under their names whole, so any number of processes may use the folder at once.
"""

from __future__ import annotations

import json
import logging
import os
import time
import uuid
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

from wiw import _core
from wiw.errors import FileError

_log = logging.getLogger("wiw.scenes")
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Sources:
    """Files that an import read, and files that it looked for and that were not there."""

    read: tuple[Path, ...]
    absent: tuple[Path, ...]


def folder() -> Path:
    """Where scenes are kept: `$WIW_CACHE/scenes`, or `~/.cache/wiw/scenes`. Deleting it is always safe."""
    root = os.environ.get("WIW_CACHE")
    return (Path(root).expanduser() if root else Path.home() / ".cache/wiw") / "scenes"


def imported(source: Path, options: dict[str, Any], build: Callable[[Path], Sources]) -> _core.scene.Scene:
    """The scene of `source` read with `options`: mapped if it is known and nothing it depends on has changed.

    `build(path)` imports the scene and writes it to `path`.
    """
    manifest = folder() / f"{_key([str(source.resolve()), options])}.json"
    known = _known(manifest)
    if known is not None:
        return known
    folder().mkdir(parents=True, exist_ok=True)
    draft = _draft(manifest)
    started = time.time_ns()
    try:
        sources = build(draft)
        entries = [_entry(path) for path in dict.fromkeys(sources.read)]
        names = [os.path.relpath(entry["path"], source.parent) for entry in entries]
        scene = folder() / f"{_key([names, [entry['digest'] for entry in entries], options])}.wiwscene"
        draft.replace(scene)
    finally:
        draft.unlink(missing_ok=True)
    if all(entry["mtime_ns"] < started for entry in entries):  # else a file may have changed while it was read
        absent = [str(path) for path in dict.fromkeys(sources.absent)]
        _write(manifest, {"scene": scene.name, "read": entries, "absent": absent})
    return _core.scene.map_cache(scene)


def generated(identity: Iterable[str | int], make: Callable[[], _core.scene.Scene]) -> _core.scene.Scene:
    """A scene that is a function of `identity` (generator, its version, seed, ...) alone: mapped, or made and kept."""
    path = folder() / f"{_key(list(identity))}.wiwscene"
    if path.exists():
        try:
            return _core.scene.map_cache(path)
        except FileError as error:
            _log.warning("built again: %s", error)
    path.parent.mkdir(parents=True, exist_ok=True)
    _core.scene.write_cache(make(), path)
    return _core.scene.map_cache(path)


def _key(parts: list[Any]) -> str:
    text = json.dumps([_core.scene.IMPORTER_VERSION, parts], sort_keys=True)
    return blake2b(text.encode(), digest_size=16).hexdigest()


def _draft(path: Path) -> Path:
    return path.with_name(f"{path.stem}.{uuid.uuid4().hex}.tmp")


def _digest(path: Path) -> str:
    state = blake2b(digest_size=16)
    with path.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            state.update(chunk)
    return state.hexdigest()


def _entry(path: Path) -> dict[str, Any]:
    status = path.stat()
    return {
        "path": str(path.absolute()),
        "bytes": status.st_size,
        "mtime_ns": status.st_mtime_ns,
        "digest": _digest(path),
    }


def _unchanged(entry: dict[str, Any]) -> bool:
    try:
        status = Path(entry["path"]).stat()
        if (status.st_size, status.st_mtime_ns) == (entry["bytes"], entry["mtime_ns"]):
            return True
        return status.st_size == entry["bytes"] and _digest(Path(entry["path"])) == entry["digest"]
    except OSError:
        return False


def _known(manifest: Path) -> _core.scene.Scene | None:
    """The mapped scene of a manifest that still holds; None if it has to be built."""
    try:
        facts = json.loads(manifest.read_text())
        if not all(map(_unchanged, facts["read"])) or any(Path(path).exists() for path in facts["absent"]):
            return None
        return _core.scene.map_cache(manifest.with_name(facts["scene"]))
    except FileNotFoundError:
        return None
    except (FileError, OSError, ValueError, KeyError, TypeError) as error:
        _log.warning("the scene cache is built again: %s", error)
        return None


def _write(path: Path, facts: dict[str, Any]) -> None:
    draft = _draft(path)
    draft.write_text(json.dumps(facts))
    draft.replace(path)
