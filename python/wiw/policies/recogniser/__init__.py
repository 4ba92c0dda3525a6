# SPDX-License-Identifier: Apache-2.0
"""Active Recognition without a language model: the trained recogniser answers, and judges plans by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD
from wiw.panorama import from_cubemap
from wiw.perception.glimpses import Glimpses, extract_glimpses, join_glimpses
from wiw.perception.recogniser import Recogniser
from wiw.perception.tracking import Track, get_target, track_rollouts
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.policies.recogniser import steering
from wiw.registry import TRACKERS
from wiw.types import Answer, Goal, Key, Proposal, Rollout

WEIGHTS = Path(__file__).parent / "weights.safetensors"
SAME_PLACE = 0.05
"""Metres; from no farther apart the panorama shows the same."""


@dataclass
class Memory:
    """What is kept of one episode."""

    looks: list[tuple[NDArray[np.float64], Glimpses]] = field(default_factory=list)
    """Real looks at the target and where they were taken, [x, y] in the frame of the start; the latest last."""
    place: NDArray[np.float64] | None = None
    """Where the target was seen last, likewise."""
    side: int = 0
    """On which side of the target the agent went past what hid it; 1 left, -1 right."""
    imagined: tuple[Any, list[Glimpses]] | None = None
    """The looks of the plans that were last imagined, under the plans' name."""


class Recognition(Policy):
    """Answers with the recogniser's distribution over all real looks kept and the imagined ones of this decision.

    It proposes to go towards the target, or aside where something stands before it, and scores a plan by how sure the
    answer would be with the plan's imagined looks. Frames that lose the target count against a plan.

    Args:
        weights: of `wiw.perception.recogniser.Recogniser`; None means those that come with the package.
        tracker: name of the tracker that finds the target in imagined frames, or an instance.
        remember: real looks that are kept, from as many places.
        views: imagined looks of a plan that are used, the last ones.
        lost: what a plan's score loses if all its frames lose the target.
        turning: what it loses for each turn, a primitive spent where it is; without, each decision turns back what the
            one before it turned.
        trust: what it loses for each place that the plan has in the order of steering, which is all that there is to
            go by without a world model.

    Raises:
        BackendError: torch is not installed.
        FileError: the weights cannot be read.
    """

    frames = FrameSpec("panorama", (576, 1024))

    def __init__(
        self,
        weights: str | Path | None = None,
        tracker: Any = "reprojection",
        remember: int = 2,
        views: int = 2,
        lost: float = 0.5,
        turning: float = 0.05,
        trust: float = 0.3,
    ) -> None:
        self.file = Path(WEIGHTS if weights is None else weights)
        self.recogniser = Recogniser.load(self.file)
        self.tracker = TRACKERS.make(tracker)
        self.needs = tuple(sorted({"depth", *self.tracker.needs}))
        self.remember, self.views, self.lost, self.turning, self.trust = remember, views, lost, turning, trust

    def describe(self) -> dict[str, Any]:
        """With a digest of the weights."""
        return {
            "policy": type(self).__name__,
            "weights": blake2b(self.file.read_bytes(), digest_size=8).hexdigest(),
            "tracker": type(self.tracker).__name__,
            "remember": self.remember,
            "views": self.views,
            "lost": self.lost,
            "turning": self.turning,
            "trust": self.trust,
        }

    def begin(self, goal: Goal, key: Key) -> Memory:
        """Nothing seen yet."""
        return Memory()

    def observe(self, situations: Sequence[Situation]) -> None:
        """Takes a real look where the target is in sight; one a place, the latest."""
        for situation in situations:
            observation, memory = situation.observation, situation.memory
            found, _ = extract_glimpses(
                observation.panorama[None], get_target(observation).mask[None], np.ones(1, bool)
            )
            if not len(found):
                continue
            here = observation.odometry[:2]
            others = [look for look in memory.looks if np.hypot(*(look[0] - here)) > SAME_PLACE]
            memory.looks = [*others, (here, found)][-self.remember :]

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Different ways to a better look, the most promising first."""
        return [self._plans(situation, candidates, horizon) for situation in situations]

    def _plans(self, situation: Situation, candidates: int, horizon: int) -> list[Proposal]:
        observation, memory = situation.observation, situation.memory
        assert observation.depth is not None
        seen = steering.sight(get_target(observation).mask, observation.depth)
        if seen is not None:
            memory.place = steering.place_of(observation, seen)
            memory.side = memory.side or seen.side
        bearing = 0.0 if memory.place is None else steering.bearing_to(observation, memory.place)
        free = steering.clearance(observation.depth)
        plans: dict[bytes, Proposal] = {}
        for rank, heading in enumerate(steering.headings(seen, bearing, memory.side)):
            actions = steering.plan(heading, free, horizon)
            plans.setdefault(actions.tobytes(), Proposal(actions, prior=0.0 - rank))
        return list(plans.values())[:candidates]

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Confidence with the plan's imagined looks, less `lost` times the share of its frames that lose the target."""
        tracks = track_rollouts(self.tracker, [each.observation for each in situations], proposals, rollouts)
        scores = []
        for situation, plans, futures, followed in zip(situations, proposals, rollouts, tracks, strict=True):
            looks = [self._looks(future, track) for future, track in zip(futures, followed, strict=True)]
            situation.memory.imagined = (_name(situation, plans), looks)
            real = _real(situation)
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
        """From all looks that are kept and those of all plans."""
        answers: list[Answer | None] = []
        for situation, plans, futures in zip(situations, proposals, rollouts, strict=True):
            looks = _real(situation)
            if futures is not None:
                looks += self._imagined(situation, plans, futures)
            choices = situation.goal.choices
            answers.append(Answer(choices, self.recogniser([join_glimpses(looks)], choices)[0]) if choices else None)
        return answers

    def _imagined(self, situation: Situation, plans: Sequence[Proposal], futures: Sequence[Rollout]) -> list[Glimpses]:
        """Looks of each plan; those that it was scored by, if it was."""
        kept = situation.memory.imagined
        if kept is not None and kept[0] == _name(situation, plans):
            return list(kept[1])
        tracks = track_rollouts(self.tracker, [situation.observation], [plans], [futures])[0]
        return [self._looks(future, track) for future, track in zip(futures, tracks, strict=True)]

    def _looks(self, rollout: Rollout, track: Track) -> Glimpses:
        """The last imagined frames in which the target is in sight; turned real ones show nothing new."""
        wanted = np.flatnonzero(track.visible & ~rollout.real)[len(track.boxes) and -self.views :]
        frames, masks = rollout.frames[wanted], track.masks[wanted]
        if rollout.view == "front" and len(wanted):
            frames, masks = _around(frames), _around(masks[..., None].astype(np.uint8))[..., 0] > 0
        return extract_glimpses(frames, masks, np.zeros(len(wanted), bool))[0]


def _real(situation: Situation) -> list[Glimpses]:
    return [found for _, found in situation.memory.looks]


def _name(situation: Situation, plans: Sequence[Proposal]) -> Any:
    return situation.key, tuple(plan.actions.tobytes() for plan in plans)


def _around(fronts: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Panoramas that show front views [K, S, S, C] where they belong, and black elsewhere."""
    faces = np.zeros((len(fronts), 6, *fronts.shape[1:]), np.uint8)
    faces[:, 0] = fronts
    return np.asarray(from_cubemap(faces, (576, 1024)), np.uint8)
