# SPDX-License-Identifier: Apache-2.0
"""Question answering without a language model: a map of objects, an answer from it, and exploring where it pays.

Real views make the map, and the map alone answers. Imagined views rank plans and never answer, as the paper's prompt
asks ("A-EQA High-Level Planner Additional Prompt").
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import TURN_LEFT, count_leading_turns
from wiw.datasets.questions import parse
from wiw.errors import ArgumentError
from wiw.mapping.alignment import turn_odometry
from wiw.mapping.object_map import ObjectMap
from wiw.mapping.routes import STEP, find_refused
from wiw.mapping.views import HFOV_DEG, Views, cut_images, cut_views, unproject
from wiw.perception.colors import name_color
from wiw.perception.scene_labels import STATES, Labeller, SceneLabels
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.policies.explorer.answering import Belief, answer
from wiw.policies.explorer.confidence import estimate_confidence
from wiw.policies.explorer.destinations import Destination, plan_route
from wiw.policies.explorer.drawing import VIEW_SIZE, draw_beliefs
from wiw.policies.explorer.home import Surface, believe_home, load_knowledge
from wiw.policies.explorer.memory import Look, Memory
from wiw.registry import LABELLERS
from wiw.types import Decision, Goal, Key, Proposal, Rollout, TextAnswer

SURFACES = ("floor", "wall")
SURFACE_STRIDE = 24
"""Pixels between the looks at floors and walls, along rows and columns."""
LOOK_ACTIONS = 3
"""Maximum number of primitives of a plan that only takes a second look."""
LOOK_AROUND = 4
"""Left turns where no way leads anywhere: a quarter turn."""
MOST_GAIN = 12.0
"""Square metres of new floor that count at most: one room. More would draw an agent to and fro across a home."""
USUAL_EXECUTE = 15
"""Primitives of a decision at most, where the agent's number is not known."""
CLEAR_SHARE = 0.01
"""Share of a view that a wanted thing must fill in an imagined view to count in full."""


class Explorer(Policy):
    """Explores a home until its map answers the question.

    Args:
        perception: who labels views: "learned", or a `wiw.perception.scene_labels.Labeller`.
        sure: confidence from which on an answer is final.
        calibrated: whether confidence is the probability of being right (`wiw.policies.explorer.confidence`), or the
            support by the map that this is estimated from.
        imagination: weight of what imagined views show, in the units of a destination's worth (square metres).
        path: worth of a metre that need not be walked, in square metres of new floor.
        affinity: worth of a room that is likely to have what is asked about.
        budget: primitives of an episode, counted as the task counts them; with its last segment the agent answers,
            whatever its confidence. None: the task's.

    Raises:
        ArgumentError: a labeller that needs the simulator's instance ids, or an option that is no number, or none of
            its range.
        DependencyError: torch is not installed.
        WeightsError: the weights cannot be read.
    """

    needs = ("depth",)
    frames = FrameSpec("panorama", (288, 512), ends=True)

    def __init__(
        self,
        perception: Any = "learned",
        sure: float = 0.7,
        imagination: float = 8.0,
        path: float = 2.0,
        affinity: float = 6.0,
        budget: int | None = None,
        calibrated: bool = True,
    ) -> None:
        _check_options(
            {"sure": sure, "imagination": imagination, "path": path, "affinity": affinity}, budget, calibrated
        )
        self.labeller: Labeller = LABELLERS.make(perception)
        if "ids" in self.labeller.needs:
            raise ArgumentError(
                f"explorer: {type(self.labeller).__name__} needs the simulator's instance ids, which agents never see; "
                "policy explorer-oracle is an explorer with true perception"
            )
        self.sure, self.imagination, self.path, self.affinity, self.budget = sure, imagination, path, affinity, budget
        self.calibrated = bool(calibrated)
        self.knowledge = load_knowledge()

    @classmethod
    def require(cls, task: Mapping[str, Any]) -> None:
        """Require a task that asks questions.

        Raises:
            ArgumentError: it does not.
        """
        if task.get("judge") is None:
            raise ArgumentError(
                f"policy explorer answers questions about a home, but task '{task.get('task', 'of this run')}' asks "
                "none; use it with task aeqa (`wiw run aeqa`)"
            )

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity, with that of the perception."""
        return {
            "policy": type(self).__name__,
            "perception": self.labeller.describe(),
            "sure": self.sure,
            "imagination": self.imagination,
            "path": self.path,
            "affinity": self.affinity,
            "budget": self.budget,
            "calibrated": self.calibrated,
        }

    def begin(self, goal: Goal, key: Key) -> Memory:
        """Return an empty map."""
        objects = ObjectMap(self.labeller.categories, STATES, least_confidence=self.labeller.least_confidence)
        return Memory(parse(goal.text or ""), objects)

    # -- real views ----------------------------------------------------------------------------------------------------

    def observe(self, situations: Sequence[Situation]) -> None:
        """Add the real views to the maps, and ask them the questions."""
        for situation in situations:
            memory = situation.memory
            for look in self.look_around(situation):
                pose = memory.align(look)
                views, labels = self.perceive(situation, look, pose)
                memory.grid.add(look.depth, pose)
                memory.objects.add(views, labels, self.name_color)
                memory.surfaces += self._look_at_surfaces(views, labels)
            self._follow(situation)
            memory.home = believe_home(memory.objects, memory.grid, memory.surfaces, self.knowledge)
            memory.belief = self._answer_from_map(memory, situation.goal.text or "")
            memory.choose_destinations(partial(self._rate, memory))

    def _look_at_surfaces(self, views: Views, labels: SceneLabels) -> list[Surface]:
        """Return looks at floors and walls: patches that are all of one surface, with their colour."""
        looks, categories = [], self.labeller.categories
        for name in SURFACES:
            if name not in categories:
                continue
            mask = (labels.category == categories.index(name)) & (views.depth > 0)
            view, rows, columns = _find_patches(mask)
            patches = views.images[_spread_patches(view, rows, columns)]
            for pixels, point in zip(patches, unproject(views, view, rows, columns), strict=True):
                color, confidence = self.name_color(pixels.reshape(-1, 3), name)
                looks.append(Surface(name, point[:2], color, confidence))
        return looks

    def _follow(self, situation: Situation) -> None:
        """Note where the agent is now and what that took of the budget, and mark the obstacles met on the way."""
        memory, walked = situation.memory, situation.executed[situation.memory.executed :]
        pose = turn_odometry(situation.observation.odometry, memory.azimuth)
        blocked = find_refused(memory.pose, walked, pose) if walked else None
        if blocked is not None:
            memory.grid.mark_blocked(blocked, STEP)
        memory.spent += len(walked) - (count_leading_turns(walked) if situation.goal.free_turns else 0)
        memory.pose, memory.executed = pose, len(situation.executed)

    def look_around(self, situation: Situation) -> Iterator[Look]:
        """Yield what is to be added to the map: the present observation."""
        observation = situation.observation
        yield Look(observation.panorama, observation.depth, observation.odometry)

    def perceive(self, situation: Situation, look: Look, pose: NDArray[np.float64]) -> tuple[Views, SceneLabels]:
        """Return the four real views of a look around from a pose in the map, and their labels.

        They are labelled at twice the size of the map's views, so that small things are recognised.
        """
        fine = cut_views(look.panorama, look.depth, pose)
        labels = self.labeller.label(fine.images, HFOV_DEG, depth=fine.depth)
        middle = np.s_[:, 1::2, 1::2]
        return cut_views(look.panorama, look.depth, pose, VIEW_SIZE), SceneLabels(
            labels.category[middle], labels.confidence[middle], labels.state[middle]
        )

    def _answer_from_map(self, memory: Memory, text: str) -> Belief:
        """Return the answer that the map gives to a text, and how sure it is."""
        found = answer(memory.question, text, memory.home, memory.grid)
        if memory.question is None or not self.calibrated:
            return found
        return replace(found, confidence=estimate_confidence(memory.question.answer_type, found.confidence))

    def name_color(self, pixels: NDArray[np.uint8], category: str) -> tuple[str, float]:
        """Return the colour word of pixels uint8 [n, 3] of one thing in such views, and its probability."""
        return name_color(pixels, category)

    # -- plans ---------------------------------------------------------------------------------------------------------

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return routes to different places, the most valuable one first; a short second look after an answer."""
        return [self._plan(situation, candidates, horizon) for situation in situations]

    def _plan(self, situation: Situation, candidates: int, horizon: int) -> list[Proposal]:
        memory = situation.memory
        final = self.is_final(situation)
        longest = min(LOOK_ACTIONS, horizon) if final else horizon
        plans: dict[bytes, Proposal] = {}
        for place in memory.destinations[: 1 if final else 2 * candidates]:
            actions = plan_route(memory.grid, memory.pose, place, longest)
            if len(actions):
                plans.setdefault(actions.tobytes(), Proposal(actions, prior=place.worth, note=place.note))
            if len(plans) == candidates:
                break
        if not plans:  # nowhere to go: another look from here
            turns = np.full(1 if final else min(LOOK_AROUND, horizon), TURN_LEFT, np.int8)
            plans[b""] = Proposal(turns, note="look around")
        return sorted(plans.values(), key=lambda plan: -plan.prior)

    def _rate(self, memory: Memory, place: Destination, metres: float) -> float:
        """Return what going to a place is worth: new floor, what is likely to be there, less the way."""
        room = memory.home.room_names.get(memory.grid.find_room(place.position[None]), "")
        kind = room.rpartition(" ")[0]
        named = memory.question.slots.get("room") if memory.question is not None else None
        likely = self.knowledge.measure_affinity(kind, memory.wanted_categories) if kind else 0.3
        likely = max(likely, float(kind == named)) if named else likely
        gain = min(place.gain, MOST_GAIN)
        return gain + place.interest + self.affinity * likely - self.path * metres

    # -- imagined views ------------------------------------------------------------------------------------------------

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Return the worth of each plan's destination, and of what is asked about in the views at its imagined end."""
        ends = [_cut_end(rollout) for futures in rollouts for rollout in futures]
        labels = iter(self._label_views(ends))
        scores = []
        for situation, plans in zip(situations, proposals, strict=True):
            shown = [self._measure_evidence(next(labels), situation.memory.wanted_categories) for _ in plans]
            prior = np.array([plan.prior for plan in plans], np.float64)
            scores.append(prior + self.imagination * np.array(shown))
        return scores

    def _label_views(self, ends: Sequence[tuple[NDArray[np.uint8], float]]) -> list[SceneLabels]:
        """Return the labels of views [V, H, W, 3] of each end; those of one angle are labelled in one batch."""
        found: dict[int, SceneLabels] = {}
        for hfov in sorted({hfov for _, hfov in ends}):
            own = [i for i, (_, other) in enumerate(ends) if other == hfov]
            labels = self.labeller.label(np.concatenate([ends[i][0] for i in own]), hfov)
            first = 0
            for i in own:
                found[i] = _take(labels, first, len(ends[i][0]))
                first += len(ends[i][0])
        return [found[i] for i in range(len(ends))]

    def _measure_evidence(self, labels: SceneLabels, wanted: Sequence[str]) -> float:
        """Return how surely something wanted is in sight, 0 to 1; what is asked about counts more than its anchors."""
        evidence = 0.0
        for rank, name in enumerate(wanted):
            if name not in self.labeller.categories:
                continue
            mask = labels.category == self.labeller.categories.index(name)
            share = float((labels.confidence * mask).sum(axis=(1, 2)).max()) / mask[0].size
            evidence = max(evidence, min(1.0, share / CLEAR_SHARE) * (1.0 if rank == 0 else 0.6))
        return evidence

    # -- answers -------------------------------------------------------------------------------------------------------

    def answer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> list[TextAnswer]:
        """Answer from the map of real views."""
        return [
            TextAnswer(own.belief.text, own.belief.confidence, final=bool(own.belief.text) and self.is_final(situation))
            for situation, own in ((situation, situation.memory) for situation in situations)
        ]

    def draw(self, situation: Situation, decision: Decision, north: float) -> dict[str, NDArray[np.uint8]]:
        """Return the map of real views, and the present view with the things believed to be in it."""
        return draw_beliefs(situation.memory, situation, decision, north)

    def is_final(self, situation: Situation) -> bool:
        """Return whether the present belief is the answer: it is sure enough, nothing is left to see, or no time."""
        memory = situation.memory
        budget = situation.goal.budget if self.budget is None else self.budget
        needed = (situation.execute or USUAL_EXECUTE) + LOOK_ACTIONS  # for one more decision, and to confirm its answer
        is_ending = budget is not None and budget - memory.spent <= needed
        return bool(memory.belief.confidence >= self.sure or not memory.destinations or is_ending)


def _check_options(numbers: Mapping[str, Any], budget: Any, calibrated: Any) -> None:
    """Check the options of an explorer, which users give by name.

    Raises:
        ArgumentError: says which one, and what is expected.
    """
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise ArgumentError(f"policy explorer: expected a number for {name}, got {value!r}")
    if budget is not None and (isinstance(budget, bool) or not isinstance(budget, int) or budget < 1):
        raise ArgumentError(f"policy explorer: expected a whole budget of at least 1, got {budget!r}")
    if calibrated not in (True, False):
        raise ArgumentError(f"policy explorer: expected true or false for calibrated, got {calibrated!r}")


def _find_patches(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return the middles, view, row and column, of the patches that a mask [V, H, W] is true all over."""
    middles = [np.arange(SURFACE_STRIDE // 2, side - SURFACE_STRIDE // 2, SURFACE_STRIDE) for side in mask.shape[1:]]
    view, rows, columns = (each.ravel() for each in np.meshgrid(np.arange(len(mask)), *middles, indexing="ij"))
    whole = mask[_spread_patches(view, rows, columns)].all(axis=(1, 2))
    return view[whole], rows[whole], columns[whole]


def _spread_patches(
    view: NDArray[np.intp], rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> tuple[NDArray[np.intp], ...]:
    """Return the indices into views of the pixels of N patches with these middles; they give [N, side, side]."""
    side = np.arange(-(SURFACE_STRIDE // 4), SURFACE_STRIDE // 4)
    return view[:, None, None], rows[:, None, None] + side[:, None], columns[:, None, None] + side


def _take(labels: SceneLabels, first: int, count: int) -> SceneLabels:
    """Return the labels of some views."""
    rows = slice(first, first + count)
    return SceneLabels(labels.category[rows], labels.confidence[rows], labels.state[rows])


def _cut_end(rollout: Rollout) -> tuple[NDArray[np.uint8], float]:
    """Return the views at the end of a rollout, uint8 [V, H, W, 3], one if it shows the front alone; and their HFOV."""
    end = rollout.frames[-1]
    if rollout.view == "panorama":
        return cut_images(end, VIEW_SIZE), HFOV_DEG
    return end[None] if end.ndim == 3 else end, 90.0
