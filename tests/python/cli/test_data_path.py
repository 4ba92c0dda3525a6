# SPDX-License-Identifier: Apache-2.0
"""The ten calls of docs/architecture.md are those that a run makes, in that order."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import FrameType

from locations import ROOT

from wiw.cli import main

PACKAGE = f"{ROOT / 'python/wiw'}/"
OPTIONS = ["--policy", "heuristic", "--world-model", "copy", "--episodes", "1", "--task-option", "decisions=1"]


def test_a_run_makes_the_calls_of_the_document(two_rooms: str, tmp_path: Path) -> None:
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    expected = [(file, call) for call, file in re.findall(r"^\| \d+ \| `(\w+)` \| `([\w./]+)` \|", text, re.MULTILINE)]
    calls: list[tuple[str, str]] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        file = frame.f_code.co_filename
        if event == "call" and file.startswith(PACKAGE):
            calls.append((file.removeprefix(PACKAGE), frame.f_code.co_name))

    sys.setprofile(note)
    try:
        assert main(["run", "imagenav", "--scenes", two_rooms, *OPTIONS, "--no-report", "--out", str(tmp_path)]) == 0
    finally:
        sys.setprofile(None)
    assert len(expected) == 10
    place = -1
    for call in expected:  # `write` of the store also writes the agent's row, so the order counts, not the first time
        assert call in calls[place + 1 :], f"{call} is not called, or not after the one before"
        place = calls.index(call, place + 1)
