# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ast
import math
from pathlib import Path
from typing import Any

import pytest
from locations import ROOT

from wiw.analysis.summary import show_utility
from wiw.analysis.utility import Utility

nbformat = pytest.importorskip("nbformat")

FOLDER = ROOT / "notebooks"
SIZES = {  # names of the cell that is tagged "parameters", and what is enough to run every cell
    "01_quickstart": {"decisions": 2},
    "02_compare_world_models": {"apartments": 2, "starts": 1, "decisions": 2},
    "03_plug_in_your_model": {"apartments": 2, "places": 16, "training_steps": 20, "starts": 1, "decisions": 2},
    "04_answer_questions": {"apartments": 4, "questions": 2, "actions": 15},
}

DEAR = ("02_compare_world_models", "03_plug_in_your_model", "04_answer_questions")
"""Run nightly: what they call is tested elsewhere, and each takes most of a minute."""


def set_parameters(notebook: Any, values: dict[str, Any]) -> None:
    """Add a cell with other values behind the one that is tagged "parameters", as papermill does."""
    (index,) = (i for i, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", ()))
    statements = ast.parse(notebook.cells[index].source).body
    names = {target.id for each in statements if isinstance(each, ast.Assign) for target in each.targets}
    assert names == set(values), "the test sets every size that the notebook declares"
    lines = [f"{name} = {value!r}" for name, value in values.items()]
    notebook.cells.insert(index + 1, nbformat.v4.new_code_cell("\n".join(lines)))


def test_every_notebook_is_run() -> None:
    assert sorted(SIZES) == sorted(path.stem for path in FOLDER.glob("*.ipynb"))


def test_a_notebook_says_of_a_utility_that_is_not_known_what_the_table_says() -> None:
    shown = show_utility(Utility("warp", math.nan, math.nan, math.nan, 4, 2, False))
    notebook = nbformat.read(FOLDER / "02_compare_world_models.ipynb", as_version=4)
    assert any(f"the table says *{shown}*" in cell.source for cell in notebook.cells)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] if name in DEAR else []) for name in SIZES]
)
def test_notebook_runs_from_top_to_bottom(name: str, tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    if any("import torch" in cell.source for cell in notebook.cells):
        pytest.importorskip("torch", reason="no torch: pip install 'wiw[torch]'")
    set_parameters(notebook, SIZES[name])
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert any("wiw-summary" in output.get("data", {}).get("text/html", "") for output in outputs)
