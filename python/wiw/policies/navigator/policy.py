# SPDX-License-Identifier: Apache-2.0
"""A policy with a belief: a trained network says of each place, seen or imagined, how far the goal is and where.

The evidence of all places is combined on a map, whose unknown parts count as floor. Plans are routes towards where the
goal may be, and their worth is how soon they would arrive, on average over that belief. Imagined views change the
belief, and with it the value of all plans.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.mapping.occupancy import OccupancyGrid
from wiw.mapping.routes import STEP, find_refused
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.policies.matcher import appearance
from wiw.policies.navigator.bands import PANORAMA, project_goal
from wiw.policies.navigator.belief import Evidence, Weights, compute_belief, find_peaks, smooth
from wiw.policies.navigator.candidates import Candidate, choose_apart, list_candidates, make_candidate, measure_arrivals
from wiw.policies.navigator.estimator import GoalEstimator, require_torch
from wiw.policies.navigator.way_cells import WayCells
from wiw.policies.navigator.ways import WayMap, Ways
from wiw.typed_values import read_values, require_positive
from wiw.types import Goal, Key, Proposal, Rollout

if TYPE_CHECKING:
    from wiw.policies.navigator.network import Features, Network

WEIGHTS = Path(__file__).with_name("weights.safetensors")
DEPTH_STRIDE = 2
"""Rows and columns of the observed depth between those that the map is made of."""
NOWHERE = np.empty((0, 2))
"""No places."""


@dataclass(frozen=True)
class NavigatorOptions:
    """Numbers of the policy, chosen on apartments of the val split."""

    bearing: float = 0.7
    """Weight of estimated bearings in the belief."""
    closeness: float = 0.7
    """Weight of estimated distances."""
    similarity: float = 0.5
    """Weight of the matcher's similarity beside the network's distance."""
    likeness: float = 4.0
    """Weight of the likeness of colours in a direction beside the network's bearing."""
    doubt: float = 0.15
    """Probability that a bearing says nothing."""
    overlap: float = 0.5
    """Metres within which places say nearly the same."""
    trust: float = 0.7
    """Weight of an imagined place beside a real one."""
    spacing: float = 0.4
    """Minimum metres between the imagined places of a plan, and between remembered ones and real ones."""
    patience: float = 12.0
    """Primitives after which an arrival is worth 1/e of one now."""
    commitment: float = 0.25
    """Share of the belief that is placed at the target, which the agent keeps heading for,"""
    loyalty: float = 0.5
    """as long as it is worth this share of the best one."""
    apart: float = 0.5
    """Metres between the ends of plans."""
    targets: int = 8
    """Maximum number of places that routes are planned to."""

    def __post_init__(self) -> None:
        require_positive("policy navigator", self, "targets")
        for name, value in vars(self).items():
            if not 0 <= value < np.inf or (value == 0 and name in ("patience", "overlap")):
                least = "above 0" if name in ("patience", "overlap") else "of 0 or more"
                raise ArgumentError(f"policy navigator: expected {name} {least}, got {value}")
        if not (self.doubt < 1 and self.commitment <= 1):
            raise ArgumentError(
                "policy navigator: expected doubt below 1 and commitment of at most 1, got "
                f"{self.doubt} and {self.commitment}"
            )


@dataclass
class Memory:
    """The memory of one episode."""

    goal: Features
    template: appearance.GoalTemplate
    grid: OccupancyGrid = field(default_factory=OccupancyGrid)
    real: list[Evidence] = field(default_factory=list)
    """One for every place where the agent has observed, the first one included."""
    imagined: list[Evidence] = field(default_factory=list)
    """One for each imagined place that the agent has not come near to yet."""
    target: NDArray[np.float64] | None = None
    """float64 [2]: where the agent is heading."""
    pose: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """float64 [3]: where the agent stood at its last observation."""
    executed: int = 0
    """Primitives executed until that observation."""


@dataclass(frozen=True)
class _Outlook:
    """Grounds of a decision: the map, the ways from where the agent and its evidence are, and the belief."""

    way_map: WayMap
    ways: Ways
    """One row: from where the agent stands."""
    belief: NDArray[np.float64]
    worth: NDArray[np.float64]
    """float64 [cells]: the belief, smoothed, and less the farther a cell is."""
    target: int
    """The cell that the agent heads for."""


class Navigator(Policy):
    """Heads for the most probable place of the goal, and sticks to it until a better one is known.

    It needs depth, of which its map is made. Without a world model it takes the plan that is worth most by what was
    really seen. Front views of perspective models count as panoramas of which only that part is shown.

    Args:
        weights: a file of `wiw train navigator`; None means those shipped with wiw.
        options: see `NavigatorOptions`.

    Raises:
        ArgumentError: an unknown option, no number, or one out of range.
        DependencyError: torch or safetensors is not installed.
        WeightsError: no such file, damaged, or of another version.
    """

    needs = ("depth",)
    frames = FrameSpec("panorama", PANORAMA)

    def __init__(self, weights: str | Path | None = None, **options: Any) -> None:
        require_torch()
        from wiw.policies.navigator.weights import load

        self.options = NavigatorOptions(**read_values(NavigatorOptions, options, "policy navigator", "option"))
        file = Path(WEIGHTS if weights is None else weights).expanduser()
        self._use_network(*load(file), blake2b(file.read_bytes(), digest_size=8).hexdigest())

    @classmethod
    def from_network(cls, network: Network, card: dict[str, Any], **options: Any) -> Navigator:
        """Make the policy of a network in memory, such as one in training; `card` has what `measure_prior` returns."""
        policy = cls.__new__(cls)
        policy.options = NavigatorOptions(**read_values(NavigatorOptions, options, "policy navigator", "option"))
        policy._use_network(network, card, "")
        return policy

    def _use_network(self, network: Network, card: dict[str, Any], digest: str) -> None:
        self.card, self._digest = card, digest
        self._estimator = GoalEstimator(network, card)

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity, with a digest of the weights."""
        return {"policy": type(self).__name__, "weights": self._digest, **asdict(self.options)}

    def begin(self, goal: Goal, key: Key) -> Memory:
        """Encode the goal image; start with an empty map."""
        if goal.image is None:
            raise ArgumentError(
                f"policy navigator: expected a goal image, got none in task {goal.task}; use it with task imagenav"
            )
        return Memory(self._estimator.encode_goal(project_goal(goal.image)), appearance.build_goal_template(goal.image))

    def observe(self, situations: Sequence[Situation]) -> None:
        """Extend each map, and remember what the present place says of the goal."""
        for situation in situations:
            memory, observation = situation.memory, situation.observation
            if observation.depth is None:
                raise ArgumentError(
                    "policy navigator builds its map from depth, but the observation has none; enable depth "
                    "(NavigationEnv(task, depth=True)), or use a policy without a map, such as vlm"
                )
            pose = np.asarray(observation.odometry, np.float64)
            if memory.executed < len(situation.executed):
                refused = find_refused(memory.pose, situation.executed[memory.executed :], pose)
                if refused is not None:
                    memory.grid.mark_blocked(refused, STEP)
            memory.pose, memory.executed = pose, len(situation.executed)
            depth = np.ascontiguousarray(observation.depth[::DEPTH_STRIDE, ::DEPTH_STRIDE])
            memory.grid.add(depth, pose)
            memory.real.append(self._judge_view(memory, observation.panorama, "panorama", pose, 1.0))
            memory.imagined = [
                own for own in memory.imagined if _measure_gap(own.pose, memory.real) > self.options.spacing
            ]

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return the plans that are worth most by what is known, whose ends are apart from each other."""
        return [self._propose_one(situation, candidates, horizon) for situation in situations]

    def extend(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Propose from imagined places, by the map and by all that is known since they were imagined."""
        return [
            self._propose_one(replace(situation, memory=replace(situation.memory)), candidates, horizon)
            for situation in situations
        ]

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Return what each plan is worth once the belief has taken in all that was imagined, which is remembered."""
        scores = []
        for situation, plans, futures in zip(situations, proposals, rollouts, strict=True):
            memory, pose = situation.memory, np.asarray(situation.observation.odometry, np.float64)
            made = [make_candidate(pose, plan.actions) for plan in plans]
            for plan, future in zip(made, futures, strict=True):
                self._remember_imagined(memory, plan, future)
            scores.append(self._evaluate(self._form_outlook(memory, pose, _get_ends(made)), made))
        return scores

    # -- evidence ------------------------------------------------------------------------------------------------------

    def _remember_imagined(self, memory: Memory, plan: Candidate, future: Rollout) -> None:
        """Remember what new imagined places say, from a plan's end backwards, no two close together."""
        for step in reversed(np.flatnonzero(~future.real)):
            pose = plan.poses[step]
            if _measure_gap(pose, [*memory.real, *memory.imagined]) > self.options.spacing:
                frame = future.frames[step]
                memory.imagined.append(self._judge_view(memory, frame, future.view, pose, self.options.trust))

    def _judge_view(
        self, memory: Memory, frame: NDArray[np.uint8], view: str, pose: NDArray[np.float64], trust: float
    ) -> Evidence:
        """Return what a panorama, or a front view, says of the goal."""
        bearings, closeness = self._estimator.rate(
            memory.goal, memory.template, frame, view, self.options.similarity, self.options.likeness
        )
        return Evidence(pose, bearings, closeness, trust)

    # -- plans ---------------------------------------------------------------------------------------------------------

    def _form_outlook(
        self, memory: Memory, pose: NDArray[np.float64], included: NDArray[np.float64] = NOWHERE
    ) -> _Outlook:
        """Return the belief by all evidence, and where it leads the agent, which it remembers.

        The map covers what is within 9 m of the start, and all evidence, the target and `included` [N, 2] beyond.
        """
        options = self.options
        evidence = [*memory.real, *memory.imagined]
        places = np.array([pose[:2], *(own.pose[:2] for own in evidence)])
        target = NOWHERE if memory.target is None else memory.target[None]
        way_map = WayMap(memory.grid, WayCells.around(np.concatenate([places, target, included])))
        ways = way_map.measure_ways(places)
        weights = Weights(options.bearing, options.closeness, options.doubt, options.overlap)
        trail = _interpolate(np.array([own.pose[:2] for own in memory.real]))
        belief = compute_belief(way_map, evidence, ways.take(slice(1, None)), trail, self._estimator.centres, weights)
        own = ways.take(slice(0, 1))
        arrivals = measure_arrivals(_stay(pose), own, 0)
        worth = smooth(way_map.cells, belief) * np.exp(-arrivals / options.patience)
        return _Outlook(way_map, own, belief, worth, self._choose_target(memory, way_map.cells, worth))

    def _choose_target(self, memory: Memory, cells: WayCells, worth: NDArray[np.float64]) -> int:
        """Return the cell worth most, or the best one near the last target while that is worth enough beside it."""
        best = int(worth.argmax())
        if memory.target is not None:
            near = cells.find_near(memory.target, self.options.overlap)
            kept = int(near[worth[near].argmax()])
            if worth[kept] >= self.options.loyalty * worth[best]:
                best = kept
        memory.target = cells.centres[best]
        return best

    def _propose_one(self, situation: Situation, count: int, horizon: int) -> list[Proposal]:
        memory, pose = situation.memory, np.asarray(situation.observation.odometry, np.float64)
        outlook = self._form_outlook(memory, pose)
        plans = self._list_plans(memory, outlook, pose, horizon)
        if not outlook.way_map.cells.contain(_get_ends(plans)):  # a straight run leads off the map
            outlook = self._form_outlook(memory, pose, pose[:2] + horizon * STEP * np.array([[-1, -1], [1, 1]]))
            plans = self._list_plans(memory, outlook, pose, horizon)
        values = self._evaluate(outlook, plans)
        chosen = choose_apart(plans, values, count, self.options.apart)
        return [Proposal(plans[i].actions, prior=float(values[i])) for i in chosen]

    def _list_plans(
        self, memory: Memory, outlook: _Outlook, pose: NDArray[np.float64], horizon: int
    ) -> list[Candidate]:
        targets = [outlook.target, *find_peaks(outlook.way_map.cells, outlook.worth, self.options.targets)]
        return list_candidates(memory.grid, outlook.way_map, outlook.ways, pose, targets, horizon)

    def _evaluate(self, outlook: _Outlook, plans: Sequence[Candidate]) -> NDArray[np.float64]:
        """Return how soon each plan would arrive on average over the belief, 1 for at once and 0 for never."""
        options = self.options
        ways = outlook.way_map.measure_ways(_get_ends(plans))
        belief = (1 - options.commitment) * outlook.belief
        belief[outlook.target] += options.commitment
        arrivals = np.stack([measure_arrivals(plan, ways, row) for row, plan in enumerate(plans)])
        return np.exp(-arrivals / options.patience) @ belief


def _stay(pose: NDArray[np.float64]) -> Candidate:
    """Return the plan that does nothing."""
    return Candidate(np.zeros(0, np.int8), pose[None])


def _get_ends(plans: Sequence[Candidate]) -> NDArray[np.float64]:
    """Return where plans end: float64 [N, 2]."""
    return np.array([plan.poses[-1, :2] for plan in plans]).reshape(-1, 2)


def _interpolate(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return places [N, 2] and some between each and the next: float64 [4 * N, 2]."""
    shares = np.arange(4)[:, None, None] / 4
    return (places + shares * (np.concatenate([places[1:], places[-1:]]) - places)).reshape(-1, 2)


def _measure_gap(pose: NDArray[np.float64], others: Sequence[Evidence]) -> float:
    """Return the metres from a place to the nearest of others."""
    return min((float(np.hypot(*(pose - other.pose)[:2])) for other in others), default=np.inf)
