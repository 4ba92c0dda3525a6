# SPDX-License-Identifier: Apache-2.0
"""A disk cache of rollouts, so that the same request is computed once.

An entry is named by everything its frames depend on: the model (`WorldModel.fingerprint`: class, declared version,
options, weights), the bytes of the observation and its history, the control and the seed. A model without a version is
never cached. An entry holds the frames of one row, raw: a panorama is read in 0.1 ms and checked in 0.3 ms, where
unpacking it from PNG would take 10 ms. Files appear under their names whole, so any number of processes may share a
folder. When it outgrows its budget, what was not used for longest goes first.
"""

from __future__ import annotations

import fcntl
import logging
import os
import struct
import time
import uuid
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.loop.clock import time_separately
from wiw.loop.limits import BUDGET_GB
from wiw.loop.model_wrapper import ModelWrapper
from wiw.types import Conditioning, Control
from wiw.world_models.base import WorldModel

_log = logging.getLogger("wiw.rollouts")
_HEADER = struct.Struct("<8s6I")
"""Magic, first frame, frames, height, width, CRC-32 of the frames, CRC-32 of the header so far."""
_MAGIC = b"wiwroll1"
_CHANNELS = 3


def default_folder() -> Path:
    """Return where rollouts are kept: `$WIW_CACHE/rollouts`, or `~/.cache/wiw/rollouts`. Deleting it is always safe."""
    root = os.environ.get("WIW_CACHE")
    return (Path(root).expanduser() if root else Path.home() / ".cache/wiw") / "rollouts"


class RolloutCache:
    """A folder of rollouts.

    Args:
        folder: where; made when the first entry is written.
        budget_gb: most gigabytes that it may take.
    """

    def __init__(self, folder: str | Path, budget_gb: float = BUDGET_GB) -> None:
        if not budget_gb > 0:
            raise ArgumentError(f"cache: expected a budget above 0 GB, got {budget_gb}")
        self.folder, self.budget = Path(folder).expanduser(), int(budget_gb * 2**30)
        self._known: int | None = None
        """Bytes at the last look; what other processes have written since is not in it."""
        self._written = 0
        self._writing = True

    def get(self, key: str, first: int, frames: NDArray[np.uint8]) -> bool:
        """Fill `frames` [K, H, W, 3] with frames `first`... of an entry; False where none matches."""
        path = self._find_path(key)
        try:
            with path.open("rb", buffering=0) as file:
                found = self._read(file, first, frames)
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:  # such as no descriptor left: the entry, which may have been paid for, is as it was
            _log.warning("cached rollout %s cannot be read now (%s); it is imagined again", path, error)
            return False
        except ValueError as error:
            _log.warning("cached rollout %s is damaged (%s); it is dropped and imagined again", path, error)
            with suppress(OSError):
                path.unlink()
            return False
        if found:
            with suppress(OSError):
                os.utime(path)  # last use
        return found

    def put(self, key: str, first: int, frames: NDArray[np.uint8]) -> None:
        """Store frames `first`... of a row; if that fails, log a warning and stop writing."""
        data = np.ascontiguousarray(frames)
        size = _HEADER.size + data.nbytes
        if not self._writing or size > self.budget:
            return
        start = struct.pack("<8s5I", _MAGIC, first, *data.shape[:3], zlib.crc32(data.data))
        path = self._find_path(key)
        draft = path.with_suffix(f".{uuid.uuid4().hex}.draft")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with draft.open("wb") as file:
                file.write(start + struct.pack("<I", zlib.crc32(start)))
                file.write(data.data)
            draft.replace(path)
            self._written += size
            if self._known is None or self._known + self._written > self.budget or self._written > self.budget // 20:
                self._trim()
        except OSError as error:  # also of a file system without locks
            with suppress(OSError):
                draft.unlink(missing_ok=True)
            self._writing = False
            _log.warning(
                "rollouts are no longer cached: %s; free some disk space or choose another folder with --cache", error
            )

    def _find_path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key[2:]}.frames"

    def _read(self, file: Any, first: int, frames: NDArray[np.uint8]) -> bool:
        """Read a file's frames; raise ValueError where it is not what was written."""
        header = file.read(_HEADER.size)
        if len(header) != _HEADER.size or zlib.crc32(header[:-4]) != _HEADER.unpack(header)[-1]:
            raise ValueError("its header is truncated or altered")
        magic, begin, count, height, width, checksum, _ = _HEADER.unpack(header)
        if magic != _MAGIC or os.fstat(file.fileno()).st_size != _HEADER.size + count * height * width * _CHANNELS:
            raise ValueError("its size differs from what was written")
        if begin > first or begin + count != first + len(frames) or (height, width) != frames.shape[1:3]:
            return False
        data = frames if begin == first else np.empty((count, height, width, _CHANNELS), np.uint8)
        view = data.data.cast("B")
        while len(view) and (taken := file.readinto(view)):
            view = view[taken:]
        if len(view) or zlib.crc32(data.data) != checksum:
            raise ValueError("its checksum differs")
        if data is not frames:
            frames[:] = data[first - begin :]
        return True

    def _trim(self) -> None:
        """Where the folder exceeds its budget, delete the oldest entries until it is a tenth below."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / ".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            entries = self._list_entries()
            total = sum(size for _, size, _ in entries)
            for _, size, path in sorted(entries) if total > self.budget else ():
                if total <= 0.9 * self.budget:
                    break
                with suppress(OSError):
                    Path(path).unlink()
                total -= size
        self._known, self._written = total, 0

    def _list_entries(self) -> list[tuple[int, int, str]]:
        """Return last use, bytes and path of each file; drafts that a dead process left behind go after an hour."""
        found = []
        for folder in os.scandir(self.folder):
            for file in os.scandir(folder.path) if folder.is_dir() else ():
                with suppress(FileNotFoundError):  # another process has dropped it
                    state = file.stat()
                    if file.name.endswith(".draft") and state.st_mtime < time.time() - 3600:
                        Path(file.path).unlink()
                    else:
                        found.append((state.st_mtime_ns, state.st_size, file.path))
        return found


class Cached(ModelWrapper):
    """A world model that is asked only for rows that the cache does not hold."""

    def __init__(self, model: WorldModel, cache: RolloutCache) -> None:
        super().__init__(model)
        self.cache = cache
        self._cached_rows = 0
        self._identity = f"{model.fingerprint()} {replace(model.accepts, best_batch=1)}".encode()

    @property
    def spent(self) -> Mapping[str, float]:
        """Requests to the model, and `cached_rows` that it was not."""
        return {**super().spent, "cached_rows": self._cached_rows}

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return frames as `WorldModel.rollout` promises them; those that are never read may be left unwritten."""
        keys = [_make_key(self._identity, observations, row, control, seeds) for row, control in enumerate(controls)]
        own = [(1 + control.shared, 1 + control.length) for control in controls]
        frames = np.empty((len(controls), 1 + len(controls[0].actions), *observations.image.shape[1:]), np.uint8)
        with time_separately("cache"):
            frames[:, 0] = observations.image
            missing = [
                row
                for row, (key, (first, end)) in enumerate(zip(keys, own, strict=True))
                if first < end and not self.cache.get(key, first, frames[row, first:end])
            ]
        self._cached_rows += len(controls) - len(missing)
        if missing:
            fresh = self.model.rollout(observations.rows(missing), [controls[row] for row in missing], seeds[missing])
            with time_separately("cache"):
                for answer, row in zip(fresh, missing, strict=True):
                    first, end = own[row]
                    self.cache.put(keys[row], first, answer[first:end])
                    frames[row, first:end] = answer[first:end]
        return frames


def cache_rollouts(model: WorldModel, cache: str | Path = "auto", budget_gb: float = BUDGET_GB) -> WorldModel:
    """Return the model behind a cache: with "auto" if it is `cacheable`, never with "off", else in a folder.

    A model that is given the simulator is never cached: its answer depends on a whole scene, which no key can hold.
    Nor is one that cannot be identified (`WorldModel.fingerprint`), for nobody could tell when its answers change: a
    warning names it.
    """
    accepts = model.accepts
    if cache == "off" or "simulator" in accepts.needs or (cache == "auto" and not accepts.cacheable):
        return model
    if not model.fingerprint():
        _warn_unknown(type(model.unwrapped).__name__, bool(model.unwrapped.version))
        return model
    return Cached(model, RolloutCache(default_folder() if cache == "auto" else cache, budget_gb))


@lru_cache(None)
def _warn_unknown(name: str, has_version: bool) -> None:
    """Say once in a process that a model is not cached."""
    if has_version:
        _log.warning(
            "rollouts of %s are not cached: it was made with an object that does not identify it. Override describe() "
            "to name what its answers depend on; or leave the cache off",
            name,
        )
        return
    _log.warning(
        "rollouts of %s are not cached: it declares no version. Give the class one, such as `version = '1'`, and "
        "change it whenever its answers change; or leave the cache off",
        name,
    )


def _make_key(
    identity: bytes, observations: Conditioning, row: int, control: Control, seeds: NDArray[np.uint64]
) -> str:
    digest = blake2b(identity, digest_size=20)
    parts: list[Any] = [observations.image[row], control.actions, control.trajectory, control.viewpoints, seeds[row]]
    parts += [values[row] for values in (observations.depth, observations.semantic) if values is not None]
    if observations.history is not None:
        past = observations.history.rows([row])  # without the padding that the rest of the batch brings about
        parts += [past.images, past.poses, past.actions, past.lengths, past.count]
    if control.ids is not None:
        parts.append(control.ids)
    for part in parts:
        array = np.ascontiguousarray(part)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.data)
    digest.update(f"{control.length}{control.text}".encode())
    return digest.hexdigest()
