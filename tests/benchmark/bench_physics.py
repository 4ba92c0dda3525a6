# SPDX-License-Identifier: Apache-2.0
"""Simulation and inverse kinematics of the Panda beside pybullet and MuJoCo.

**Simulation**: the arm follows targets that swing by 0.1 rad, new ones ten times a second, over a table with ten cubes
of 4 cm at rest; one second of 240 steps a repeat. All load the same URDF (links without mass get a milligram for the
peers, which would otherwise refuse them or weigh a kilogram). pybullet: 50 solver iterations and its own residual
threshold (1e-7), which are ours too, position control with its default gains, no sleeping; with and without fixed links
merged, as ours are. Both take steps of 1/240 s; arm, table and cubes all meet each other, links of the arm do not. Our
broadphase compares all pairs of boxes, pybullet's keeps trees. MuJoCo: Newton solver with its defaults, implicitfast,
position actuators; links of the arm do not meet each other. A contact model of another kind, so only an orientation.

**Inverse kinematics**: position and rotation of the hand to 0.1 mm and 1 mrad, from the ready pose to random reachable
poses, and to poses near by, as along a path. pybullet: residual threshold 1e-4, at most 100 iterations and 20 restarts
from random positions, judged by our forward kinematics; Python's calls are part of both.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from harness import measure, optional, report

import wiw
from wiw.physics import PANDA_READY, PANDA_TCP, Box, InverseKinematics, World, panda, place

STEPS, EVERY = 240, 24
CUBES = [(0.45 + 0.06 * (i % 4), -0.2 + 0.08 * (i // 4), 0.02) for i in range(10)]
URDF = Path(wiw.__file__).parent / "configs/robots/panda.urdf"
LIMITS = panda().limits
TCP = panda().link_index(PANDA_TCP)
POSES = 100
RESTARTS = 20


def target(second: float) -> np.ndarray:
    swing = 0.1 * np.sin(2 * np.pi * (0.5 * second + np.arange(9) / 7))
    return PANDA_READY + np.where(np.arange(9) < 7, swing, -0.01)


def peers_urdf() -> str:
    """With a milligram in links that have none."""
    mass = (
        '<inertial><mass value="1e-6"/><inertia ixx="1e-9" ixy="0" ixz="0" iyy="1e-9" iyz="0" izz="1e-9"/></inertial>'
    )
    text = URDF.read_text()
    for link in ("panda_link8", PANDA_TCP):
        text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{mass}</link>')
    return text


def ours() -> Callable[[], Any]:
    world = World()
    world.add_body(Box([1.5, 1.5, 0.1]), T_world_body=place(z=-0.05), friction=0.8)
    world.add_articulation(panda())
    world.set_joint_positions(PANDA_READY)
    for at in CUBES:
        world.add_body(Box([0.04] * 3), mass=0.1, T_world_body=place(*at), friction=0.8)

    def second() -> None:
        for _ in range(STEPS // EVERY):
            world.set_joint_targets(target(world.time))
            world.step(EVERY)

    return second


class PyBullet:
    """One client with the Panda; by movable joints."""

    def __init__(self, module: Any, merged: bool) -> None:
        self.bullet = module
        self.client = module.connect(module.DIRECT)
        with tempfile.NamedTemporaryFile("w", suffix=".urdf", delete=False) as file:
            file.write(peers_urdf())
        flags = module.URDF_USE_INERTIA_FROM_FILE | (module.URDF_MERGE_FIXED_LINKS if merged else 0)
        self.robot = self.call("loadURDF", file.name, useFixedBase=True, flags=flags)
        Path(file.name).unlink()
        info = [self.call("getJointInfo", self.robot, i) for i in range(self.call("getNumJoints", self.robot))]
        self.joints = [joint[0] for joint in info if joint[2] != module.JOINT_FIXED]
        self.names = [joint[1].decode() for joint in info if joint[2] != module.JOINT_FIXED]
        self.tcp = next((joint[0] for joint in info if joint[12].decode() == PANDA_TCP), None)
        self.order = [panda().joints.index(name) for name in self.names]
        self.put(PANDA_READY)

    def call(self, name: str, *args: Any, **options: Any) -> Any:
        return getattr(self.bullet, name)(*args, physicsClientId=self.client, **options)

    def put(self, positions: np.ndarray) -> None:
        for joint, i in zip(self.joints, self.order, strict=True):
            self.bullet.resetJointState(self.robot, joint, positions[i], physicsClientId=self.client)

    def simulation(self) -> Callable[[], Any]:
        self.call("setGravity", 0, 0, -9.81)
        self.call("setPhysicsEngineParameter", numSolverIterations=50, fixedTimeStep=1 / 240)
        table = self.call("createCollisionShape", self.bullet.GEOM_BOX, halfExtents=[0.75, 0.75, 0.05])
        cube = self.call("createCollisionShape", self.bullet.GEOM_BOX, halfExtents=[0.02] * 3)
        bodies = [self.call("createMultiBody", 0, table, basePosition=[0, 0, -0.05])]
        bodies += [self.call("createMultiBody", 0.1, cube, basePosition=at) for at in CUBES]
        for body in bodies:
            self.call("changeDynamics", body, -1, lateralFriction=0.8)
        forces = LIMITS["effort"][self.order]
        step, time = self.bullet.stepSimulation, 0.0

        def second() -> None:
            nonlocal time
            for _ in range(STEPS // EVERY):
                self.bullet.setJointMotorControlArray(
                    self.robot,
                    self.joints,
                    self.bullet.POSITION_CONTROL,
                    targetPositions=target(time)[self.order],
                    forces=forces,
                    physicsClientId=self.client,
                )
                for _ in range(EVERY):
                    step(physicsClientId=self.client)
                time += EVERY / STEPS

        return second

    def solve(self, pose: np.ndarray, rng: np.random.Generator, start: np.ndarray) -> bool:
        quaternion = self.call("getQuaternionFromEuler", euler(pose))
        self.put(start)
        for _ in range(RESTARTS + 1):
            found = self.bullet.calculateInverseKinematics(
                self.robot,
                self.tcp,
                pose[:3, 3],
                quaternion,
                maxNumIterations=100,
                residualThreshold=1e-4,
                physicsClientId=self.client,
            )
            q = np.empty(9)
            q[self.order] = found
            if within(q) and reached(pose, panda().forward_kinematics(q)[TCP]):
                return True
            self.put(rng.uniform(LIMITS["lower"], LIMITS["upper"]))
        return False


def mujoco_simulation(mujoco: Any) -> Callable[[], Any]:
    spec = mujoco.MjSpec.from_string(peers_urdf())
    spec.option.timestep = 1 / 240
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = 2, 1
    for joint, gain, force in zip(panda().joints, [2000.0] * 7 + [500.0] * 2, LIMITS["effort"], strict=True):
        actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=gain, kv=gain / 10)
        actuator.forcerange = [-force, force]
        actuator.forcelimited = True
    floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.75, 0.75, 0.05], pos=[0, 0, -0.05])
    geoms = [floor]
    for at in CUBES:
        body = spec.worldbody.add_body(pos=at)
        body.add_freejoint()
        geoms.append(body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02] * 3, mass=0.1))
    for geom in geoms:
        geom.contype, geom.conaffinity, geom.friction = 1, 3, [0.8, 0.005, 0.0001]
    model = spec.compile()
    data = mujoco.MjData(model)
    for i, joint in enumerate(panda().joints):
        data.joint(joint).qpos = PANDA_READY[i]

    def second() -> None:
        for _ in range(STEPS // EVERY):
            data.ctrl[:] = target(data.time)
            mujoco.mj_step(model, data, EVERY)

    return second


def euler(pose: np.ndarray) -> list[float]:
    r = pose[:3, :3]
    return [np.arctan2(r[2, 1], r[2, 2]), -np.arcsin(np.clip(r[2, 0], -1, 1)), np.arctan2(r[1, 0], r[0, 0])]


def within(q: np.ndarray) -> bool:
    return bool((q[:7] >= LIMITS["lower"][:7]).all() and (q[:7] <= LIMITS["upper"][:7]).all())


def reached(a: np.ndarray, b: np.ndarray) -> bool:
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < 1e-4 and np.arccos(np.clip(cosine, -1, 1)) < 1e-3)


def simulation() -> None:
    bullet, mujoco = optional("pybullet"), optional("mujoco")
    cases = {
        "wiw": ours(),
        "pybullet, fixed links merged": bullet and PyBullet(bullet, merged=True).simulation(),
        "pybullet": bullet and PyBullet(bullet, merged=False).simulation(),
        "mujoco (Newton)": mujoco and mujoco_simulation(mujoco),
    }
    report("Panda and ten cubes, 240 steps", cases, measure(cases), "wiw", "pybullet >= 1.0 x ours")


def kinematics(title: str, poses: list[np.ndarray]) -> None:
    bullet = optional("pybullet")
    peer = bullet and PyBullet(bullet, merged=False)
    solver, rng = InverseKinematics(panda(), PANDA_TCP), np.random.default_rng(0)
    solved = dict.fromkeys(("wiw", "pybullet"), 0.0)

    def wiw_solves() -> None:
        solved["wiw"] = np.mean([solver(pose, PANDA_READY, restarts=RESTARTS).reached for pose in poses])

    def pybullet_solves() -> None:
        solved["pybullet"] = np.mean([peer.solve(pose, rng, PANDA_READY) for pose in poses])

    cases = {"wiw": wiw_solves, "pybullet": pybullet_solves if peer else None}
    report(f"{POSES} solves, {title}", cases, measure(cases, repeats=9, warmup=1), "wiw", "pybullet >= 5 x ours")
    print("  solved: " + ", ".join(f"{name} {share:.0%}" for name, share in solved.items() if cases[name]))


def main() -> None:
    simulation()
    rng = np.random.default_rng(1)
    anywhere = [rng.uniform(LIMITS["lower"], LIMITS["upper"]) for _ in range(POSES)]
    near = [PANDA_READY + np.r_[rng.normal(scale=0.05, size=7), 0, 0] for _ in range(POSES)]
    for title, positions in (("random poses", anywhere), ("poses near the start", near)):
        kinematics(title, [panda().forward_kinematics(q)[TCP] for q in positions])


if __name__ == "__main__":
    main()
