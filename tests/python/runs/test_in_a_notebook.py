# SPDX-License-Identifier: Apache-2.0
"""World models whose class exists in a Jupyter kernel alone."""

from __future__ import annotations

import ast

import pytest

MODEL = """
import numpy as np
import wiw
from wiw.runs.recipes import TaskRecipe

class Mine(wiw.WorldModel):
    accepts = wiw.accepts(control="trajectory", size=(48, 96), cacheable=True)
    version = "1"

    def rollout(self, observations, controls, seeds):
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        frames[:, 1:] //= 2
        return frames
"""
TOLD = "print(Mine().fingerprint())"
RUN = """
task = TaskRecipe("imagenav", {{"scenes": {scene!r}, "decisions": 1}})
arms = {{"none": "none", "mine": Mine(), "copy": "copy"}}
agent = wiw.Agent("matcher", Mine)
log = wiw.evaluate(task, agent, 2, out={out!r}, progress=False, cache="off", arms=arms)
print(([(row["arm"], row["status"]) for row in log.episodes], log.arms))
"""
WORKERS = """
try:
    wiw.evaluate(task, agent, 2, out={out!r}, progress=False, cache="off", workers=2)
except wiw.errors.InfrastructureError as error:
    print(error)
"""


@pytest.fixture
def printed(tmp_path):
    """Runs cells in one kernel; what each printed."""
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")

    def run(*cells):
        notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
        nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
        return ["".join(output.get("text", "") for output in cell.outputs).strip() for cell in notebook.cells]

    return run


def test_a_class_of_a_cell_is_named_by_its_version_evaluated_and_kept_from_worker_processes(
    printed, tmp_path, two_rooms
):
    run = RUN.format(scene=two_rooms, out=str(tmp_path / "run"))
    workers = WORKERS.format(out=str(tmp_path / "workers"))
    said = printed(MODEL, TOLD, MODEL.replace('"1"', '"2"'), TOLD, MODEL, TOLD, run, workers)
    first, edited, again = said[1], said[3], said[5]
    assert first == again != edited and len(first) == 40
    ended, arms = ast.literal_eval(said[6])
    assert arms == ["none", "mine", "copy"] and sorted(ended) == sorted(2 * [(arm, "done") for arm in arms])
    assert "cannot be rebuilt in a worker process" in said[7] and "path.py:Class" in said[7]
    assert "workers=1" in said[7]
