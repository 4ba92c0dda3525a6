# SPDX-License-Identifier: Apache-2.0
"""The commands of docs/reproduce.md, in order, on small scans, with a mock language model and `copy` for `svd`."""

from __future__ import annotations

import gzip
import html
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import scan_files as files
from locations import ROOT

import wiw
from wiw.cli import main

pytest.importorskip("opengl_basisu", reason="no opengl_basisu: pip install 'wiw[hm3d]'")
pytest.importorskip("openai", reason="no openai: pip install 'wiw[vlm]'")

PAGE = ROOT / "docs/reproduce.md"
STANDS_IN = {"svd": "copy", "none,svd": "none,copy", "http://localhost:8000/v1": "mock", "sam2": "flow"}
SHORTER = ["--task-option", "decisions=2"]
PROMPT = r"""
\begin{tcolorbox}[
  title=ImageNav Planner Prompt
]
You see its \{\texttt{obs\_key}\}. Give the next \texttt{<\{look\_ahead\_action\_num\}>} actions.
\end{tcolorbox}
"""


def list_commands() -> list[str]:
    blocks = re.findall(r"```bash\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return [line for block in blocks for line in block.splitlines()]


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Both datasets and their episode files, in the published layouts."""
    mp3d = files.write_matterport(tmp_path / "mp3d")
    hm3d = files.write_hm3d(tmp_path / "hm3d")
    here: dict[str, Any] = {"episode_id": 0, "start_position": [4.6, 0.0, -3.2], "start_rotation": [1.0, 0.0, 0.0, 0.0]}
    seen = {"scene_id": f"/there/mp3d/{mp3d.stem}/{mp3d.name}", "target_id": files.TABLE, "target_categrory": "table"}
    write_gzip(tmp_path / "episodes_AR.json.gz", {"episodes": [{**here, **seen, "difficulty": 1}]})
    goal = {"goal_position": [5.2, 0.0, -1.4], "goal_rotation": [1.0, 0.0, 0.0, 0.0], "goal_radius": 0.5}
    place = {"datum_id": 1, "scene_relpath": str(hm3d.relative_to(tmp_path)), "goal_image_relpath": "images/1.png"}
    write_gzip(
        tmp_path / "episodes_IGNav.json.gz", {"version": 1, "data": [{**here, **goal, **place, "step_to_goal": 9}]}
    )
    return tmp_path


def write_gzip(path: Path, body: object) -> None:
    path.write_bytes(gzip.compress(json.dumps(body).encode()))


def test_the_pages_commands_run_in_order(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "paper.tex").write_text(PROMPT)
    places = {"$DATA": str(data), "$PAPER": str(tmp_path / "paper.tex")}
    commands = list_commands()
    assert len(commands) == 9
    for command in commands:
        words = [STANDS_IN.get(word, word) for word in shlex.split(command)]
        for name, place in places.items():
            words = [word.replace(name, place) for word in words]
        shorter = SHORTER if words[1] == "run" else []
        assert words[0] == "wiw" and main([*words[1:], *shorter]) == 0, (command, capsys.readouterr().err)
    for run in ("runs/ar", "runs/imagenav"):
        assert [row["status"] for row in wiw.load_run(run).episodes] == ["done"] * 2
        assert "not the paper's protocol" in html.unescape((tmp_path / run / "report.html").read_text())
