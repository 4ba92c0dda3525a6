# SPDX-License-Identifier: Apache-2.0
"""Progress bars, one per arm: in a terminal by rich, in a notebook by the browser."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any, Protocol

from wiw.types import EpisodeResult


@dataclass
class ArmProgress:
    """Progress of one arm, and its success rate so far."""

    total: int
    """Episodes of the arm, those included that ended before this process began."""
    decisions_each: int = 1
    """Maximum number of decisions an episode may take; ends early where the goal is reached."""
    ended: int = 0
    errors: int = 0
    successes: float = 0.0
    decisions: int = 0

    def count(self, status: str, metrics: Mapping[str, float]) -> None:
        """Count an episode that has ended."""
        self.ended += 1
        self.errors += status == "error"
        self.successes += metrics.get("success", 0.0)

    @property
    def begun(self) -> bool:
        """Whether a decision has been taken since this process began."""
        return self.decisions > 0

    @property
    def share(self) -> float:
        """0 to 1; decisions of running episodes count in part, so that the bar moves from the start."""
        running = self.decisions / max(1, self.decisions_each)
        return min(1.0, (self.ended + min(running, 0.95 * (self.total - self.ended))) / max(1, self.total))

    @property
    def text(self) -> str:
        """E.g. "7/20 episodes, SR 43 %"."""
        scored = self.ended - self.errors
        rate = f", SR {100 * self.successes / scored:.0f} %" if scored else ""
        count = "1 error" if self.errors == 1 else f"{self.errors} errors"
        return f"{self.ended}/{self.total} episodes{rate}{f', {count}' if self.errors else ''}"


@dataclass
class AnswerProgress:
    """Progress of judging answers."""

    total: int
    ended: int = 0
    errors: int = 0

    @property
    def share(self) -> float:
        """0 to 1."""
        return self.ended / max(1, self.total)

    @property
    def begun(self) -> bool:
        """Always: judging begins with the first answer."""
        return True

    @property
    def text(self) -> str:
        """E.g. "7/20 answers, 1 error"."""
        count = "1 error" if self.errors == 1 else f"{self.errors} errors"
        return f"{self.ended}/{self.total} answers{f', {count}' if self.errors else ''}"


class Progress(Protocol):
    """Progress of a piece of work, as a board shows it."""

    @property
    def total(self) -> int:
        """Parts of the work."""

    @property
    def ended(self) -> int:
        """Parts that are done."""

    @property
    def begun(self) -> bool:
        """Whether anything has been done since this process began."""

    @property
    def share(self) -> float:
        """0 to 1."""

    @property
    def text(self) -> str:
        """The state in words."""


class Board(Protocol):
    """Displays progress."""

    def show(self, arm: str, progress: Progress) -> None:
        """Show the new state of an arm, or of another piece of work."""

    def note(self, text: str) -> None:
        """Show a sentence that stays."""

    def close(self) -> None:
        """Finish: the run has ended or was stopped."""


class Tracker:
    """Counts decisions and episodes of a run and updates the board."""

    def __init__(self, arms: Mapping[str, ArmProgress], decisions_each: int, board: Board) -> None:
        self._arms = {arm: replace(progress, decisions_each=decisions_each) for arm, progress in arms.items()}
        self._running: dict[tuple[str, int], int] = {}
        self._board = board
        for arm, progress in self._arms.items():
            board.show(arm, progress)

    def decision(self, arm: str, episode: int) -> None:
        """Count a decision."""
        self._running[arm, episode] = self._running.get((arm, episode), 0) + 1
        self._arms[arm].decisions += 1
        self._board.show(arm, self._arms[arm])

    def forget(self, arm: str, episode: int) -> None:
        """Drop the decisions of an episode that has ended or starts again."""
        self._arms[arm].decisions -= self._running.pop((arm, episode), 0)

    def episode(self, arm: str, result: EpisodeResult) -> None:
        """Count an episode that has ended."""
        self.forget(arm, result.episode)
        progress = self._arms[arm]
        progress.count(result.status, result.metrics)
        self._board.show(arm, progress)

    def note(self, text: str) -> None:
        """Show a sentence that stays."""
        self._board.note(text)


class SilentBoard:
    """Displays nothing."""

    def show(self, arm: str, progress: Progress) -> None:
        """Do nothing."""

    def note(self, text: str) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class TerminalBoard:
    """Rich bars; plain lines at quarter marks where the output is not a terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self._console = Console(stderr=True)
        self._bars = Progress(
            TextColumn("{task.description:<12}", style="bold", markup=False),
            BarColumn(bar_width=32),
            TextColumn("{task.fields[text]}", markup=False),
            TimeElapsedColumn(),
            TextColumn("<"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._tasks: dict[str, Any] = {}
        self._quarters: dict[str, int] = {}
        self._begun: dict[str, tuple[float, int]] = {}
        self._bars.start()

    def show(self, arm: str, progress: Progress) -> None:
        """Move the arm's bar."""
        if not self._console.is_terminal:
            self._line(arm, progress)
            return
        if arm not in self._tasks:
            self._tasks[arm] = self._bars.add_task(arm, total=1.0, text="waiting", start=False)
        if progress.share > 0 and not self._bars.tasks[self._tasks[arm]].started:
            self._bars.start_task(self._tasks[arm])
        self._bars.update(self._tasks[arm], completed=progress.share, text=progress.text)

    def _line(self, arm: str, progress: Progress) -> None:
        quarter = 4 * progress.ended // max(1, progress.total)
        if arm not in self._quarters:
            self._quarters[arm] = quarter
        if arm not in self._begun and progress.begun:
            self._begun[arm] = time.monotonic(), progress.ended
        if quarter > self._quarters[arm]:
            self._quarters[arm] = quarter
            self.note(f"{arm}: {progress.text}{self._describe_time_left(arm, progress)}")

    def _describe_time_left(self, arm: str, progress: Progress) -> str:
        """Return e.g. ", about 0:12:30 left" for the arm; empty at its end."""
        begin, before = self._begun.get(arm, (0.0, progress.ended))
        left = progress.total - progress.ended
        if not left or progress.ended == before:
            return ""
        seconds = left * (time.monotonic() - begin) / (progress.ended - before)
        return f", about {timedelta(seconds=round(seconds))} left"

    def note(self, text: str) -> None:
        """Print it above the bars."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Leave the bars as they are."""
        self._bars.stop()


class NotebookBoard:
    """HTML bars in a cell's output; needs no widgets."""

    def __init__(self) -> None:
        from IPython.display import HTML, display

        self._html = HTML
        self._arms: dict[str, Progress] = {}
        self._notes: list[str] = []
        self._shown = 0.0
        self._handle = display(HTML(""), display_id=True)

    def show(self, arm: str, progress: Progress) -> None:
        """Redraw, at most five times per second."""
        self._arms[arm] = progress
        if time.monotonic() - self._shown > 0.2:
            self._draw()

    def _draw(self) -> None:
        from html import escape

        self._shown = time.monotonic()
        rows = "".join(
            f"<tr><td><b>{escape(arm)}</b></td><td><progress value='{p.share:.3f}' max='1'></progress></td>"
            f"<td>{p.text}</td></tr>"
            for arm, p in self._arms.items()
        )
        notes = "".join(f"<p>{escape(note)}</p>" for note in self._notes)
        self._handle.update(self._html(f"<table>{rows}</table>{notes}"))

    def note(self, text: str) -> None:
        """Show it below the bars."""
        self._notes.append(text)
        self._draw()

    def close(self) -> None:
        """Draw the last state."""
        self._draw()


def make_board(wanted: bool) -> Board:
    """Return a board for a terminal or a notebook, or one that displays nothing."""
    if not wanted:
        return SilentBoard()
    return NotebookBoard() if in_notebook() else TerminalBoard()


def in_notebook() -> bool:
    """Return whether a notebook shows the value of this cell, so that printing it would show it twice."""
    if "IPython" not in sys.modules:  # a notebook has it loaded, and elsewhere loading it takes longer than a short run
        return False
    from IPython import get_ipython

    return type(get_ipython()).__name__ == "ZMQInteractiveShell"
