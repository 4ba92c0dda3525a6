# SPDX-License-Identifier: Apache-2.0
"""The files of docs/examples do what their pages say."""

from __future__ import annotations

from pathlib import Path

import pytest
from locations import ROOT

import wiw
from wiw.registry import METRICS

EXAMPLES = ROOT / "docs/examples"


def run(scene: str, tmp_path: Path, policy: str, model: str) -> wiw.RunLog:
    agent = wiw.Agent(policy, model, candidates=3)
    options = {"scenes": scene, "decisions": 2}
    return wiw.evaluate("imagenav", agent, 1, seed=0, out=tmp_path / "run", progress=False, **options)


def test_the_world_model_keeps_its_contract() -> None:
    findings = wiw.check_model(f"{EXAMPLES}/flat_world.py:FlatWorld")
    assert [finding for finding in findings if finding.serious] == []


def test_the_policy_decides_by_what_is_imagined(two_rooms: str, tmp_path: Path) -> None:
    seeker, flat = f"{EXAMPLES}/colour_seeker.py:ColourSeeker", f"{EXAMPLES}/flat_world.py:FlatWorld"
    log = run(two_rooms, tmp_path, seeker, flat)
    assert [episode["status"] for episode in log.episodes] == ["done"]
    decisions = list(log.decisions)
    assert len({score for row in decisions for score in row["scores"]}) > 2
    assert all(row["chosen"] == max(range(3), key=row["scores"].__getitem__) for row in decisions)


def test_the_metric_is_a_column(two_rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(METRICS.registered, "near", METRICS.find(f"{EXAMPLES}/near_miss.py:NEAR"))
    log = run(two_rooms, tmp_path, "heuristic", "copy")
    numbers = log.numbers()["copy"].estimates
    near = float(log.episodes[0]["metrics"]["distance_to_goal"] < 1.5)
    assert numbers["near"].value == pytest.approx(100 * near)


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.name)
def test_a_page_leads_to_each_example(file: Path) -> None:
    assert any(f"examples/{file.name}" in page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))
