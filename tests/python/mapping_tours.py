# SPDX-License-Identifier: Apache-2.0
"""Walks through apartments with true depth and true labels, and the scene's table in the frame of the start."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import env as _env
from wiw.datasets.worlds import World, world
from wiw.mapping.object_map import BACKGROUND, MapObject, ObjectMap
from wiw.mapping.occupancy import OccupancyGrid
from wiw.mapping.views import Views, cut_labels, cut_views

STATES = ("", "on", "off", "open", "closed")


@dataclass(frozen=True)
class Thing:
    """A row of the scene's table."""

    id: int
    name: str
    category: str
    state: str
    room: str
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def center(self) -> NDArray[np.float64]:
        return (self.low + self.high) / 2


class Tour:
    """Observations from `count` places of an apartment, each near the one before."""

    def __init__(self, scene: str, count: int) -> None:
        self.world: World = world(scene, "cpu")
        self.core = _env.NavigationEnv(
            self.world.renderer.core,
            self.world.navmesh,
            self.world.ground,
            _env.NavigationConfig(motion=_env.Motion.refuse),
        )
        points = self.world.ground.put_down(self.world.navmesh.sample(count, 0)).astype(float)
        headings = np.random.default_rng(0).integers(16, size=count) * np.pi / 8
        left, order = set(range(1, count)), [0]
        while left:
            order.append(min(left, key=lambda k: (np.linalg.norm(points[k] - points[order[-1]]), k)))
            left.remove(order[-1])
        self.start, self.yaw = points[order[0]], float(headings[order[0]])
        self.observations = [self.observe(points[k], float(headings[k])) for k in order]

    def observe(self, position: NDArray[np.float64], yaw: float) -> dict[str, Any]:
        self.core.reset(position, yaw)
        return self.core.observe(["panorama", "depth", "panorama_ids"]) | {"odometry": self.odometry()}

    def odometry(self) -> NDArray[np.float64]:
        turned = (self.core.yaw - self.yaw + np.pi) % (2 * np.pi) - np.pi
        return np.array([*self.to_start(self.core.position)[:2], turned])

    def axes(self) -> NDArray[np.float64]:
        """Rows are the axes of the start (forward, left, up) in the world."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[-sin, 0, -cos], [-cos, 0, sin], [0, 1, 0]])

    def to_start(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((np.asarray(points, float) - self.start) @ self.axes().T)

    def to_world(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        full = np.zeros((*np.shape(points)[:-1], 3))
        full[..., : np.shape(points)[-1]] = points
        return np.asarray(full @ self.axes() + self.start)

    @property
    def categories(self) -> tuple[str, ...]:
        return ("", *sorted({instance["category"] for instance in self.world.scene.instances}))

    def label(self, ids: NDArray[np.uint32]) -> Any:
        """True labels of instance ids, as a labeller gives them."""
        names = self.categories
        category, state = np.zeros((2, len(self.world.scene.instances) + 1), np.uint8)
        for thing in self.things():
            category[thing.id] = names.index(thing.category)
            state[thing.id] = STATES.index(thing.state)
        return SimpleNamespace(category=category[ids], state=state[ids], confidence=np.ones(ids.shape, np.float32))

    def things(self) -> list[Thing]:
        found = []
        for instance in self.world.scene.instances:
            (x0, y0, z0), (x1, y1, z1) = np.asarray(instance["bounds"], float)
            corners = self.to_start(np.array([[x, y, z] for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]))
            told = instance["attributes"]
            state = told.get("state", "")
            found.append(
                Thing(
                    instance["id"], instance["name"], instance["category"], state if state in STATES else "",
                    told.get("room", ""), corners.min(0), corners.max(0),
                )
            )  # fmt: skip
        return found

    def cut(self, index: int) -> tuple[Views, NDArray[np.uint32]]:
        observation = self.observations[index]
        views = cut_views(observation["panorama"], observation["depth"], observation["odometry"])
        return views, cut_labels(observation["panorama_ids"])


@dataclass(frozen=True)
class Mapped:
    """A tour with what was mapped on it."""

    tour: Tour
    objects: ObjectMap
    grid: OccupancyGrid
    largest: NDArray[np.int64]
    """Most pixels that each instance has filled in one view, by id."""
    owners: tuple[NDArray[np.int32], ...]

    def shown(self, least: int = 100) -> list[Thing]:
        """Things that have filled so many pixels of a view."""
        return [
            thing
            for thing in self.tour.things()
            if thing.category not in BACKGROUND and self.largest[thing.id] >= least
        ]

    def matches(self, thing: Thing) -> list[MapObject]:
        """The mapped objects most of which lie where a thing is."""
        return [
            known
            for known in self.objects.objects
            if known.category == thing.category
            and ((known.points >= thing.low - 0.1) & (known.points <= thing.high + 0.1)).all(axis=1).mean() > 0.5
        ]


def add_all(tour: Tour, count: int | None = None) -> Mapped:
    objects, grid = ObjectMap(tour.categories, STATES), OccupancyGrid()
    largest, owners = np.zeros(len(tour.world.scene.instances) + 1, np.int64), []
    for index, observation in enumerate(tour.observations[:count]):
        views, ids = tour.cut(index)
        owners.append(objects.add(views, tour.label(ids)))
        grid.add(observation["depth"], observation["odometry"])
        for view in ids:
            largest = np.maximum(largest, np.bincount(view.ravel(), minlength=len(largest)))
    return Mapped(tour, objects, grid, largest, tuple(owners))


@cache
def walk(scene: str = "apartments:val/3", count: int = 30) -> Tour:
    return Tour(scene, count)


@cache
def mapped(scene: str = "apartments:val/3", count: int = 30) -> Mapped:
    return add_all(walk(scene, count))
