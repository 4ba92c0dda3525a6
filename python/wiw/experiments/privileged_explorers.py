# SPDX-License-Identifier: Apache-2.0
"""Explorers with privileged information about a home, to tell which errors are due to perception, to exploration, or to
neither.

They can be given two things: perception (true labels and colours of real views, from the simulator's instance ids) and
a tour (views from all over the home before the first decision). Together with the explorer itself this makes four arms
of one run. Privileged explorers must not be used to compare world models; runs record what they are given.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.ar import category_of
from wiw.datasets.questions.mesh_table import NAMES
from wiw.loop.privileged import LiveEnvironments, Privileged
from wiw.mapping.views import HFOV_DEG, Views, cut_labels, cut_views
from wiw.perception.colors import COLORS
from wiw.perception.oracle_labeller import OracleLabeller
from wiw.perception.scene_labels import SceneLabels
from wiw.policies.base import Situation
from wiw.policies.explorer.drawing import VIEW_SIZE
from wiw.policies.explorer.memory import Look
from wiw.policies.explorer.policy import Explorer

SPACING = 1.2
"""Distance in metres within which a tour passes every reachable place."""
SURVEY = 500
"""Number of places from which a tour is chosen."""


class PrivilegedExplorer(Explorer, Privileged):
    """`Explorer` with privileged information; subclasses define which.

    Args:
        options: options of `Explorer`.
    """

    true_labels: ClassVar[bool] = False
    """Whether real views have true labels and colours; imagined views are labelled as usual."""
    tour: ClassVar[bool] = False
    """Whether the map begins with views from all over the home, so that the first answer is final."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._environments = LiveEnvironments()

    def grant(self, environments: LiveEnvironments) -> None:
        """Take the environments that provide the privileged information."""
        self._environments = environments

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity that says what is given."""
        given = (("perception", self.true_labels), ("tour", self.tour))
        return {**super().describe(), "privileged": [name for name, whether in given if whether]}

    def look_around(self, situation: Situation) -> Iterator[Look]:
        """Yield the views of a tour, if one is due, and then the real one; with instance ids if true labels are
        given.
        """
        env = self._environments.find(situation.key)
        if self.tour and not situation.memory.grid.visits:
            yield from take_tour(env, self.true_labels)
        for look in super().look_around(situation):
            yield replace(look, ids=env.instances()[0]) if self.true_labels else look

    def perceive(self, situation: Situation, look: Look, pose: NDArray[np.float64]) -> tuple[Views, SceneLabels]:
        """Return the views and their labels; with instance ids, from these, with each thing painted in its colour."""
        if look.ids is None:
            return super().perceive(situation, look, pose)
        instances = _rename(self._environments.find(situation.key).state.world.scene.instances)
        views, ids = cut_views(look.panorama, look.depth, pose, VIEW_SIZE), cut_labels(look.ids, VIEW_SIZE)
        labels = OracleLabeller(instances, self.labeller.categories).label(views.images, HFOV_DEG, ids)
        return replace(views, images=self._paint(views.images, ids, instances)), labels

    def _paint(
        self, images: NDArray[np.uint8], ids: NDArray[np.uint32], instances: Sequence[Mapping[str, Any]]
    ) -> NDArray[np.uint8]:
        """Return views in which the red of each pixel is the number of its thing's colour.

        Where a scene does not say it, that is the colour which the explorer itself sees.
        """
        painted = _paint_colors(instances)[ids]
        for each in instances:
            if each["attributes"].get("color") not in COLORS and (own := ids == each["id"]).any():
                painted[own] = COLORS.index(super().name_color(images[own], each["category"])[0])
        return painted

    def name_color(self, pixels: NDArray[np.uint8], category: str) -> tuple[str, float]:
        """Return the colour word that painted pixels stand for, or that real ones show."""
        if not self.true_labels:
            return super().name_color(pixels, category)
        return COLORS[int(np.bincount(pixels[:, 0]).argmax())], 1.0

    def is_final(self, situation: Situation) -> bool:
        """Return whether the present belief is given as the answer: after a tour there is nothing left to see."""
        return self.tour or super().is_final(situation)


def _rename(instances: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return instances with categories in the words of apartments, which labellers and questions use."""
    named = ((each, category_of(each)) for each in instances)
    return [{**each, "category": NAMES.get(name, name)} for each, name in named]


def _paint_colors(instances: Sequence[Mapping[str, Any]]) -> NDArray[np.uint8]:
    """Return the pixel of each instance, uint8 [instances + 1, 3], whose red is the number of its colour."""
    painted = np.zeros((max((int(each["id"]) for each in instances), default=0) + 1, 3), np.uint8)
    for each in instances:
        color = each["attributes"].get("color", "")
        painted[each["id"]] = COLORS.index(color) if color in COLORS else 0
    return painted


class OracleExplorer(PrivilegedExplorer):
    """Explores like `explorer`, but with true labels."""

    true_labels = True


class TourExplorer(PrivilegedExplorer):
    """Gets a tour of the whole home, and labels it like `explorer`."""

    tour = True


class OracleTourExplorer(PrivilegedExplorer):
    """Gets a tour of the whole home with true labels: what it gets wrong is an error of the map or the answering."""

    true_labels = tour = True


def take_tour(env: Any, ids: bool) -> Iterator[Look]:
    """Yield looks around from places all over the home of a live environment, which does not move.

    Args:
        env: a navigation environment in an episode.
        ids: whether looks carry the simulator's instance ids.
    """
    yield from look_from(env, choose_places(env.state.world, env.state.positions[-1]), ids)


def look_from(env: Any, places: Iterable[NDArray[np.float64]], ids: bool) -> Iterator[Look]:
    """Yield a look around from each place, float64 [3] in the world; the environment itself does not move."""
    start, here = env.state.positions[-1], env.observation.odometry
    simulator = env.fork()
    heading = float(simulator.yaw)
    outputs = ["panorama", "depth", *(["panorama_ids"] if ids else [])]
    for place in places:
        simulator.reset(place, heading)
        shown = simulator.observe(outputs)
        odometry = _to_odometry(np.asarray(simulator.position) - start, heading, here)
        yield Look(shown["panorama"], shown["depth"], odometry, shown.get("panorama_ids"))


def choose_places(world: Any, start: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return places within `SPACING` of every place that can be reached from a start, float64 [N, 3].

    The farthest from all that are chosen is next, from the start on; a pure function of (world, start).
    """
    island = int(world.navmesh.island_of(start))
    points = world.ground.put_down(world.navmesh.sample(SURVEY, core.fold_key([0x70A2]), island)).astype(np.float64)
    away = np.linalg.norm(points - start, axis=1)
    chosen = []
    while len(points) and away.max() > SPACING:
        chosen.append(points[int(away.argmax())])
        away = np.minimum(away, np.linalg.norm(points - chosen[-1], axis=1))
    return np.array(chosen).reshape(-1, 3)


def _to_odometry(offset: NDArray[np.float64], heading: float, here: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x, y, azimuth of a place in the frame of the start.

    Args:
        offset: of the place from the agent, in the world (Y up).
        heading: of the agent in the world, radians, left positive from -Z.
        here: x, y, azimuth of the agent.
    """
    ahead = np.array([-np.sin(heading), 0.0, -np.cos(heading)]) @ offset
    left = np.array([-np.cos(heading), 0.0, np.sin(heading)]) @ offset
    cos, sin = np.cos(here[2]), np.sin(here[2])
    return np.array([here[0] + cos * ahead - sin * left, here[1] + sin * ahead + cos * left, here[2]])
