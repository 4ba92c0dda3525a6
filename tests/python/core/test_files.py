# SPDX-License-Identifier: Apache-2.0
"""Files are complete or absent, and writers leave alone what others are writing."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wiw import files
from wiw.errors import FileError
from wiw.files import atomic_file, remove_abandoned_drafts


def test_a_folder_is_not_a_file_to_write(tmp_path: Path) -> None:
    (tmp_path / "report").mkdir()
    expected = "report is a folder; expected a file to write: add a file name"
    with pytest.raises(FileError, match=expected), atomic_file(tmp_path / "report"):
        raise AssertionError("work begins although nothing can be written")


@pytest.mark.parametrize(
    ("place", "alive", "days", "stays"),
    [
        ("here", True, 3, True),
        ("here", False, 0, False),
        ("elsewhere", False, 0, True),
        ("elsewhere", True, 3, False),
    ],
)
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_only_abandoned_drafts_are_removed(
    tmp_path: Path, kind: str, place: str, alive: bool, days: float, stays: bool
) -> None:
    """A process id says something on its own machine only; elsewhere the last change does."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    owner = f"{files._place() if place == 'here' else '0' * 8}-{os.getppid() if alive else ended.pid}"
    draft = tmp_path / f".table.parquet.{owner}.part"
    inside = draft / "half" if kind == "folder" else draft
    inside.parent.mkdir(exist_ok=True)
    inside.write_bytes(b"half")
    changed = time.time() - days * 86_400
    for each in {inside, draft}:
        os.utime(each, (changed, changed))
    remove_abandoned_drafts(tmp_path, "other.parquet")
    assert draft.exists()
    with atomic_file(tmp_path / "table.parquet") as own:
        own.write_bytes(b"whole")
    assert draft.exists() is stays and (tmp_path / "table.parquet").read_bytes() == b"whole"
