# SPDX-License-Identifier: Apache-2.0
"""Training data of armnet: recorded play at tables, most of it with mistakes.

A play is one task's table with nine views and eight gripper poses between them. Its plan is an expert's, for the
requested target or another, and mostly corrupted: all of it shifted, every pose slightly off, poses left out, the
gripper inverted, poses replaced by random ones. A model that saw only experts would imagine success after every plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.demonstrations import Demonstration, Demonstrations
from wiw.tabletop.base import DOWN, TableSetup, TabletopTask
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import LAMPS, TABLE, Workbench
from wiw.training.gather import Arrays, Job, ProgressBar, gather_arrays
from wiw.world_models.armnet.body import render_arm
from wiw.world_models.armnet.network import FRONT, WINDOW

POSES = 8
"""Poses in a play."""
MAX_SKIPPED = 5
"""Most poses executed before the first view."""
PLAYS_PER_FILE = 25
"""Plays in a cache file."""
EVENTS = ("still", "lit first", "lit second", "lit third", "carried", "placed", "pushed")
"""Events of a thing at a pose: nothing; it is a button whose lamp changes to the colour of the first, second,
or third and later push; it is in the gripper and moves; it was in the gripper, which lets go of it; it moves otherwise.
"""
MAX_THINGS = 5
"""Most things on a table."""
MOVED, TURNED = 0.005, 0.1
"""Metres, or radians, from which on a thing has moved."""


@dataclass(frozen=True)
class Plays:
    """N plays, in the network's window of the front view."""

    views: NDArray[np.uint8]
    """[N, 9, h, w, 3]: the front view."""
    bare: NDArray[np.uint8]
    """[N, 9, h, w, 3]: the arm over the bare table."""
    arm: NDArray[np.bool_]
    """[N, 9, h, w]: the pixels that the arm covers."""
    poses: NDArray[np.float64]
    """[N, 9, 7]: the poses that the gripper reached."""
    things: NDArray[np.uint8]
    """[N, 9, h, w]: the thing that each pixel shows, from 1; 0: none, or not recorded. For evaluation only."""
    events: NDArray[np.uint8]
    """[N, 8, 5]: what became of each thing at each pose, as its place in `EVENTS`. For evaluation only."""

    def __len__(self) -> int:
        return len(self.views)


FILE_FIELDS = ("seen", "bare", "arm", "poses", "things", "events")
"""Names of the arrays of `Plays` in cache files, in the order of its fields."""


def merge_plays(parts: Sequence[Plays]) -> Plays:
    """Concatenate plays."""
    return Plays(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Plays)))


def gather_plays(count: int, seed: int, folder: Path, workers: int, bar: ProgressBar) -> Plays:
    """Load `count` plays; record those that `folder` lacks in `workers` processes.

    Raises:
        FileError: the folder cannot be written.
    """
    job = Job(f"{count} plays", FILE_FIELDS, partial(_build_chunk, seed=seed), ("plays", 2, seed))
    chunks = {str(number): f"plays {number}" for number in range(-(-count // PLAYS_PER_FILE))}
    found = gather_arrays(chunks, job, folder, workers, bar)
    return Plays(*(np.concatenate([part[name] for part in found])[:count] for name in FILE_FIELDS))


def _build_chunk(name: str, seed: int) -> Arrays:
    plays = record_plays(seed, PLAYS_PER_FILE * int(name), PLAYS_PER_FILE)
    return dict(zip(FILE_FIELDS, (getattr(plays, each.name) for each in fields(Plays)), strict=True))


def record_plays(seed: int, first: int, count: int) -> Plays:
    """Record plays number `first` and following; each is a pure function of the seed and its number."""
    numbers = range(first, first + count)
    return merge_plays([_record_play(np.random.default_rng(core.fold_key([seed, 0xA12E, n])), n) for n in numbers])


def read_demonstration_plays(folder: Path) -> Plays:
    """Convert a collection of `wiw collect` to plays, with views at the end of each action.

    A demonstration that ends early repeats its last view.

    Raises:
        DependencyError: pyarrow is not installed.
        FileError: there is no such collection, or it is damaged.
    """
    return merge_plays([play for each in Demonstrations(folder) for play in _split_demonstration(each)])


def _split_demonstration(demonstration: Demonstration) -> list[Plays]:
    ends = np.flatnonzero(demonstration.ended)
    frames = [0, *ends.tolist()]
    commanded = np.concatenate([demonstration.poses[:1], demonstration.actions[ends]])
    parts = []
    for first in range(0, len(ends), POSES):
        which = np.minimum(np.arange(first, first + POSES + 1), len(ends))
        images = [demonstration.images[frames[at]] for at in which]
        views = [cv2.resize(image, FRONT[::-1], interpolation=cv2.INTER_AREA)[WINDOW] for image in images]
        parts.append(_build_play(np.stack(views), commanded[which]))
    return parts


def _record_play(rng: np.random.Generator, number: int) -> Plays:
    task = list(TABLETOP_TASKS.values())[number % len(TABLETOP_TASKS)]
    setup = task.create_setup(int(rng.integers(2**31)), int(rng.integers(task.variations)))
    bench, plan = setup.build_workbench(), list[NDArray[np.float64]]()

    def execute_next() -> NDArray[np.float64]:
        while not plan:
            plan.extend(corrupt_plan(_plan_as_expert(task, setup, bench, rng), rng))
        pose = plan.pop(0)
        bench.move_to(pose)
        return pose

    for _ in range(int(rng.integers(MAX_SKIPPED + 1))):
        execute_next()
    commanded, frames = [bench.pose], [_render_window(bench)]
    events = np.zeros((POSES, MAX_THINGS), np.uint8)
    for at in range(POSES):
        before = bench.fork()
        commanded.append(execute_next())
        frames.append(_render_window(bench))
        events[at, : len(bench.things)] = find_events(before, bench)
    views, things = (np.stack(part) for part in zip(*frames, strict=True))
    return _build_play(views, np.stack(commanded), things, events)


def find_events(before: Workbench, after: Workbench) -> list[int]:
    """Return what has become of each thing between two states of a workbench, as its place in `EVENTS`."""
    found = []
    for name in after.things:
        moved = np.linalg.inv(before.get_pose(name)) @ after.get_pose(name)
        far = np.linalg.norm(moved[:3, 3]) > MOVED or np.arccos(np.clip((np.trace(moved) - 2) / 2, -1, 1)) > TURNED
        lamp = _find_lamp(after, name)
        if lamp != _find_lamp(before, name):
            event = EVENTS[lamp]
        elif name == before.held_object:
            event = "placed" if after.held_object is None else "carried" if far else "still"
        else:
            event = "pushed" if far else "still"
        found.append(EVENTS.index(event))
    return found


def _find_lamp(bench: Workbench, name: str) -> int:
    """Return which lamp of a button is on, from 1, or 0: that of its latest push."""
    return min(max((n for n, pushed in enumerate(bench.pressed_buttons, 1) if pushed == name), default=0), len(LAMPS))


def _build_play(
    views: NDArray[np.uint8],
    commanded: NDArray[np.float64],
    things: NDArray[np.uint8] | None = None,
    events: NDArray[np.uint8] | None = None,
) -> Plays:
    """Return one play, with renderings of the arm alone at the same poses."""
    arms = list(render_arm(commanded, FRONT))
    return Plays(
        views[None],
        np.stack([arm.color[WINDOW] for arm in arms])[None],
        np.stack([arm.arm[WINDOW] for arm in arms])[None],
        np.stack([arm.pose for arm in arms])[None],
        (np.zeros(views.shape[:-1], np.uint8) if things is None else things)[None],
        (np.zeros((len(views) - 1, MAX_THINGS), np.uint8) if events is None else events)[None],
    )


def _render_window(bench: Workbench) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the view in the network's window, and the thing, from 1, that each of its pixels shows."""
    seen = bench.render_view("front", FRONT, ("color", "instance"))
    numbers = {name: number for number, name in enumerate(bench.things, 1)}
    of_instance = np.array([0, *(numbers.get(name, 0) for name in bench.instance_names)], np.uint8)
    return seen["color"][WINDOW], of_instance[seen["instance"][WINDOW]]


def _plan_as_expert(
    task: TabletopTask, setup: TableSetup, bench: Workbench, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return an expert's plan from the present state, for the requested target or, as often, for another."""
    others = task.list_alternatives(setup.objects, setup.target)
    target = others[rng.integers(len(others))] if rng.random() < 0.5 else setup.target
    return task.plan_expert(bench.get_poses(setup.objects), target, bench.pose)


def corrupt_plan(plan: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Corrupt a plan [K, 7] in one of six ways, or, three times in ten, return it unchanged."""
    plan = plan.copy()
    way = rng.choice(7, p=(0.3, 0.15, 0.2, 0.1, 0.08, 0.07, 0.1))
    if way == 1:
        plan[:, :2] += rng.normal(0, 0.025, 2)
    elif way == 2:
        plan[:, :3] += rng.normal(0, 0.012, plan[:, :3].shape)
        plan[:, 5] += rng.normal(0, 0.15, len(plan))
    elif way == 3:
        plan = np.delete(plan, rng.integers(len(plan), size=1), axis=0)
    elif way == 4:
        wrong = rng.random(len(plan)) < 0.3
        plan[wrong, 6] = 1 - plan[wrong, 6]
    elif way == 5:
        plan = rng.permutation(plan)
    elif way == 6:
        plan[rng.random(len(plan)) < 0.5] = _sample_pose(rng)
    plan[:, 2] = np.maximum(plan[:, 2], TABLE + 0.002)
    return plan


def _sample_pose(rng: np.random.Generator) -> NDArray[np.float64]:
    """Sample a pose within reach, with the hand pointing down."""
    x, y, height = rng.uniform((0.0, -0.28, 0.01), (0.34, 0.28, 0.3))
    return np.array([x, y, TABLE + height, DOWN[0], DOWN[1], rng.uniform(-0.5, 0.5), float(rng.integers(2))])
