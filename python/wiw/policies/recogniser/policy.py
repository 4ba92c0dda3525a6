# SPDX-License-Identifier: Apache-2.0
"""Active Recognition without a language model: the trained recogniser answers, and its confidence scores plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD
from wiw.errors import ArgumentError
from wiw.panorama import from_cubemap
from wiw.perception.glimpses import Glimpses, extract_glimpses, join_glimpses
from wiw.perception.recogniser import Recogniser
from wiw.perception.tracking import Track, get_target, track_rollouts
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.policies.recogniser import steering
from wiw.registry import TRACKERS
from wiw.types import Answer, Goal, Key, Proposal, Rollout

SHIPPED = {name: Path(__file__).parent / f"{name}.safetensors" for name in ("pictures", "extents")}
"""Weights that come with the package: one recogniser that goes by pictures alone, and one that is also told sizes."""
SAME_PLACE = 0.05
"""Places closer together than this, in metres, count as the same."""


@dataclass
class Memory:
    """The memory of one episode."""

    looks: list[tuple[NDArray[np.float64], Glimpses]] = field(default_factory=list)
    """Real glimpses of the target and where they were taken, [x, y] in the start frame; the latest last."""
    place: NDArray[np.float64] | None = None
    """The target's last known position, in the start frame."""
    side: int = 0
    """The side on which the agent passed what hides the target; 1 left, -1 right."""
    imagined: tuple[Any, list[Glimpses]] | None = None
    """Glimpses of the plans imagined last, with the key of these plans."""


class Recognition(Policy):
    """Answers with the recogniser's distribution, given the stored real glimpses and this decision's imagined ones.

    It proposes to approach the target, or to step aside where something hides it, and scores a plan by the confidence
    of the answer with the plan's imagined glimpses. Frames that lose the target count against a plan.

    Args:
        weights: file of a `wiw.perception.recogniser.Recogniser`, or the name of one of those shipped: "pictures", or
            "extents", which measures the target by depth and knows furniture by other makers better, but gains less
            from imagination (docs/results.md).
        tracker: name of the tracker that locates the target in imagined frames, or an instance.
        tracker_options: what a tracker given by name is made with.
        remember: number of real glimpses stored, from as many places.
        views: number of imagined glimpses of a plan used, the last ones.
        lost: deduction from a plan's score if all its frames lose the target, else in proportion.
        turning: deduction for each turn, which is a primitive that leads nowhere; without it, each decision would undo
            the turns of the one before.
        trust: deduction for each rank in the order of proposals, which is all that counts without a world model.

    Raises:
        ArgumentError: no glimpses to remember or to view, deductions that are no numbers, or weights that are neither a
            name nor a file.
        DependencyError: torch or safetensors is not installed.
        FileError: the weights cannot be read.
    """

    frames = FrameSpec("panorama", (576, 1024))

    @classmethod
    def require(cls, task: Mapping[str, Any]) -> None:
        """Require a task whose goal is to name an object.

        Raises:
            ArgumentError: the task has no categories to choose from.
        """
        if not task.get("categories"):
            raise ArgumentError(
                f"policy recogniser names the object that a task marks, but task '{task.get('task', 'of this run')}' "
                "marks none; use it with task ar (`wiw run ar`), and for imagenav a policy such as matcher"
            )

    def __init__(
        self,
        weights: str | Path = "pictures",
        tracker: Any = "reprojection",
        tracker_options: Mapping[str, Any] | None = None,
        remember: int = 2,
        views: int = 2,
        lost: float = 0.5,
        turning: float = 0.05,
        trust: float = 0.3,
    ) -> None:
        if not all(isinstance(count, int) and count >= 1 for count in (remember, views)):
            raise ArgumentError(
                f"policy recogniser: expected remember and views of at least 1, got {remember} and {views}"
            )
        if not all(isinstance(weight, int | float) and np.isfinite(weight) for weight in (lost, turning, trust)):
            raise ArgumentError(
                f"policy recogniser: expected numbers for lost, turning and trust, got {lost}, {turning} and {trust}"
            )
        self.file = _find_weights(weights)
        self.recogniser = Recogniser.load(self.file)
        self.tracker = TRACKERS.make(tracker, **(tracker_options or {}))
        self.needs = tuple(sorted({"depth", *self.tracker.needs}))
        self.remember, self.views, self.lost, self.turning, self.trust = remember, views, lost, turning, trust

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity, with a digest of the weights."""
        return {
            "policy": type(self).__name__,
            "weights": blake2b(self.file.read_bytes(), digest_size=8).hexdigest(),
            "tracker": self.tracker.describe(),
            "remember": self.remember,
            "views": self.views,
            "lost": self.lost,
            "turning": self.turning,
            "trust": self.trust,
        }

    def begin(self, goal: Goal, key: Key) -> Memory:
        """Return an empty memory."""
        return Memory()

    def observe(self, situations: Sequence[Situation]) -> None:
        """Store a real glimpse where the target is in sight; one per place, the latest."""
        for situation in situations:
            observation, memory = situation.observation, situation.memory
            depth = observation.depth if self.recogniser.network.extents else None
            found, _ = extract_glimpses(
                observation.panorama[None], get_target(observation).mask[None], np.ones(1, bool), [depth]
            )
            if not len(found):
                continue
            here = observation.odometry[:2]
            others = [look for look in memory.looks if np.hypot(*(look[0] - here)) > SAME_PLACE]
            memory.looks = [*others, (here, found)][-self.remember :]

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return different paths to a better view, the most promising first."""
        return [self._build_plans(situation, candidates, horizon) for situation in situations]

    def _build_plans(self, situation: Situation, candidates: int, horizon: int) -> list[Proposal]:
        observation, memory = situation.observation, situation.memory
        assert observation.depth is not None
        seen = steering.locate_in_view(get_target(observation).mask, observation.depth)
        if seen is not None:
            memory.place = steering.compute_target_place(observation, seen)
            memory.side = memory.side or seen.side
        bearing = 0.0 if memory.place is None else steering.compute_bearing(observation, memory.place)
        free = steering.measure_clearance(observation.depth)
        plans: dict[bytes, Proposal] = {}
        for rank, heading in enumerate(steering.rank_headings(seen, bearing, memory.side)):
            actions = steering.plan_towards(heading, free, horizon)
            plans.setdefault(actions.tobytes(), Proposal(actions, prior=0.0 - rank))
        return list(plans.values())[:candidates]

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Return the confidence with the plan's imagined glimpses, less `lost` times its share of frames without the
        target.
        """
        tracks = track_rollouts(self.tracker, [each.observation for each in situations], proposals, rollouts)
        scores = []
        for situation, plans, futures, followed in zip(situations, proposals, rollouts, tracks, strict=True):
            looks = [self._extract_glimpses(future, track) for future, track in zip(futures, followed, strict=True)]
            situation.memory.imagined = (_plans_key(situation, plans), looks)
            real = _get_real_glimpses(situation)
            choices = situation.goal.choices
            sure = self.recogniser([join_glimpses([*real, each]) for each in looks], choices).max(axis=1)
            boxless = np.array([1 - track.visible.mean() for track in followed])
            turns = np.array([np.count_nonzero(plan.actions != FORWARD) for plan in plans])
            rank = np.array([sum(other.prior > plan.prior for other in plans) for plan in plans])
            scores.append(sure - self.lost * boxless - self.turning * turns - self.trust * rank)
        return scores

    def answer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> list[Answer | None]:
        """Answer by all stored glimpses and those of all plans."""
        answers: list[Answer | None] = []
        for situation, plans, futures in zip(situations, proposals, rollouts, strict=True):
            looks = _get_real_glimpses(situation)
            if futures is not None:
                looks += self._get_imagined_glimpses(situation, plans, futures)
            choices = situation.goal.choices
            answers.append(Answer(choices, self.recogniser([join_glimpses(looks)], choices)[0]) if choices else None)
        return answers

    def _get_imagined_glimpses(
        self, situation: Situation, plans: Sequence[Proposal], futures: Sequence[Rollout]
    ) -> list[Glimpses]:
        """Return the glimpses of each plan; the ones it was scored by, if it was scored."""
        kept = situation.memory.imagined
        if kept is not None and kept[0] == _plans_key(situation, plans):
            return list(kept[1])
        tracks = track_rollouts(self.tracker, [situation.observation], [plans], [futures])[0]
        return [self._extract_glimpses(future, track) for future, track in zip(futures, tracks, strict=True)]

    def _extract_glimpses(self, rollout: Rollout, track: Track) -> Glimpses:
        """Extract glimpses from the last imagined frames that show the target; rotated real frames show nothing new."""
        wanted = np.flatnonzero(track.visible & ~rollout.real)[len(track.boxes) and -self.views :]
        frames, masks = rollout.frames[wanted], track.masks[wanted]
        if rollout.view == "front" and len(wanted):
            frames, masks = (
                _embed_front_views(frames),
                _embed_front_views(masks[..., None].astype(np.uint8))[..., 0] > 0,
            )
        return extract_glimpses(frames, masks, np.zeros(len(wanted), bool))[0]


def _find_weights(weights: str | Path) -> Path:
    """Return the file of weights given by path or by the name of shipped ones."""
    file = SHIPPED.get(str(weights), Path(weights).expanduser())
    if not file.suffix and not file.exists():
        raise ArgumentError(
            f"policy recogniser: expected weights {' or '.join(SHIPPED)}, or a file of `wiw train recogniser`, got "
            f"'{weights}'"
        )
    return file


def _get_real_glimpses(situation: Situation) -> list[Glimpses]:
    return [found for _, found in situation.memory.looks]


def _plans_key(situation: Situation, plans: Sequence[Proposal]) -> Any:
    return situation.key, tuple(plan.actions.tobytes() for plan in plans)


def _embed_front_views(fronts: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Embed front views [K, S, S, C] into panoramas that are black elsewhere."""
    faces = np.zeros((len(fronts), 6, *fronts.shape[1:]), np.uint8)
    faces[:, 0] = fronts
    return np.asarray(from_cubemap(faces, (576, 1024)), np.uint8)
