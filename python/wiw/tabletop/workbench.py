# SPDX-License-Identifier: Apache-2.0
"""A table with a robot arm and objects on it: physics and rendering.

The frame is the robot's: z up, x from the arm towards the front camera, the table's top at `TABLE`. Rendering uses the
renderer's frame, where y is up (`Y_UP`).
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.errors import ArgumentError
from wiw.physics import Articulation, Box, Gripper, World, WorldState, place
from wiw.render import Output, Renderer
from wiw.scenes import Scene
from wiw.tabletop.link_meshes import build_link_meshes
from wiw.tabletop.robot import Robot, load_panda
from wiw.tabletop.shapes import build_mesh, merge_meshes

Colour = tuple[float, float, float]
"""RGB from 0 to 1, as displayed."""
Pose = NDArray[np.float64]
"""Homogeneous transform [4, 4]."""

TABLE = 0.75
"""Height of the table's top above the floor in metres, about that of RLBench."""
TOP = (1.1, 1.4, 0.05)
"""Size of the table's top in metres."""
WOOD: Colour = (0.78, 0.69, 0.57)
"""Colour of the table."""
BASE = place(x=-0.35, z=TABLE)
"""Pose of the arm's base, half a metre behind the middle of the table's top."""
TABLE_POSE = place(x=0.15, z=TABLE - TOP[2] / 2)
Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
SUN = {"direction": (0.45, 1.0, 0.45), "strength": 0.5, "ambient": 0.66}
HIDDEN_DEPTH = 3.0
"""Metres by which hidden parts are moved down, out of view; not further, as shadow maps span the whole scene."""
SHUT = 0.5
"""Gripper values below this close the fingers."""
PUSHED = 0.003
"""Metres that a button's plate must go down to count as pushed; RLBench's number."""
LAMPS: Mapping[str, Colour] = {"lime": (0.45, 0.95, 0.1), "amber": (1.0, 0.62, 0.0), "red": (0.95, 0.05, 0.05)}
"""Colours of the first, second and third push of an episode; later ones are like the third."""
LAMP_OFF_POSE = place(z=-1.0)
"""Pose of lamps that are off: under the floor, out of every view."""


@dataclass(frozen=True)
class Thing:
    """An object on the table: a rigid body of one or several shapes, or a mechanism with joints."""

    name: str
    parts: tuple[tuple[Any, Pose], ...] = ()
    """Shapes of `wiw.physics` and their poses in the object's frame."""
    colour: Colour = (0.5, 0.5, 0.5)
    mass: float = 0.0
    """Kilograms; an object without mass never moves."""
    friction: float = 0.5
    mechanism: Articulation | None = None
    """Instead of parts, with the colours of its own description."""
    has_body: bool = True
    """Whether it collides; without a body it is only visible, like a mark on the table."""
    lamp: Any = None
    """For a button, which is a mechanism: a shape around its base that lights up, as in `LAMPS`, when it is pushed."""


@dataclass(frozen=True)
class Camera:
    """A camera and what it looks at."""

    eye: tuple[float, float, float]
    at: tuple[float, float, float]
    hfov_deg: float = 60.0
    on_hand: bool = False
    """Whether the positions are in the frame of the arm's hand instead of the table's."""

    @property
    def pose(self) -> Pose:
        """Pose [4, 4]; the camera looks along -z with +y up, from `eye` to `at`."""
        ahead = np.subtract(self.at, self.eye) / np.linalg.norm(np.subtract(self.at, self.eye))
        up = (0, 0, 1) if abs(ahead[2]) < 0.95 else (1, 0, 0)
        right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(right, ahead), -ahead], axis=1)
        pose[:3, 3] = self.eye
        return pose

    def project_points(self, points: ArrayLike, size: tuple[int, int]) -> NDArray[np.float64]:
        """Project points [N, 3] in front of the camera to pixels, right and down: float64 [N, 2]."""
        height, width = size
        seen = (np.asarray(points, np.float64) - self.eye) @ self.pose[:3, :3]
        focal = width / 2 / np.tan(np.radians(self.hfov_deg) / 2)
        return np.array([width / 2, height / 2]) + focal * seen[:, :2] * (1, -1) / -seen[:, 2:]


WRIST = "wrist"
"""Name of the camera on the hand."""
CAMERAS: Mapping[str, Camera] = {
    "front": Camera((1.0, 0.0, 1.4), (0.0, 0.0, 0.96)),
    "left_shoulder": Camera((-0.45, 0.75, 1.6), (0.2, 0.0, 0.8)),
    "right_shoulder": Camera((-0.45, -0.75, 1.6), (0.2, 0.0, 0.8)),
    WRIST: Camera((0.07, 0.0, 0.02), (0.02, 0.0, 0.3), 80.0, on_hand=True),
}


@dataclass(frozen=True)
class Move:
    """How far the arm got on its way to a pose."""

    free: float
    """Share of the straight path that is free of the table and within reach, from 0 to 1; the arm sets out on that
    part.

    The arm may touch objects, so a fixed one, such as a peg, can still stop it: `Workbench.pose` is the pose it
    reached.
    """
    reason: str
    """"free", or what ended the path: "out of reach", "joint limits", "not converged", "jump" or "collision"."""


@dataclass(frozen=True)
class Film:
    """The states of a workbench at each physics step of a move, the start first; items are forks.

    State that is updated at the end of a move, such as the object held, is only in the workbench itself.
    """

    start: Workbench
    states: Sequence[WorldState]

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, index: int) -> Workbench:
        return self.start.fork(self.states[index])


class Workbench:
    """The arm, the table and objects, in a state that can be forked.

    Args:
        things: the objects on the table, and their poses [4, 4].
        backend: renderer, "auto", "cpu" or "gpu".
        robot: the arm; the project's own Panda if None.

    Raises:
        ArgumentError: two objects have the same name, or shapes or numbers are impossible.
    """

    def __init__(
        self,
        things: Sequence[tuple[Thing, Pose]],
        backend: Literal["auto", "cpu", "gpu"] = "auto",
        robot: Robot | None = None,
    ) -> None:
        self.robot = robot or load_panda()
        self.things = {thing.name: thing for thing, _ in things}
        if len(self.things) < len(things):
            raise ArgumentError(f"Workbench: expected a name for each thing, got {[t.name for t, _ in things]}")
        self._world = World()
        self._world.add_body(Box(TOP), T_world_body=TABLE_POSE, name="table", friction=0.8)
        self._arm = self._world.add_articulation(self.robot.description, BASE)
        self._bodies, self._mechanisms = dict[str, int](), dict[str, int]()
        self._marks = {thing.name: pose for thing, pose in things if not thing.has_body}
        for thing, pose in things:
            if not thing.has_body:
                continue
            if thing.mechanism is None:
                self._bodies[thing.name] = self._world.add_body(
                    list(thing.parts), mass=thing.mass, T_world_body=pose, name=thing.name, friction=thing.friction
                )
            else:
                self._mechanisms[thing.name] = self._world.add_articulation(thing.mechanism, pose)
        self._world.set_joint_positions(self.robot.ready_joints, self._arm)
        self._buttons = tuple(thing.name for thing, _ in things if thing.lamp is not None)
        self._pressed: tuple[str, ...] = ()
        self._offsets: Mapping[str, Pose] = {}
        self._scene_renderer = _SceneRenderer(self, backend)

    def fork(self, state: WorldState | None = None) -> Workbench:
        """Return an independent copy of the state, to simulate ahead; it shares the renderer.

        Args:
            state: of the physics; the present one if None.
        """
        other = copy(self)
        other._world = self._world.fork()
        if state is not None:
            other._world.restore(state)
        return other

    def draw_elsewhere(self, offsets: Mapping[str, Pose]) -> Workbench:
        """Return the same workbench, physics shared, that draws some objects elsewhere than they are.

        Args:
            offsets: transforms [4, 4] in the table's frame, by an object's name.
        """
        other = copy(self)
        other._offsets = dict(offsets)
        return other

    @property
    def seconds(self) -> float:
        """Simulated time since the table was set up."""
        return self._world.time

    # -- the arm -------------------------------------------------------------------------------------------------------

    @property
    def pose(self) -> NDArray[np.float64]:
        """float64 [7]: x, y, z, roll, pitch, yaw of the point between the finger tips, and the opening of the
        fingers.
        """
        from scipy.spatial.transform import Rotation

        tip = self._world.link_poses(self._arm)[self.robot.tool_index]
        angles = Rotation.from_matrix(tip[:3, :3]).as_euler("xyz")
        return np.array([*tip[:3, 3], *angles, self._gripper.opening])

    @property
    def idle_action(self) -> NDArray[np.float64]:
        """float64 [7]: the pose that changes nothing where the gripper is sent to it, as what is held stays held.

        `pose` does not: fingers around something wide are open, and fingers that are to open let it go.
        """
        return np.array([*self.pose[:6], 0.0]) if self._gripper.held is not None else self.pose

    @property
    def _gripper(self) -> Gripper:
        """The gripper; it has no state."""
        return self.robot.create_gripper(self._world, self._arm)

    @property
    def joints(self) -> NDArray[np.float64]:
        """float64 [dof]: positions of the arm's joints and of the two fingers; nine for the Panda."""
        return self._world.joint_positions(self._arm)

    @property
    def held_object(self) -> str | None:
        """Name of the object in the gripper, if any."""
        index = self._gripper.held
        return next((name for name, body in self._bodies.items() if body == index), None)

    def move_to(self, pose: ArrayLike) -> Move:
        """Move the gripper straight to a pose [7] as far as the path is free, then open or close it.

        A path that leads into the table or out of reach is followed as far as it is free; the arm may touch everything
        else.

        Raises:
            ArgumentError: not finite, another shape, or a gripper outside [0, 1]; nothing has moved then.
        """
        wanted = np.asarray(pose, np.float64)
        if wanted.shape != (7,) or not np.isfinite(wanted).all() or not 0 <= wanted[6] <= 1:
            raise ArgumentError(
                f"move_to: expected a finite pose [7] with a gripper from 0 to 1, got {wanted.tolist()}"
            )
        x, y, z, *angles = wanted[:6]
        path = self._world.plan_linear(
            place(x, y, z, angles),
            self.robot.tcp,
            self._arm,
            allowed=list(self._bodies.values()),
            allowed_articulations=list(self._mechanisms.values()),
        )
        self._world.follow(path, self._arm)
        gripper = self._gripper
        if wanted[6] < SHUT and gripper.held is None:
            gripper.close()
        elif wanted[6] >= SHUT and (gripper.held is not None or gripper.opening < wanted[6]):
            gripper.open(float(wanted[6]))
        self._record_pushes()
        return Move(path.free, path.reason)

    def film(self, pose: ArrayLike) -> tuple[Move, Film]:
        """Execute `move_to`, and record every physics step.

        Raises:
            ArgumentError: as `move_to`.
        """
        start = self.fork()
        self._world.record()
        try:
            move = self.move_to(pose)
        finally:
            states = self._world.recorded()
        return move, Film(start, states)

    # -- things --------------------------------------------------------------------------------------------------------

    def get_pose(self, name: str) -> Pose:
        """Return an object's pose [4, 4]; for a mechanism, that of its base."""
        if name in self._marks:
            return self._marks[name]
        if name in self._bodies:
            return self._world.body_poses()[self._bodies[name]]
        return self._world.link_poses(self._mechanisms[name])[0]

    def get_poses(self, names: Sequence[str]) -> dict[str, Pose]:
        """Return the poses of objects, by name."""
        return {name: self.get_pose(name) for name in names}

    def get_joint_positions(self, name: str) -> NDArray[np.float64]:
        """Return the joint positions of a mechanism, float64 [dof]."""
        return self._world.joint_positions(self._mechanisms[name])

    @property
    def pressed_buttons(self) -> tuple[str, ...]:
        """Buttons in the order in which they were pushed: those whose plate was down at the end of a move.

        The same one twice in a row counts once.
        """
        return self._pressed

    def set_spring(self, name: str, force: float) -> None:
        """Attach springs that pull the joints of a mechanism back to zero with at most `force` newtons (or newton
        metres).
        """
        count = len(self.get_joint_positions(name))
        self._world.set_joint_targets(np.zeros(count), self._mechanisms[name])
        self._world.set_joint_forces(np.full(count, force), self._mechanisms[name])

    def settle(self, steps: int = 240) -> None:
        """Simulate some steps so that objects come to rest."""
        self._world.step(steps)

    def _record_pushes(self) -> None:
        for name in self._buttons:
            if self.get_joint_positions(name)[0] < -PUSHED and self._pressed[-1:] != (name,):
                self._pressed = (*self._pressed, name)

    # -- pictures ------------------------------------------------------------------------------------------------------

    def render_view(
        self,
        camera: str = "front",
        size: tuple[int, int] = (480, 480),
        outputs: Sequence[Output] = ("color",),
        arm: bool = True,
    ) -> dict[str, NDArray[Any]]:
        """Render a camera's view: "color" uint8 [H, W, 3], "depth" float32 [H, W] planar metres, "instance" uint32 [H,
        W].

        Args:
            camera: one of `CAMERAS`.
            size: (height, width) in pixels.
            outputs: any of the three.
            arm: whether the arm is visible.

        Raises:
            ArgumentError: there is no such camera.
        """
        found = self._scene_renderer.render_batch(
            self, self.get_camera_pose(camera), CAMERAS[camera].hfov_deg, size, outputs, arm
        )
        return {name: image[0] for name, image in found.items()}

    def get_camera_pose(self, camera: str) -> Pose:
        """Return a camera's present pose [4, 4]: it looks along -z with +y up.

        Raises:
            ArgumentError: there is no such camera.
        """
        if camera not in CAMERAS:
            raise ArgumentError(f"camera: expected one of {', '.join(CAMERAS)}, got {camera!r}")
        found = CAMERAS[camera]
        return self.hand_pose @ found.pose if found.on_hand else found.pose

    @property
    def instance_names(self) -> tuple[str, ...]:
        """Names of the instance ids from 1: objects, "arm", and parts of the room ("table", "floor", "wall").

        An object made of several parts has several ids.
        """
        return self._scene_renderer.instance_names

    def render_fronts_after(self, poses: ArrayLike, size: tuple[int, int], first: int = 0) -> NDArray[np.uint8]:
        """Move to each of the poses [K, 7] in turn; return the front views after `poses[first:]`, uint8 [N, H, W, 3]"""
        views = []
        for number, pose in enumerate(np.asarray(poses, np.float64)):
            self.move_to(pose)
            if number >= first:
                views.append(self.render_view("front", size)["color"])
        return np.stack(views)

    def get_part_poses(self) -> list[Pose]:
        """Return the world poses of all drawn parts that may move: objects in order, then the arm's links."""
        bodies, arm = self._world.body_poses(), self._world.link_poses(self._arm)
        found: list[Pose] = []
        for name, thing in self.things.items():
            first = len(found)
            if thing.mechanism is None:
                found.append(bodies[self._bodies[name]] if thing.has_body else self._marks[name])
            else:
                links = self._world.link_poses(self._mechanisms[name])
                found += [links[link] for link, _ in build_link_meshes(thing.mechanism)]
            if thing.lamp is not None:
                lit = self._find_lit_lamp(name)
                found += [self.get_pose(name) if number == lit else LAMP_OFF_POSE for number in range(len(LAMPS))]
            if name in self._offsets:
                found[first:] = [self._offsets[name] @ pose for pose in found[first:]]
        return found + [arm[link] for link, _ in self.robot.link_meshes]

    def _find_lit_lamp(self, name: str) -> int | None:
        """Return which of a button's lamps is on: that of its latest push."""
        pushes = [number for number, other in enumerate(self._pressed) if other == name]
        return min(pushes[-1], len(LAMPS) - 1) if pushes else None

    @property
    def hand_pose(self) -> Pose:
        """Pose [4, 4] of the arm's hand."""
        return self._world.link_poses(self._arm)[self.robot.description.link_index(self.robot.hand)]


class _SceneRenderer:
    """The scene of a workbench and its renderer, shared by all its forks; created with the first image."""

    def __init__(self, bench: Workbench, backend: Literal["auto", "cpu", "gpu"]) -> None:
        self._things, self._robot, self._start = bench.things, bench.robot, bench.get_part_poses()
        self._first, self._backend = len(_ROOM) + 1, backend
        self._lock = threading.Lock()

    @cached_property
    def _renderer(self) -> Renderer:
        meshes: list[dict[str, Any]] = []
        materials: list[dict[str, Any]] = []

        def add(mesh: Mapping[str, Any], colour: Sequence[float], pose: Pose, name: str) -> None:
            materials.append({"name": name, "base_color": (*map(float, colour[:3]), 1.0)})
            meshes.append({**mesh, "material": len(materials) - 1, "name": name, "T_world_instance": Y_UP @ pose})

        for name, shape, colour, pose in _ROOM:
            add(build_mesh(shape), colour, pose, name)
        poses = iter(self._start)
        for thing in self._things.values():
            if thing.mechanism is None:
                whole = merge_meshes([(build_mesh(shape), pose) for shape, pose in thing.parts])
                add(whole, thing.colour, next(poses), thing.name)
            else:
                for _, mesh in build_link_meshes(thing.mechanism):
                    add(mesh, _PAINTED, next(poses), thing.name)
            if thing.lamp is not None:
                for colour in LAMPS.values():
                    add(build_mesh(thing.lamp), colour, next(poses), thing.name)
        for _, mesh in self._robot.link_meshes:
            add(mesh, _PAINTED, next(poses), "arm")
        scene = Scene.from_arrays(meshes, name="workbench", materials=materials, sun=SUN)
        return Renderer(scene, self._backend, samples=4)

    @property
    def instance_names(self) -> tuple[str, ...]:
        """Names of the drawn instances, in the order of ids from 1."""
        return tuple(each["name"] for each in self._renderer.scene.instances)

    def render_batch(
        self,
        bench: Workbench,
        camera: Pose,
        hfov_deg: float,
        size: tuple[int, int],
        outputs: Sequence[Output],
        arm: bool,
    ) -> dict[str, NDArray[Any]]:
        """Render a state as a batch of one image."""
        moved = np.stack([Y_UP @ pose for pose in bench.get_part_poses()])
        if not arm:
            moved[len(moved) - len(self._robot.link_meshes) :, 1, 3] -= HIDDEN_DEPTH
        ids = np.arange(self._first, self._first + len(moved), dtype=np.uint32)
        with self._lock:  # forks in other threads draw by the same renderer
            self._renderer.core.set_poses(ids, moved.astype(np.float32))
            return self._renderer.perspective(Y_UP @ camera, size, hfov_deg, outputs=outputs)


_PAINTED: Colour = (1.0, 1.0, 1.0)
"""Base colour of meshes with vertex colours."""
_LEG = Box((0.05, 0.05, TABLE - TOP[2]))
_ROOM: list[tuple[str, Any, Colour, Pose]] = [
    ("floor", Box((12, 12, 0.02)), (0.5, 0.52, 0.55), place(z=-0.01)),
    ("wall", Box((0.02, 4, 2.6)), (0.9, 0.92, 0.93), place(x=-1.2, z=1.3)),
    ("table", Box(TOP), WOOD, TABLE_POSE),
    *(
        ("table", _LEG, (0.6, 0.52, 0.43), place(x=x, y=y, z=(TABLE - TOP[2]) / 2))
        for x in (-0.35, 0.65)
        for y in (-0.64, 0.64)
    ),
]
"""Drawn parts that never move."""
