# SPDX-License-Identifier: Apache-2.0
"""A plan space of the user's own, from end to end, in one file: turn a dial by angles until its hand points at a mark.

Nothing of `wiw` knows the space but its registry.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw.envs import Segment
from wiw.errors import ArgumentError, ContractError, StoreError
from wiw.loop.contract import check_needs, check_plan_space
from wiw.loop.imagination import Imagination, Request
from wiw.loop.imagine import seed_of
from wiw.loop.plan_space import PlanSpace, plan_space
from wiw.policies.base import FrameSpec
from wiw.registry import PLAN_SPACES
from wiw.report.plans import numbers
from wiw.runs.shapes import check_decision
from wiw.types import Answer, Conditioning, Control, Episode, Goal, Key, Observation, Proposal, Rollout, Truth
from wiw.world_models.base import ask

SIZE = (16, 32)
NEAR = 0.15
"""Radians between hand and mark that count as success."""


class DialFutures(Imagination):
    """Frames of every plan, as the model gives them."""

    def __init__(self, rollouts: Sequence[Sequence[Rollout]], costs: Sequence[Mapping[str, int]]) -> None:
        self.rollouts, self.costs, self.view = rollouts, costs, "perspective"

    def show(self, frames: FrameSpec) -> list[list[Rollout]]:
        return [list(own) for own in self.rollouts]


class Dial(PlanSpace):
    """float64 [K]: angles by which a dial is turned, in radians, at most half a turn each."""

    words = "turns of a dial"

    def check_plan(self, source: str, actions: Any, longest: int) -> Any:
        plan = np.asarray(actions, np.float64)
        if plan.ndim != 1 or not 1 <= len(plan) <= longest or not (np.abs(plan) <= np.pi).all():
            raise ContractError(f"{source}: expected 1 to {longest} angles from -pi to pi, got {plan.tolist()}")
        return plan

    def check_model(self, model: wiw.WorldModel, longest: int) -> None:
        check_plan_space(model, "dial", self.words)
        check_needs(model)

    def imagine(self, model: wiw.WorldModel, request: Request) -> DialFutures:
        """Ask for one plan at a time."""
        rollouts, costs = [], []
        episodes = zip(request.keys, request.inputs, request.plans, request.origins, strict=True)
        for key, shown, plans, origins in episodes:
            image = shown.observation.front[None]
            frames = []
            for plan, number in zip(plans, origins, strict=True):
                seeds = np.array([seed_of(key, number)], np.uint64)
                with request.clock("world_model"):
                    frames.append(ask(model, Conditioning(image), [_control(plan.actions)], seeds)[0, 1:])
            rollouts.append([Rollout(own, np.zeros(len(own), np.bool_)) for own in frames])
            costs.append({"consultations": 1, "rows": len(plans), "frames": sum(map(len, frames))})
        return DialFutures(rollouts, costs)


def _control(angles: Any) -> Control:
    count = len(angles)
    still = np.zeros(count, np.int8), np.zeros((count, 3)), np.broadcast_to(np.eye(4), (count, 4, 4))
    return Control(*still, ids=angles, length=count)


PLAN_SPACES.register("dial", Dial)


class StillDial(wiw.WorldModel):
    """Nothing ever turns."""

    accepts = wiw.accepts("action", "perspective", SIZE, space="dial")
    version = "1"

    def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
        return np.repeat(observations.image[:, None], 1 + len(controls[0].actions), 1)


class TurningDial(wiw.WorldModel):
    """Draws the hand where the angles lead to."""

    accepts = wiw.accepts("action", "perspective", SIZE, space="dial")
    version = "1"

    def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
        return np.stack(
            [
                np.stack([image, *(draw(read(image) + turned) for turned in np.cumsum(control.ids))])
                for image, control in zip(observations.image, controls, strict=True)
            ]
        )


def draw(angle: float) -> Any:
    """A picture of the hand; its bytes tell the angle."""
    share = round(angle / (2 * np.pi) % 1 * 65535)
    picture = np.zeros((*SIZE, 3), np.uint8)
    picture[..., 0], picture[..., 1] = share >> 8, share & 255
    picture[::2, :, 2] = 90
    return picture


def read(picture: Any) -> float:
    return (int(picture[0, 0, 0]) * 256 + int(picture[0, 0, 1])) / 65535 * 2 * np.pi


def apart(one: float, other: float) -> float:
    return abs((one - other + np.pi) % (2 * np.pi) - np.pi)


class Fiddler(wiw.Policy):
    """Would turn by fixed angles; likes futures in which the hand is near the mark that the goal shows."""

    space = "dial"
    plans = ([0.1, 0.1], [-0.4, -0.25], [0.5], [0.9, 0.35])

    def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
        return [[Proposal(np.array(plan[:horizon])) for plan in self.plans[:candidates]] for _ in situations]

    def score(self, situations: Any, proposals: Any, rollouts: Any) -> Any:
        return [
            np.array([-apart(read(rollout.frames[-1]), read(situation.goal.image)) for rollout in own])
            for situation, own in zip(situations, rollouts, strict=True)
        ]


class DialEnv(wiw.Env):
    def __init__(self, task: DialTask) -> None:
        self.task = task

    def begin(self, episode: Episode) -> Observation:
        self.episode, self.angle, self.turns = episode, 0.0, 0
        return self.observation

    def run(self, plan: Any, answer: Answer | None = None) -> Segment:
        for turned in plan:
            self.angle += float(turned)
        self.turns += len(plan)
        done = self._left() < NEAR
        path = np.repeat(self._position()[None], len(plan) + 1, 0)
        return Segment(self.observation, np.asarray(plan), path, done, not done and self.turns >= self.task.budget)

    @property
    def goal(self) -> Goal:
        return Goal(self.task.name, image=draw(self.episode.goal_yaw))

    @property
    def observation(self) -> Observation:
        picture = draw(self.angle)
        return Observation(picture, picture, np.zeros(3))

    def truth(self) -> Truth:
        return Truth(self._position(), self.angle, self._left(), self._left())

    def result(self) -> dict[str, float]:
        return {"success": float(self._left() < NEAR), "actions": float(self.turns)}

    def _left(self) -> float:
        return apart(self.angle, self.episode.goal_yaw)

    def _position(self) -> Any:
        return np.array([np.cos(self.angle), 0.0, np.sin(self.angle)])


@dataclass
class DialTask(wiw.Task):
    """Marks at angles that the policy's turns can reach."""

    seed: int = 0
    budget: int = 16
    name: str = "dial"
    space: str = "dial"

    @property
    def defaults(self) -> dict[str, Any]:
        return {"candidates": 4, "horizon": 2, "execute": 2, "space": self.space}

    def describe(self) -> dict[str, Any]:
        return {"task": self.name, "seed": self.seed, "budget": self.budget}

    def environment(self, depth: bool = False) -> DialEnv:
        return DialEnv(self)

    def episodes(self, count: int) -> list[Episode]:
        start = (1.0, 0.0, 0.0)
        marks = [sum(Fiddler.plans[1 + i % 3]) * (2 + i % 2) for i in range(count)]
        return [Episode(f"{i:04d}", "dial", start, 0.0, start, mark, abs(mark)) for i, mark in enumerate(marks)]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Any:
    arms = {"none": "none", "still": StillDial(), "turning": TurningDial()}
    out = tmp_path_factory.mktemp("dial") / "run"
    return wiw.evaluate(DialTask(), wiw.Agent(Fiddler()), 6, out=out, arms=arms, progress=False, keep_images="all")


def test_a_model_of_the_space_helps_and_the_floor_does_not(log: Any) -> None:
    assert [row["status"] for row in log.episodes] == ["done"] * 18
    own = {arm: [row for row in log.episodes if row["arm"] == arm] for arm in ("none", "still", "turning")}
    won = {arm: [row["metrics"]["success"] for row in rows] for arm, rows in own.items()}
    assert won["turning"] == [1.0] * 6 and won["none"] == won["still"] and sum(won["none"]) < 6
    assert {row["arm"]: row["success"] for row in log.table()}.keys() == won.keys()


def test_its_decisions_are_recorded_as_they_were_taken(log: Any) -> None:
    plans = [list(plan) for plan in Fiddler.plans]
    again = wiw.load_run(log.path)
    assert again.decisions == log.decisions and log.decisions
    for row in again.decisions:
        assert [proposal["actions"] for proposal in row["proposals"]] == plans
        assert row["executed"] == row["actions"] == plans[row["chosen"]]
        assert row["calls"] == ({} if row["arm"] == "none" else {"consultations": 1, "rows": 4, "frames": 7})
    assert {row["chosen"] for row in again.decisions if row["arm"] == "turning"} > {0}
    assert set(log.store.images("turning", 0, 0)) == {"panorama", "goal", *(f"imagined/{k}" for k in range(4))}


def test_report_view_and_export_show_its_plans_as_numbers(log: Any, tmp_path: Path) -> None:
    report = log.report().read_text()
    assert "0.9, 0.35" in report and "-0.4, -0.25" in report
    pages = "".join(page.read_text() for page in log.view(tmp_path / "view").parent.rglob("*.html"))
    assert "0.9, 0.35" in pages and "↑" not in pages
    assert log.export(csv=tmp_path / "csv")
    assert numbers([[1.0, 0.0], [0.5, 2]]) == "(1, 0), (0.5, 2)"


def test_actions_of_two_kinds_in_one_decision_are_an_edited_store(log: Any) -> None:
    row = log.decisions[0]
    for mixed in ([0.1, [0.1, 0.2]], [[0.1], [0.1, 0.2]]):
        with pytest.raises(StoreError, match="expected actions of one kind"):
            check_decision({**row, "actions": mixed, "executed": []}, "here")
    check_decision({**row, "actions": [[0.1, 0.2]], "executed": [[0.1, 0.2]]}, "here")


def test_a_decision_of_it_is_drawn() -> None:
    env = DialTask().environment()
    observation = env.begin(DialTask().episode(1))
    agent = wiw.Agent(Fiddler(), TurningDial(), candidates=4, horizon=2)
    decision = agent.decide(observation, env.goal, Key(0, 0))
    assert decision.actions.dtype == np.float64 and decision.chosen == 3
    drawn = [text.get_text() for axes in wiw.show(decision).axes for text in axes.texts]
    assert "0.9, 0.35" in drawn


def test_parts_of_other_spaces_are_refused_in_its_words() -> None:
    assert isinstance(plan_space("dial"), Dial)
    with pytest.raises(ArgumentError, match=r"takes space='discrete', but this agent plans in turns of a dial"):
        wiw.Agent(Fiddler(), "warp")
    with pytest.raises(ArgumentError, match=r"plans in turns of a dial, but the reviser .* discrete primitives"):
        wiw.Agent(Fiddler(), StillDial(), reviser="matcher")
    with pytest.raises(ArgumentError, match="turns of a dial do not lead to other places"):
        wiw.Agent(Fiddler(), StillDial(), depth=2)

    class Wild(Fiddler):
        plans = ([4.0],)

    env = DialTask().environment()
    observation = env.begin(DialTask().episode(0))
    with pytest.raises(ContractError, match=r"Wild\.propose: expected 1 to 5 angles from -pi to pi, got \[4\.0\]"):
        wiw.Agent(Wild(), StillDial()).decide(observation, env.goal, Key(0, 0))
