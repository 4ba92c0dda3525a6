# SPDX-License-Identifier: Apache-2.0
"""Wrong answers are blamed on perception, exploration, both together, or the answer itself."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from locations import PYTHON_TESTS
from test_blame import change

import wiw
from wiw.analysis.blame import EpisodeBlame
from wiw.analysis.blame_schemes import LOOP, QUESTIONS, choose_scheme
from wiw.cli import main
from wiw.datasets import episodes as episode_file
from wiw.datasets.questions import Question
from wiw.datasets.questions.facts import make_table
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, StoreError
from wiw.experiments.counterparts import COUNTERPARTS
from wiw.report.plots import BLAME_COLORS
from wiw.runs.recipes import AgentRecipe, TaskRecipe, arm_recipes
from wiw.runs.store import RunStore
from wiw.scenes import apartment_table
from wiw.studies.evaluate import run_arms
from wiw.types import Episode

SCENE = "apartments:val/1"
PERCEPTION = f"{PYTHON_TESTS / 'aeqa_parts.py'}:RedIsASofa"
ACTIONS = 20
OPTIONS = {"explorer": {"perception": PERCEPTION, "budget": ACTIONS}}
ASKED = [("bed", "yellow"), ("sofa", "red"), ("stove", "white"), ("bed", "purple")]
"""Category and expected colour: the yellow bed is beside the start, the red sofa and the white stove are far away."""
CAUSES = ["perception", "exploration", "joint", "answering"]
WHOLE = "explorer,explorer-oracle,explorer-tour,explorer-oracle-tour"


def make_episode(number: int, category: str, color: str) -> Episode:
    place, table = world(SCENE), make_table(apartment_table(1, "val"))
    bed = next(each for each in table.things if each.category == "bed")
    points = place.ground.put_down(place.navmesh.sample(300, 3)).astype(np.float64)
    room = next(each for each in table.rooms if each.name == bed.room)
    inside = points[room.contains(points)]
    start = inside[int(np.linalg.norm(inside - bed.centre, axis=1).argmax())]
    question = Question(
        f"What color is the {category}?", color, "attribute recognition", "color", (), "color", {"object": category}
    )
    x, y, z = (float(value) for value in start)
    return Episode(f"{number:04}", SCENE, (x, y, z), 0.0, (x, y, z), 0.0, 2.0, {"question": question.to_info()})


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> TaskRecipe:
    path = tmp_path_factory.mktemp("questions") / "questions.json"
    episode_file.save(path, [make_episode(i, *asked) for i, asked in enumerate(ASKED)], "aeqa")
    return TaskRecipe("aeqa", {"episode_file": str(path), "backend": "cpu", "actions": ACTIONS})


@pytest.fixture(scope="module")
def run(task: TaskRecipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with an arm that can be blamed and one that cannot; nothing was rerun."""
    folder = tmp_path_factory.mktemp("asked") / "run"
    agents = arm_recipes(AgentRecipe("explorer", policy_options=OPTIONS), ["none", "explorer-oracle+none"])
    run_arms(task, agents, len(ASKED), out=folder, progress=False, keep_images=1, live=4).close()
    return folder


def change_info(run: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    with RunStore.read(run) as store:
        info = store.info
    edit(info)
    change(run, "UPDATE run SET info = ?", json.dumps(info))


@pytest.fixture(scope="module")
def blamed(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("blamed") / "run"
    shutil.copytree(run, folder)
    return wiw.blame(folder, "none", progress=False)


@pytest.mark.nightly
def test_each_wrong_answer_is_blamed_on_what_causes_it(blamed: Any) -> None:
    line = blamed["none"]
    assert [one.verdict for one in line.episodes] == CAUSES and not line.rerun_errors
    assert line.verdicts == {"imagination": 0, **dict.fromkeys(CAUSES, 1)}
    recovery = {rerun: found.value for rerun, found in line.recovery.items()}
    assert recovery == {"imagination": 0, "perception": 25, "exploration": 25, "both": 75}


@pytest.mark.nightly
def test_reruns_differ_from_the_run_by_their_ground_truth_alone(blamed: Any) -> None:
    with RunStore.read(blamed.run) as store, RunStore.read(blamed.run / "blame") as reruns:
        own, built, recipes = store.info["built"]["none"], reruns.info["built"], reruns.info["agents"]
    privileged = {"perception": ["perception"], "exploration": ["tour"], "both": ["perception", "tour"]}
    assert set(built) == {f"none/{rerun}" for rerun in QUESTIONS.reruns}
    for rerun, stages in privileged.items():
        policy = {**built[f"none/{rerun}"]["policy"]}
        assert policy.pop("privileged") == stages
        assert {**policy, "policy": "Explorer"} == own["policy"] and policy["budget"] == ACTIONS
        assert recipes[f"none/{rerun}"]["model"] is None
    assert recipes["none/imagination"]["model"] == "oracle" and recipes["none/imagination"]["policy"] == "explorer"
    assert wiw.verify(blamed.run / "blame", episodes=1).same


@pytest.mark.nightly
def test_an_explorer_that_has_changed_is_refused(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    change_info(tmp_path / "run", lambda info: info["built"]["none"]["policy"].update(affinity=99.0))
    with pytest.raises(StoreError, match=r"policy\.affinity: the run has 99\.0, now 6\.0"):
        wiw.blame(tmp_path / "run", "none", episodes=1, progress=False)


@pytest.mark.nightly
def test_what_is_shown_names_the_stages_of_question_answering(blamed: Any, capsys: Any, tmp_path: Path) -> None:
    assert main(["blame", str(blamed.run), "--arm", "none"]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in (*QUESTIONS.reruns, *QUESTIONS.verdicts))
    assert not any(word in shown for word in ("scoring", "proposals", "beyond"))
    stored = json.loads((blamed.run / "blame.json").read_text())
    assert [one["verdict"] for one in stored["episodes"]] == CAUSES
    assert set(stored["episodes"][0]["mended"]) == set(QUESTIONS.reruns)
    log = wiw.load_run(blamed.run)
    (line,) = log.blame()
    assert line["blame_answering"] == 1 and line["mended_both"] == 75 and "blame_beyond" not in line
    page = log.report(tmp_path / "report.html").read_text()
    section = page[page.index('<section id="blame">') :].partition("</section>")[0]
    assert all(f">{rerun} %</th>" in section for rerun in QUESTIONS.reruns)
    assert all(f">{verdict}</th>" in section for verdict in QUESTIONS.verdicts) and "beyond" not in section
    drawing = page[page.index("Stage to blame") :].partition("</figure>")[0]
    assert all(f">{verdict}<" in drawing for verdict in QUESTIONS.verdicts) and "scoring" not in drawing
    view = log.view(tmp_path / "view")
    pages = "".join(path.read_text() for path in (view.parent / "episodes").glob("*.html"))
    assert all(f"to blame: {cause}" in pages for cause in CAUSES)


@pytest.mark.nightly
def test_an_arm_of_another_policy_is_refused_before_anything_runs(run: Path, capsys: Any) -> None:
    for arms in (None, "explorer-oracle"):
        with pytest.raises(ArgumentError, match=r"'explorer-oracle'.*only policy 'explorer'.*imagination, "):
            wiw.blame(run, arms, progress=False)
    assert main(["blame", str(run)]) == 2
    assert "choose from the arms with that policy: --arm none" in capsys.readouterr().err
    assert not (run / "blame").exists()


@pytest.mark.parametrize(("policy", "reviser"), [("vlm", None), ("explorer", "vlm"), ("mine.py:Explorer", None)])
def test_only_explorers_that_answer_themselves_can_be_blamed(policy: str, reviser: str | None) -> None:
    agent = AgentRecipe(policy, "warp", reviser).to_json()
    assert agent is not None
    assert not QUESTIONS.allows(agent) and LOOP.allows(agent)


@pytest.mark.nightly
def test_a_run_without_an_explorer_says_how_to_make_one(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    change_info(tmp_path / "run", lambda info: [agent.update(policy="vlm") for agent in info["agents"].values()])
    with pytest.raises(ArgumentError, match=r"policy 'vlm'.*`wiw run aeqa --policy explorer` starts a run"):
        wiw.blame(tmp_path / "run", progress=False)
    assert not (tmp_path / "run" / "blame").exists()


@pytest.mark.parametrize(
    ("mended", "verdict"),
    [
        ({"imagination": True, "perception": True, "exploration": True, "both": True}, "imagination"),
        ({"imagination": False, "perception": True, "exploration": True, "both": False}, "perception"),
        ({"perception": False, "exploration": True, "both": True}, "exploration"),
        ({"perception": False, "exploration": False, "both": True}, "joint"),
        ({"imagination": False, "perception": False, "exploration": False, "both": False}, "answering"),
    ],
)
def test_the_least_that_turns_a_wrong_answer_into_a_right_one_is_to_blame(
    mended: dict[str, bool], verdict: str
) -> None:
    assert EpisodeBlame("x", 0, "s", mended, QUESTIONS).verdict == verdict


def test_the_task_chooses_the_scheme() -> None:
    for name, scheme in (("imagenav", LOOP), ("ar", LOOP), ("manipulation", LOOP), ("aeqa", QUESTIONS)):
        assert choose_scheme(TaskRecipe(name).build().describe()) is scheme
    for scheme in (LOOP, QUESTIONS):
        assert len(scheme.verdicts) == len(scheme.reruns) + 1 and set(scheme.verdicts) <= set(BLAME_COLORS)


def test_counterparts_are_registered_and_described() -> None:
    from aeqa_parts import Blindfold

    for policy, known in COUNTERPARTS.items():
        original = wiw.policy(policy, perception=Blindfold()).describe()
        for counterpart in known.values():
            made = wiw.policy(counterpart.policy, perception=Blindfold()).describe()
            assert made == {**original, **counterpart.identity}


def test_the_four_arms_of_the_table_have_the_same_options() -> None:
    arms = arm_recipes(AgentRecipe("explorer", policy_options=OPTIONS), [f"{name}+none" for name in WHOLE.split(",")])
    assert ",".join(arms) == WHOLE
    for name, recipe in arms.items():
        assert isinstance(recipe, AgentRecipe) and recipe.policy == name
        assert recipe.policy_options[name] == OPTIONS["explorer"]
    own = {"explorer": {"sure": 0.5}, "explorer-tour": {"sure": 0.9}}
    assert AgentRecipe("explorer", policy_options=own).with_policy("explorer-tour").policy_options == own
    assert "heuristic" not in AgentRecipe("explorer", policy_options=OPTIONS).with_policy("heuristic").policy_options


@pytest.mark.nightly
def test_the_table_of_perception_and_exploration_is_one_command(
    task: TaskRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arms = ",".join(f"{name}+none" for name in WHOLE.split(","))
    command = ["run", "aeqa", "--arms", arms, "--episode-file", str(task.options["episode_file"])]
    command += ["--task-option", f"actions={ACTIONS}", "--backend", "cpu", "--out", str(tmp_path / "run")]
    command += ["--policy-option", f"perception={PERCEPTION}", "--policy-option", f"budget={ACTIONS}"]
    command += ["--episodes", "2", "--keep-images", "0"]
    assert main(command) == 0
    lines = wiw.load_run(tmp_path / "run").table()
    right = {line["arm"]: line["success"] for line in lines if line["arm"] != "blind"}
    assert right == {"explorer": 0, "explorer-oracle": 50, "explorer-tour": 50, "explorer-oracle-tour": 100}
