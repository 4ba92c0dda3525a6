# SPDX-License-Identifier: Apache-2.0
"""A task without a world, for tests of everything around the loop: walk along a line to a goal at its end.

The agent draws each plan from the decision's key, so a run's results are a function of (seed, episode, decision) alone.
"""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wiw._core import core
from wiw.envs.base import Env, Segment
from wiw.loop.agent import Agent
from wiw.loop.base import BaseAgent
from wiw.policies.base import Policy
from wiw.runs.compose import Limits, RunContext
from wiw.runs.recipes import agent_recipe
from wiw.tasks.base import Task
from wiw.types import Answer, Decision, Episode, Goal, Observation, Proposal, Rollout, Truth

FORWARD, LEFT = 1, 2
STEP = 0.2


class LineEnv(Env):
    def __init__(self, task: LineTask) -> None:
        self.task = task

    def begin(self, episode: Episode) -> Observation:
        if episode.episode_id in self.task.broken:
            raise OSError(f"no such scene: {episode.scene}")
        self.episode, self.x, self.actions = episode, 0.0, 0
        return self.observation

    @property
    def goal(self) -> Goal:
        return Goal("line", image=np.full((48, 48, 3), 200, np.uint8))

    def run(self, actions: Any, answer: Answer | None = None) -> Segment:
        path = [self._position()]
        for action in actions:
            self.x += STEP * (action == FORWARD)
            self.actions += 1
            path.append(self._position())
        done = self._left() < 0.5
        time.sleep(self.task.delay)
        return Segment(
            self.observation, np.asarray(actions), np.array(path), done, not done and self.actions >= self.task.budget
        )

    def truth(self) -> Truth:
        return Truth(self._position(), 0.0, self._left(), self._left())

    def result(self) -> dict[str, float]:
        success = float(self._left() < 0.5)
        travelled = max(self.x, 1e-9)
        return {
            "success": success,
            "actions": float(self.actions),
            "travelled": self.x,
            "shortest": self.episode.geodesic,
            "spl": success * self.episode.geodesic / max(travelled, self.episode.geodesic),
            "distance_to_goal": self._left(),
        }

    def _left(self) -> float:
        return abs(self.episode.geodesic - self.x)

    def _position(self) -> Any:
        return np.array([self.x, 0.0, 0.0])

    @property
    def observation(self) -> Observation:
        panorama = np.full((32, 64, 3), min(255, int(20 * self.x)), np.uint8)
        return Observation(panorama, panorama[:32, :32], np.array([self.x, 0.0, 0.0]))


@dataclass
class LineTask(Task):
    """Goals from 1 to 3 m ahead, two episodes a scene."""

    seed: int = 0
    budget: int = 15
    broken: tuple[str, ...] = ()
    delay: float = 0.0
    name: str = "line"
    decisions: int = 8

    @property
    def defaults(self) -> dict[str, int]:
        return {"candidates": 2, "horizon": 5, "execute": 3}

    def describe(self) -> dict[str, Any]:
        return {"task": self.name, "seed": self.seed, "budget": self.budget, "decisions": self.decisions}

    def environment(self, depth: bool = False) -> LineEnv:
        return LineEnv(self)

    def episodes(self, count: int) -> list[Episode]:
        lengths = 1 + 2 * core.uniform(core.fold_key([self.seed, 7]), count)
        return [
            Episode(f"{i:04d}", f"line/{i // 2}", (0.0, 0.0, 0.0), 0.0, (float(d), 0.0, 0.0), 0.0, float(d))
            for i, d in enumerate(lengths)
        ]


@dataclass
class PictureTask(LineTask):
    """Goals whose place is not known, as in lists of questions; their pictures lie in a folder."""

    picture: str = "/data/goals/0.png"

    def episodes(self, count: int) -> list[Episode]:
        unknown: dict[str, Any] = {"goal_position": (math.nan,) * 3}
        info = {"goal_image": self.picture}
        return [replace(each, **unknown, info=info) for each in super().episodes(count)]


@dataclass
class LineAgent(BaseAgent):
    """Goes forward with probability `drive`; `kill` names episodes that kill or hang their process at decision 1."""

    drive: float = 0.7
    kill: tuple[int, ...] = ()
    marker: str = ""
    """File whose absence lets `kill` strike only once."""
    hangs: bool = False
    """Whether `kill` hangs the process instead."""
    needs: tuple[str, ...] = ()
    model: Any = None

    def describe(self) -> dict[str, Any]:
        return {"policy": "line", "drive": self.drive}

    def decide_batch(self, queries: Any) -> list[Decision]:
        return [self._decide(query) for query in queries]

    def _decide(self, query: Any) -> Decision:
        key = query.key
        if key.episode in self.kill and key.decision == 1:
            self._die()
        plans = []
        for candidate in range(2):
            draws = core.uniform(core.fold_key([key.seed, key.episode, key.decision, candidate]), 5)
            plans.append(Proposal(np.where(draws < self.drive, FORWARD, LEFT), prior=float(draws[0]), note="drawn"))
        scores = np.array([float((plan.actions == FORWARD).sum()) for plan in plans])
        chosen = int(scores.argmax())
        frames = np.full((5, 24, 24, 3), 90, np.uint8)
        return Decision(
            plans[chosen].actions,
            3,
            tuple(plans),
            tuple(Rollout(frames, np.zeros(5, bool)) for _ in plans),
            scores,
            chosen,
            query.observation,
            query.goal,
            key,
            {"propose": 0.001},
            {"rows": 2, "frames": 10},
        )

    def _die(self) -> None:
        if self.marker:
            if Path(self.marker).exists():
                return
            Path(self.marker).touch()
        if self.hangs:
            threading.Event().wait()
        os.kill(os.getpid(), signal.SIGKILL)


def agent_for(task: Any, agent: Any, **limits: Any) -> Agent:
    """The agent with everything that a run of the task adds: its numbers, its reviser, limits."""
    return agent_recipe(agent).build(RunContext(task), Limits(**limits))


def line_task(
    scenes: str = "", seed: int = 0, preset: str = "default", backend: str = "auto", **rules: Any
) -> LineTask:
    """The task as the command line makes it; scenes "slow" takes its time, "broken" cannot start an episode."""
    return LineTask(seed=seed, delay=0.05 * (scenes == "slow"), broken=("0001",) if scenes == "broken" else ())


class SizeReader(Policy):
    """Walks as the heuristic does and tells things by how much of the panorama they fill: 0.01 steradians each.

    A thing that fills between 0.01 n and 0.01 (n + 1) is taken for choice n, with a given confidence.
    """

    def __init__(self, confidence: float = 0.9, plan: tuple[int, ...] = (FORWARD, FORWARD)) -> None:
        self.confidence, self.plan = confidence, plan

    def propose(self, situations: Any, candidates: int, horizon: int) -> list[list[Proposal]]:
        return [[Proposal(np.array(self.plan[:horizon], np.int8))] for _ in situations]

    def score(self, situations: Any, proposals: Any, rollouts: Any) -> list[Any]:
        return [np.zeros(len(plans)) for plans in proposals]

    def answer(self, situations: Any, proposals: Any, rollouts: Any) -> list[Any]:
        return [self._answer(situation) for situation in situations]

    def _answer(self, situation: Any) -> Answer:
        choices, mask = situation.goal.choices, situation.observation.target.mask
        rows = np.cos((np.arange(mask.shape[0]) + 0.5) / mask.shape[0] * np.pi - np.pi / 2)
        size = float((mask * rows[:, None]).sum()) * 2 * np.pi**2 / mask.size
        believed = min(int(size / 0.01), len(choices) - 1)
        rest = (1 - self.confidence) / (len(choices) - 1)
        return Answer(choices, np.where(np.arange(len(choices)) == believed, self.confidence, rest))
