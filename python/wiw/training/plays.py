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
from wiw.tabletop.workbench import TABLE, Workbench
from wiw.training.gather import Arrays, Job, ProgressBar, gather_arrays
from wiw.world_models.armnet.body import render_arm
from wiw.world_models.armnet.network import FRONT, WINDOW

POSES = 8
"""Poses in a play."""
MAX_SKIPPED = 5
"""Most poses executed before the first view."""
PLAYS_PER_FILE = 25
"""Plays in a cache file."""


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

    def __len__(self) -> int:
        return len(self.views)


FILE_FIELDS = ("seen", "bare", "arm", "poses")
"""Names of the arrays of `Plays` in cache files, in the order of its fields."""


def merge_plays(parts: Sequence[Plays]) -> Plays:
    """Concatenate plays."""
    return Plays(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Plays)))


def gather_plays(count: int, seed: int, folder: Path, workers: int, bar: ProgressBar) -> Plays:
    """Load `count` plays; record those that `folder` lacks in `workers` processes.

    Raises:
        FileError: the folder cannot be written.
    """
    job = Job(f"{count} plays", FILE_FIELDS, partial(_build_chunk, seed=seed), ("plays", 1, seed))
    chunks = {str(number): f"plays {number}" for number in range(-(-count // PLAYS_PER_FILE))}
    found = gather_arrays(chunks, job, folder, workers, bar)
    return Plays(*(np.concatenate([part[name] for part in found])[:count] for name in FILE_FIELDS))


def _build_chunk(name: str, seed: int) -> Arrays:
    plays = record_plays(seed, PLAYS_PER_FILE * int(name), PLAYS_PER_FILE)
    return dict(zip(FILE_FIELDS, (plays.views, plays.bare, plays.arm, plays.poses), strict=True))


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
    commanded, views = [bench.pose], [_render_window(bench)]
    for _ in range(POSES):
        commanded.append(execute_next())
        views.append(_render_window(bench))
    return _build_play(np.stack(views), np.stack(commanded))


def _build_play(views: NDArray[np.uint8], commanded: NDArray[np.float64]) -> Plays:
    """Return one play, with renderings of the arm alone at the same poses."""
    arms = list(render_arm(commanded, FRONT))
    return Plays(
        views[None],
        np.stack([arm.color[WINDOW] for arm in arms])[None],
        np.stack([arm.arm[WINDOW] for arm in arms])[None],
        np.stack([arm.pose for arm in arms])[None],
    )


def _render_window(bench: Workbench) -> NDArray[np.uint8]:
    view: NDArray[np.uint8] = bench.render_view("front", FRONT)["color"][WINDOW]
    return view


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
