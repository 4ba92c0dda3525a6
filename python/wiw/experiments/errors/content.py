# SPDX-License-Identifier: Apache-2.0
"""Errors of content: the right place and looks, but objects are missing, moved or invented, or walls are open.

They affect only what is rendered, never what happens: the simulator's own forks, physics included, stay true. Light
that is baked into textures is unchanged.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.questions.facts import STRUCTURE
from wiw.errors import ArgumentError
from wiw.experiments.errors.base import Degradation, make_generator, per_space
from wiw.experiments.errors.control import list_moves
from wiw.experiments.errors.drawing import ComposedRenderer, DrawnBench, MovedRenderer
from wiw.experiments.errors.forks import Walker, WorldFork
from wiw.metrics import pose_error
from wiw.tabletop.workbench import HIDDEN_DEPTH
from wiw.types import GRIPPER_POSES, Conditioning, Control
from wiw.world_models.base import WorldModel

BARRIERS = frozenset({"wall", "door", "door frame", "window"})
"""Categories left out by hallucinated free space."""
AROUND = 4.0
"""Distance from the agent in metres within which objects are invented."""
TABLE_AREA = ((-0.1, 0.4), (-0.4, 0.4))
"""Metres in x and y between which things are invented on a table."""


@dataclass(frozen=True)
class DrawnFork:
    """Stands in for a fork of the simulator whose world is rendered differently, and whose cameras may be elsewhere."""

    renderer: Any
    find_cameras: Any
    """Function of a plan, int8 [K], that returns float64 [K, 4, 4]."""

    def camera_poses_after(self, actions: NDArray[np.int8]) -> NDArray[np.float64]:
        """Return the cameras after each primitive."""
        return np.asarray(self.find_cameras(actions))


class ContentDegradation(Degradation):
    """An error in what exists."""

    family = "content"
    draws_future = True

    def rollout(
        self,
        model: WorldModel,
        observations: Conditioning,
        controls: Sequence[Control],
        seeds: NDArray[np.uint64],
    ) -> NDArray[np.uint8]:
        """Return what the oracle sees of a world that is rendered with this error."""
        assert observations.simulators is not None
        draw = self.draw_table if model.accepts.space == GRIPPER_POSES else self.draw_world
        pairs = zip(observations.simulators, seeds, strict=True)
        drawn = [draw(simulator, int(seed)) for simulator, seed in pairs]
        return model.rollout(replace(observations, simulators=drawn), controls, seeds)

    @abstractmethod
    def draw_world(self, fork: WorldFork, seed: int) -> DrawnFork:
        """Return a fork whose world is drawn with the error, for plans of primitives."""

    @abstractmethod
    def draw_table(self, bench: Any, seed: int) -> DrawnBench:
        """Return a workbench that is drawn with the error, for plans of poses."""


class Missing(ContentDegradation):
    """Some objects are missing."""

    kind = "missing"
    about = "Leaves out random objects: furniture and small things, or what is on a table."
    unit = "share of the objects"
    doses = per_space((0.25, 0.5, 1.0))
    most = 1.0

    def draw_world(self, fork: WorldFork, seed: int) -> DrawnFork:
        """Return a fork without the things that are drawn to be missing."""
        return _hide(fork, _choose(list_things(fork.world.scene), make_generator(seed), self.dose))

    def draw_table(self, bench: Any, seed: int) -> DrawnBench:
        """Return a workbench without the things that are drawn to be missing."""
        names = list(bench.things)
        drawn = make_generator(seed).random(len(names)) < self.dose
        return DrawnBench(
            bench, {name: shift(0, 0, -HIDDEN_DEPTH) for name, gone in zip(names, drawn, strict=True) if gone}
        )


class Moved(ContentDegradation):
    """Objects are in the wrong place."""

    kind = "moved"
    about = "Moves every object horizontally, each in its own direction, through whatever is there."
    unit = "metres"
    doses = per_space((0.25, 0.5, 1.0), (0.03, 0.1, 0.3))

    def draw_world(self, fork: WorldFork, seed: int) -> DrawnFork:
        """Return a fork whose things are drawn beside their places."""
        things = list_things(fork.world.scene)
        angles = make_generator(seed).uniform(0, 2 * np.pi, len(things.ids))
        poses = things.poses.copy()
        poses[:, 0, 3] += self.dose * np.cos(angles)
        poses[:, 2, 3] += self.dose * np.sin(angles)
        return DrawnFork(MovedRenderer(fork.renderer, things.ids, poses, things.poses), fork.camera_poses_after)

    def draw_table(self, bench: Any, seed: int) -> DrawnBench:
        """Return a workbench whose things are drawn beside their places."""
        angles = make_generator(seed).uniform(0, 2 * np.pi, len(bench.things))
        places = zip(bench.things, angles, strict=True)
        return DrawnBench(
            bench, {name: shift(self.dose * np.cos(angle), self.dose * np.sin(angle)) for name, angle in places}
        )


class Invented(ContentDegradation):
    """Objects appear that do not exist."""

    kind = "invented"
    about = "Shows copies of the scene's objects where there are none, on free floor within 4 m or on the table."
    unit = "copies per object of the scene"
    doses = per_space((0.25, 0.5, 1.0))
    most = 1.0

    def draw_world(self, fork: WorldFork, seed: int) -> DrawnFork:
        """Return a fork whose pictures have copies in them."""
        things, generator = list_things(fork.world.scene), make_generator(seed)
        chosen = _choose(things, generator, self.dose)
        places = _draw_floor(fork, len(things.ids), generator)
        copies = chosen.poses.copy()
        way = places[np.searchsorted(things.ids, chosen.ids)] - chosen.middles
        copies[:, [0, 2], 3] += way[:, [0, 2]]  # a file's pose may be anywhere, as one for all of them
        moved = MovedRenderer(fork.renderer, chosen.ids, copies, chosen.poses)
        return DrawnFork(ComposedRenderer(fork.renderer, moved, chosen.ids), fork.camera_poses_after)

    def draw_table(self, bench: Any, seed: int) -> DrawnBench:
        """Return a workbench whose pictures have copies in them."""
        generator = make_generator(seed)
        names, drawn = list(bench.things), generator.random(len(bench.things)) < self.dose
        low, high = np.array(TABLE_AREA).T
        places = generator.uniform(low, high, (len(names), 2))
        poses = bench.get_poses(names)
        offsets = {
            name: shift(*(place - poses[name][:2, 3]))
            for name, place, one in zip(names, places, drawn, strict=True)
            if one
        }
        return DrawnBench(bench, offsets, copies=True)


class OpenSpace(ContentDegradation):
    """Hallucinated free space."""

    kind = "open"
    about = "Leaves out random walls, doors and windows of rooms, and at random moves on where a step is blocked."
    unit = "share of the walls, doors and windows, and of the blocked steps"
    doses = per_space((0.25, 0.5, 1.0), ())
    most = 1.0

    def draw_world(self, fork: WorldFork, seed: int) -> DrawnFork:
        """Return a fork that sees, and goes, through barriers."""
        barriers = list_barriers(fork.world.scene)
        hidden = _hide(fork, _choose(barriers, make_generator(seed), self.dose))
        return DrawnFork(hidden.renderer, lambda actions: self._find_cameras(fork, actions, seed))

    def draw_table(self, bench: Any, seed: int) -> DrawnBench:
        """Raise an error: there are no walls around a table."""
        raise ArgumentError("error 'open': a table has no walls; expected plans of primitives")

    def misplace(self, simulator: Any, actions: NDArray[Any], seed: int) -> NDArray[np.float64]:
        """See `Degradation.misplace`."""
        if not len(actions):
            return np.zeros((0, 2))
        metres, angles = pose_error(simulator.camera_poses_after(actions), self._find_cameras(simulator, actions, seed))
        return np.stack([metres, np.degrees(angles)], axis=1)

    def _find_cameras(self, fork: WorldFork, actions: NDArray[np.int8], seed: int) -> NDArray[np.float64]:
        walker, passes = Walker(fork), make_generator(seed, 1).random(len(actions)) < self.dose
        moves = zip(*list_moves(actions).T, passes, strict=True)
        return np.stack([walker.move(ahead, left, turn, bool(through)) for ahead, left, turn, through in moves])


@dataclass(frozen=True)
class Instances:
    """Some instances of a scene."""

    ids: NDArray[np.uint32]
    """uint32 [N], ascending."""
    poses: NDArray[np.float32]
    """float32 [N, 4, 4]: T_world_instance."""
    middles: NDArray[np.float32]
    """float32 [N, 3]: middle of the bounds in the world."""
    drop: float
    """Metres down that take an instance out of every view."""


@lru_cache(4)
def list_things(scene: Any) -> Instances:
    """Return the instances of a scene that are things rather than parts of the building.

    Raises:
        ArgumentError: there are none, as in a scan without labels.
    """
    return _list_instances(scene, "things", lambda category: category not in STRUCTURE)


@lru_cache(4)
def list_barriers(scene: Any) -> Instances:
    """Return the walls, doors and windows of a scene.

    Raises:
        ArgumentError: there are none apart from the rest.
    """
    return _list_instances(scene, "walls, doors or windows", lambda category: category in BARRIERS)


def _list_instances(scene: Any, words: str, belongs: Any) -> Instances:
    drawn = [each for each in scene.instances if each["triangle_count"]]
    found = [each for each in drawn if each["category"] and belongs(each["category"])]
    if not found:
        raise ArgumentError(
            f"scene {scene.name} has no {words} that could be changed; expected a scene whose instances have "
            "categories, such as a generated apartment"
        )
    low, high = scene.bounds
    ids = np.array([each["id"] for each in found], np.uint32)
    middles = np.stack([each["bounds"].mean(axis=0) for each in found])
    poses = np.stack([each["T_world_instance"] for each in found])
    return Instances(ids, poses, middles, float(high[1] - low[1]) + 1.0)


def _choose(instances: Instances, generator: np.random.Generator, share: float) -> Instances:
    """Return the instances that are drawn; those of a smaller share are among those of a larger one."""
    drawn = generator.random(len(instances.ids)) < share
    return Instances(instances.ids[drawn], instances.poses[drawn], instances.middles[drawn], instances.drop)


def _hide(fork: WorldFork, instances: Instances) -> DrawnFork:
    below = instances.poses.copy()
    below[:, 1, 3] -= instances.drop
    return DrawnFork(MovedRenderer(fork.renderer, instances.ids, below, instances.poses), fork.camera_poses_after)


def _draw_floor(fork: WorldFork, count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return places on free floor near the agent, float64 [count, 3]; anywhere on it where there is little near."""
    here = fork.world
    places = np.asarray(here.navmesh.sample(16 * count, int(generator.integers(2**31)), here.floor), np.float64)
    near = np.linalg.norm(places - fork.core.position, axis=1) < AROUND
    return (places[near] if near.sum() >= count else places)[:count]


def shift(x: float, y: float, z: float = 0.0) -> NDArray[np.float64]:
    """Return a translation [4, 4]."""
    found = np.eye(4)
    found[:3, 3] = x, y, z
    return found
