# SPDX-License-Identifier: Apache-2.0
"""Placebos cost what the real arm costs, tell nothing of the plan, and are as reproducible as anything else."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from fakes import LineTask
from hypothesis import given, settings
from hypothesis import strategies as st
from pressing_policy import Pressing

import wiw
from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT
from wiw.cli import main
from wiw.errors import ArgumentError
from wiw.experiments.gating import Gated
from wiw.experiments.placebos import ShuffledPlacebo, SwappedPlacebo, shuffle
from wiw.experiments.semantics import Labelled
from wiw.loop.attempts import Attempted
from wiw.loop.imagination import ModelInput
from wiw.loop.imagine import make_model_spec
from wiw.loop.memory import Query
from wiw.loop.model_imaginer import ModelImaginer
from wiw.runs.compose import NextEpisodes, RunContext
from wiw.runs.recipes import AgentRecipe, TaskRecipe, absolute, arm_recipes
from wiw.runs.verify import verify
from wiw.tasks.imagenav import ImageNav
from wiw.tasks.manipulation import Manipulation
from wiw.types import Key, Proposal

NOWHERE = RunContext(LineTask())
SPEC = make_model_spec(wiw.accepts(control="trajectory"))
PLANS = st.lists(
    st.lists(st.sampled_from([int(FORWARD), int(TURN_LEFT), int(TURN_RIGHT), int(STOP)]), min_size=1, max_size=6),
    min_size=1,
    max_size=5,
)


def proposals(plans):
    return [Proposal(plan, prior=float(i), note=str(i)) for i, plan in enumerate(plans)]


@settings(max_examples=60)
@given(PLANS, st.integers(0, 5))
def test_shuffling_keeps_lengths_primitives_and_stops(plans, decision) -> None:
    dealt = shuffle(proposals(plans), Key(3, 1, decision), SPEC)
    assert [len(p.actions) for p in dealt] == [len(plan) for plan in plans]
    assert sorted(a for p in dealt for a in p.actions.tolist()) == sorted(a for plan in plans for a in plan)
    for p, plan in zip(dealt, plans, strict=True):
        assert [a == STOP for a in p.actions.tolist()] == [a == STOP for a in plan]
    assert [(p.prior, p.note) for p in dealt] == [(p.prior, p.note) for p in proposals(plans)]
    again = shuffle(proposals(plans), Key(3, 1, decision), SPEC)
    assert all((a.actions == b.actions).all() for a, b in zip(dealt, again, strict=True))


def test_shuffling_differs_by_decision_and_usually_changes_plans() -> None:
    plans = proposals([[1, 1, 1, 1, 1], [2, 2, 1, 1, 1], [1, 3, 1, 3, 1]])
    found = {tuple(tuple(p.actions.tolist()) for p in shuffle(plans, Key(0, 0, d), SPEC)) for d in range(30)}
    assert len(found) > 15 and tuple(tuple(p.actions.tolist()) for p in plans) not in found


def test_shuffling_leaves_no_plan_its_own_future() -> None:
    """Where turns begin the plans, orders that cost the same often differ in one plan alone."""
    plans = proposals([[1, 1, 1, 1, 1], [3, 1, 1, 1, 1], [2, 1, 1, 1, 1]])
    dealt = [shuffle(plans, Key(0, 0, decision), SPEC) for decision in range(30)]
    same = [sum(np.array_equal(p.actions, plan.actions) for p, plan in zip(own, plans, strict=True)) for own in dealt]
    assert np.mean(same) < 0.2


class Seen(wiw.WorldModel):
    """Answers with the mean colour of what it is shown; remembers plans and colours."""

    accepts = wiw.accepts(control="action", view="panorama")

    def __init__(self) -> None:
        self.log = []

    def rollout(self, observations, controls, seeds):
        for image, control in zip(observations.image, controls, strict=True):
            self.log.append((int(image.mean()), control.actions[: control.length].tolist()))
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)


class Fixed(wiw.Policy):
    """Three plans, one beginning with a turn; likes bright ends."""

    def propose(self, situations, candidates, horizon):
        return [[Proposal([1, 1, 2]), Proposal([2, 1, 1]), Proposal([1, 3, 1])] for _ in situations]

    def score(self, situations, proposals, rollouts):
        return [np.array([float(r.frames[-1].mean()) for r in rows]) for rows in rollouts]


def observe(fill):
    panorama = np.full((576, 1024, 3), fill, np.uint8)
    return wiw.types.Observation(panorama, panorama[:480, :480], np.zeros(3))


def query(fill, episode=0):
    return Query(observe(fill), wiw.types.Goal("x"), Key(0, episode, 0))


class Elsewhere:
    """First moments of one grey; remembers for which episodes they are kept."""

    def __init__(self, fill):
        self.moment, self.kept = ModelInput(observe(fill)), set()

    def of(self, key):
        self.kept.add(key.episode)
        return self.moment

    def forget(self, key):
        self.kept.discard(key.episode)


def test_the_swapped_model_sees_another_episode_and_the_policy_keeps_its_real_views() -> None:
    model = Seen()
    agent = wiw.Agent(Fixed(), SwappedPlacebo(model, Elsewhere(200)))
    (decision,) = agent.decide_batch([query(40)])
    assert [colour for colour, _ in model.log] == [200] * 3
    assert sorted(plan for _, plan in model.log) == [[1, 1], [1, 1, 2], [1, 3, 1]]
    turned, ahead = decision.rollouts[1].frames[0], decision.rollouts[1].frames[1]
    assert turned.mean() == 40 and decision.rollouts[1].real[0] and ahead.mean() == 200
    assert agent.describe()["placebo"] == "swapped" and agent.model is model


def test_a_swapped_placebo_forgets_an_episode_that_has_ended() -> None:
    moments = Elsewhere(200)
    agent = wiw.Agent(Fixed(), Gated(SwappedPlacebo(Seen(), moments), 1.0))
    agent.decide_batch([query(40), query(60, episode=1)])
    assert moments.kept == {0, 1}
    agent.forget(Key(0, 0, 3))
    assert moments.kept == {1}


def test_the_shuffled_model_sees_other_plans_and_the_policy_scores_its_own() -> None:
    real, placebo = Seen(), Seen()
    wiw.Agent(Fixed(), real).decide_batch([query(40)])
    (decision,) = wiw.Agent(Fixed(), ShuffledPlacebo(placebo)).decide_batch([query(40)])
    assert [p.actions.tolist() for p in decision.proposals] == [[1, 1, 2], [2, 1, 1], [1, 3, 1]]
    assert [len(r.frames) for r in decision.rollouts] == [3, 3, 3]
    assert sorted(plan for _, plan in placebo.log) != sorted(plan for _, plan in real.log)
    assert len(placebo.log) == len(real.log) == decision.calls["rows"]


WRAPPERS = {
    "shuffled": ShuffledPlacebo,
    "swapped": lambda model: SwappedPlacebo(model, Elsewhere(200)),
    "gated": lambda model: Gated(model, 0.5),
    "labelled": lambda model: Labelled(model, "simulator"),
}


@pytest.mark.parametrize("order", list(permutations(WRAPPERS)), ids="-".join)
def test_wrappers_of_a_model_compose_in_any_order(order) -> None:
    def decide(names):
        model = Seen()
        changed = Attempted(model)
        for name in names:
            changed = WRAPPERS[name](changed)
        agent = wiw.Agent(Fixed(), changed)
        return agent, model, agent.decide_batch([query(40 + episode, episode) for episode in range(8)])

    agent, model, decisions = decide(order)
    _, expected, others = decide(WRAPPERS)
    assert agent.model.unwrapped is model and model.log == expected.log and {colour for colour, _ in model.log} == {200}
    for one, other in zip(decisions, others, strict=True):
        np.testing.assert_array_equal(one.scores, other.scores)
        assert one.calls == other.calls and (one.rollouts is None) == (other.rollouts is None)
    assert 0 < sum(decision.rollouts is not None for decision in decisions) < 8
    assert agent.count_spent()["rows"] == len(model.log) == sum(d.calls.get("rows", 0) for d in decisions)
    described = agent.describe()
    assert described["model"] == model.describe() and described["imagine_fraction"] == 0.5
    assert described["semantics"] == "simulator" and described["placebo"] in ("shuffled", "swapped")


def test_the_agent_of_a_changed_model_can_be_replaced_part_by_part() -> None:
    agent = wiw.Agent(Fixed(), Gated(ShuffledPlacebo(Seen()), 0.5))
    fewer = agent.replace(candidates=2)
    assert fewer.describe() == {**agent.describe(), "candidates": 2, "width": 2}
    assert "placebo" not in agent.replace(model="copy").describe() and agent.replace(model=None).model is None


def test_what_placebo_arms_are_of() -> None:
    agent = AgentRecipe("matcher", "oracle", horizon=7)
    arms = ["placebo-shuffled", "placebo-swapped:copy", "heuristic+placebo-shuffled", "placebo-shuffled:a/b.py:Mine"]
    made = arm_recipes(agent, arms)
    assert made == {
        "placebo-shuffled": AgentRecipe("matcher", "oracle", horizon=7, placebo="shuffled"),
        "placebo-swapped:copy": AgentRecipe("matcher", "copy", horizon=7, placebo="swapped"),
        "heuristic+placebo-shuffled": AgentRecipe("heuristic", "oracle", horizon=7, placebo="shuffled"),
        "placebo-shuffled:Mine": AgentRecipe("matcher", "a/b.py:Mine", horizon=7, placebo="shuffled"),
    }
    assert AgentRecipe.from_json(made["placebo-shuffled"].to_json()) == made["placebo-shuffled"]
    assert arm_recipes(AgentRecipe("matcher"), ["placebo-swapped"])["placebo-swapped"].model == "warp"
    built = arm_recipes(wiw.Agent("matcher", "copy"), ["placebo-shuffled"])["placebo-shuffled"].build(NOWHERE)
    assert built.describe()["placebo"] == "shuffled" and type(built.model.unwrapped).__name__ == "Copy"
    own = [AgentRecipe("matcher", "oracle", error="blur@16"), AgentRecipe("matcher", "copy", placebo="swapped")]
    assert [name for each in own for name in arm_recipes(each, None)] == [
        "error-blur@16:oracle",
        "placebo-swapped:copy",
    ]
    assert list(arm_recipes(AgentRecipe("matcher", "copy", reseed=1), None)) == ["reseeded:copy"]
    assert absolute("placebo-shuffled:a.py:Mine").startswith("placebo-shuffled:/")
    for wrong in ("placebo-odd", "placebo-shuffled:none"):
        with pytest.raises(ArgumentError, match="placebo-shuffled"):
            arm_recipes(agent, [wrong])
    with pytest.raises(ArgumentError, match="placebo='shuffled' needs a world model"):
        AgentRecipe("matcher", placebo="shuffled").build(NOWHERE)
    with pytest.raises(ArgumentError, match="expected placebo shuffled or swapped or blind, got 'odd'"):
        AgentRecipe("matcher", "copy", placebo="odd").build(NOWHERE)


def test_a_placebo_of_poses_is_refused_when_it_is_composed() -> None:
    context = RunContext(Manipulation("push_buttons"))
    with pytest.raises(ArgumentError, match="reshuffles primitives, but these plans contain none; use 'swapped'"):
        AgentRecipe(Pressing(), "copy", placebo="shuffled").build(context)


def test_a_swapped_placebo_is_of_the_runs_next_episode(two_rooms) -> None:
    task = ImageNav(scenes=two_rooms)
    episodes = task.episodes(3)
    moments = NextEpisodes(RunContext(task, episodes), ModelImaginer(Seen()))
    env = task.environment()
    for episode in (0, 2):
        shown = moments.of(Key(0, episode, 5))
        expected = env.begin(episodes[(episode + 1) % 3])
        np.testing.assert_array_equal(shown.observation.panorama, expected.panorama)
        assert shown.simulator is None and shown.semantic is None and moments.of(Key(0, episode, 6)) is shown


@pytest.fixture(scope="module")
def run(two_rooms, tmp_path_factory):
    """The same arms with one worker and several episodes live, and with two workers."""
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 2})
    agent = AgentRecipe("heuristic", "copy", reviser="matcher")
    arms = ["copy", "placebo-shuffled", "placebo-swapped", "placebo-swapped:oracle"]

    def made(workers, live):
        out = tmp_path_factory.mktemp("run") / "r"
        quiet = {"progress": False, "keep_images": 0}
        return wiw.evaluate(task, agent, 3, out=out, workers=workers, live=live, arms=arms, **quiet)

    return made(1, 3), made(2, 1)


def test_placebos_do_not_depend_on_workers_or_batches(run) -> None:
    def facts(log):
        names = ("arm", "episode", "decision", "actions", "scores", "executed", "path", "calls")
        return [{name: row[name] for name in names} for row in log.decisions]

    assert facts(run[0]) == facts(run[1]) and len({row["arm"] for row in run[0].decisions}) == 4
    assert all(row["status"] == "done" for row in run[0].episodes)


def test_placebos_can_be_verified(run) -> None:
    found = verify(run[0].path, episodes=1)
    assert found.same and len(found.checks) == 4, str(found)


def test_placebos_cost_what_the_real_arm_costs(run) -> None:
    """Where both stand at the same place: at the first decision, with the same proposals."""
    first = {(row["arm"], row["episode"]): row for row in run[0].decisions if row["decision"] == 0}
    for episode in range(3):
        real, swapped = first["copy", episode], first["placebo-swapped", episode]
        assert real["proposals"] == swapped["proposals"] and real["calls"] == swapped["calls"]
        shuffle = first["placebo-shuffled", episode]["calls"]
        assert abs(shuffle["rows"] - real["calls"]["rows"]) <= 1
        assert first["placebo-shuffled", episode]["proposals"] == real["proposals"]


def test_a_swap_needs_another_episode(two_rooms, tmp_path) -> None:
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1})
    with pytest.raises(ArgumentError, match="at least 2 episodes"):
        wiw.evaluate(task, AgentRecipe("matcher"), 1, out=tmp_path / "r", arms=["placebo-swapped"], progress=False)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["ar", "--episodes", "1", "--arms", "none,placebo-swapped"], "so it needs at least 2 episodes; got 1"),
        (
            ["manipulation", "--world-model", "armnet", "--arms", "none,placebo-shuffled"],
            "these plans contain none",
        ),
    ],
)
def test_a_placebo_that_a_run_cannot_have_is_refused_before_anything_runs(
    command: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", *command, "--out", str(tmp_path / "run")]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "run").exists()
