# SPDX-License-Identifier: Apache-2.0
"""Trackers from the command line and from recipes, and what a run says of the one it had."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pydantic")
pytest.importorskip("transformers")

import tiny_detectors
import wiw
from recognition_file import a_file
from wiw.cli import main
from wiw.cli.parts import AgentFlags
from wiw.errors import ArgumentError, RegistryError
from wiw.loop.config import PlanConfig
from wiw.perception.tracking import Reprojection
from wiw.runs.compose import RunContext
from wiw.runs.recipes import AgentRecipe
from wiw.tasks.ar import AR
from wiw.tasks.imagenav import ImageNav


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_detectors.save_sam2(tmp_path_factory.mktemp("sam2"), video=True)


@pytest.fixture
def context(tmp_path: Path, two_rooms: str) -> RunContext:
    return RunContext(AR(episode_file=a_file(tmp_path, two_rooms)))


def describe_tracker(recipe: AgentRecipe, context: RunContext) -> Any:
    return recipe.build(context).describe()["revision"].get("tracker")


VLM: dict[str, Any] = {"policy_options": {"vlm": {"vlm": "mock", "cache": "off"}}}


@pytest.mark.parametrize(
    ("recipe", "name"),
    [
        (AgentRecipe("vlm", "copy", tracker="flow", **VLM), "Flow"),
        (AgentRecipe("vlm", "copy", tracker="reprojection", **VLM), "Reprojection"),
        (AgentRecipe("heuristic", "copy", "vlm", tracker="flow", **VLM), "Flow"),
        (AgentRecipe("recogniser", "copy"), "Reprojection"),
        (AgentRecipe("recogniser", "copy", tracker="flow"), "Flow"),
        (AgentRecipe("heuristic", "copy", tracker="flow"), "Flow"),  # the task's own reviser
        (AgentRecipe("recogniser", "copy", tracker=Reprojection()), "Reprojection"),
    ],
)
def test_the_policy_that_revises_has_the_tracker(recipe: AgentRecipe, name: str, context: RunContext) -> None:
    assert describe_tracker(recipe, context)["name"] == name
    assert recipe.is_named is not isinstance(recipe.tracker, Reprojection)


def test_a_reviser_that_nobody_names_has_the_options_of_the_preset(tmp_path: Path, two_rooms: str) -> None:
    context = RunContext(AR(episode_file=a_file(tmp_path, two_rooms), preset="foresight"))
    for policy in ("heuristic", "recogniser"):
        assert describe_tracker(AgentRecipe(policy, "copy"), context)["name"] == "Growing"


def test_options_alone_are_those_of_the_policys_own_tracker(weights: Path, context: RunContext) -> None:
    recipe = AgentRecipe("vlm", "copy", tracker_options={"weights": str(weights)}, **VLM)
    assert describe_tracker(recipe, context)["name"] == "Sam2"
    assert AgentRecipe.from_json(recipe.to_json()) == recipe


def test_trackers_that_nobody_looks_through_are_refused(context: RunContext) -> None:
    with pytest.raises(ArgumentError, match=r"tracker: policy matcher does not use one; expected .* vlm or recogniser"):
        AgentRecipe("heuristic", "copy", "matcher", tracker="flow").build(context)
    with pytest.raises(RegistryError, match=r"tracker 'flow': .*weights"):
        AgentRecipe("vlm", "copy", tracker="flow", tracker_options={"weights": "x"}).describe()
    with pytest.raises(ArgumentError, match="task 'imagenav' has no target to track"):
        AgentRecipe("matcher", tracker="flow").require(ImageNav(scenes="apartments:val"), 2)
    nav = RunContext(ImageNav(scenes="apartments:val"))
    assert "tracker" not in AgentRecipe("vlm", **VLM).build(nav).describe()["policy"]


def test_flags_become_a_recipe(tmp_path: Path) -> None:
    weights = tmp_path
    flags = AgentFlags(
        policy="heuristic",
        revision="vlm",
        revision_option=("tries=2", "answer_view=target"),
        vlm="mock",
        tracker="sam2",
        tracker_option=(f"weights={weights}", "prompt=mask"),
    )
    recipe = flags.make_recipe("ar", None, PlanConfig())
    assert recipe.policy_options == {"vlm": {"vlm": "mock", "tries": 2, "answer_view": "target"}}
    assert (recipe.tracker, recipe.tracker_options) == ("sam2", {"weights": str(weights), "prompt": "mask"})
    for wrong, message in (
        (AgentFlags(revision_option=("tries=2",)), "--revision-option: name the policy .* --revision"),
        (AgentFlags(tracker="sam2", tracker_option=("weights",)), "--tracker-option: expected KEY=VALUE"),
    ):
        with pytest.raises(ArgumentError, match=message):
            wrong.make_recipe("ar", None, PlanConfig())


def test_a_heuristic_revised_by_a_language_model_and_sam2_is_one_command(
    weights: Path, tmp_path: Path, two_rooms: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """`run` and `scale` with tiny random weights; the box is theirs, and the run names the tracker."""
    (tmp_path / "short.yaml").write_text("decisions: 2\nhorizon: 2\n")
    common = [
        "ar", "--policy", "heuristic", "--revision", "vlm", "--revision-option", "cache=off", "--vlm", "mock",
        "--world-model", "copy", "--episode-file", str(a_file(tmp_path, two_rooms, yaw=np.pi / 2)),
        "--tracker", "sam2", "--tracker-option", f"weights={weights}", "--preset", str(tmp_path / "short.yaml"),
        "--episodes", "1",
    ]  # fmt: skip
    assert main(["run", *common, "--out", str(tmp_path / "run")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Tracker Sam2 located the target in imagined frames by their pixels." in said
    assert "Tracker Sam2 located" in (tmp_path / "run/report.html").read_text()
    log = wiw.load_run(tmp_path / "run")
    assert log.store.info["built"]["copy"]["revision"]["tracker"]["name"] == "Sam2"
    assert {each["purpose"] for row in log.store.decisions("copy") for each in row["exchanges"]} == {"move", "answer"}
    assert wiw.verify(tmp_path / "run", episodes=1).same
    assert main(["scale", *common, "--candidates", "1,2", "--out", str(tmp_path / "scale")]) == 0
    assert wiw.load_run(tmp_path / "scale").store.info["agents"]["candidates=2"]["tracker"] == "sam2"


def test_blame_finds_weights_and_servers_where_they_are_now_and_no_others(
    weights: Path, tmp_path: Path, two_rooms: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mock that answers at random fails; its failure is rerun from another folder of the same weights."""
    gone, run = tmp_path / "before", tmp_path / "run"
    shutil.copytree(weights, gone)
    (tmp_path / "short.yaml").write_text("decisions: 1\nhorizon: 1\n")
    recipe = AgentRecipe("heuristic", "copy", "vlm", tracker="sam2", tracker_options={"weights": str(gone)}, **VLM)
    for seed in range(9):  # until one fails
        shutil.rmtree(run, ignore_errors=True)
        log = wiw.evaluate("ar", recipe, 1, seed=seed, out=run, progress=False, preset=str(tmp_path / "short.yaml"),
                           episode_file=str(a_file(tmp_path, two_rooms)))  # fmt: skip
        if log.episodes[0]["metrics"]["success"] == 0:
            break
    shutil.rmtree(gone)
    elsewhere = ["blame", str(run), "--tracker-option", f"weights={weights}", "--revision-option"]
    assert main([*elsewhere, f"cache={tmp_path}/replies"]) == 0
    assert "imagination" in capsys.readouterr().out
    assert main([*elsewhere, "cache=off"]) == 2, "all is rerun"
    assert "nothing left to rerun" in capsys.readouterr().err
    shutil.rmtree(run / "blame")
    assert main([*elsewhere, "tries=9"]) != 0
    assert "tries" in capsys.readouterr().err
