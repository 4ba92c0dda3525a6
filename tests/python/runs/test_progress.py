# SPDX-License-Identifier: Apache-2.0
"""Progress of a run: what its lines say, and from where a run that goes on counts."""

from __future__ import annotations

from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from fakes import LineAgent, LineTask
from rich.console import Console

from wiw.runs.progress import ArmProgress, SilentBoard, TerminalBoard
from wiw.runs.store import RunStore
from wiw.studies.evaluate import run_arms


class RecordingBoard(SilentBoard):
    def __init__(self) -> None:
        self.texts: dict[str, list[str]] = {}

    def show(self, arm: str, progress: ArmProgress) -> None:
        self.texts.setdefault(arm, []).append(progress.text)


def test_a_run_that_goes_on_counts_from_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(resume: bool) -> Any:
        arms = {"copy": LineAgent(1.0), "oracle": LineAgent(1.0)}
        return run_arms(LineTask(), arms, 6, out=tmp_path / "run", resume=resume)

    run(resume=False)
    store = RunStore.resume(tmp_path / "run")
    store.discard("copy", [4, 5])
    store.close()
    board = RecordingBoard()
    monkeypatch.setattr("wiw.runs.execute.make_board", lambda _: board)
    run(resume=True)
    assert board.texts["copy"][0].startswith("4/6 episodes, SR 100 %")
    assert board.texts["copy"][-1].startswith("6/6 episodes, SR 100 %")
    assert board.texts["oracle"] == ["6/6 episodes, SR 100 %"]


def test_plain_lines_say_how_long_the_rest_takes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [100.0]
    monkeypatch.setattr("wiw.runs.progress.time.monotonic", lambda: now[0])
    board, progress = TerminalBoard(), ArmProgress(8, 20, ended=2, successes=2.0)
    board.show("warp", progress)  # two had ended before
    progress.decisions = 1
    board.show("warp", progress)
    for _ in range(6):
        now[0] += 30
        progress.count("done", {"success": 1.0})
        board.show("warp", progress)
    board.close()
    assert capsys.readouterr().err.splitlines() == [
        "warp: 4/8 episodes, SR 100 %, about 0:02:00 left",
        "warp: 6/8 episodes, SR 100 %, about 0:01:00 left",
        "warp: 8/8 episodes, SR 100 %",
    ]


@pytest.mark.parametrize("terminal", [True, False])
def test_names_with_brackets_are_shown_as_they_are(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rich would take them for markup, and stop at one that closes nothing."""
    shown = StringIO()
    monkeypatch.setattr("rich.console.Console", partial(Console, file=shown, force_terminal=terminal, width=100))
    board, progress = TerminalBoard(), ArmProgress(1, 1)
    for _ in range(2):
        board.show("warp[/size=144]", progress)
        progress.decisions = 1
        progress.count("done", {"success": 1.0})
    board.show("warp[/size=144]", progress)
    board.close()
    assert "warp[/size=144]" in shown.getvalue()
