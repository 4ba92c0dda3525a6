# SPDX-License-Identifier: Apache-2.0
"""Candidate plans: routes to where the goal may be, round corners, and straight runs; and when they would arrive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, to_trajectory
from wiw.mapping.occupancy import CELL, OccupancyGrid
from wiw.mapping.routes import HEADINGS, STEP, TURN, follow_heading, route
from wiw.policies.navigator.ways import WayMap, Ways, crop_layer, find_blocked

ARRIVAL = 0.45
"""Metres from the goal within which the agent has arrived."""
RADIUS = 0.15
"""Metres from its target within which a route ends."""
LEEWAY = 5
"""Steps beyond the horizon to which a route may swerve."""
FRAME = 3
"""Cells at the edge of a cropped floor that are blocked, so that no route steps over it."""
LOOK_AROUND = 4
"""Turns of a plan where no way leads anywhere."""


@dataclass(frozen=True)
class Candidate:
    """A plan, and where it leads."""

    actions: NDArray[np.int8]
    poses: NDArray[np.float64]
    """float64 [K, 3]: x, y, azimuth after each action, if no step is refused, in the frame of the start."""

    @property
    def moves(self) -> bool:
        """Whether it leads to another place."""
        return bool((self.actions == int(FORWARD)).any())


def make_candidate(pose: NDArray[np.float64], actions: NDArray[np.int8]) -> Candidate:
    """Return a plan with the poses that it leads to from a pose."""
    forward, left, turned = to_trajectory(actions).T
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = pose[0] + cos * forward - sin * left, pose[1] + sin * forward + cos * left
    return Candidate(np.asarray(actions, np.int8), np.stack([x, y, pose[2] + turned], axis=1))


def list_candidates(
    grid: OccupancyGrid,
    way_map: WayMap,
    ways: Ways,
    pose: NDArray[np.float64],
    targets: Sequence[int],
    horizon: int,
) -> list[Candidate]:
    """List routes to targets, and straight runs in all headings that go on to the first one; no plan twice.

    Plans have `horizon` primitives, where a way leads on so far.

    Args:
        grid: what is known of the floor.
        way_map: the same, coarser, with what may be floor.
        ways: from where the agent stands, one row.
        pose: x, y, azimuth of the agent.
        targets: cells of the way map; those that cannot be reached are left out.
        horizon: L.
    """
    floor = crop_floor(grid, pose, (horizon + LEEWAY) * STEP)
    reachable = [target for target in targets if np.isfinite(ways.metres[0, target])]
    stops = [_find_stop(way_map, ways, target, horizon) for target in reachable]
    plans = [_plan_route(floor, pose, [stop, *stops], horizon) for stop in stops]
    for k in range(HEADINGS):
        run = follow_heading(grid, pose, float(pose[2]) + k * TURN, horizon * STEP)
        if run.length:
            rest = _plan_route(floor, run.poses[-1], stops, horizon - len(run.actions))
            plans.append(np.concatenate([run.actions[:horizon], rest]))
    unlike = {plan.tobytes(): plan for plan in plans if len(plan)}
    if not unlike:
        unlike[b""] = np.full(min(horizon, LOOK_AROUND), TURN_LEFT, np.int8)
    return [make_candidate(pose, plan) for plan in unlike.values()]


def crop_floor(grid: OccupancyGrid, pose: NDArray[np.float64], reach: float) -> OccupancyGrid:
    """Return the part of a map around the agent, with what is unknown taken for floor, and a blocked frame."""
    half = int(reach / CELL) + FRAME
    row, column = (int(cell) - half for cell in np.floor(pose[:2] / CELL))
    inside = slice(FRAME, 2 * half - FRAME)
    blocked = np.ones((2 * half, 2 * half), bool)
    blocked[inside, inside] = crop_layer(grid, find_blocked(grid), (row, column), (2 * half, 2 * half))[inside, inside]
    return OccupancyGrid(origin=(row, column), free=~blocked, occupied=blocked, walls=np.zeros_like(blocked))


def _find_stop(way_map: WayMap, ways: Ways, target: int, horizon: int) -> NDArray[np.float64]:
    """Return the last point of the way to a cell that the horizon reaches."""
    cells = way_map.trace(ways, 0, target)
    near = np.flatnonzero(ways.metres[0, cells] <= horizon * STEP)
    return way_map.cells.centres[cells[near[-1]]]


def _plan_route(
    floor: OccupancyGrid, pose: NDArray[np.float64], stops: Sequence[NDArray[np.float64]], horizon: int
) -> NDArray[np.int8]:
    """Return at most `horizon` primitives from a pose to the first stop, from there to the next, and so on."""
    actions, end = np.zeros(0, np.int8), np.asarray(pose, np.float64)
    for stop in stops:
        if len(actions) >= horizon:
            break
        found = route(floor, end, stop, RADIUS, first=horizon - len(actions))
        actions, end = np.concatenate([actions, found.actions]), found.poses[-1]
    return actions


def measure_arrivals(candidate: Candidate, ways: Ways, row: int) -> NDArray[np.float64]:
    """Return the primitives after which the agent would be at each cell if it followed a plan, float64 [cells].

    Args:
        candidate: the plan.
        ways: from the ends of plans.
        row: which of them is this plan's.
    """
    end = candidate.poses[-1]
    metres = ways.metres[row]
    off = np.remainder(ways.azimuths[row] - end[2] + np.pi, 2 * np.pi) - np.pi
    rest = np.maximum(metres - ARRIVAL, 0) / STEP + np.where(metres > ARRIVAL, np.abs(off) / TURN, 0)
    found = len(candidate.actions) + rest
    for step in reversed(range(len(candidate.poses))):
        near = ways.cells.find_near(candidate.poses[step, :2], ARRIVAL)
        found[near] = np.minimum(found[near], step + 1)
    return found


def choose_apart(candidates: Sequence[Candidate], values: NDArray[np.float64], count: int, apart: float) -> list[int]:
    """Choose the best plans whose ends are `apart` metres from each other; where there are too few, closer ones.

    Plans that only turn come after those that move, but for the best one: nothing would be imagined for them.
    """
    order = [int(i) for i in np.argsort(-values, kind="stable")]
    order = [*order[:1], *sorted(order[1:], key=lambda i: not candidates[i].moves)]
    chosen: list[int] = []
    for least in (apart, apart / 2, 0.0):
        for i in order:
            ends = [np.hypot(*(candidates[i].poses[-1] - candidates[j].poses[-1])[:2]) for j in chosen]
            if len(chosen) < count and i not in chosen and all(end >= least for end in ends):
                chosen.append(i)
    return chosen
