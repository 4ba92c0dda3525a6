# SPDX-License-Identifier: Apache-2.0
"""A table with a robot arm and things on it: their physics, and pictures of the same.

The frame is that of robots: z up, x from the arm to the front camera, the table's top at `TABLE`. Pictures are drawn in
the renderer's frame, where y is up (`Y_UP`).
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from wiw.errors import ArgumentError
from wiw.physics import Articulation, Box, Gripper, World, WorldState, place
from wiw.render import Output, Renderer
from wiw.scenes import Scene
from wiw.tabletop.looks import looks_of
from wiw.tabletop.robot import Robot, own_panda
from wiw.tabletop.shapes import joined, mesh_of

Colour = tuple[float, float, float]
"""RGB from 0 to 1, as displayed."""
Pose = NDArray[np.float64]
"""[4, 4]."""

TABLE = 0.75
"""Metres from the floor to the table's top, which is about that of RLBench."""
TOP = (1.1, 1.4, 0.05)
"""Metres of the table's top."""
WOOD: Colour = (0.78, 0.69, 0.57)
"""The table's colour."""
BASE = place(x=-0.35, z=TABLE)
"""Where the arm stands; the middle of the table's top lies half a metre in front of it."""
MIDDLE = place(x=0.15, z=TABLE - TOP[2] / 2)
Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
SUN = {"direction": (0.45, 1.0, 0.45), "strength": 0.5, "ambient": 0.66}
FAR_BELOW = 3.0
"""Metres down to where nobody sees what is left out of a picture; no further, as maps of shadows span all things."""
SHUT = 0.5
"""A gripper value below it closes the fingers."""
PUSHED = 0.003
"""Metres that the plate of a button has to go down; RLBench's number."""
LAMPS: Mapping[str, Colour] = {"lime": (0.45, 0.95, 0.1), "amber": (1.0, 0.62, 0.0), "red": (0.95, 0.05, 0.05)}
"""Colours of the first, second and third push of an episode; later ones are as the third."""
OFF = place(z=-1.0)
"""Where lamps are that are off: under the floor, out of every view."""


@dataclass(frozen=True)
class Thing:
    """Something on the table: a rigid body of one or several shapes, or a mechanism with joints."""

    name: str
    parts: tuple[tuple[Any, Pose], ...] = ()
    """Shapes of `wiw.physics` and their poses in the thing's frame."""
    colour: Colour = (0.5, 0.5, 0.5)
    mass: float = 0.0
    """Kilograms; what has none stays where it is."""
    friction: float = 0.5
    mechanism: Articulation | None = None
    """In place of parts; in the colours of its own description."""
    touched: bool = True
    """Whether it has a body; what has none is only seen, as a mark on the table."""
    lamp: Any = None
    """Of a button, which is a mechanism: a shape around its base that lights up, by `LAMPS`, when it is pushed."""


@dataclass(frozen=True)
class Camera:
    """Where pictures are taken from."""

    eye: tuple[float, float, float]
    at: tuple[float, float, float]
    hfov_deg: float = 60.0
    on_hand: bool = False
    """Whether the places are in the frame of the arm's hand, not the table's."""

    @property
    def pose(self) -> Pose:
        """[4, 4]: it looks along -z with +y up, from its eye to what it looks at."""
        ahead = np.subtract(self.at, self.eye) / np.linalg.norm(np.subtract(self.at, self.eye))
        up = (0, 0, 1) if abs(ahead[2]) < 0.95 else (1, 0, 0)
        right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(right, ahead), -ahead], axis=1)
        pose[:3, 3] = self.eye
        return pose

    def pixels_of(self, points: ArrayLike, size: tuple[int, int]) -> NDArray[np.float64]:
        """float64 [N, 2]: where points [N, 3] before the camera are in its picture, in pixels right and down."""
        height, width = size
        seen = (np.asarray(points, np.float64) - self.eye) @ self.pose[:3, :3]
        focal = width / 2 / np.tan(np.radians(self.hfov_deg) / 2)
        return np.array([width / 2, height / 2]) + focal * seen[:, :2] * (1, -1) / -seen[:, 2:]


CAMERAS: Mapping[str, Camera] = {
    "front": Camera((1.0, 0.0, 1.4), (0.0, 0.0, 0.96)),
    "left_shoulder": Camera((-0.45, 0.75, 1.6), (0.2, 0.0, 0.8)),
    "right_shoulder": Camera((-0.45, -0.75, 1.6), (0.2, 0.0, 0.8)),
    "wrist": Camera((0.07, 0.0, 0.02), (0.02, 0.0, 0.3), 80.0, on_hand=True),
}


@dataclass(frozen=True)
class Move:
    """How far the arm came on its way to a pose."""

    free: float
    """Share of the straight way that is free of the table and within reach, from 0 to 1, and that it set out on.

    Things may be touched, so what stands fast, such as a peg, can still stop it: `Workbench.pose` is where it has come.
    """
    why: str
    """"free", or what ended the way: "out of reach", "joint limits", "not converged", "jump" or "collision"."""


@dataclass(frozen=True)
class Film:
    """A workbench as it was at each physics step of a way, the start first; its items are forks.

    What is noticed only once the way has ended, such as what is held now, the workbench itself can tell.
    """

    start: Workbench
    states: Sequence[WorldState]

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, index: int) -> Workbench:
        return self.start.fork(self.states[index])


class Workbench:
    """The arm, the table and things, in a state that can be forked.

    Args:
        things: what stands on the table, and where: poses [4, 4].
        backend: renderer, "auto", "cpu" or "gpu".
        robot: the arm; the project's own Panda if None.

    Raises:
        ArgumentError: two things of one name, or impossible shapes or numbers.
    """

    def __init__(
        self,
        things: Sequence[tuple[Thing, Pose]],
        backend: Literal["auto", "cpu", "gpu"] = "auto",
        robot: Robot | None = None,
    ) -> None:
        self.robot = robot or own_panda()
        self.things = {thing.name: thing for thing, _ in things}
        if len(self.things) < len(things):
            raise ArgumentError(f"Workbench: expected a name for each thing, got {[t.name for t, _ in things]}")
        self._world = World()
        self._world.add_body(Box(TOP), T_world_body=MIDDLE, name="table", friction=0.8)
        self._arm = self._world.add_articulation(self.robot.description, BASE)
        self._bodies, self._mechanisms = dict[str, int](), dict[str, int]()
        self._marks = {thing.name: pose for thing, pose in things if not thing.touched}
        for thing, pose in things:
            if not thing.touched:
                continue
            if thing.mechanism is None:
                self._bodies[thing.name] = self._world.add_body(
                    list(thing.parts), mass=thing.mass, T_world_body=pose, name=thing.name, friction=thing.friction
                )
            else:
                self._mechanisms[thing.name] = self._world.add_articulation(thing.mechanism, pose)
        self._world.set_joint_positions(self.robot.ready, self._arm)
        self._buttons = tuple(thing.name for thing, _ in things if thing.lamp is not None)
        self._pressed: tuple[str, ...] = ()
        self._pictures = _Pictures(self, backend)

    def fork(self, state: WorldState | None = None) -> Workbench:
        """The same state apart, to be run ahead; pictures are drawn with the same renderer.

        Args:
            state: of the physics; the present one if None.
        """
        other = object.__new__(Workbench)
        other.__dict__.update(self.__dict__)
        other._world = self._world.fork()
        if state is not None:
            other._world.restore(state)
        return other

    @property
    def seconds(self) -> float:
        """Of the physics, since the table was made."""
        return self._world.time

    # -- the arm -------------------------------------------------------------------------------------------------------

    @property
    def pose(self) -> NDArray[np.float64]:
        """float64 [7]: x, y, z, roll, pitch, yaw of the point between the finger tips, and how open they are."""
        tip = self._world.link_poses(self._arm)[self.robot.tcp_index]
        angles = Rotation.from_matrix(tip[:3, :3]).as_euler("xyz")
        return np.array([*tip[:3, 3], *angles, self._gripper.opening])

    @property
    def _gripper(self) -> Gripper:
        """Has no state of its own."""
        return self.robot.gripper(self._world, self._arm)

    @property
    def joints(self) -> NDArray[np.float64]:
        """float64 [dof]: positions of the arm's joints and of the two fingers; of the Panda nine."""
        return self._world.joint_positions(self._arm)

    @property
    def held(self) -> str | None:
        """What the gripper holds."""
        index = self._gripper.held
        return next((name for name, body in self._bodies.items() if body == index), None)

    def go(self, pose: ArrayLike) -> Move:
        """Moves the gripper straight to a pose [7] as far as the way is free, then opens or closes it.

        A way that leads into the table or out of reach is gone as far as it is free; the arm may touch everything else.

        Raises:
            ArgumentError: not finite, another shape, or a gripper outside [0, 1]; nothing has moved then.
        """
        wanted = np.asarray(pose, np.float64)
        if wanted.shape != (7,) or not np.isfinite(wanted).all() or not 0 <= wanted[6] <= 1:
            raise ArgumentError(f"go: expected a finite pose [7] with a gripper from 0 to 1, got {wanted.tolist()}")
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
        self._note_pushes()
        return Move(path.free, path.reason)

    def film(self, pose: ArrayLike) -> tuple[Move, Film]:
        """`go`, and what it looked like on the way.

        Raises:
            ArgumentError: as `go`.
        """
        start = self.fork()
        self._world.record()
        try:
            move = self.go(pose)
        finally:
            states = self._world.recorded()
        return move, Film(start, states)

    # -- things --------------------------------------------------------------------------------------------------------

    def place_of(self, name: str) -> Pose:
        """Where a thing is, [4, 4]; a mechanism's base."""
        if name in self._marks:
            return self._marks[name]
        if name in self._bodies:
            return self._world.body_poses()[self._bodies[name]]
        return self._world.link_poses(self._mechanisms[name])[0]

    def places(self, names: Sequence[str]) -> dict[str, Pose]:
        """Where things are, by name."""
        return {name: self.place_of(name) for name in names}

    def joints_of(self, name: str) -> NDArray[np.float64]:
        """float64 [dof]: joint positions of a mechanism."""
        return self._world.joint_positions(self._mechanisms[name])

    @property
    def pressed(self) -> tuple[str, ...]:
        """Buttons in the order in which they were pushed: those whose plate was down when a way ended.

        The same one twice in a row counts once.
        """
        return self._pressed

    def set_spring(self, name: str, force: float) -> None:
        """Lets the joints of a mechanism go back to zero with at most so many newtons (or newton metres)."""
        count = len(self.joints_of(name))
        self._world.set_joint_targets(np.zeros(count), self._mechanisms[name])
        self._world.set_joint_forces(np.full(count, force), self._mechanisms[name])

    def settle(self, steps: int = 240) -> None:
        """Lets things come to rest."""
        self._world.step(steps)

    def _note_pushes(self) -> None:
        for name in self._buttons:
            if self.joints_of(name)[0] < -PUSHED and self._pressed[-1:] != (name,):
                self._pressed = (*self._pressed, name)

    # -- pictures ------------------------------------------------------------------------------------------------------

    def picture(
        self,
        camera: str = "front",
        size: tuple[int, int] = (480, 480),
        outputs: Sequence[Output] = ("color",),
        arm: bool = True,
    ) -> dict[str, NDArray[Any]]:
        """What a camera sees: "color" uint8 [H, W, 3], "depth" float32 [H, W] planar metres, "instance" uint32 [H, W].

        Args:
            camera: one of `CAMERAS`.
            size: (height, width) in pixels.
            outputs: any of the three.
            arm: whether the arm is there to be seen.

        Raises:
            ArgumentError: no such camera.
        """
        found = self._pictures.taken(self, self.camera_pose(camera), CAMERAS[camera].hfov_deg, size, outputs, arm)
        return {name: image[0] for name, image in found.items()}

    def camera_pose(self, camera: str) -> Pose:
        """Where a camera is now, [4, 4]: it looks along -z with +y up.

        Raises:
            ArgumentError: no such camera.
        """
        if camera not in CAMERAS:
            raise ArgumentError(f"picture: expected a camera among {', '.join(CAMERAS)}, got {camera!r}")
        found = CAMERAS[camera]
        return self.hand @ found.pose if found.on_hand else found.pose

    @property
    def names(self) -> tuple[str, ...]:
        """What the ids in pictures stand for, from 1: things, "arm", and what the room has ("table", "floor", "wall").

        One that is made of several parts has several ids.
        """
        return self._pictures.names

    def fronts_after(self, poses: ArrayLike, size: tuple[int, int]) -> NDArray[np.uint8]:
        """uint8 [K, H, W, 3]: the front camera's view after each of the poses [K, 7], gone to one after another."""
        views = []
        for pose in np.asarray(poses, np.float64):
            self.go(pose)
            views.append(self.picture("front", size)["color"])
        return np.stack(views)

    def poses_of_parts(self) -> list[Pose]:
        """T_world of all that is drawn and may move: things by their order, then the arm's links."""
        bodies, arm = self._world.body_poses(), self._world.link_poses(self._arm)
        found: list[Pose] = []
        for name, thing in self.things.items():
            if thing.mechanism is None:
                found.append(bodies[self._bodies[name]] if thing.touched else self._marks[name])
            else:
                links = self._world.link_poses(self._mechanisms[name])
                found += [links[link] for link, _ in looks_of(thing.mechanism)]
            if thing.lamp is not None:
                lit = self._lamp_of(name)
                found += [self.place_of(name) if number == lit else OFF for number in range(len(LAMPS))]
        return found + [arm[link] for link, _ in self.robot.looks]

    def _lamp_of(self, name: str) -> int | None:
        """Which of its lamps is on: that of its latest push."""
        pushes = [number for number, other in enumerate(self._pressed) if other == name]
        return min(pushes[-1], len(LAMPS) - 1) if pushes else None

    @property
    def hand(self) -> Pose:
        """[4, 4]: where the arm's hand is."""
        return self._world.link_poses(self._arm)[self.robot.description.link_index(self.robot.hand)]


class _Pictures:
    """The scene of a workbench and its renderer, which all its forks draw with; made when first a picture is taken."""

    def __init__(self, bench: Workbench, backend: Literal["auto", "cpu", "gpu"]) -> None:
        self._things, self._robot, self._start = bench.things, bench.robot, bench.poses_of_parts()
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
            add(mesh_of(shape), colour, pose, name)
        poses = iter(self._start)
        for thing in self._things.values():
            if thing.mechanism is None:
                whole = joined([(mesh_of(shape), pose) for shape, pose in thing.parts])
                add(whole, thing.colour, next(poses), thing.name)
            else:
                for _, mesh in looks_of(thing.mechanism):
                    add(mesh, _PAINTED, next(poses), thing.name)
            if thing.lamp is not None:
                for colour in LAMPS.values():
                    add(mesh_of(thing.lamp), colour, next(poses), thing.name)
        for _, mesh in self._robot.looks:
            add(mesh, _PAINTED, next(poses), "arm")
        scene = Scene.from_arrays(meshes, name="workbench", materials=materials, sun=SUN)
        return Renderer(scene, self._backend, samples=4)

    @property
    def names(self) -> tuple[str, ...]:
        """Of what is drawn, in the order of ids from 1."""
        return tuple(each["name"] for each in self._renderer.scene.instances)

    def taken(
        self,
        bench: Workbench,
        camera: Pose,
        hfov_deg: float,
        size: tuple[int, int],
        outputs: Sequence[Output],
        arm: bool,
    ) -> dict[str, NDArray[Any]]:
        """A batch of one picture of a state."""
        moved = np.stack([Y_UP @ pose for pose in bench.poses_of_parts()])
        if not arm:
            moved[len(moved) - len(self._robot.looks) :, 1, 3] -= FAR_BELOW
        ids = np.arange(self._first, self._first + len(moved), dtype=np.uint32)
        with self._lock:  # forks in other threads draw by the same renderer
            self._renderer.core.set_poses(ids, moved.astype(np.float32))
            return self._renderer.perspective(Y_UP @ camera, size, hfov_deg, outputs=outputs)


_PAINTED: Colour = (1.0, 1.0, 1.0)
"""Of what has its colours in its mesh."""
_LEG = Box((0.05, 0.05, TABLE - TOP[2]))
_ROOM: list[tuple[str, Any, Colour, Pose]] = [
    ("floor", Box((12, 12, 0.02)), (0.5, 0.52, 0.55), place(z=-0.01)),
    ("wall", Box((0.02, 4, 2.6)), (0.9, 0.92, 0.93), place(x=-1.2, z=1.3)),
    ("table", Box(TOP), WOOD, MIDDLE),
    *(
        ("table", _LEG, (0.6, 0.52, 0.43), place(x=x, y=y, z=(TABLE - TOP[2]) / 2))
        for x in (-0.35, 0.65)
        for y in (-0.64, 0.64)
    ),
]
"""What is drawn and never moves."""
