# SPDX-License-Identifier: Apache-2.0
"""A policy without a VLM: straight runs in diverse headings, scored by colour, edges and a map of unexplored space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, to_trajectory
from wiw.errors import ArgumentError
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.policies.matcher import appearance
from wiw.policies.matcher.exploration import ExplorationMap
from wiw.typed_values import read_values, require_positive
from wiw.types import Goal, Key, Proposal, Rollout

HEADINGS = 16
TURN = 2 * np.pi / HEADINGS
STEP = 0.2
SOURCE = (144, 256)
"""Height and width of imagined panoramas: in 94 % of decisions it takes the plan that it takes with 576x1024
(docs/results.md)."""
SAME_PLACE = 0.15
"""Metres within which a place imagined before informs about this one."""


@dataclass(frozen=True)
class MatcherOptions:
    """Weights, tuned on apartments of the train and val splits."""

    histogram: float = 2.0
    """Weight of the overlap between the goal's colours and those seen in a heading."""
    frontier: float = 1.0
    """Weight per metre gained towards the frontier most worth exploring."""
    likeness: float = 4.0
    """A frontier's worth: this times how much the views towards it look like the goal,"""
    travel: float = 0.1
    """less this for each metre to it."""
    novelty: float = 0.3
    """Weight per metre (at most one) of distance from the agent's trail."""
    turn: float = 0.04
    """Cost of one turn."""
    imagined: float = 1.5
    """Weight of the best imagined similarity less the present one."""
    near: float = 4.0
    """How much more that weighs when the goal is near."""
    calm: float = 0.8
    """Share of the exploration terms that fades when the goal is near."""
    gate: float = 2.5
    """Similarity at which the goal is near with probability one half."""
    gate_width: float = 0.15
    spread: int = 3
    """Minimum difference between headings of imagined plans, in turns, when the goal is near."""
    reach: float = 1.0
    """Metres ahead at which a heading is evaluated."""

    def __post_init__(self) -> None:
        require_positive("policy matcher", self, "spread")
        for name, value in vars(self).items():
            if name in ("reach", "gate_width") and not 0 < value < np.inf:
                raise ArgumentError(f"policy matcher: expected {name} above 0, got {value}")
            if name != "gate" and not 0 <= value < np.inf:
                raise ArgumentError(f"policy matcher: expected {name} of 0 or more, got {value}")
        if not (self.calm <= 1 and np.isfinite(self.gate)):
            raise ArgumentError(
                f"policy matcher: expected calm of at most 1 and a number for gate, got {self.calm} and {self.gate}"
            )


@dataclass
class Memory:
    """The memory of one episode."""

    goal: appearance.GoalTemplate
    map: ExplorationMap = field(default_factory=ExplorationMap)
    profile: NDArray[np.float32] = field(default_factory=lambda: np.zeros(appearance.COLUMNS, np.float32))
    """Similarity of the present place at each heading column."""
    gate: float = 0.0
    histogram: NDArray[np.float32] = field(default_factory=lambda: np.zeros(HEADINGS, np.float32))
    imagined_places: list[tuple[NDArray[np.float64], float]] = field(default_factory=list)
    """Position in the start frame and similarity of every imagined place."""
    recalled_gains: dict[bytes, float] = field(default_factory=dict)
    """By plan proposed last: the gain in similarity that earlier imagination promised for it."""
    executed: int = 0
    """Primitives that had been executed at the latest observation."""
    places: list[tuple[NDArray[np.float64], float]] = field(default_factory=list)
    """Odometry and similarity of every place the agent has really visited."""

    @property
    def similarity(self) -> float:
        """Similarity of the present place, best over headings."""
        return float(self.profile.max())


class Matcher(Policy):
    """Explores while nothing matches the goal image, and climbs the similarity to it once something does.

    Without a world model it takes the best of all 16 headings by what it really sees; with one, the best plans are
    imagined, and the similarity of the imagined places decides between them.
    """

    needs = ("depth",)
    frames = FrameSpec("panorama", appearance.PANORAMA, source_size=SOURCE)

    def __init__(self, **options: Any) -> None:
        self.options = MatcherOptions(**read_values(MatcherOptions, options, "policy matcher", "option"))

    def describe(self) -> dict[str, Any]:
        """Return name and weights."""
        return {"policy": type(self).__name__, **asdict(self.options)}

    def begin(self, goal: Goal, key: Key) -> Memory:
        """Extract features of the goal image; start with an empty map.

        Raises:
            ArgumentError: the goal has no image.
        """
        return Memory(appearance.build_goal_template(self._require_goal_image(goal)))

    def observe(self, situations: Sequence[Situation]) -> None:
        """Extend each map, and measure the similarity of the present place to the goal."""
        bands = _extract_bands(situations)
        for i, situation in enumerate(situations):
            memory: Memory = situation.memory
            likeness = self._measure_place(memory, bands.take(i))
            observation = situation.observation
            assert observation.depth is not None
            executed, memory.executed = situation.executed[memory.executed :], len(situation.executed)
            if FORWARD in executed[:2]:  # where the agent has not moved, something unseen is in the way
                memory.map.mark_blocked(observation.odometry)
            memory.map.update(_sample_depth(observation.depth), observation.odometry, likeness)
            memory.places.append((observation.odometry, memory.similarity))

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return the best headings by what is really seen, as straight runs; spread out once the goal is near."""
        return [self._propose_one(situation, candidates, horizon) for situation in situations]

    def extend(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Propose from imagined places, by what is imagined there and the map of what was really seen."""
        bands = _extract_bands(situations)
        there = [replace(s, memory=replace(s.memory)) for s in situations]
        for i, situation in enumerate(there):
            self._measure_place(situation.memory, bands.take(i))
        return self.propose(there, candidates, horizon)

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Return the prior plus the imagined gain in similarity, where it differs from the recalled one.

        Imagined places are remembered, so that a heading keeps its promise while others are imagined.
        """
        scores = []
        for situation, plans, futures in zip(situations, proposals, rollouts, strict=True):
            memory: Memory = situation.memory
            odometry = situation.observation.odometry
            surprises = []
            for plan, future in zip(plans, futures, strict=True):
                gain = measure_imagined_gain(memory, odometry, plan, future)
                surprises.append(0.0 if gain is None else gain - memory.recalled_gains.get(plan.actions.tobytes(), 0.0))
            scores.append(np.array([plan.prior for plan in plans]) + self._weight(memory) * np.array(surprises))
        return scores

    def _require_goal_image(self, goal: Goal) -> NDArray[np.uint8]:
        if goal.image is None:
            name = type(self).__name__.lower()
            raise ArgumentError(
                f"policy {name}: expected a goal image, got none in task {goal.task}; use it with task imagenav"
            )
        return goal.image

    def _measure_place(self, memory: Memory, band: appearance.Band) -> NDArray[np.float32]:
        """Measure a place against the goal; return the similarity of each column's view, float32 [128]."""
        likeness = appearance.histogram_similarity(band, memory.goal)[0]
        memory.profile = appearance.similarity(band, memory.goal)[0]
        memory.gate = 1 / (1 + np.exp(-(memory.similarity - self.options.gate) / self.options.gate_width))
        memory.histogram = sample_headings(likeness)
        return likeness

    def _weight(self, memory: Memory) -> float:
        return self.options.imagined * (1 + self.options.near * memory.gate)

    def _propose_one(self, situation: Situation, candidates: int, horizon: int) -> list[Proposal]:
        memory: Memory = situation.memory
        odometry = situation.observation.odometry
        priors, runs = self._judge_headings(memory, odometry)
        recalled = recall_gains(memory, odometry, runs)
        priors = priors + self._weight(memory) * recalled
        order = [int(k) for k in np.argsort(-priors, kind="stable")]
        plans = {k: plan_straight_run(k, horizon, int(runs[k] / STEP)) for k in order}
        apart = self.options.spread if memory.gate > 0.5 else 1
        chosen = choose_diverse(order, plans, apart, candidates)
        memory.recalled_gains = {plans[k].tobytes(): float(recalled[k]) for k in chosen}
        return [Proposal(plans[k], prior=float(priors[k])) for k in chosen]

    def _judge_headings(
        self, memory: Memory, odometry: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the prior of each heading and the free metres ahead; heading k is k left turns away."""
        options = self.options
        distance = memory.map.distance_to_target(options.likeness, options.travel)
        runs, ends = memory.map.look_ahead(odometry, HEADINGS, options.reach)
        progress = np.clip(
            memory.map.sample_grid(distance, odometry[None, :2])[0] - memory.map.sample_grid(distance, ends), -1.5, 1.5
        )
        novelty = np.minimum(memory.map.distance_to_trail(ends), 1.0)
        turns = np.array([circular_distance(k, 0) for k in range(HEADINGS)])
        calm = 1 - options.calm * memory.gate
        prior = (
            options.histogram * memory.histogram
            + calm * (options.frontier * progress + options.novelty * novelty)
            - options.turn * turns
        )
        return prior - 2.0 * (runs < STEP), runs


def _sample_depth(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return every other row of a panorama's depth [H, W], and the columns in which likeness is measured."""
    width = depth.shape[1]
    return depth[1::2, (2 * np.arange(appearance.COLUMNS) + 1) * width // (2 * appearance.COLUMNS)]


def _extract_bands(situations: Sequence[Situation]) -> appearance.Band:
    panoramas = [panorama.resize(situation.observation.panorama, appearance.PANORAMA) for situation in situations]
    return appearance.extract_features(np.stack(panoramas))


def sample_headings(columns: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the values [16] at headings k = 0, 1, ... left turns from a row [128] over panorama columns."""
    width = len(columns)
    centres = (width // 2 - np.arange(HEADINGS) * width // HEADINGS) % width
    return columns[centres]


def circular_distance(a: int, b: int) -> int:
    """Return the number of turns between two headings."""
    difference = abs(a - b) % HEADINGS
    return min(difference, HEADINGS - difference)


def plan_straight_run(heading: int, horizon: int, free_steps: int) -> NDArray[np.int8]:
    """Turn towards `heading` (left turns, 0..15), then step forward; at least one primitive, at most `horizon`."""
    turns = heading if heading <= HEADINGS // 2 else heading - HEADINGS
    plan = [TURN_LEFT if turns > 0 else TURN_RIGHT] * abs(turns) + [FORWARD] * max(free_steps, 1)
    return np.array(plan[:horizon], np.int8)


def choose_diverse(order: list[int], plans: dict[int, NDArray[np.int8]], apart: int, count: int) -> list[int]:
    """Choose the first `count` headings of `order` that are `apart` turns from each other, then any; no plan twice."""
    chosen: list[int] = []
    for least in (apart, 1):
        for k in order:
            if len(chosen) == count:
                return chosen
            same = any(np.array_equal(plans[k], plans[other]) for other in chosen)
            if not same and all(circular_distance(k, other) >= least for other in chosen):
                chosen.append(k)
    return chosen


def recall_gains(memory: Memory, odometry: NDArray[np.float64], runs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the best gain in similarity imagined along each heading's run, float64 [16]; 0 if unknown."""
    gains = np.zeros(HEADINGS)
    if not memory.imagined_places:
        return gains
    points, values = np.stack([p for p, _ in memory.imagined_places]), np.array([v for _, v in memory.imagined_places])
    for k in range(HEADINGS):
        azimuth = odometry[2] + k * TURN
        steps = np.arange(STEP, max(runs[k], STEP) + 1e-9, STEP)[:, None]
        way = odometry[:2] + steps * np.array([np.cos(azimuth), np.sin(azimuth)])
        distance = np.linalg.norm(way[:, None] - points, axis=2)
        nearest = distance.argmin(1)
        known = distance[np.arange(len(way)), nearest] < SAME_PLACE
        if known.any():
            gains[k] = values[nearest[known]].max() - memory.similarity
    return gains


def measure_imagined_gain(
    memory: Memory, odometry: NDArray[np.float64], plan: Proposal, rollout: Rollout
) -> float | None:
    """Return the gain in similarity at the plan's best imagined place; None if no new place was imagined.

    Panoramas are compared over all headings; the front views of a perspective model only with what is seen now in the
    direction in which the plan ends. The places are remembered.
    """
    positions = predict_positions(odometry, plan.actions)
    new = ~rollout.real & (np.linalg.norm(positions - odometry[:2], axis=1) > 0)
    if not new.any():
        return None
    if rollout.view == "panorama":
        values = appearance.similarity(appearance.extract_features(rollout.frames[new]), memory.goal).max(1)
    else:
        bands = np.stack([appearance.project_front(frame)[0] for frame in rollout.frames[new]])
        ahead = appearance.similarity(appearance.extract_features(bands), memory.goal)[:, appearance.COLUMNS // 2]
        turns = int((plan.actions == TURN_LEFT).sum() - (plan.actions == TURN_RIGHT).sum())
        values = memory.similarity + ahead - sample_headings(memory.profile)[turns % HEADINGS]
    memory.imagined_places += [(p, float(v)) for p, v in zip(positions[new], values, strict=True)]
    return float(values.max()) - memory.similarity


def predict_positions(odometry: NDArray[np.float64], actions: NDArray[np.int8]) -> NDArray[np.float64]:
    """Return where each primitive ends if none is refused, in the frame of `odometry`: float64 [K, 2]."""
    forward, left = to_trajectory(actions)[:, :2].T
    x, y, azimuth = odometry
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    return np.stack([x + cos * forward - sin * left, y + sin * forward + cos * left], 1)
