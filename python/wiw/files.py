# SPDX-License-Identifier: Apache-2.0
"""Files and folders that are there whole or not at all, whenever their writer is killed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from wiw.errors import FileError


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A file beside `path` to write to; it takes the place of `path` only once it is written whole.

    Raises:
        FileError: it cannot be written, for instance because the disk is full; `path` is as it was.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    with _write_draft(path, draft):
        path.parent.mkdir(parents=True, exist_ok=True)
        sweep(path.parent, path.name)
        yield draft
        _sync(draft)
        draft.replace(path)


@contextmanager
def atomic_folder(path: Path, replace: Callable[[Path], bool] = lambda folder: False) -> Iterator[Path]:
    """The same for a folder: an empty one beside `path` that becomes `path` once all is in it.

    Args:
        path: a folder that is not there yet, is empty, or that `replace` says may be replaced.
        replace: told what `path` holds.

    Raises:
        FileError: `path` holds something already, or cannot be written.
    """
    if path.exists() and (not path.is_dir() or (any(path.iterdir()) and not replace(path))):
        raise FileError(f"{path} holds something already; expected a folder that is new or empty: name another")
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    with _write_draft(path, draft):
        path.parent.mkdir(parents=True, exist_ok=True)
        sweep(path.parent, path.name)
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
    except OSError as error:
        raise FileError(
            f"{path}: cannot be written ({error.strerror or error}); expected a folder with free space and the right "
            "to write: make room or name another place. Nothing half-written is left"
        ) from error
    finally:
        _remove(draft)


def _old(path: Path) -> Path:
    """Where a folder that is replaced stays until the new one is in its place."""
    return path.with_name(f".{path.name}.old.{os.getpid()}.part")


def sweep(folder: Path, name: str = "*") -> None:
    """Takes away what writers of files of such a name in a folder have left if they were killed."""
    for draft in folder.glob(f".{name}.*.part"):
        if not _runs(draft.name.removesuffix(".part").rpartition(".")[2]):
            _remove(draft)


def _runs(pid: str) -> bool:
    """Whether there is such a process, and not as a zombie."""
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
