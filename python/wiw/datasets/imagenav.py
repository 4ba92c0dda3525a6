# SPDX-License-Identifier: Apache-2.0
"""Image-Goal Navigation episodes for any scene: goals out of sight, yet within reach of the paper's budget."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError
from wiw.types import Episode

CAMERA_HEIGHT = 1.0
_log = logging.getLogger("wiw.datasets")


@dataclass(frozen=True)
class EpisodeRules:
    """Rules that a start and a goal of an episode satisfy. Lengths in metres."""

    shortest: float = 2.0
    """Least geodesic distance."""
    longest: float = 8.0
    budget: int = 42
    """Most primitives an ideal run may need: 70 % of the paper's 20 decisions of 3 primitives."""
    goal_depth: float = 1.2
    """Least median depth of the goal view, so that it shows more than a wall."""
    goal_instances: int = 4
    """Least number of things in the goal view, the outside counted. In a scene of fewer, such as a scan that is one
    mesh, nothing is asked of their number."""
    attempts: int = 400
    """Pairs tried per episode before giving up."""


def generate(
    world: World, count: int, seed: int, rules: EpisodeRules = EpisodeRules(), *, first: int = 0
) -> list[Episode]:
    """Return episodes `first` to `first + count - 1` of one scene, each a function of (scene, seed, its number) alone.

    Raises:
        ArgumentError: the scene has too few pairs of places that satisfy `rules`; says which rules they broke.
    """
    rules = _fit_rules(world, rules)
    return [_episode(world, index, seed, rules) for index in range(first, first + count)]


def _fit_rules(world: World, rules: EpisodeRules) -> EpisodeRules:
    """Return the rules, less the number of things in view where the whole scene has fewer."""
    instances = len(world.scene.instances)
    if rules.goal_instances <= instances + 1:
        return rules
    _log.info(
        "%s has %d instances: goal views are not asked for %d things", world.name, instances, rules.goal_instances
    )
    return replace(rules, goal_instances=0)


def _episode(world: World, index: int, seed: int, rules: EpisodeRules) -> Episode:
    key = core.fold_key([seed, index, 0x1A6E])
    points = world.ground.put_down(world.navmesh.sample(2 * rules.attempts, key))
    draws = core.uniform(core.fold_key([key, 1]), 5 * rules.attempts).reshape(-1, 5)
    broken: Counter[str] = Counter()
    for start, goal, draw in zip(points[::2], points[1::2], draws, strict=True):
        geodesic = float(world.navmesh.geodesic_distance(start, goal))
        if not rules.shortest <= geodesic <= rules.longest:
            broken["shortest, longest"] += 1
            continue
        start_yaw = float(2 * np.pi * draw[0])
        ideal = ideal_primitives(np.asarray(world.navmesh.shortest_path(start, goal)), start_yaw)
        if ideal > rules.budget:
            broken["budget"] += 1
            continue
        if is_in_view(world, start, goal):
            broken["the goal in sight of the start"] += 1
            continue
        goal_yaw = _best_view(world, goal, 2 * np.pi * draw[1:], rules)
        if goal_yaw is None:
            broken["goal_depth, goal_instances"] += 1
            continue
        return Episode(
            episode_id=f"{index:04d}",
            scene=world.name,
            start_position=_triple(start),
            start_yaw=start_yaw,
            goal_position=_triple(goal),
            goal_yaw=goal_yaw,
            geodesic=geodesic,
            info={"ideal_primitives": ideal},
        )
    reasons = ", ".join(f"{count} broke {rule}" for rule, count in broken.most_common())
    raise ArgumentError(
        f"{world.name}: no start and goal among {rules.attempts} satisfy {rules}: {reasons}. Loosen one "
        "(--task-option goal_depth=0.8, or goal_depth=0.8 in Python), or raise attempts"
    )


def ideal_primitives(path: NDArray[np.float64], yaw: float, step: float = 0.2, turn: float = np.pi / 8) -> int:
    """Return the primitives of a path [N, 3] from heading `yaw`: its turns in whole steps, its length in strides."""
    legs = np.diff(path[:, [0, 2]], axis=0)
    legs = legs[np.linalg.norm(legs, axis=1) > 1e-6]
    headings = np.arctan2(-legs[:, 0], -legs[:, 1])
    turns = np.diff(np.concatenate([[yaw], headings]))
    turns = np.abs(np.remainder(turns + np.pi, 2 * np.pi) - np.pi)
    return int(np.round(turns / turn).sum() + np.ceil(np.linalg.norm(legs, axis=1).sum() / step))


def is_in_view(world: World, start: NDArray[np.float64], goal: NDArray[np.float64], margin: float = 0.3) -> bool:
    """Return whether the goal camera's position is visible from the start camera's, by the depth along the ray."""
    eye, place = (np.add(p, [0.0, CAMERA_HEIGHT, 0.0]) for p in (start, goal))
    way = place - eye
    pose = camera_pose(start, float(np.arctan2(-way[0], -way[2])))
    pitch = np.arctan2(way[1], np.hypot(way[0], way[2]))
    depth = world.renderer.panorama(pose[None], (64, 128), outputs=("depth",))["depth"][0]
    row = int((0.5 - pitch / np.pi) * 64)
    seen = depth[max(row - 1, 0) : row + 2, 63:65]
    return bool((seen == 0).any() or seen.max() > np.linalg.norm(way) - margin)


def camera_pose(position: NDArray[np.float64], yaw: float, height: float = CAMERA_HEIGHT) -> NDArray[np.float64]:
    """Return T_world_camera [4, 4] of an agent at `position` on the floor, heading `yaw` radians."""
    pose = np.eye(4)
    pose[0, 0] = pose[2, 2] = np.cos(yaw)
    pose[0, 2], pose[2, 0] = np.sin(yaw), -np.sin(yaw)
    pose[:3, 3] = np.add(position, [0.0, height, 0.0])
    return pose


def _best_view(world: World, goal: NDArray[np.float64], yaws: NDArray[np.float64], rules: EpisodeRules) -> float | None:
    """Return the heading whose view reaches deepest, if any view is worth looking at."""
    poses = np.stack([camera_pose(goal, float(yaw)) for yaw in yaws])
    views = world.renderer.perspective(poses, (60, 60), 90.0, outputs=("depth", "instance"))
    depths = np.median(views["depth"].reshape(len(yaws), -1), axis=1)
    things = np.array([len(np.unique(view)) for view in views["instance"]])
    depths[things < rules.goal_instances] = 0
    best = int(depths.argmax())
    return float(yaws[best]) if depths[best] >= rules.goal_depth else None


def _triple(point: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(point[0]), float(point[1]), float(point[2])
