# SPDX-License-Identifier: Apache-2.0
"""A run is of one version of the user's own files: resumed, verified and gone on with only as they were."""

from __future__ import annotations

import importlib
import sqlite3
import sys
from pathlib import Path

import pytest

import wiw
from wiw.errors import ConstructionError, StoreError
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.sources import require_sources, source_digests
from wiw.runs.store_file import store_path
from wiw.runs.verify import verify
from wiw.serving.background import serve_in_background
from wiw.studies.evaluate import evaluate, resume_run

MODEL = """
import numpy as np
import wiw


class Own(wiw.WorldModel):
    accepts = wiw.accepts(control="image", causal=True)

    def rollout(self, observations, controls, seeds):
        from shades import SHADE

        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        frames[:, 1:] -= frames[:, 1:] // SHADE
        return frames
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A model, and beside it what it imports when it is asked."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "own.py").write_text(MODEL)
    (tmp_path / "shades.py").write_text("SHADE = 8\n")
    yield tmp_path
    sys.modules.pop("shades", None)


def test_a_part_counts_with_what_it_derives_from_and_imports(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = folder / "mine"
    package.mkdir()
    for name, text in {
        "__init__.py": "",
        "base.py": "from wiw import Policy as Above\nimport numpy.linalg\n\n\nclass Base(Above):\n    pass\n",
        "net.py": "from . import blocks\nimport json\n",
        "blocks.py": "import mine.net\n",
        "unread.py": "",
        "policy.py": "from mine.base import Base\n\n\nclass Mine(Base):\n    def f(_):\n        from .net import x\n",
    }.items():
        (package / name).write_text(text)
    monkeypatch.syspath_prepend(str(folder))
    found = source_digests(importlib.import_module("mine.policy").Mine)
    assert {Path(path).name for path in found} == {"__init__.py", "policy.py", "base.py", "net.py", "blocks.py"}
    assert all(len(digest) == 32 for digest in found.values())
    before = dict(found)
    (package / "blocks.py").write_text("import mine.net  # edited\n")
    after = source_digests(importlib.import_module("mine.policy").Mine)
    assert [path for path in before if before[path] != after[path]] == [str(package / "blocks.py")]
    assert source_digests(wiw.world_model("warp")) == {} == source_digests(wiw.Agent)


def test_a_function_counts_by_its_file(folder: Path) -> None:
    own = wiw.world_model(f"{folder}/own.py:Own", isolate=False)
    model = wiw.world_model(own.rollout, accepts=wiw.accepts(control="image"))
    assert {Path(path).name for path in source_digests(model)} == {"own.py", "shades.py"}


def test_what_has_changed_is_named(tmp_path: Path) -> None:
    require_sources(tmp_path, {"a": "1"}, {"a": "1"})
    require_sources(tmp_path, None, {"a": "1"})
    for now in ({"a": "2"}, {}, {"a": "1", "b": "1"}):
        with pytest.raises(StoreError, match=r"changed since the run was started: [ab]\. .*start a new run"):
            require_sources(tmp_path, {"a": "1"}, now)


@pytest.mark.parametrize("name", ["own.py", "shades.py"])
def test_an_edited_model_is_no_part_of_its_old_run(folder: Path, two_rooms: str, name: str) -> None:
    task, run = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1}), folder / "run"
    agent = AgentRecipe("heuristic", f"{folder}/own.py:Own")
    evaluate(task, agent, 2, out=run, progress=False)
    with sqlite3.connect(store_path(run)) as store:
        store.execute("DELETE FROM outcome WHERE episode = 1")
    text = (folder / name).read_text()
    (folder / name).write_text(text.replace("SHADE = 8", "SHADE = 4") + "# edited\n")
    for go_on in (
        lambda: resume_run(run, progress=False),
        lambda: evaluate(task, agent, 2, out=run, resume=True, progress=False),
        lambda: verify(run),
    ):
        with pytest.raises(StoreError, match=rf"source files have changed.*{name}.*start a new run in another folder"):
            go_on()
    (folder / name).write_text(text)
    assert resume_run(run, progress=False).complete and verify(run).same


BROKEN = """
from own import Own


class Broken(Own):
    def __init__(self):
        raise ValueError("no weights")
"""


def test_a_model_that_could_not_be_made_is_mended_and_the_run_resumes(folder: Path, two_rooms: str) -> None:
    (folder / "broken.py").write_text(BROKEN)
    task, run = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1}), folder / "run"
    agent = AgentRecipe("heuristic")
    with pytest.raises(ConstructionError, match="no weights") as caught:
        evaluate(task, agent, 2, out=run, arms=["none", f"{folder}/broken.py:Broken"], progress=False)
    assert caught.value.__notes__ == [f"Everything recorded is kept. Once the cause is fixed:  wiw resume {run}"]
    mended = "from own import Own\n\n\nclass Broken(Own):\n    pass\n"
    (folder / "broken.py").write_text(mended)
    log = resume_run(run, progress=False)
    assert log.complete and verify(run).same
    (changed,) = log.store.info["sources_changed"]
    assert changed["files"] == [str(folder / "broken.py")]
    with sqlite3.connect(store_path(run)) as store:
        store.execute("DELETE FROM outcome WHERE arm != 'none' AND episode = 1")
    (folder / "broken.py").write_text(mended + "# edited\n")
    with pytest.raises(StoreError, match=r"source files have changed.*broken\.py"):
        resume_run(run, progress=False)


def test_a_model_in_memory_is_held_to_its_file_too(folder: Path, two_rooms: str) -> None:
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1})

    def go_on(resume: bool):
        model = wiw.world_model(f"{folder}/own.py:Own")
        return evaluate(task, wiw.Agent("heuristic", model), 1, out=folder / "run", resume=resume, progress=False)

    assert go_on(False).complete and go_on(True).complete
    (folder / "own.py").write_text(MODEL + "# edited\n")
    with pytest.raises(StoreError, match=r"source files have changed.*own\.py"):
        go_on(True)


EDITOR = """
from pathlib import Path

from own import Own


class Editor(Own):
    def rollout(self, observations, controls, seeds):
        Path(__file__).with_name("other.py").write_text("from own import Own as Other  # edited")
        return super().rollout(observations, controls, seeds)
"""


def test_a_file_that_is_edited_while_the_run_goes_on_stops_it(folder: Path, two_rooms: str) -> None:
    (folder / "editor.py").write_text(EDITOR)
    (folder / "other.py").write_text("import own\n\n\nclass Other(own.Own):\n    pass\n")
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1})
    agent = AgentRecipe("heuristic", f"{folder}/editor.py:Editor")
    arms = [f"{folder}/editor.py:Editor", f"{folder}/other.py:Other"]
    with pytest.raises(StoreError, match=r"source files have changed.*other\.py"):
        evaluate(task, agent, 1, out=folder / "run", arms=arms, progress=False)


def test_a_served_model_without_a_version_is_told_apart_by_its_files(folder: Path) -> None:
    said = []
    for text in (MODEL, MODEL, MODEL + "# edited\n"):
        (folder / "own.py").write_text(text)
        with serve_in_background(wiw.world_model(f"{folder}/own.py:Own")) as server:
            said.append(wiw.world_model(f"remote:{server.address}").describe()["model"]["sources"])
    assert said[0] == said[1] != said[2] and set(said[0]) == {"own.py", "shades.py"}
