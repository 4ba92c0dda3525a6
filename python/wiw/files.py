# SPDX-License-Identifier: Apache-2.0
"""Atomic writes of files and folders: complete or absent, even if the writer is killed."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path

from wiw.errors import FileError

ABANDONED = 86_400.0
"""Seconds after which an unchanged draft is abandoned, where its writer may be on another machine."""


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file beside `path`, which replaces `path` once it is complete.

    Raises:
        FileError: it cannot be written, for instance because the disk is full or `path` is a folder; `path` is as it
            was.
    """
    if path.is_dir():
        raise FileError(f"{path} is a folder; expected a file to write: add a file name")
    draft = _draft(path)
    with _write_draft(path, draft):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned_drafts(path.parent, path.name)
        yield draft
        _sync(draft)
        draft.replace(path)


def write_files(folder: Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Write files into a folder, each of them atomically, text as UTF-8; return their paths in the order of `contents`.

    Raises:
        FileError: one of them cannot be written.
    """
    for name, content in contents.items():
        with atomic_file(folder / name) as draft:
            draft.write_bytes(content.encode() if isinstance(content, str) else content)
    return [folder / name for name in contents]


@contextmanager
def atomic_folder(path: Path, replace: Callable[[Path], bool] = lambda folder: False) -> Iterator[Path]:
    """Yield an empty temporary folder beside `path`, which replaces `path` once it is complete.

    Args:
        path: a folder that is not there yet, is empty, or that `replace` says may be replaced.
        replace: called with `path`; whether its content may be replaced.

    Raises:
        FileError: `path` holds something already, or cannot be written.
    """
    if path.exists() and (not path.is_dir() or (any(path.iterdir()) and not replace(path))):
        raise FileError(f"{path} is not empty; expected a new or empty folder: choose another")
    draft = _draft(path)
    with _write_draft(path, draft):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned_drafts(path.parent, path.name)
        draft.mkdir()
        yield draft
        if path.is_dir() and any(path.iterdir()):
            path.rename(_old(path))
        draft.replace(path)
        _remove(_old(path))


@contextmanager
def _write_draft(path: Path, draft: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        if not _is_of_system(error):
            raise
        raise FileError(
            f"{path}: cannot be written ({getattr(error, 'strerror', None) or error}); expected a writable folder with "
            "free space: make room or choose another place. No partial file is left"
        ) from error
    finally:
        _remove(draft)


def _is_of_system(error: Exception) -> bool:
    """Return whether the system refused to write; safetensors reports that by an error of its own."""
    own = type(error).__name__ == "SafetensorError" and "I/O error" in str(error)
    return own or isinstance(error, OSError)


def _draft(path: Path) -> Path:
    """Return the temporary path beside `path` that no other process on any machine uses."""
    return path.with_name(f".{path.name}.{_place()}-{os.getpid()}.part")


def _old(path: Path) -> Path:
    """Return where a replaced folder stays until the new one is in place."""
    return _draft(path.with_name(f"{path.name}.old"))


@cache
def _place() -> str:
    """Return a short name of what process ids belong to: this machine since it was started, and a container of it."""
    known = os.uname().nodename
    with suppress(OSError):  # some sandboxes hide these
        known += Path("/proc/sys/kernel/random/boot_id").read_text() + str(Path("/proc/self/ns/pid").readlink())
    return sha256(known.encode()).hexdigest()[:8]


def remove_abandoned_drafts(folder: Path, name: str = "*") -> None:
    """Remove the temporary files that killed writers of files of such a name have left in a folder.

    Those of another machine that shares the folder, or from before a restart, go once they have not changed for a day.
    """
    for draft in folder.glob(f".{name}.*.part"):
        place, _, pid = draft.name.removesuffix(".part").rpartition(".")[2].partition("-")
        if not _runs(pid) if place == _place() else time.time() - _last_change(draft) > ABANDONED:
            _remove(draft)


def _last_change(draft: Path) -> float:
    """Return when a file or anything in a folder was changed last; infinity if it is gone."""
    try:
        return max(each.stat().st_mtime for each in (draft, *draft.rglob("*")))
    except OSError:
        return float("inf")


def _runs(pid: str) -> bool:
    """Return whether a process is running, and not a zombie."""
    try:
        return pid.isdigit() and Path("/proc", pid, "stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def _remove(draft: Path) -> None:
    if draft.is_dir():
        shutil.rmtree(draft, ignore_errors=True)
    else:
        with suppress(OSError):  # none was made, such as below a file
            draft.unlink()


def _sync(file: Path) -> None:
    with file.open("rb") as written:
        os.fsync(written.fileno())
