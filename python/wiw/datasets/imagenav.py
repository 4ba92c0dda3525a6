# SPDX-License-Identifier: Apache-2.0
"""Image-Goal Navigation episodes for any scene: goals out of sight, yet within reach of the paper's budget."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.cameras import camera_pose, is_in_view
from wiw.datasets.fields import to_position
from wiw.datasets.ways_on import NO_FORK, SEEN_AROUND, TWO_CORNERS, find_broken_rule
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError, EpisodesError
from wiw.types import Episode

_log = logging.getLogger("wiw.datasets")

TierName = Literal["any", "near", "far", "beyond", "all"]
_LENGTH, _BUDGET, _IN_SIGHT, _DULL_GOAL = (
    "shortest, longest",
    "budget",
    "the goal out of sight of the start",
    "goal_depth, goal_instances",
)
RULES = (_LENGTH, _BUDGET, _IN_SIGHT, _DULL_GOAL, SEEN_AROUND, NO_FORK, TWO_CORNERS)
"""Rules, in the order in which they are checked."""
NUMBERS = ("shortest", "longest", "budget", "goal_depth", "goal_instances")
"""Rules that are numbers a place is held to."""
ATTEMPTS = 10
"""Factor on the pairs tried per episode of a tier, since lengths are drawn from a part of the tier's range."""


@dataclass(frozen=True)
class Tier:
    """Lengths of a tier's episodes, in metres and primitives."""

    shortest: float
    longest: float
    budget: int
    about: str


TIERS: Mapping[str, Tier] = {
    "near": Tier(2.0, 5.0, 42, "goals 2 to 5 m away, out of sight"),
    "far": Tier(5.0, 8.0, 48, "goals 5 to 8 m away, out of sight"),
    "beyond": Tier(3.0, 7.0, 42, "goals 3 to 7 m away, one corner beyond the view from the start, where the way forks"),
}


@dataclass(frozen=True)
class EpisodeRules:
    """Rules that a start and a goal of an episode satisfy. Lengths in metres."""

    shortest: float = 2.0
    """Minimum geodesic distance."""
    longest: float = 8.0
    budget: int = 42
    """Maximum number of primitives an ideal run may need: 70 % of the paper's 20 decisions of 3 primitives."""
    goal_depth: float = 1.2
    """Minimum median depth of the goal view, so that it shows more than a wall."""
    goal_instances: int = 4
    """Minimum number of things in the goal view, the outside counted. In a scene of fewer, such as a scan that is one
    mesh, nothing is asked of their number."""
    attempts: int = 400
    """Pairs tried per episode before giving up; ten times as many within a tier."""
    tier: TierName = "any"
    """near, far or beyond (`TIERS`), which sets shortest, longest and budget; all: the three in turn; any: none."""

    def __post_init__(self) -> None:
        if self.attempts < 1:
            raise ArgumentError(f"imagenav: attempts: expected at least 1, got {self.attempts}")
        given = [
            name for name in ("shortest", "longest", "budget") if getattr(self, name) != getattr(EpisodeRules, name)
        ]
        if self.tier != "any" and given:
            raise ArgumentError(
                f"imagenav: tier '{self.tier}' sets shortest, longest and budget; expected none of these in addition, "
                f"got {', '.join(given)}. Leave these out, or the tier"
            )

    @property
    def tiers(self) -> tuple[str, ...]:
        """Tiers that episodes are of, in turn; empty if they are of none."""
        return {"any": (), "all": tuple(TIERS)}.get(self.tier, (self.tier,))


def generate(
    world: World, count: int, seed: int, rules: EpisodeRules = EpisodeRules(), *, first: int = 0
) -> list[Episode]:
    """Return episodes `first` to `first + count - 1` of one scene, each a function of (scene, seed, its number) alone.

    Within tiers `count` episodes of each are returned, the tiers in turn. Their lengths are spread evenly: a tier's
    range is cut into `count` parts, each for one episode, so that an episode is a function of `count`, too.

    Raises:
        EpisodesError: the scene has too few pairs of places that satisfy `rules`; says which rules they broke.
    """
    rules = _fit_rules(world, rules)
    if not rules.tiers:
        return [_episode(world, index, seed, rules) for index in range(first, first + count)]
    turns = [(tier, part) for part in range(count) for tier in rules.tiers]
    return [
        _episode(world, index, seed, _fit_part(rules, tier, part, count), tier)
        for index, (tier, part) in enumerate(turns, start=first)
    ]


def _fit_part(rules: EpisodeRules, tier: str, part: int, parts: int) -> EpisodeRules:
    """Return the rules of an episode of a tier, whose length lies in one of equal parts of the tier's range."""
    own = TIERS[tier]
    share = (own.longest - own.shortest) / parts
    return replace(
        rules,
        tier="any",
        shortest=own.shortest + part * share,
        longest=own.shortest + (part + 1) * share,
        budget=own.budget,
        attempts=ATTEMPTS * rules.attempts,
    )


def _fit_rules(world: World, rules: EpisodeRules) -> EpisodeRules:
    """Return the rules, less the number of things in view where the whole scene has fewer."""
    instances = len(world.scene.instances)
    if rules.goal_instances <= instances + 1:
        return rules
    _log.info(
        "%s has %d instances: goal views are not asked for %d things", world.name, instances, rules.goal_instances
    )
    return replace(rules, goal_instances=0)


def _episode(world: World, index: int, seed: int, rules: EpisodeRules, tier: str = "") -> Episode:
    """Return an episode that satisfies `rules`, and what its tier asks beside a length."""
    key = core.fold_key([seed, index, 0x1A6E])
    points = world.ground.put_down(world.navmesh.sample(2 * rules.attempts, key, world.floor))
    draws = core.uniform(core.fold_key([key, 1]), 5 * rules.attempts).reshape(-1, 5)
    broken: Counter[str] = Counter()
    for start, goal, draw in zip(points[::2], points[1::2], draws, strict=True):
        geodesic = float(world.navmesh.geodesic_distance(start, goal))
        if not rules.shortest <= geodesic <= rules.longest:
            broken[_LENGTH] += 1
            continue
        start_yaw = float(2 * np.pi * draw[0])
        ideal = ideal_primitives(np.asarray(world.navmesh.shortest_path(start, goal)), start_yaw)
        if ideal > rules.budget:
            broken[_BUDGET] += 1
            continue
        if is_in_view(world, start, goal):
            broken[_IN_SIGHT] += 1
            continue
        goal_yaw = _best_view(world, goal, 2 * np.pi * draw[1:], rules)
        if goal_yaw is None:
            broken[_DULL_GOAL] += 1
            continue
        rule = find_broken_rule(world, start, goal) if tier == "beyond" else None
        if rule is not None:
            broken[rule] += 1
            continue
        return Episode(
            episode_id=f"{index:04d}",
            scene=world.name,
            start_position=to_position(start),
            start_yaw=start_yaw,
            goal_position=to_position(goal),
            goal_yaw=goal_yaw,
            geodesic=geodesic,
            info={"ideal_primitives": ideal, **({"tier": tier} if tier else {})},
        )
    raise _explain_failure(world, rules, tier, broken)


def _explain_failure(world: World, rules: EpisodeRules, tier: str, broken: Counter[str]) -> EpisodesError:
    """Return the error of a scene without a pair of places that satisfies the rules, which are checked in turn."""
    rule = next(each for each in reversed(RULES) if each in broken)
    reasons = ", ".join(f"{count} broke {each}" for each, count in broken.most_common())
    asked = f"episodes of tier '{tier}', " if tier else ""
    given = rules.attempts // ATTEMPTS if tier else rules.attempts
    more = f"more attempts (--task-option attempts={10 * given})"
    loosen = (
        f"Choose a larger scene, another tier, or {more}"
        if tier
        else f"Loosen one (--task-option goal_depth=0.8, or goal_depth=0.8 in Python), or allow {more}"
    )
    numbers = ", ".join(f"{name}={getattr(rules, name):g}" for name in NUMBERS)
    return EpisodesError(
        f"{world.name}: {asked}no start and goal among {rules.attempts} satisfy {numbers}: {reasons}. The rule that "
        f"the best attempts broke: {rule}. {loosen}",
        rule,
    )


def ideal_primitives(path: NDArray[np.float64], yaw: float, step: float = 0.2, turn: float = np.pi / 8) -> int:
    """Return the primitives of a path [N, 3] from heading `yaw`: its turns in whole steps, its length in strides."""
    legs = np.diff(path[:, [0, 2]], axis=0)
    legs = legs[np.linalg.norm(legs, axis=1) > 1e-6]
    headings = np.arctan2(-legs[:, 0], -legs[:, 1])
    turns = np.diff(np.concatenate([[yaw], headings]))
    turns = np.abs(np.remainder(turns + np.pi, 2 * np.pi) - np.pi)
    return int(np.round(turns / turn).sum() + np.ceil(np.linalg.norm(legs, axis=1).sum() / step))


def _best_view(world: World, goal: NDArray[np.float64], yaws: NDArray[np.float64], rules: EpisodeRules) -> float | None:
    """Return the heading whose view reaches deepest, if any view is worth looking at."""
    poses = np.stack([camera_pose(goal, float(yaw)) for yaw in yaws])
    views = world.renderer.perspective(poses, (60, 60), 90.0, outputs=("depth", "instance"))
    depths = np.median(views["depth"].reshape(len(yaws), -1), axis=1)
    things = np.array([len(np.unique(view)) for view in views["instance"]])
    depths[things < rules.goal_instances] = 0
    best = int(depths.argmax())
    return float(yaws[best]) if depths[best] >= rules.goal_depth else None
