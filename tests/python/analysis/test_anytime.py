# SPDX-License-Identifier: Apache-2.0
"""Looking early: confidence sequences, rules for stopping, and runs that stop by them."""

import math
import sqlite3
from dataclasses import replace

import numpy as np
import pytest
from fakes import LineAgent, LineTask

import wiw
from wiw.analysis.anytime import SHARES, find_anytime_interval, find_anytime_p, trace_capital
from wiw.analysis.simulate import draw_outcome_counts
from wiw.analysis.stopping import list_units, parse_stop_rule
from wiw.cli import main
from wiw.errors import ArgumentError, StoreError
from wiw.runs.config import RunConfig
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.studies.evaluate import run_arms
from wiw.studies.run_log import load_run
from wiw.types import Episode

ARMS = ["none", "oracle", "placebo-shuffled:warp"]


def test_capital_is_that_of_a_gambler():
    """Every share of the capital is a pot of its own, which is doubled or lost bet by bet."""
    values, mean = np.array([0.2, 0.9, 1.0, 0.4]), 0.3
    pots = []
    for share in SHARES:
        over, under = 1.0, 1.0
        for value in values:
            over *= 1 + share / mean * (value - mean)
            under *= 1 - share / (1 - mean) * (value - mean)
        pots += [over, under]
    assert trace_capital(values, np.array([mean]))[-1, 0] == pytest.approx(math.log(np.mean(pots)))


def test_a_mean_is_held_until_the_gambler_has_won_twenty_times_her_stake():
    values = np.random.default_rng(0).uniform(0, 1, 60)
    low, high = find_anytime_interval(values)
    for mean, held in ((low - 0.004, False), (low + 0.004, True), (high - 0.004, True), (high + 0.004, False)):
        assert (trace_capital(values, np.array([mean])).max() < math.log(20)) == held
    wins = np.full(9, 1.0)
    assert find_anytime_p(wins) == pytest.approx(1 / np.mean([*((1 + SHARES) ** 9), *((1 - SHARES) ** 9)]))
    assert find_anytime_interval([]) == (0, 1) and find_anytime_p([]) == 1


def test_intervals_only_shrink():
    values = np.random.default_rng(1).choice([-1.0, 0.0, 1.0], 50, p=[0.1, 0.6, 0.3])
    ends = np.array([find_anytime_interval(values[:count], bounds=(-1, 1)) for count in range(1, 51)])
    assert (np.diff(ends[:, 0]) >= 0).all() and (np.diff(ends[:, 1]) <= 0).all()
    assert -1 <= ends[-1, 0] < 0.2 < ends[-1, 1] <= 1


def measure_false_stops(share, correlation, scenes, per_scene, runs):
    """Percent of runs of two equal arms in which any look, after each scene, finds a difference."""
    rng = np.random.default_rng([round(100 * share), round(10 * correlation), scenes])
    counts = draw_outcome_counts([share, share, 1 - 2 * share], [per_scene] * scenes, correlation, runs, rng)
    means = (counts @ np.array([1.0, -1.0, 0.0])) / per_scene
    return 100 * np.mean([find_anytime_p(one) <= 0.05 for one in means])


def measure_misses(rate, correlation, scenes, runs):
    """Percent of runs in which any look's interval of a rate misses it."""
    rng = np.random.default_rng([round(100 * rate), scenes])
    counts = draw_outcome_counts([rate, 1 - rate], [5] * scenes, correlation, runs, rng)
    return 100 * np.mean([trace_capital(one[:, 0] / 5, np.array([rate])).max() >= math.log(20) for one in counts])


def test_looking_after_every_scene_finds_nothing_that_is_not_there():
    assert measure_false_stops(0.3, 0.3, 40, 5, runs=300) <= 5
    assert measure_misses(0.2, 0.1, 40, runs=300) <= 5


@pytest.mark.nightly
@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("per_scene", [1, 5])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 0.5])
def test_looking_at_any_time_keeps_the_error_rate(share, per_scene, correlation):
    assert measure_false_stops(share, correlation, 200, per_scene, runs=2000) < 5 + 1.5
    assert measure_misses(share, correlation, 200, runs=2000) < 5 + 1.5


@pytest.mark.parametrize(
    ("text", "targets", "width"),
    [
        ("oracle-none excludes 0", (("oracle", "none"),), None),
        (" placebo-shuffled:warp - none  excludes 0", (("placebo-shuffled:warp", "none"),), None),
        ("width<8", tuple((arm,) for arm in ARMS), 8.0),
        ("width(oracle) < 7.5", (("oracle",),), 7.5),
        ("width(oracle-placebo-shuffled:warp)<10", (("oracle", "placebo-shuffled:warp"),), 10.0),
    ],
)
def test_rules_that_are_understood(text, targets, width):
    rule = parse_stop_rule(text, ARMS, 20)
    assert (rule.targets, rule.width) == (targets, width)
    assert list(rule.list_bounds(50)) == [20, 40, 50] and list(rule.list_bounds(20)) == [20]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("oracle-warp excludes 0", "'oracle-warp' is neither an arm nor a difference of two"),
        ("oracle excludes 0", "a single arm, not a difference"),
        ("oracle-none excludes 5", "no such rule"),
        ("width<0", "no interval is narrower than 0 points"),
        ("width(warp)<8", "'warp' is neither an arm"),
        ("", "no such rule"),
    ],
)
def test_rules_that_are_not(text, message):
    with pytest.raises(ArgumentError) as error:
        parse_stop_rule(text, ARMS, 20)
    for expected in (message, "'A-B excludes 0'", "'width<N'", "none, oracle, placebo-shuffled:warp"):
        assert expected in str(error.value)


def test_a_scene_counts_once_all_of_it_has_ended():
    def episode(scene):
        return Episode("", scene, (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0, 1.0)

    scenes = ["apartments:val/1", "b", "apartments:val/1?state", "b", "c"]
    assert list_units([episode(scene) for scene in scenes], 4) == [[0, 2], [1, 3]]
    assert list_units([episode(scene) for scene in scenes], 3) == [[0, 2]]
    assert list_units([episode("house")] * 5, 3) == [[0], [1], [2]]


@pytest.mark.parametrize(("scenes", "said"), [(["house"] * 4, "over 4 episodes"), (["a", "b"] * 2, "over 2 scenes")])
def test_a_look_names_what_it_counts(scenes, said):
    episodes = [Episode("", scene, (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0, 1.0) for scene in scenes]
    rows = [{"arm": "none", "episode": i, "status": "done", "metrics": {"success": 1.0}} for i in range(4)]
    assert str(parse_stop_rule("width<8", ["none"], 4).look(4, episodes, rows)).startswith(
        "4 of 4 episodes: none 100.0"
    )
    assert said in parse_stop_rule("width<8", ["none"], 4).look(4, episodes, rows).text


def list_scenes(scenes):
    return [Episode("", scene, (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0, 1.0) for scene in scenes]


@pytest.mark.parametrize(
    ("bound", "said"),
    [
        (3, "oracle-none unknown: no scene is complete so far"),
        (4, "oracle-none +100.0 [-"),
        (8, "over 2 scenes"),
    ],
)
@pytest.mark.parametrize("rule", ["oracle-none excludes 0", "width(oracle-none)<300"])
def test_a_look_before_scenes_are_complete_says_so(bound, said, rule):
    """Episodes of the first of several scenes do not count as units."""
    rows = [
        {"arm": arm, "episode": i, "status": "done", "metrics": {"success": float(arm == "oracle")}}
        for arm in ("none", "oracle")
        for i in range(bound)
    ]
    look = parse_stop_rule(rule, ["none", "oracle"], 4).look(bound, list_scenes(["a"] * 4 + ["b"] * 4), rows)
    assert said in look.text and ("over 1 scene, " in f"{look.text}, ") == (bound == 4)
    assert look.is_enough == (bound > 3 and rule.startswith("width"))


class FewScenes(LineTask):
    """Twenty episodes in each scene."""

    def episodes(self, count):
        return [replace(one, scene=f"line/{i // 20}") for i, one in enumerate(super().episodes(count))]


def test_p_is_over_complete_scenes_however_many_have_ended(tmp_path):
    """Twenty of twenty episodes of a single scene say next to nothing about other scenes; nor does a part of one."""
    agents = {"none": LineAgent(0.0), "oracle": LineAgent(1.0)}
    log = run_arms(FewScenes(), agents, 60, out=tmp_path, until="width<1", look_every=30, progress=False)
    whole = log.numbers().difference("oracle", "none")
    rows = {(row["arm"], row["episode"]): row["metrics"]["success"] for row in log.episodes}
    assert whole.p_value == pytest.approx(find_anytime_p(average(rows, 3)))
    for ended, scenes in ((45, 2), (39, 1), (20, 1), (19, 0)):
        with sqlite3.connect(tmp_path / "run.sqlite") as store:
            store.execute("DELETE FROM outcome WHERE episode >= ? AND arm = 'none'", (ended,))
        numbers = load_run(tmp_path).numbers()
        found = numbers.difference("oracle", "none")
        assert found.estimate.n == ended
        assert found.p_value == pytest.approx(find_anytime_p(average(rows, scenes))) and not found.is_shown
        text = " ".join(str(numbers).split())
        assert f"a betting test over scenes ({scenes} {'is' if scenes == 1 else 'are'} complete), valid at any" in text
    assert find_anytime_p(np.ones(19)) < 0.001, "as episodes they would seem to show it"


def average(rows, scenes):
    return [
        np.mean([rows["oracle", i] - rows["none", i] for i in range(20 * scene, 20 * scene + 20)])
        for scene in range(scenes)
    ]


class OneScene(LineTask):
    """All episodes in one scene."""

    def episodes(self, count):
        return [replace(one, scene="line") for one in super().episodes(count)]


def test_in_a_run_of_one_scene_bets_are_on_episodes_and_the_notes_say_so(tmp_path):
    agents = {"none": LineAgent(0.0), "oracle": LineAgent(1.0)}
    log = run_arms(OneScene(), agents, 20, out=tmp_path, until="width<1", look_every=30, progress=False)
    numbers, rows = log.numbers(), {(row["arm"], row["episode"]): row["metrics"]["success"] for row in log.episodes}
    differences = [rows["oracle", i] - rows["none", i] for i in range(20)]
    assert numbers.difference("oracle", "none").p_value == pytest.approx(find_anytime_p(differences))
    text = " ".join(str(numbers).split())
    assert "a betting test over episodes of one scene, which says nothing about other scenes, valid at any time" in text
    assert "a betting test over scenes" not in text


AGENTS = {"none": LineAgent(0.2), "oracle": LineAgent(1.0)}


def test_a_run_stops_as_soon_as_it_has_shown_enough(tmp_path, capsys):
    run = tmp_path / "run"
    given = {"out": run, "until": "oracle-none excludes 0", "look_every": 16}
    log = run_arms(LineTask(), AGENTS, 200, **given)
    stopped = log.store.info["stopped"]
    assert log.complete and 16 <= stopped["episodes"] < 80 and stopped["episodes"] % 16 == 0
    assert {row["episode"] for row in log.episodes} == set(range(stopped["episodes"]))
    assert "of 200 episodes: oracle-none +" in stopped["why"]
    said = capsys.readouterr().err
    assert said.count("of 200 episodes: oracle-none") == stopped["episodes"] // 16 and "so the run stops" in said
    numbers = log.numbers()
    assert numbers["none"].pending == 0 and numbers["none"].total == stopped["episodes"]
    assert numbers.difference("oracle", "none").is_shown
    assert numbers.difference("oracle", "none", "actions").p_value == 1, "bets need bounds"
    for page in (str(numbers), log.report().read_text()):
        text = " ".join(page.split())
        assert (
            f"checked every 16 episodes, to stop once oracle-none excludes 0. It stopped at {stopped['episodes']}"
            in text
        )
        assert "a betting test over scenes" in text
    assert run_arms(LineTask(), AGENTS, 200, resume=True, **given).store.info["stopped"] == stopped
    with pytest.raises(StoreError, match="until"):
        run_arms(LineTask(), AGENTS, 200, out=run, resume=True, until="width<5", progress=False)


def test_the_interval_at_the_stop_is_that_of_scenes_in_order(tmp_path):
    log = run_arms(LineTask(), AGENTS, 60, out=tmp_path, until="width(oracle-none)<90", look_every=20, progress=False)
    rows = {(row["arm"], row["episode"]): row["metrics"]["success"] for row in log.episodes}
    count = log.store.info["stopped"]["episodes"]
    means = [
        np.mean([rows["oracle", i] - rows["none", i] for i in pair])
        for pair in np.arange(count).reshape(-1, 2).tolist()
    ]
    low, high = find_anytime_interval(means, bounds=(-1, 1))
    assert f"[{100 * low:.1f}, {100 * high:.1f}] over {count // 2} scenes" in log.store.info["stopped"]["why"]


def test_a_run_that_is_never_sure_ends_with_its_episodes(tmp_path):
    log = run_arms(LineTask(), AGENTS, 12, out=tmp_path, until="width<1", look_every=5, progress=False)
    assert "stopped" not in log.store.info and len(log.episodes) == 24
    assert "It was never stopped, as the rule held at no look." in " ".join(str(log.numbers()).split())


def test_an_interrupted_run_goes_on_to_the_same_stop(tmp_path, monkeypatch):
    rule = {"until": "width(oracle)<40", "look_every": 20, "progress": False}
    decide = LineAgent.decide_batch

    def interrupt(agent, queries):
        if agent.drive == 1 and any(query.key.episode == 30 for query in queries):
            raise KeyboardInterrupt
        return decide(agent, queries)

    monkeypatch.setattr(LineAgent, "decide_batch", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_arms(LineTask(), AGENTS, 100, out=tmp_path / "cut", **rule)
    assert "stopped" not in load_run(tmp_path / "cut").store.info
    monkeypatch.undo()
    resumed = run_arms(LineTask(), AGENTS, 100, out=tmp_path / "cut", resume=True, **rule)
    whole = run_arms(LineTask(), AGENTS, 100, out=tmp_path / "whole", **rule)
    assert resumed.store.info["stopped"] == whole.store.info["stopped"]
    assert str(resumed.numbers()) == str(whole.numbers())


@pytest.mark.nightly
def test_workers_stop_at_the_same_look(tmp_path):
    rule = {"until": "width(none)<60", "look_every": 8, "progress": False}
    agents = {"none": AgentRecipe("heuristic")}
    runs = [
        run_arms(TaskRecipe("fakes:line_task"), agents, 40, out=tmp_path / str(workers), workers=workers, **rule)
        for workers in (1, 2)
    ]
    assert runs[0].store.info["stopped"] == runs[1].store.info["stopped"]
    assert str(runs[0].numbers()) == str(runs[1].numbers())


def test_settings_that_do_not_go_together():
    with pytest.raises(ArgumentError, match="give --episodes"):
        RunConfig(until="width<8")
    with pytest.raises(ArgumentError, match="shard"):
        RunConfig(until="width<8", episodes=20, shard="1/2")
    with pytest.raises(ArgumentError, match="look_every of at least 1"):
        RunConfig(look_every=0)


def test_command_line(tmp_path, capsys):
    run = ["run", "fakes:line_task", "--policy", "heuristic", "--arms", "none,twin=none", "--episodes", "8"]
    run += ["--out", str(tmp_path / "run"), "--look-every", "4", "--no-report"]
    assert main([*run, "--until", "twin-none excludes 1"]) == 2
    assert "expected 'A-B excludes 0'" in capsys.readouterr().err and not (tmp_path / "run").exists()
    assert main([*run, "--until", "twin-none excludes 0"]) == 0
    assert "until   twin-none excludes 0; checked every 4 episodes per arm" in capsys.readouterr().err
    assert wiw.load_run(tmp_path / "run").store.info["until"] == {"rule": "twin-none excludes 0", "every": 4}
    with sqlite3.connect(tmp_path / "run" / "run.sqlite") as store:
        store.execute("DELETE FROM outcome WHERE arm = 'twin' AND episode > 5")
    assert main(["resume", str(tmp_path / "run"), "--no-report"]) == 0
    said = capsys.readouterr().err
    assert "4 of 8 episodes: twin-none" in said and "8 of 8 episodes: twin-none" in said
    assert wiw.load_run(tmp_path / "run").complete
