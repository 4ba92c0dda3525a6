# SPDX-License-Identifier: Apache-2.0
"""What the README shows runs as it stands, in a smaller scene."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import wiw

README = Path(__file__).parents[2] / "README.md"


@pytest.fixture
def blocks(two_rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The Python blocks, in order."""
    monkeypatch.chdir(tmp_path)
    found = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    smaller = {"apartments:val": two_rooms, "seed=0)": "seed=0, decisions=3)", "episodes=20": "episodes=1"}
    return [re.sub("|".join(map(re.escape, smaller)), lambda hit: smaller[hit[0]], block) for block in found]


def test_the_python_of_the_readme_runs(blocks: list[str]) -> None:
    names: dict[str, object] = {}
    for block in blocks[1:]:
        exec(block, names)
    assert names["over"] and names["log"].complete


def test_the_readmes_model_is_a_model(blocks: list[str], two_rooms: str, tmp_path: Path) -> None:
    still = "def my_network(image, paths, seeds):\n    return np.repeat(image[:, None], 1 + paths.shape[1], 1)\n"
    (tmp_path / "mymodel.py").write_text(blocks[0] + "\n\n" + still)
    log = wiw.evaluate("imagenav", wiw.Agent("matcher", "mymodel.py:MyModel"), 1, scenes=two_rooms, decisions=2)
    assert [episode["status"] for episode in log.episodes] == ["done"]
    assert np.isfinite(log.numbers()["mymodel"].estimates["success"].value)
