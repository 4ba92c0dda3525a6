# SPDX-License-Identifier: Apache-2.0
"""What the README and docs/python.md show runs as it stands, in a smaller scene; their links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from locations import ROOT

import wiw

PAGES = [ROOT / "README.md", ROOT / "docs/python.md"]
LINKED = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.fixture
def blocks(two_rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The Python blocks, in order."""
    monkeypatch.chdir(tmp_path)
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    found = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
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


@pytest.mark.parametrize("page", LINKED, ids=lambda page: page.name)
def test_links_and_named_documents_are_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    assert [link for link in links if link and not (page.parent / link).exists()] == []
    named = re.findall(r"`((?:docs|python|scripts|notebooks|configs)/[\w./-]+)`", text)
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_the_index_leads_to_every_page() -> None:
    index = (ROOT / "docs/README.md").read_text(encoding="utf-8")
    pages = {page.name for page in (ROOT / "docs").glob("*.md")} - {"README.md"}
    assert sorted(page for page in pages if f"({page})" not in index) == []


def test_the_readme_names_every_world_model_and_is_short() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    listed = [name for name in wiw.registry.WORLD_MODELS.built_in if not name.endswith(("-action", ":"))]
    assert [name for name in listed if f"`{name}`" not in text] == []
    assert len(text.splitlines()) < 160
    assert (ROOT / "docs/decision.png").stat().st_size < 300_000
