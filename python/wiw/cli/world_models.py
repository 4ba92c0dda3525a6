# SPDX-License-Identifier: Apache-2.0
"""Build the table of `wiw list world-models`: inputs, outputs, weights, and what each model lacks on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from wiw.registry import WORLD_MODELS

GAP = 2
"""Spaces between columns, and before the lines below a row."""
INPUT = 2
"""The column that is folded if the terminal is narrow."""
HEADS = ("name", "control", "input", "output", "size", "frames")
CAPTION = (
    "Control is how a model is told the plan. NAME-action is the paper's NAME†; remote: takes whatever its server "
    "takes. Weights are downloaded into the Hugging Face cache on first use; --world-model-option weights=FOLDER uses "
    "a local folder."
)


@dataclass(frozen=True)
class _Row:
    cells: tuple[str, ...]
    weights: str = ""
    status: str = ""
    style: str = ""


def world_models(width: int) -> Any:
    """List all registered models for a terminal of so many columns: a row each, weights and status below it."""
    from rich.console import Group
    from rich.text import Text

    rows = [_make_row(name) for name in WORLD_MODELS.names()]
    widths = [max(map(len, column)) for column in zip(HEADS, *(row.cells for row in rows), strict=True)]
    spare = width - sum(widths) - GAP * (len(widths) - 1)
    widths[INPUT] = max(widths[INPUT] + min(spare, 0), len("perspective"))
    lines = [_make_line(HEADS, widths, "bold"), _indent(Text("weights, and what is missing on this machine", "bold"))]
    for row in rows:
        said = Text.assemble((row.weights, "dim"), "  " if row.weights and row.status else "", (row.status, row.style))
        lines += [_make_line(row.cells, widths), _indent(said)]
    return Group(*lines, Text(), Text(CAPTION, "dim"))


def _make_line(cells: tuple[str, ...], widths: list[int], style: str = "") -> Any:
    from rich.table import Table
    from rich.text import Text

    line = Table.grid(padding=(0, GAP, 0, 0))
    for width in widths:
        line.add_column(width=width)
    line.add_row(*(Text(cell, style) for cell in cells))
    return line


def _indent(text: Any) -> Any:
    from rich.padding import Padding

    return Padding(text, (0, 0, 0, GAP), expand=False)


def _make_row(name: str) -> _Row:
    """Return the row of a registered model, with dashes for what is known only once it is built."""
    from wiw.world_models.base import find_accepts
    from wiw.world_models.status import lacks

    dashes = (name, *"-" * (len(HEADS) - 1))
    try:
        model = WORLD_MODELS.find(name)
    except Exception as error:  # a broken plugin must not hide the others
        return _Row(dashes, status=str(error), style="red")
    declared, requires = find_accepts(model), getattr(model, "requires", None)
    lacking = lacks(requires) if requires else []
    status = f"needs {', '.join(lacking)}" if lacking else "ready"
    style = "yellow" if lacking else "green"
    if declared is None:
        return _Row(dashes, status=status, style=style)
    height, width = declared.size
    takes = " + ".join((declared.view, *declared.needs))
    cells = (name, declared.control, takes, declared.view, f"{height}x{width}", str(declared.frames or "any"))
    return _Row(cells, requires.weights if requires else "", status, style)
