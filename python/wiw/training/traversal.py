# SPDX-License-Identifier: Apache-2.0
"""Traversals of scenes: Algorithm 1 of the World-in-World paper, stage 2, carried out with the agent's primitives.

A segment leads from one waypoint to the next: forward steps of 0.2 m and turns of 22.5 degrees, each recorded. The
agent is never moved in any other way: a segment begins with the pose in which the one before it ended.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.action import FORWARD, NULL, TURN_LEFT, TURN_RIGHT, ActionSpace
from wiw.nav import DistanceField, NavMesh
from wiw.training.navigation_rules import NavigationRules
from wiw.training.waypoints import Waypoints

HEADINGS = 16
"""Headings of a traversal, one turn apart."""
STEP_M = float(ActionSpace().forward_m)
TURN_RAD = 2 * np.pi / HEADINGS
COVERAGE_RADIUS = 1.0
"""Metres: floor closer than this, geodesically, to a recorded position counts as covered."""
MAX_DETOUR = 3
"""Turns away from the path that the agent tries where the step ahead is blocked."""
PATIENCE = 20
"""Forward steps without coming closer to the waypoint, after which a way is searched for."""
SEARCH_GAIN = 0.2
"""Metres that a searched way must bring the agent closer than it has been."""
SEARCH_STEPS = 4000
"""Steps that a search tries before the agent counts as stuck."""
SEARCH_CELL = 0.05
"""Metres: a search takes positions within one cell as one."""

Ending = Literal["reached", "stuck", "cap"]


@dataclass(frozen=True)
class TraversalSegment:
    """T frames from one waypoint towards the next. Frame 0 is before the first action, and its action is Null."""

    positions: NDArray[np.float32]
    """float32 [T, 3]: on the navigation mesh, metres."""
    headings: NDArray[np.int64]
    """int64 [T]: turns of 22.5 degrees to the left of the traversal's north, 0 to 15."""
    actions: NDArray[np.int8]
    """int8 [T]: the action that led to each frame, as numbered by `wiw.action`."""
    waypoint: NDArray[np.float32]
    """float32 [3]: where it leads."""
    ending: Ending
    """Whether the waypoint was reached, the agent was stuck, or the number of frames was at its limit."""

    def __len__(self) -> int:
        return len(self.actions)


@dataclass(frozen=True)
class Traversal:
    """The segments of one pass over one island."""

    island: int
    north: float
    """Heading 0, radians to the left of the world's -Z; random, so that walls are seen at all angles."""
    segments: tuple[TraversalSegment, ...]
    waypoints: NDArray[np.float32]
    """float32 [W, 3]: all that were selected, in descending order of leaf score."""
    dropped: int
    """Waypoints that the agent could not reach."""
    area: float
    """Square metres of the island."""
    coverage: float
    """Share of the island within `COVERAGE_RADIUS` of a recorded position."""

    @property
    def frames(self) -> int:
        """Number of frames of all segments."""
        return sum(map(len, self.segments))


def plan_scene(
    navmesh: NavMesh,
    scene: str,
    seed: int,
    pass_index: int,
    rules: NavigationRules,
    roofs: Collection[int] = (),
) -> list[Traversal]:
    """Plan one pass over all islands of a scene but its roofs; a pure function of its arguments.

    Args:
        navmesh: of the scene.
        scene: its name, from which randomness is derived.
        seed: of the dataset.
        pass_index: from 0; other passes have other samples and starts.
        rules: the numbers of the algorithm.
        roofs: islands to leave out.
    """
    name = int.from_bytes(blake2b(scene.encode(), digest_size=8).digest(), "little")
    traversals, left = [], rules.max_scene_frames
    for island in choose_islands(navmesh, rules, roofs):
        if left < 2:
            break
        key = core.fold_key([seed, name, pass_index, island])
        traversals.append(plan_traversal(navmesh, island, key, rules, left))
        left -= traversals[-1].frames
    return traversals


def choose_islands(navmesh: NavMesh, rules: NavigationRules, roofs: Collection[int] = ()) -> list[int]:
    """Return the islands to traverse: the largest, and others that are large enough; no roofs."""
    floors = [index for index in range(len(navmesh.islands)) if index not in roofs]
    return [index for index in floors if index == floors[0] or navmesh.islands[index].area > rules.min_island_area]


def plan_traversal(
    navmesh: NavMesh, island: int, key: int, rules: NavigationRules, max_frames: int | None = None
) -> Traversal:
    """Plan the segments of one island by Algorithm 1.

    Args:
        navmesh: of the scene.
        island: index into `navmesh.islands`.
        key: all randomness derives from it.
        rules: the numbers of the algorithm.
        max_frames: maximum number of frames, if lower than the rules allow.
    """
    waypoints = Waypoints(navmesh, island, core.fold_key([key, 0]), rules)
    north = 2 * np.pi * float(core.uniform(core.fold_key([key, 1]), 1)[0])
    follower, current, dropped = _start(navmesh, waypoints, core.fold_key([key, 2]), north, rules)
    segments: list[TraversalSegment] = []
    left = min(max_frames or rules.max_scene_frames, rules.max_scene_frames)
    while (
        left >= 2 and follower.can_step() and (following := waypoints.find_next(follower.position, current)) is not None
    ):
        segment = follower.follow(waypoints.samples[following], min(left, rules.max_segment_frames))
        waypoints.mark_visited(segment.positions)
        if segment.ending != "reached":
            waypoints.drop(following)
            dropped += segment.ending == "stuck"
        if len(segment) > 1:
            segments.append(segment)
            left -= len(segment)
        current = following
    coverage = measure_coverage(navmesh, waypoints.samples, segments)
    area = float(navmesh.islands[island].area)
    return Traversal(island, follower.north, tuple(segments), waypoints.points, dropped, area, coverage)


def _start(
    navmesh: NavMesh, waypoints: Waypoints, key: int, north: float, rules: NavigationRules
) -> tuple[Follower, int, int]:
    """Place the agent on a random waypoint; return it with the waypoint's index and the number of waypoints dropped.

    Waypoints lie at the periphery, some in nooks shorter than a step, out of which no heading leads.
    """
    starts = waypoints.candidates
    dropped = 0
    for index in starts[np.argsort(core.uniform(key, len(starts)))]:
        follower = Follower(navmesh, waypoints.samples[index], north, rules)
        if follower.can_step():
            break
        waypoints.drop(int(index))
        dropped += 1
    return follower, int(index), dropped


def measure_coverage(navmesh: NavMesh, samples: NDArray[np.float32], segments: Sequence[TraversalSegment]) -> float:
    """Return the share of samples [N, 3] within a geodesic distance of `COVERAGE_RADIUS` of any recorded position."""
    if not segments:
        return 0.0
    positions = np.unique(np.concatenate([segment.positions for segment in segments]), axis=0)
    return float(np.mean(navmesh.distances_from(positions)(samples) < COVERAGE_RADIUS))


class Follower:
    """An agent that walks shortest paths with forward steps and turns.

    It heads for the point of the path `lookahead` metres ahead: it turns where its heading is off by more than the
    threshold, else it steps forward. Where the step is blocked, it tries headings up to `MAX_DETOUR` turns off. Where
    none is free, as in nooks hardly wider than a step, it searches for the fewest actions that bring it closer.

    Args:
        navmesh: that it walks on.
        position: float [3] where it starts, on the mesh.
        north: heading 0, radians to the left of -Z; the heading it starts with.
        rules: look-ahead and goal radius.
    """

    def __init__(self, navmesh: NavMesh, position: NDArray[np.float32], north: float, rules: NavigationRules) -> None:
        self._navmesh, self._rules = navmesh, rules
        self.position, self.heading, self.north = np.asarray(position, np.float32), 0, north

    def can_step(self) -> bool:
        """Return whether a step is free in any heading."""
        return any(self._step_end(heading) is not None for heading in range(HEADINGS))

    def follow(self, waypoint: NDArray[np.float32], max_frames: int) -> TraversalSegment:
        """Walk to a waypoint [3]; end there, where the agent is stuck, or after `max_frames` frames."""
        positions, headings, actions = [self.position], [self.heading], [int(NULL)]
        ending: Ending = "cap"
        walk = self._walk(waypoint)
        while len(actions) < max_frames:
            action = next(walk)
            if not isinstance(action, int):
                ending = action
                break
            positions.append(self.position)
            headings.append(self.heading)
            actions.append(action)
        return TraversalSegment(
            np.stack(positions), np.array(headings, np.int64), np.array(actions, np.int8), waypoint, ending
        )

    def _walk(self, waypoint: NDArray[np.float32]) -> Iterator[int | Literal["reached", "stuck"]]:
        """Carry out actions, yielding each once it is done; at last how the walk ended."""
        remaining = self._navmesh.distances_from(waypoint)
        best, waited = float("inf"), 0
        while (metres := float(remaining(self.position))) > self._rules.goal_radius:
            best, waited = (metres, 0) if metres < best - 1e-3 else (best, waited + 1)
            step = self._find_step(waypoint) if waited <= PATIENCE else None
            steps = self._search_steps(remaining, best - SEARCH_GAIN) if step is None else [step]
            if not steps:
                yield "stuck"
                return
            for heading, end in steps:
                yield from self._turn_to(heading)
                self.position = end
                yield int(FORWARD)
        yield "reached"

    def _search_steps(self, remaining: DistanceField, metres: float) -> list[tuple[int, NDArray[np.float32]]]:
        """Return the headings and ends of steps to within a distance of the waypoint, by few actions; or none.

        A* over positions: what is left of the path in steps never overestimates the actions to come.
        """
        start = _cell(self.position)
        came: dict[_Cell, _Reached | None] = {start: None}
        queue = [(0.0, 0, 0, self.heading, start, self.position)]
        while queue and len(came) < SEARCH_STEPS:
            _, _, actions, facing, cell, position = heapq.heappop(queue)
            if remaining(position) <= metres:
                return _trace_steps(came, cell)
            for heading in range(HEADINGS):
                end = self._step_end(heading, position)
                if end is None or (following := _cell(end)) in came:
                    continue
                came[following] = cell, heading, end
                cost = actions + 1 + abs(_count_turns(facing, heading))
                ahead = cost + float(remaining(end)) / STEP_M
                heapq.heappush(queue, (ahead, len(came), cost, heading, following, end))  # the number breaks ties
        return []

    def _turn_to(self, heading: int) -> Iterator[int]:
        turns = _count_turns(self.heading, heading)
        for _ in range(abs(turns)):
            self.heading = (self.heading + (1 if turns > 0 else -1)) % HEADINGS
            yield int(TURN_LEFT if turns > 0 else TURN_RIGHT)

    def _find_step(self, waypoint: NDArray[np.float32]) -> tuple[int, NDArray[np.float32]] | None:
        """Return a heading in which a step is free, and the step's end: the present heading where it is close enough to
        the path, else the one nearest to the path.
        """
        ahead = find_point_ahead(self._navmesh.shortest_path(self.position, waypoint), self._rules.lookahead)
        away = ahead - self.position
        bearing = float(np.arctan2(-away[0], -away[2]) - self.north) / TURN_RAD
        for heading in self._rank_headings(bearing):
            end = self._step_end(heading)
            if end is not None:
                return heading, end
        return None

    def _rank_headings(self, bearing: float) -> list[int]:
        """Return the headings to try for a bearing, in turns from north; the best first."""
        nearest = round(bearing)
        side = 1 if bearing >= nearest else -1
        offsets = [0, *(sign * side * turns for turns in range(1, MAX_DETOUR + 1) for sign in (1, -1))]
        off = abs((self.heading - bearing + HEADINGS / 2) % HEADINGS - HEADINGS / 2) * np.degrees(TURN_RAD)
        kept = [self.heading] if off <= self._rules.turn_threshold_deg else []
        return [*kept, *((nearest + offset) % HEADINGS for offset in offsets)]

    def _step_end(self, heading: int, start: NDArray[np.float32] | None = None) -> NDArray[np.float32] | None:
        """Return where a step forward leads, by the rule of environments: None if its end is off the mesh."""
        yaw = self.north + heading * TURN_RAD
        position = self.position if start is None else start
        end = (position.astype(np.float64) + STEP_M * np.array([-np.sin(yaw), 0, -np.cos(yaw)])).astype(np.float32)
        return np.asarray(self._navmesh.snap(end), np.float32) if self._navmesh.is_navigable(end) else None


_Cell = tuple[int, ...]
_Reached = tuple[_Cell, int, NDArray[np.float32]]
"""The cell that a step began in, its heading, and its end."""


def _cell(position: NDArray[np.float32]) -> _Cell:
    return tuple(np.rint(position / SEARCH_CELL).astype(int).tolist())


def _trace_steps(came: dict[_Cell, _Reached | None], cell: _Cell) -> list[tuple[int, NDArray[np.float32]]]:
    """Return the steps that a search took to a cell, in order."""
    steps = []
    while (step := came[cell]) is not None:
        cell, heading, end = step
        steps.append((heading, end))
    return steps[::-1]


def _count_turns(heading: int, other: int) -> int:
    """Return the turns from one heading to another, left ones positive, -8 to 7."""
    return (other - heading + HEADINGS // 2) % HEADINGS - HEADINGS // 2


def find_point_ahead(path: NDArray[np.float32], distance: float) -> NDArray[np.float64]:
    """Return the point of a path [P, 3] at a horizontal distance along it, or its end; float64 [3]."""
    points = np.asarray(path, np.float64)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0)[:, [0, 2]].T))])
    return np.array([np.interp(distance, along, points[:, axis]) for axis in range(3)])
