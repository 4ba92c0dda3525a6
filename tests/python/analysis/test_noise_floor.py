# SPDX-License-Identifier: Apache-2.0
"""An arm that repeats another with other random numbers, and what a report says of it."""

from dataclasses import replace

import pytest
from fakes import LineTask, line_task  # noqa: F401 - the task is named by its path below

import wiw
from wiw.analysis.noise_floor import NoiseFloor, find_repeats
from wiw.analysis.statistics import compare
from wiw.analysis.summary import is_under_test, notes, role_of, split_outcomes, summarise
from wiw.cli import main
from wiw.cli.run import add_noise_floor
from wiw.errors import ArgumentError
from wiw.metrics.metric import SUCCESS
from wiw.runs.recipes import AgentRecipe, arm_recipes
from wiw.runs.workers import mix_seed
from wiw.studies.run_log import load_run


def test_an_arm_that_repeats_another_is_the_same_agent_with_another_seed():
    own = AgentRecipe("heuristic", "warp")
    made = arm_recipes(own, ["warp", "reseeded:warp", "reseeded", "heuristic+reseeded:none", "again=reseeded:copy"][:2])
    assert list(made) == ["warp", "reseeded:warp"]
    plain, again = (dict(recipe.describe()) for recipe in made.values())
    assert again.pop("reseed") == 1 and again == plain and made["warp"] == own
    named = arm_recipes(own, ["reseeded", "heuristic+reseeded:none", "again=reseeded:copy"])
    assert list(named) == ["reseeded:warp", "heuristic+reseeded:none", "again"]
    assert named["heuristic+reseeded:none"].model is None and named["again"].model == "copy"
    assert all(recipe.reseed == 1 for recipe in named.values())
    with pytest.raises(ArgumentError, match="choose another name"):
        arm_recipes(own, ["oracle=reseeded:oracle"])


def test_seeds_of_repeats_are_others_and_always_the_same():
    assert mix_seed(7, None) == 7
    assert mix_seed(7, 1) == mix_seed(7, 1) and len({7, 8, mix_seed(7, 1), mix_seed(8, 1), mix_seed(7, 2)}) == 5


def test_which_arm_the_option_repeats():
    assert add_noise_floor(None, "warp") == "warp,reseeded:warp"
    assert add_noise_floor("none,copy,oracle", "none") == "none,copy,oracle,reseeded:oracle"
    assert add_noise_floor("none,copy", "warp") == "none,copy,reseeded:warp"
    assert add_noise_floor("none,heuristic+copy", "none") == "none,heuristic+copy,heuristic+reseeded:copy"
    named = add_noise_floor("none,big=warpnet?weights=a.npz", "none")
    assert named == "none,big=warpnet?weights=a.npz,reseeded-big=reseeded:warpnet?weights=a.npz"
    for arm in ("reseeded:warp", "reseeded-big", "heuristic+reseeded:copy"):
        assert role_of(arm).startswith("noise floor") and not is_under_test(arm, role_of(arm))


def test_the_report_says_how_much_an_arm_differs_from_itself(tmp_path, capsys):
    command = ["run", "fakes:line_task", "--policy", "heuristic", "--episodes", "24", "--out", str(tmp_path / "run")]
    assert main([*command, "--noise-floor", "--no-report"]) == 0
    capsys.readouterr()
    log = load_run(tmp_path / "run")
    assert log.arms == ["none", "reseeded:none"]
    rows = {(row["arm"], row["episode"]): row["metrics"]["success"] for row in log.episodes}
    executed = {arm: [row["executed"] for row in log.decisions if row["arm"] == arm] for arm in log.arms}
    assert executed["none"] != executed["reseeded:none"], "other draws"
    differing = sum(rows["none", i] != rows["reseeded:none", i] for i in range(24))
    (noise,) = log.numbers().noise
    found = noise.difference
    assert (found.arm, found.base) == ("reseeded:none", "none") and found.wins + found.losses == differing
    (said,) = [note for note in notes(log.numbers()) if note.startswith("Noise floor")]
    same = "has the same outcome in all 24 episodes" in said
    assert same if differing == 0 else f"in {differing} of 24 episodes" in said
    assert "Noise floor" in log.report().read_text()
    assert wiw.verify(tmp_path / "run", episodes=2).same


@pytest.mark.parametrize(
    ("first", "again", "expected"),
    [
        ([0, 1, 0, 0, 0, 0], [1, 0, 1, 0, 0, 0], "3 of 6 episodes (2 won, 1 lost), SR by +16.7"),
        ([0, 1, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], "has the same outcome in all 6 episodes"),
    ],
)
def test_how_much_an_arm_differs_from_itself_is_said(first, again, expected):
    arms = {"mine": first, "reseeded:mine": again}
    rows = [
        {"arm": arm, "episode": i, "scene": str(i), "status": "done", "metrics": {"success": float(value)}}
        for arm, values in arms.items()
        for i, value in enumerate(values)
    ]
    done, _ = split_outcomes(list(arms), rows)
    found = compare("reseeded:mine", "mine", done, SUCCESS)
    said = notes(replace(summarise(list(arms), rows, 6), noise=(NoiseFloor("with frames of 8x16", found),)))
    assert any(note.startswith("Noise floor: with frames of 8x16 mine") and expected in note for note in said)


SMALL, LARGE = {"size": [144, 256]}, {"size": [288, 512]}


@pytest.mark.parametrize(
    ("models", "expected"),
    [
        ({"small": ("warp", SMALL), "warp": ("warp", {})}, [("small", "warp", "144x256")]),
        ({"big": ("warp", LARGE), "small": ("warp", SMALL)}, [("small", "big", "144x256")]),
        (
            {"small": ("warp", SMALL), "big": ("warp", LARGE), "warp": ("warp", {})},
            [("small", "warp", "144x256"), ("big", "warp", "288x512")],
        ),
        ({"warp": ("warp", SMALL), "oracle": ("oracle", {}), "none": (None, {})}, []),
        ({"a": ("warp", {**SMALL, "fill": "far"}), "b": ("warp", {})}, []),
        ({"a": ("warp", SMALL), "b": ("warp", SMALL)}, []),
        ({"a": ("mine.py:Mine", {"size": 96}), "b": ("mine.py:Mine", {})}, [("a", "b", "96")]),
    ],
)
def test_arms_of_one_model_and_several_sizes_are_repeats(models, expected):
    agents = {
        name: {"policy": "matcher", **({"model": model} if model else {}), **({"model_options": how} if how else {})}
        for name, (model, how) in models.items()
    }
    found = [(each.arm, each.base, each.change.removeprefix("with frames of ")) for each in find_repeats(agents)]
    assert found == expected
    more = {**agents, "again": {**agents[next(iter(agents))], "reseed": 1}}
    repeats = [each for each in find_repeats(more) if "random" in each.change]
    assert [(each.arm, each.base) for each in repeats] == [("again", next(iter(agents)))]


def test_runs_without_repeats_say_nothing(tmp_path):
    log = wiw.evaluate("fakes:line_task", AgentRecipe("heuristic"), 2, out=tmp_path / "run", progress=False)
    assert log.numbers().noise == () and not any("Noise" in note for note in notes(log.numbers()))
