# SPDX-License-Identifier: Apache-2.0
"""The study of errors: known costs are found again, runs go on where they stopped, and the page says what came out."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fakes import LineTask

from wiw.analysis.errors import METRES, summarise_errors
from wiw.analysis.intervals import clustered_interval
from wiw.analysis.statistics import holm
from wiw.cli import main
from wiw.errors import ArgumentError, StoreError
from wiw.experiments.errors.kinds import ERRORS
from wiw.report.error_page import write_errors
from wiw.report.error_tables import (
    COST_TITLES,
    GAP_TITLES,
    explain,
    list_costs,
    list_gaps,
    list_lines,
    list_titles,
    print_errors,
)
from wiw.runs.rows import OutcomeRow
from wiw.runs.store import RunStore
from wiw.studies.errors import SMALL, ErrorSettings, make_recipes, read_errors, study_errors
from wiw.types import PRIMITIVES, EpisodeResult

ARMS = {"error-blur@64": ("blur", 64.0), "error-lag@2": ("lag", 2.0), "error-lag@4": ("lag", 4.0)}
DISTANCE = {"error-blur@64": 0.5, "error-lag@2": 0.2, "error-lag@4": 0.4}
COST = {"error-blur@64": 0.0, "error-lag@2": 0.25, "error-lag@4": 0.5}
"""Share of the successes that an arm loses: nothing by blur, in proportion to the distance by lag."""
EPISODES = 40
CONTROL = ("control, per 0.1 in 1 - SSIM", "control, per 0.1 m")
SETTINGS = {"episodes": EPISODES, "seed": 0, "fidelity_share": 0.25}


def outcomes() -> list[dict]:
    rows = []
    for arm in ("none", "oracle", *ARMS):
        for index in range(EPISODES):
            lost = (index // 10) / 4 < COST.get(arm, 0.0)
            success = float(arm != "none" and not lost)
            metrics = {"success": success, "actions": 10.0 + 5 * (arm != "oracle")}
            rows.append({"arm": arm, "episode": index, "scene": f"s{index % 10}", "status": "done", "metrics": metrics})
    return rows


def decisions() -> list[dict]:
    rows = []
    for arm in ("oracle", *ARMS):
        far = DISTANCE.get(arm, 0.0)
        poses = {"pose_errors": [[far * ("lag" in arm), 0.0], [None, None]]} if arm != "oracle" else {}
        measured = {"ssim": [1 - far, None], "psnr": [100 - 50 * far, None], "regret": 2 * COST.get(arm, 0.0), **poses}
        rows += [{"arm": arm, "episode": index, "fidelity": measured} for index in range(EPISODES)]
        rows += [{"arm": arm, "episode": 0, "fidelity": None}]
    return rows


def test_the_small_version_is_as_small_as_it_says() -> None:
    (task,) = SMALL.tasks
    assert task == "imagenav" and SMALL.episodes == 8
    assert sorted(SMALL.list_arms(task)) == sorted(
        f"error-{kind}@{dose:g}" for kind in SMALL.kinds for dose in ERRORS[kind].doses[PRIMITIVES][-2:]
    )


@pytest.fixture(scope="module")
def table():
    return summarise_errors("imagenav", "matcher", outcomes(), decisions(), ARMS, ["open"])


def test_every_arm_is_paired_with_the_oracle(table) -> None:
    assert (table.label, table.episodes, table.scenes, table.distance) == ("SR", EPISODES, 10, "1 - SSIM")
    assert table.references["none"].value == 0 and table.references["oracle"].value == 100
    assert table.gain.estimate.value == 100
    found = {line.arm: line for line in table.lines}
    for arm, (kind, dose) in ARMS.items():
        line = found[arm]
        assert (line.kind, line.family, line.dose) == (kind, ERRORS[kind].family, dose)
        assert line.loss.estimate.value == pytest.approx(-100 * COST[arm])
        assert line.regret.estimate.value == pytest.approx(2 * COST[arm])
        assert line.trajectory.estimate.value == 5
        assert line.measures["1 - SSIM"].value == pytest.approx(DISTANCE[arm])
    assert found["error-lag@4"].loss.p_adjusted < 0.05 < found["error-blur@64"].loss.p_adjusted


def test_answers_are_compared_by_their_scores() -> None:
    rows = outcomes()
    for row in rows:
        metres = row["metrics"].pop("actions") / 10
        row["metrics"] |= {"success": 0.0, "answer_score": 0.5 + row["metrics"]["success"] / 2, "path_length": metres}
    found = summarise_errors("aeqa", "explorer", rows, decisions(), ARMS, [])
    assert found.label == "Score" and found.references["none"].value == 50
    losses = {line.arm: line.loss.estimate.value for line in found.lines}
    assert losses == {arm: pytest.approx(-50 * COST[arm]) for arm in ARMS}
    assert {line.trajectory.estimate.value for line in found.lines} == {0.5}, "metres"


def test_costs_are_slopes_through_the_oracle(table) -> None:
    costs = {(each.family, each.measure): each for each in table.costs}
    assert costs["looks", "1 - SSIM"].loss.value == 0
    control = costs["control", "1 - SSIM"]
    assert control.loss.value == pytest.approx(12.5) and control.arms == 2  # 50 points for 0.4
    assert control.regret.value == pytest.approx(0.25)
    assert costs["control", METRES].loss.value == pytest.approx(12.5) and ("looks", METRES) not in costs
    (gap,) = [each for each in table.gaps if each.measure == "1 - SSIM"]
    assert (gap.family, gap.base) == ("control", "looks") and gap.loss.value == pytest.approx(12.5)
    assert gap.loss.excludes_zero and gap.is_shown and gap.p_adjusted < 0.05


def test_pairs_of_families_are_adjusted_for_each_other() -> None:
    arms = {**ARMS, "error-flicker@20": ("flicker", 20.0)}
    rows = [*outcomes(), *({**row, "arm": "error-flicker@20"} for row in outcomes() if row["arm"] == "error-lag@2")]
    looked = [*decisions(), *({**row, "arm": "error-flicker@20"} for row in decisions() if row["arm"] == "error-lag@2")]
    found = summarise_errors("imagenav", "matcher", rows, looked, arms)
    gaps = [each for each in found.gaps if each.measure == "1 - SSIM"]
    alone = {(each.family, each.base): each for each in gaps}
    assert len(gaps) == 3
    pooled = alone["control", "looks"]
    (single,) = [
        each
        for each in summarise_errors("imagenav", "matcher", outcomes(), decisions(), ARMS).gaps
        if each.measure == "1 - SSIM"
    ]
    assert pooled.loss.value == single.loss.value and pooled.p_adjusted == pytest.approx(3 * single.p_adjusted)
    for few in (1, 3):
        cut = [{**row, "scene": "s0"} for row in rows if row["episode"] < few]
        (one, *_) = summarise_errors("imagenav", "matcher", cut, looked, arms).gaps
        assert 0.5 < one.p_adjusted <= 1 and not one.is_shown


def test_arms_that_are_not_shown_count_among_the_tests(table) -> None:
    few = {"error-lag@4": ARMS["error-lag@4"]}
    others = [arm for arm in ARMS if arm not in few]
    (line,) = summarise_errors("imagenav", "matcher", outcomes(), decisions(), few, others=others).lines
    (whole,) = [each for each in table.lines if each.arm == "error-lag@4"]
    assert line.loss.p_adjusted == whole.loss.p_adjusted > line.loss.p_value
    (alone,) = summarise_errors("imagenav", "matcher", outcomes(), decisions(), few).lines
    assert alone.loss.p_adjusted == alone.loss.p_value


def test_every_arm_is_paired_with_none_and_adjusted_for_all_arms(table) -> None:
    """The gain of true futures is 100 points, of which blur leaves all and lag half."""
    p_values = [line.over_none.p_value for line in table.lines]
    for line, expected in zip(table.lines, holm(p_values), strict=True):
        assert line.over_none.estimate.value == pytest.approx(100 - 100 * COST[line.arm])
        assert line.over_none.p_adjusted == pytest.approx(expected) and line.over_none.base == "none"
    cells = dict(list_lines(table))
    column = list_titles(table).index("minus none")
    assert cells["oracle"][column].startswith("+100.0 [") and cells["none"][column] == ""
    assert cells["error-lag@4"][column].startswith("+50.0 [")
    few = {"error-lag@4": ARMS["error-lag@4"]}
    (line,) = summarise_errors("imagenav", "matcher", outcomes(), decisions(), few, others=["error-blur@64"]).lines
    assert line.over_none.p_adjusted == pytest.approx(2 * line.over_none.p_value)
    assert "Significantly above none, adjusted for all arms: error-blur@64, error-lag@2, error-lag@4." in explain(table)


def test_an_arm_below_none_is_said_to_be() -> None:
    rows = outcomes()
    for row in rows:
        if row["arm"] in ("none", "error-lag@4"):
            row["metrics"]["success"] = float(row["arm"] == "none")
    said = explain(summarise_errors("imagenav", "matcher", rows, decisions(), ARMS))
    assert "Significantly below none, adjusted for all arms: error-lag@2, error-lag@4." in said
    alike = [{**row, "metrics": {"success": 1.0, "actions": 10.0}} for row in rows]
    said = explain(summarise_errors("imagenav", "matcher", alike, decisions(), ARMS))
    assert "No arm is significantly above or below none, adjusted for all arms." in said


def test_regret_says_in_how_many_episodes_it_was_measured() -> None:
    few = [row for row in decisions() if row["episode"] < 12 or row["arm"] != "error-lag@4"]
    found = summarise_errors("imagenav", "matcher", outcomes(), few, ARMS)
    column = list_titles(found).index("n (regret)")
    cells = {arm: (own[column - 2], own[column]) for arm, own in list_lines(found)}
    assert cells["error-lag@4"] == ("40", "12") and cells["error-blur@64"] == ("40", "40") and cells["none"] == ("", "")
    costs = {name: own[COST_TITLES.index("n (regret)")] for name, own in list_costs(found)}
    assert costs == {"looks, per 0.1 in 1 - SSIM": "40", **dict.fromkeys(CONTROL, "12")}
    assert [own[GAP_TITLES.index("n (regret)")] for _, own in list_gaps(found)] == ["12"]


def test_costs_are_stated_by_the_test_that_is_adjusted_for_all_of_them(table) -> None:
    control = next(cost for cost in table.costs if cost.family == "control")
    assert control.loss.excludes_zero and control.is_shown
    assert not any("may be chance" in line and "control cost" in line for line in explain(table))
    unsure = explain(replace(table, costs=(replace(control, p_adjusted=0.06),)))
    assert any("p 0.060, adjusted for all costs): this may be chance" in line for line in unsure)


def test_the_p_of_a_cost_is_that_of_its_interval_adjusted_for_all_costs() -> None:
    """Alone, p is 1 - the confidence at which the interval of what is lost ends at 0."""
    arms = {"error-blur@64": ("blur", 64.0), "error-lag@2": ("lag", 2.0), "error-flicker@20": ("flicker", 20.0)}
    cut = [row for row in outcomes() if row["episode"] in (*range(4), *range(10, 26))]  # 4 of 20 episodes are lost
    rows = [*cut, *({**row, "arm": "error-flicker@20"} for row in cut if row["arm"] == "error-lag@2")]
    measured = {"ssim": [0.8], "psnr": [90.0], "regret": 0.5}  # the distance of lag@2, and no error of poses
    looked = [*decisions(), *({"arm": "error-flicker@20", "episode": i, "fidelity": measured} for i in range(EPISODES))]
    (alone,) = summarise_errors("imagenav", "matcher", rows, looked, {"error-flicker@20": ("flicker", 20.0)}).costs
    lost = [float(row["episode"] < 10) for row in cut if row["arm"] == "none"]
    scenes = [row["scene"] for row in cut if row["arm"] == "none"]
    low, _ = clustered_interval(lost, scenes, "difference", confidence=1 - alone.p_adjusted)
    assert sum(lost) == 4 and low == pytest.approx(0, abs=1e-6) and 0.01 < alone.p_adjusted < 0.25
    found = {(each.family, each.measure): each for each in summarise_errors("imagenav", "", rows, looked, arms).costs}
    assert len(found) == 4
    for family, measure in (("flicker", "1 - SSIM"), ("control", "1 - SSIM"), ("control", METRES)):
        assert found[family, measure].p_adjusted == pytest.approx(4 * alone.p_adjusted)


def test_the_words_say_what_the_numbers_do(table) -> None:
    text = " ".join(explain(table))
    assert "Errors of control cost 12.5" in text and "control costs more" in text
    assert "Errors of looks cost 0.0" in text and "error-lag@4" in text
    assert "Left out, as they make no sense in imagenav: open." in text


def test_the_page_has_figure_tables_and_units(table, tmp_path: Path) -> None:
    written = write_errors([table], SETTINGS, "{}", tmp_path)
    assert [path.name for path in written] == ["errors.html", "errors.svg", "errors.png", "errors.json"]
    assert all(path.stat().st_size > 0 for path in written)
    page = written[0].read_text()
    assert page.count("<svg") == 1 and "error-lag@4" in page and ERRORS["lag"].unit in page


def test_unfinished_arms_are_shown_but_not_counted_among_the_costs() -> None:
    missing = {"error-lag@4": 0, "error-lag@2": 7}
    cut = [row for row in outcomes() if row["episode"] < missing.get(row["arm"], EPISODES)]
    found = summarise_errors("imagenav", "matcher", cut, decisions(), ARMS)
    assert [line.arm for line in found.lines] == ["error-blur@64", "error-lag@2"]
    assert found.episodes == EPISODES and {cost.family for cost in found.costs} == {"looks"}


def test_an_arm_without_an_episode_of_the_oracle_is_not_shown_yet() -> None:
    rows = [row for row in outcomes() if (row["episode"] == 0) != (row["arm"] == "error-lag@4") and row["episode"] < 2]
    found = summarise_errors("imagenav", "matcher", rows, decisions(), ARMS)
    assert [line.arm for line in found.lines] == ["error-blur@64", "error-lag@2"]


def test_a_single_episode_has_no_interval_of_regret() -> None:
    first = [row for row in outcomes() if row["episode"] == 0]
    found = summarise_errors("imagenav", "matcher", first, decisions(), ARMS)
    cells = [cell for _, own in list_lines(found) for cell in own]
    assert "+1.000 [?]" in cells and not any("nan" in cell for cell in cells)


def test_an_error_that_costs_nothing_so_far_is_not_sure_to_cost_nothing(table) -> None:
    (looks,) = [cost for cost in table.costs if cost.family == "looks" and cost.measure == "1 - SSIM"]
    assert looks.loss.low < 0 < looks.loss.high < 5


def test_errors_that_were_not_measured_are_drawn_without_costs(tmp_path: Path) -> None:
    found = summarise_errors("imagenav", "matcher", outcomes(), [], ARMS)
    assert found.costs == () and found.distance == "1 - SSIM"
    assert all(path.stat().st_size > 0 for path in write_errors([found], SETTINGS, "{}", tmp_path))
    print_errors([found])


@pytest.mark.parametrize(
    "changes", [{"tasks": ("walking",)}, {"kinds": ()}, {"doses": 4}, {"episodes": 0}, {"tier": "beyond"}]
)
def test_settings_out_of_range_are_refused(changes: dict) -> None:
    with pytest.raises(ArgumentError, match="errors: expected"):
        ErrorSettings(**changes)


def test_a_preset_and_a_tier_say_what_is_run() -> None:
    settings = ErrorSettings(tasks=("imagenav",), preset="foresight", tier="beyond")
    task, agent = make_recipes("imagenav", settings)
    assert task.options == {"seed": 0, "per_scene": 2, "tier": "beyond", "preset": "foresight"}
    assert agent.policy == settings.find_policy("imagenav") == "navigator"
    assert ErrorSettings(preset="foresight", policy="matcher").find_policy("imagenav") == "matcher"
    with pytest.raises(ArgumentError, match="manipulation: no preset 'foresight'"):
        ErrorSettings(preset="foresight").find_policy("manipulation")


def test_what_makes_no_sense_is_left_out_by_name() -> None:
    settings = ErrorSettings()
    assert settings.list_left_out("manipulation") == ["open"] and settings.list_left_out("imagenav") == []
    arms = settings.list_arms("imagenav")
    assert len(arms) == 3 * len(ERRORS) and arms["error-drift@0.05"] == ("drift", 0.05)
    assert [dose for _, dose in ErrorSettings(doses=2, kinds=("lag",)).list_arms("ar").values()] == [2.0, 4.0]


def test_a_study_goes_on_where_it_stopped_and_gains_kinds(two_rooms: str, tmp_path: Path, capsys) -> None:
    settings = ErrorSettings(
        tasks=("imagenav",), kinds=("blur", "ignored"), doses=1, episodes=2, scenes=two_rooms, size=(64, 128)
    )
    study_errors(tmp_path / "study", replace(settings, kinds=("ignored",)))
    found = study_errors(tmp_path / "study", settings)
    (table,) = found.tables
    assert [line.arm for line in table.lines] == ["error-blur@64", "error-ignored@1"] and table.episodes == 2
    stores = sorted((tmp_path / "study").rglob("run.sqlite"))
    others = replace(settings, episodes=9, seed=5, scenes=None, size=None, policy="heuristic", fidelity_share=1.0)
    assert read_errors(tmp_path / "study", others).to_json() == found.to_json(), "as it was started"
    with pytest.raises(StoreError, match="a different configuration"):
        study_errors(tmp_path / "study", replace(settings, kinds=("blur",)))
    again = study_errors(tmp_path / "study", settings)
    assert again.to_json() == found.to_json() == read_errors(tmp_path / "study", settings).to_json()
    assert stores == sorted((tmp_path / "study").rglob("run.sqlite"))
    arguments = ["--out", str(tmp_path / "study"), "--tasks", "imagenav", "--kinds", "blur,ignored", "--doses", "1"]
    assert main(["study", "errors", *arguments, "--episodes", "2", "--scenes", two_rooms, "--read-only"]) == 0
    assert "Errors of control cost" in " ".join(capsys.readouterr().out.split())
    assert main(["study", "errors", *arguments, "--episodes", "20", "--scenes", two_rooms]) == 2
    assert "shard-1-of-1, a part of a study of another number of episodes" in capsys.readouterr().err
    assert main(["study", "errors", "--out", str(tmp_path / "study"), "--kinds", "lag", "--read-only"]) == 2
    assert "no episode of an arm with an error so far" in capsys.readouterr().err
    numbers = json.loads((tmp_path / "study" / "errors.json").read_text())
    assert np.isfinite(numbers["tasks"][0]["lines"][0]["outcome"]["value"])


def test_distances_of_few_episodes_go_with_the_success_of_many(two_rooms: str, tmp_path: Path, capsys) -> None:
    many = ErrorSettings(
        tasks=("imagenav",), kinds=("blur",), doses=1, episodes=2, scenes=two_rooms, size=(64, 128), fidelity_share=0.01
    )
    few = replace(many, episodes=1, fidelity_share=1.0)
    (own,) = study_errors(tmp_path / "many", many).tables
    (measured,) = study_errors(tmp_path / "few", few).tables
    found = read_errors(tmp_path / "many", many, distances=tmp_path / "few")
    assert found.to_json() == study_errors(tmp_path / "many", many, distances=tmp_path / "few").to_json()
    (both,) = found.tables
    assert not own.lines[0].measures and measured.episodes == 1 and both.episodes == 2
    assert str(both.lines[0].measures) == str(measured.lines[0].measures)  # as text, since intervals of one are NaN
    assert both.lines[0].measures["1 - SSIM"].n == 1
    assert both.lines[0].outcome == own.lines[0].outcome and both.references == own.references
    assert {cost.family for cost in both.costs} == {"looks"} and own.costs == ()
    folders = ["--out", str(tmp_path / "many"), "--distances", str(tmp_path / "few")]
    arguments = ["study", "errors", "--tasks", "imagenav", "--kinds", "blur", "--doses", "1", *folders, "--read-only"]
    assert main(arguments) == 0
    assert "Errors of looks cost" in " ".join(capsys.readouterr().out.split())

    study_errors(tmp_path / "larger", replace(few, size=(72, 144)))
    with pytest.raises(StoreError, match=r"expected distances of the same agent as in .*many.*--fidelity-share"):
        read_errors(tmp_path / "many", many, distances=tmp_path / "larger")
    study_errors(tmp_path / "seeded", replace(few, seed=1))
    with pytest.raises(StoreError, match="expected distances of the same task as in"):
        read_errors(tmp_path / "many", many, distances=tmp_path / "seeded")
    with pytest.raises(StoreError, match="has no run of imagenav; name the folder of a study"):
        read_errors(tmp_path / "many", many, distances=tmp_path)
    with pytest.raises(StoreError, match="has no run of imagenav"):
        study_errors(tmp_path / "new", many, distances=tmp_path)
    assert not (tmp_path / "new").exists(), "nothing was run before"


READ = """
import os, resource, sys
from wiw.studies.errors import ErrorSettings, read_errors
resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 30,) * 2)
print(read_errors(sys.argv[1], ErrorSettings(tasks=("imagenav",))).to_json())
"""


def write_part(folder: Path) -> None:
    """Write a part of a study in which every arm has ended four episodes."""
    arms = ("none", "oracle", *ARMS)
    agents = {arm: {"policy": "matcher", "model_options": {}} for arm in arms}
    config = {"task": {}, "seed": 0, "episodes": 4, "arms": [{"name": arm, "agent": agents[arm]} for arm in arms]}
    info = {"task": {"name": "imagenav", "options": {}}, "agents": agents, "limits": {"fidelity_share": 0.25}}
    info |= {"pictures": [], "live": 1, "workers": 1}
    with RunStore.create(folder, config, info, LineTask().episodes(4)) as store:
        for row in outcomes():
            if (index := row["episode"]) < 4:
                result = EpisodeResult(index, str(index), row["scene"], "done", row["metrics"], 1.0)
                store.write(OutcomeRow(row["arm"], result))


def test_a_study_has_more_parts_than_a_process_may_open_files(tmp_path: Path) -> None:
    first = tmp_path / "imagenav" / "shard-1-of-40"
    write_part(first)
    for number in range(2, 41):
        shutil.copytree(first, first.with_name(f"shard-{number}-of-40"))
    done = subprocess.run(
        [sys.executable, "-c", READ, tmp_path], check=False, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["tasks"][0]["episodes"] == 4
