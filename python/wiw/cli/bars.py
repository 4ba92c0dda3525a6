# SPDX-License-Identifier: Apache-2.0
"""Progress bars of a collection; plain lines at each quarter if the output is not a terminal."""

from __future__ import annotations

from typing import Any


class Bars:
    """Named bars on standard error, which appear when they are first shown."""

    def __enter__(self) -> Bars:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self._console = Console(stderr=True)
        name = TextColumn("{task.description:<12}", style="bold", markup=False)
        text = TextColumn("{task.fields[text]}", markup=False)
        times = TimeElapsedColumn(), TextColumn("<"), TimeRemainingColumn()
        columns = name, BarColumn(bar_width=32), text, *times
        self._bars = Progress(*columns, console=self._console, disable=not self._console.is_terminal)
        self._tasks: dict[str, Any] = {}
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def show(self, name: str, done: int, total: int, text: str) -> None:
        """Move a bar to `done` of `total`, which may grow, with a text beside it that is shown as it is."""
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(name, total=total, text=text)
        before = self._bars.tasks[self._tasks[name]].completed
        self._bars.update(self._tasks[name], completed=done, total=total, text=text)
        if not self._console.is_terminal and 4 * done // max(1, total) > 4 * before // max(1, total):
            self._console.print(f"{name}: {text}", highlight=False, markup=False)
