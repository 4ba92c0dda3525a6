# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from fakes import LineAgent, LineTask
from scipy import stats

import wiw
from wiw.analysis.pilot import PILOTS, estimate_correlation, read_pilot
from wiw.analysis.power import simulate_power
from wiw.analysis.simulate import draw_outcome_counts
from wiw.analysis.statistics import compute_p_value, estimate_difference, holm
from wiw.cli import main
from wiw.errors import ArgumentError
from wiw.metrics.metric import SUCCESS
from wiw.studies.evaluate import run_arms


@pytest.fixture
def fewer_runs(monkeypatch):
    """Simulate about 1,000 runs, not 8,000, where a chance need not be known to a percent."""
    monkeypatch.setattr("wiw.analysis.power._DRAWS", 30_000)


def test_the_power_of_flips_of_single_episodes_is_the_exact_sum():
    """Without correlation: over all numbers of wins and losses of 40 pairs."""
    won, lost, n = 0.3, 0.05, 40
    exact = 0.0
    for wins in range(n + 1):
        for losses in range(min(wins, n - wins + 1)):
            if stats.binomtest(wins, wins + losses).pvalue <= 0.05:
                exact += stats.multinomial.pmf([wins, losses, n - wins - losses], n, [won, lost, 1 - won - lost])
    _, by_test = simulate_power(won, lost, n, 1, 0.0, 0.95, np.random.default_rng(0))
    assert by_test == pytest.approx(exact, abs=0.02)


def test_as_many_episodes_do_show_the_difference():
    """With the functions that make the tables, on episodes drawn one by one."""
    plan = wiw.power(20, losses=5, correlation=0.1)
    assert plan.won == 25 and plan.episodes == plan.scenes * plan.per_scene
    rng = np.random.default_rng(3)
    concentration = 9 * np.array([0.25, 0.05, 0.7])  # correlation 1 / (1 + 9)
    scenes = list(np.repeat(np.arange(plan.scenes), plan.per_scene))
    shown = []
    for _ in range(150):
        local = rng.dirichlet(concentration, plan.scenes)
        ways = np.concatenate([rng.choice(3, plan.per_scene, p=shares) for shares in local])
        arm, base = (ways == 0).astype(float), (ways == 1).astype(float)
        found = estimate_difference(arm, base, scenes, SUCCESS)
        shown.append((found.low > 0, compute_p_value(arm, base, scenes, SUCCESS) <= 0.05))
    by_interval, by_test = np.mean(shown, 0)
    assert by_interval == pytest.approx(plan.by_interval, abs=0.1) and by_test == pytest.approx(plan.by_test, abs=0.1)
    assert 0.8 <= plan.by_interval < 0.9


@pytest.mark.usefixtures("fewer_runs")
def test_what_costs_episodes():
    plain = wiw.power(15).episodes
    assert wiw.power(10).episodes > plain
    assert wiw.power(15, losses=8).episodes > plain
    assert wiw.power(15, correlation=0.3).episodes > plain
    assert wiw.power(15, chance=0.95).episodes > plain
    assert wiw.power(15, arms=5).episodes > plain
    assert wiw.power(15, per_scene=1).scenes > wiw.power(15).scenes
    worse, better = wiw.power(-15, base=60), wiw.power(15, base=60)
    assert worse.scenes == better.scenes
    assert (worse.won, worse.lost) == (better.lost, better.won) == (2, 17)
    assert "if 2 % of episodes are won, 17 % are lost" in str(worse)


@pytest.mark.parametrize(
    "numbers", [{"scenes": 12}, {"scenes": 40, "losses": 6}, {"scenes": 40, "arms": 4, "per_scene": 2}]
)
def test_the_least_difference_is_the_one_that_needs_so_many_scenes(numbers):
    found = wiw.power(**numbers)
    options = {name: value for name, value in numbers.items() if name != "scenes"}
    assert found.scenes == numbers["scenes"] and 0.8 <= found.by_interval < 0.85
    assert (
        wiw.power(found.difference + 1, **options).scenes
        <= found.scenes
        <= wiw.power(found.difference - 1, **options).scenes
    )


@pytest.mark.usefixtures("fewer_runs")
def test_what_shows_less():
    plain = wiw.power(scenes=20).difference
    assert wiw.power(scenes=40).difference < plain
    assert wiw.power(scenes=20, losses=8).difference > plain
    assert wiw.power(scenes=20, correlation=0.3).difference > plain
    assert wiw.power(scenes=20, arms=5).difference > plain
    assert wiw.power(scenes=20, chance=0.95).difference > plain


def test_several_arms_are_reckoned_with_as_holm_does():
    assert holm([0.05 / 4, 0.5, 0.6, 0.7])[0] == pytest.approx(0.05)
    assert "as one of 4 arms" in str(wiw.power(15, arms=4))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"difference": 0}, "a difference other than 0"),
        ({"difference": 90}, "+90 points mean that 92 % are won, but the base fails only in 80 %"),
        ({"difference": -30}, "-30 points mean that 32 % are lost, but the base succeeds only in 20 %"),
        ({"difference": 10, "correlation": 1.0}, "correlation in [0, 1)"),
        ({"difference": 10, "chance": 1.0}, "chance between 0 and 1"),
        ({"difference": 0.01}, "more than 100000 scenes"),
        ({}, "either a difference"),
        ({"difference": 10, "scenes": 20}, "either a difference"),
        ({"scenes": 1}, "at least 2 scenes"),
        ({"scenes": 2, "per_scene": 1}, "cannot show a difference of up to 78 points"),
        ({"scenes": 20, "arms": 0}, "arms of at least 1"),
    ],
)
def test_numbers_that_no_run_could_have(numbers, message):
    with pytest.raises(ArgumentError) as error:
        wiw.power(**numbers)
    assert message in str(error.value)


@pytest.mark.usefixtures("fewer_runs")
def test_command_line(capsys):
    assert main(["power", "15", "--arms", "3"]) == 0
    assert str(wiw.power(15, arms=3)) == capsys.readouterr().out.strip()
    assert main(["power", "-15", "--base", "50"]) == 0 and "-15 points" in capsys.readouterr().out
    assert main(["power", "--scenes", "40"]) == 0
    assert str(wiw.power(scenes=40)) == capsys.readouterr().out.strip()
    assert main(["power", "10", "--scenes", "40"]) == 2 and "either a difference" in capsys.readouterr().err
    assert main(["power"]) == 0 and "12/2" in capsys.readouterr().out
    assert main(["power", "90"]) == 2 and "80 %" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["power", "--help"])
    assert "wiw power 10 --arms 4" in capsys.readouterr().out


def test_a_pilot_says_how_many_episodes_the_next_run_needs(tmp_path, capsys):
    """Two arms of a run: won and lost, and how alike episodes of a scene are."""
    run = tmp_path / "run"
    arms = {"mine": LineAgent(0.7), "warp": LineAgent(0.4), "another": LineAgent(0.2)}
    log = run_arms(LineTask(), arms, 60, out=run, progress=False)
    success = {arm: np.array([r["metrics"]["success"] for r in log.episodes if r["arm"] == arm]) for arm in log.arms}
    pilot = read_pilot(log, "mine", "warp")
    assert pilot.base == pytest.approx(100 * success["warp"].mean())
    assert pilot.losses == pytest.approx(100 * np.mean(success["warp"] > success["mine"])) and pilot.per_scene == 2
    assert read_pilot(log, "warp", "mine").losses == pilot.losses, "the better arm's, whichever is the base"
    assert main(["power", "15", "--pilot", str(run), "--pilot-arms", "mine,warp"]) == 0
    said = capsys.readouterr().out
    assert "pilot: mine and warp, 60 episodes" in said
    assert str(wiw.power(15, **pilot.settings())) in said
    for flags, message in (
        (["--pilot", str(run)], "--pilot RUN with --pilot-arms ARM,BASE"),
        (["--pilot", str(run), "--pilot-arms", "mine"], "expected --pilot-arms ARM,BASE, got 'mine'"),
        (["--pilot", str(run), "--pilot-arms", "mine,oracle"], "no arm 'oracle'"),
        (["--task", "chess"], "no pilot for task 'chess'; choose from imagenav"),
    ):
        assert main(["power", "15", *flags]) == 2 and message in " ".join(capsys.readouterr().err.split())


def test_the_correlation_of_a_pilot_is_that_of_its_scenes():
    rng = np.random.default_rng(1)
    for correlation in (0.0, 0.3):
        (counts,) = draw_outcome_counts([0.3, 0.1, 0.6], [6] * 3000, correlation, 1, rng)
        values = np.concatenate([np.repeat([1.0, -1.0, 0.0], ways) for ways in counts])
        found = estimate_correlation(values, np.repeat(np.arange(3000), 6))
        assert found == pytest.approx(correlation, abs=0.03)
    assert estimate_correlation(np.ones(4), np.arange(4)) == 0


@pytest.mark.usefixtures("fewer_runs")
@pytest.mark.parametrize(
    "given",
    [
        {"difference": "10"},
        {"difference": [10]},
        {"difference": float("nan")},
        {"difference": 10, "base": "20"},
        {"difference": 10, "per_scene": 2.5},
        {"difference": 10, "arms": 1.5},
        {"difference": 10, "seed": -1},
        {"scenes": 10.5},
    ],
)
def test_what_is_no_such_number_is_refused(given):
    with pytest.raises(ArgumentError, match=r"power: \w+: expected (a finite number|a whole number|at least 0), got"):
        wiw.power(**given)


def test_two_models_five_points_apart_on_each_task(capsys):
    assert main(["power", "5", "--task", "all"]) == 0
    shown = capsys.readouterr().out
    assert all(task in shown for task in PILOTS)
    assert main(["power", "--task", "all", "--scenes", "40"]) == 0
    shown = capsys.readouterr().out
    assert all(task in shown for task in PILOTS) and "manipulation: power: 40 episodes in 40 scenes" in shown
    assert main(["power", "5", "--task", "all", "--chance", "2"]) == 2
    assert main(["power", "5", "--task", "imagenav"]) == 0
    shown = capsys.readouterr().out
    assert str(wiw.power(5, **PILOTS["imagenav"].settings())) in shown


@pytest.mark.parametrize(
    ("arms", "said"), [(1, "its 95 % interval, and"), (4, "its 98.75 % interval, adjusted for 4 arms, and")]
)
def test_the_interval_is_named_by_its_confidence(arms, said, capsys):
    """One of four arms has an interval that excludes 0 where its p, times four, is at most 0.05."""
    plan = wiw.power(20, arms=arms)
    assert said in str(plan) and plan.confidence == pytest.approx(100 - 5 / arms)
    assert main(["power", "--arms", str(arms)]) == 0
    assert said.removeprefix("its ").removesuffix(", and") in " ".join(capsys.readouterr().out.split())
