# SPDX-License-Identifier: Apache-2.0
"""A disk cache of imported and generated scenes, which are memory-mapped instead of rebuilt.

A scene file is named by the content of everything it was made from: the files read, the options and the importer's
version. Beside it a small manifest remembers, for one source and its options, which files were read and which were
looked for in vain, so that an edited file or a texture that has turned up since makes the scene be built again. Files
appear under their names whole, so any number of processes may use the folder at once. When the folder outgrows its
limit, the scenes that were not used for longest go first; processes that have them mapped keep them. On a network file
system, those of other machines would not, so scenes used in the last week stay there.
"""

from __future__ import annotations

import fcntl
import json
import logging
import math
import os
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

from wiw import _core
from wiw.errors import ArgumentError, FileError
from wiw.file_systems import find_network

_log = logging.getLogger("wiw.scenes")
_CHUNK = 1 << 20
LIMIT_GB = 8.0
"""Most gigabytes that scenes may take; an apartment takes 15 MB. `$WIW_CACHE_GB` sets another limit."""
DRAFT_LIFETIME = 24 * 3600
"""Seconds after which nobody can be writing a draft any more."""
SHARED_LIFETIME = 7 * 24 * 3600
"""Seconds after its last opening for which a scene on a network file system may be mapped by another machine."""


@dataclass(frozen=True)
class Sources:
    """Files that an import read, and files that it looked for and that were not there."""

    read: tuple[Path, ...]
    absent: tuple[Path, ...]


def folder() -> Path:
    """Return where scenes are kept: `$WIW_CACHE/scenes`, or `~/.cache/wiw/scenes`. Deleting it is always safe."""
    root = os.environ.get("WIW_CACHE")
    return (Path(root).expanduser() if root else Path.home() / ".cache/wiw") / "scenes"


def load_imported(source: Path, options: dict[str, Any], build: Callable[[Path], Sources]) -> _core.scene.Scene:
    """Return the scene of `source` read with `options`: mapped if it is known and nothing it depends on has changed.

    `build(path)` imports the scene and writes it to `path`. Paths in `options` must be absolute. A link to a source
    counts as another source: its textures are looked for beside the link. Where the folder cannot be written, a
    warning says so and the scene is kept for this process alone.
    """
    manifest = folder() / f"{_key([str(source.absolute()), options])}.json"
    known = _find_known(manifest)
    if known is not None:
        return known
    draft = _draft(manifest)
    try:
        folder().mkdir(parents=True, exist_ok=True)
        draft.touch()
    except OSError as error:
        _log.warning("an imported scene cannot be cached and will be imported again next time: %s", error)
        return temporary(build)
    started = time.time_ns()
    try:
        sources = build(draft)
        built = _core.scene.map_cache(draft)  # before another process can see the scene and trim it
        entries = [_entry(path) for path in dict.fromkeys(sources.read)]
        names = [os.path.relpath(entry["path"], source.absolute().parent) for entry in entries]
        scene = folder() / f"{_key([names, [entry['digest'] for entry in entries], options])}.wiwscene"
        draft.replace(scene)
    finally:
        for path in (draft, *draft.parent.glob(f"{draft.name}.*")):  # a killed importer leaves a draft of the draft
            path.unlink(missing_ok=True)
    _trim(scene)
    if all(entry["mtime_ns"] < started for entry in entries):  # else a file may have changed while it was read
        absent = [str(path.absolute()) for path in dict.fromkeys(sources.absent)]
        _write(manifest, {"scene": scene.name, "read": entries, "absent": absent})
    return built


def temporary(build: Callable[[Path], Any]) -> _core.scene.Scene:
    """Map the scene that `build(path)` writes from a file that is removed at once; the mapping outlives it."""
    with TemporaryDirectory(prefix="wiw-scene-") as place:
        build(Path(place) / "scene")
        return _core.scene.map_cache(Path(place) / "scene")


def load_generated(identity: Iterable[str | int], make: Callable[[], _core.scene.Scene]) -> _core.scene.Scene:
    """Return a scene that depends on `identity` (generator, version, seed, ...) alone: mapped, or generated.

    Processes that request the same scene at the same time build it once. Where it cannot be stored, for lack of space
    or permission, a warning says so and the scene is in memory only.
    """
    path = folder() / f"{_key(list(identity))}.wiwscene"
    with _turn(path):
        known = _map_scene(path)
        return _keep_scene(make(), path) if known is None else known


@cache
def build_digest() -> str:
    """Return the digest of the compiled core, which names every version of the generators in it."""
    return _digest(Path(_core.__file__))


def limit() -> float:
    """Return the maximum number of bytes that scenes may take on disk.

    Raises:
        ArgumentError: `$WIW_CACHE_GB` is not a number of gigabytes.
    """
    text = os.environ.get("WIW_CACHE_GB", str(LIMIT_GB))
    try:
        gigabytes = float(text)
    except ValueError:
        gigabytes = -1.0
    if not gigabytes >= 0:
        raise ArgumentError(f"WIW_CACHE_GB: expected a number of gigabytes, got '{text}'")
    return gigabytes * 2**30


def _keep_scene(scene: _core.scene.Scene, path: Path) -> _core.scene.Scene:
    """Return the scene mapped from its new file; the scene itself where the file cannot be written."""
    try:
        _core.scene.write_cache(scene, path)
        _trim(path)
        return _core.scene.map_cache(path)
    except (FileError, OSError) as error:
        _log.warning("a generated scene cannot be cached and will be generated again next time: %s", error)
        return scene


@contextmanager
def _turn(path: Path) -> Iterator[None]:
    """Let one process or thread at a time create `path`; where nothing can be locked, all at once."""
    name = path.with_suffix(".lock")
    lock = _open_lock(name)
    try:
        yield
    finally:
        if lock is not None:
            with suppress(OSError):
                name.unlink()
            lock.close()


def _open_lock(name: Path) -> IO[str] | None:
    try:
        name.parent.mkdir(parents=True, exist_ok=True)
        lock = name.open("w")
    except OSError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
    except OSError:  # e.g. a network disk without locks
        lock.close()
        return None
    return lock


def _map_scene(path: Path) -> _core.scene.Scene | None:
    """Map the scene kept at `path` and mark it as used; None if there is none or, with a warning, a damaged one."""
    if not path.exists():
        return None
    try:
        scene = _core.scene.map_cache(path)
    except FileError as error:
        _log.warning("rebuilt: %s", error)
        return None
    with suppress(OSError):
        os.utime(path)
    return scene


def _trim(newest: Path) -> None:
    """Remove scenes, those unused for longest first, until the others fit the limit; never `newest`.

    Drafts that killed processes left go too.
    """
    _remove_abandoned_drafts(newest.parent)
    scenes = []
    for path in newest.parent.glob("*.wiwscene"):
        with suppress(FileNotFoundError):  # another process trims as well
            status = path.stat()
            scenes.append((status.st_mtime_ns, status.st_size, path))
    excess = sum(size for _, size, _ in scenes) - limit()
    latest = time.time() - SHARED_LIFETIME if excess > 0 and find_network(newest) else math.inf
    for used, size, path in sorted(scenes):
        if excess > 0 and path != newest and used < latest * 1e9:
            path.unlink(missing_ok=True)
            excess -= size


def _remove_abandoned_drafts(place: Path) -> None:
    for path in place.glob("*.tmp"):
        with suppress(OSError):  # another process removes them as well
            if time.time() - path.stat().st_mtime > DRAFT_LIFETIME:
                path.unlink()


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


def _is_unchanged(entry: dict[str, Any]) -> bool:
    try:
        status = Path(entry["path"]).stat()
        if (status.st_size, status.st_mtime_ns) == (entry["bytes"], entry["mtime_ns"]):
            return True
        return status.st_size == entry["bytes"] and _digest(Path(entry["path"])) == entry["digest"]
    except OSError:
        return False


def _find_known(manifest: Path) -> _core.scene.Scene | None:
    """Return the mapped scene of a manifest that still holds; None if it has to be built."""
    try:
        facts = json.loads(manifest.read_text())
        if not all(map(_is_unchanged, facts["read"])) or any(Path(path).exists() for path in facts["absent"]):
            return None
        return _map_scene(manifest.with_name(facts["scene"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        _log.warning("the scene cache is rebuilt: %s", error)
        return None


def _write(path: Path, facts: dict[str, Any]) -> None:
    draft = _draft(path)
    draft.write_text(json.dumps(facts))
    draft.replace(path)
