# SPDX-License-Identifier: Apache-2.0
"""Where to go next: frontiers of the known floor, and things worth a nearer look."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wiw.mapping.object_map import MapObject
from wiw.mapping.occupancy import OccupancyGrid
from wiw.mapping.routes import measure_distances, route
from wiw.policies.explorer.answering import measure_clarity

NEAR = 1.2
"""Metres from which a thing is looked at."""
LOOKED_AT = 1.6
"""Metres from which a thing has been looked at as nearly as it will be."""
INTEREST = 12.0
"""Worth of a nearer look at what the question is about, in square metres of new floor."""
LEAST_GAIN = 0.4
"""Square metres of new floor from which on a frontier is worth going to."""
MOST_FRONTIERS = 12
"""Frontiers that are rated, the longest."""
GAIN_REACH = 4.0


@dataclass(frozen=True)
class Destination:
    """A place worth going to."""

    position: NDArray[np.float64]
    """float64 [2] in the frame of the start."""
    gain: float
    """Square metres of floor that could be seen from there for the first time."""
    interest: float = 0.0
    """Worth of a nearer look at a thing."""
    radius: float = 0.25
    """Metres from the place within which the route may end."""
    note: str = ""
    worth: float = 0.0


Rate = Callable[[Destination, float], float]


def choose_destinations(
    grid: OccupancyGrid,
    pose: NDArray[np.float64],
    things: Sequence[MapObject],
    rate: Rate,
) -> list[Destination]:
    """Return the places that can be reached and promise something, the most worth first.

    Args:
        grid: what is known of the floor.
        pose: x, y, azimuth of the agent.
        things: what the question is about, as far as it is in the map.
        rate: returns the worth of a place, with the metres to it.
    """
    distances = measure_distances(grid, pose)
    found = [look for thing in things if (look := _look_nearer(grid, thing)) is not None]
    for frontier in grid.frontiers[:MOST_FRONTIERS]:
        gain = grid.measure_gain(frontier.position, reach=GAIN_REACH)
        if gain >= LEAST_GAIN:
            found.append(Destination(frontier.position, gain, note="unknown floor"))
    rated = []
    for place in found:
        metres = _measure_way(grid, distances, place)
        if np.isfinite(metres):
            rated.append(replace(place, worth=rate(place, metres)))
    return sorted(rated, key=lambda place: (-place.worth, *place.position.tolist()))


def _look_nearer(grid: OccupancyGrid, thing: MapObject) -> Destination | None:
    """Return the place of a thing that has not been looked at from near; None for one that has."""
    place = thing.center[:2]
    if min((float(np.hypot(*(visit - place))) for visit in grid.visits), default=np.inf) <= LOOKED_AT:
        return None
    return Destination(place, 0.0, INTEREST * (1 - measure_clarity(thing)), NEAR, "a nearer look")


def plan_route(grid: OccupancyGrid, pose: NDArray[np.float64], place: Destination, longest: int) -> NDArray[np.int8]:
    """Return the first primitives of the route to a place; turns towards it where the agent is there already."""
    found = route(grid, pose, place.position, place.radius, first=longest)
    if len(found.actions):
        return found.actions
    away = place.position - pose[:2]
    if not np.hypot(*away) > 0.05:
        return found.actions
    return route(grid, pose, float(np.arctan2(away[1], away[0])), first=longest).actions


def _measure_way(grid: OccupancyGrid, distances: NDArray[np.float64], place: Destination) -> float:
    """Return the metres to a place, or to the nearest one around it from where it is looked at; inf without a way."""
    reach = max(1, round(place.radius / 0.1))
    row, column = (int(cell[0]) for cell in grid.to_cells(place.position[None]))
    rows, columns = (slice(max(0, cell - reach), max(0, cell + reach + 1)) for cell in (row, column))
    box = distances[rows, columns]
    return float(box.min(initial=np.inf))
