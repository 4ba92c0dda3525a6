# SPDX-License-Identifier: Apache-2.0
"""What armnet learns from: plays at tables, most of which go wrong in one way or another.

A play is a table of one of the tasks and nine views with eight gripper poses between them. Plans are those of experts,
for the target that is asked for or another, and most are spoilt: all of it shifted, every pose a little off, poses left
out, the gripper shut where it should open, poses anywhere. Who saw experts alone would imagine success of every plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.demonstrations import Demonstration, Demonstrations
from wiw.tabletop.kind import DOWN, Kind, Setup
from wiw.tabletop.kinds import KINDS
from wiw.tabletop.workbench import TABLE, Workbench
from wiw.training.gather import Arrays, Bar, Job, gather
from wiw.world_models.armnet.body import sights
from wiw.world_models.armnet.network import FRONT, WINDOW

POSES = 8
"""Gone to in a play."""
SKIPPED = 5
"""At most, before its first view."""
CHUNK = 25
"""Plays a file."""


@dataclass(frozen=True)
class Plays:
    """N plays, in the network's window of the front view."""

    seen: NDArray[np.uint8]
    """[N, 9, h, w, 3]: the front view."""
    bare: NDArray[np.uint8]
    """[N, 9, h, w, 3]: the arm over the bare table."""
    arm: NDArray[np.bool_]
    """[N, 9, h, w]: where it hides the table."""
    poses: NDArray[np.float64]
    """[N, 9, 7]: where the gripper has come to."""

    def __len__(self) -> int:
        return len(self.seen)


FIELDS = ("seen", "bare", "arm", "poses")


def merged(parts: Sequence[Plays]) -> Plays:
    """All in one."""
    return Plays(*(np.concatenate([getattr(part, name) for part in parts]) for name in FIELDS))


def gathered_plays(count: int, seed: int, folder: Path, workers: int, bar: Bar) -> Plays:
    """So many plays; those that `folder` does not hold are made by `workers` processes.

    Raises:
        FileError: the folder cannot be written.
    """
    job = Job(f"{count} plays", FIELDS, partial(_chunk, seed=seed), ("plays", 1, seed))
    chunks = {str(number): f"plays {number}" for number in range(-(-count // CHUNK))}
    found = gather(chunks, job, folder, workers, bar)
    return Plays(*(np.concatenate([part[name] for part in found])[:count] for name in FIELDS))


def _chunk(name: str, seed: int) -> Arrays:
    plays = played(seed, CHUNK * int(name), CHUNK)
    return {field: getattr(plays, field) for field in FIELDS}


def played(seed: int, first: int, count: int) -> Plays:
    """Plays number `first` and on; each is a function of the seed and its number."""
    numbers = range(first, first + count)
    return merged([_play(np.random.default_rng(core.fold_key([seed, 0xA12E, n])), n) for n in numbers])


def demonstrated(folder: Path) -> Plays:
    """What `wiw collect` has written, as plays: views as actions end. Who has come to the end stays there.

    Raises:
        DependencyError: pyarrow is not installed.
        FileError: there is no such collection, or it is damaged.
    """
    return merged([play for each in Demonstrations(folder) for play in _parts(each)])


def _parts(demonstration: Demonstration) -> list[Plays]:
    ends = np.flatnonzero(demonstration.ended)
    frames = [0, *ends.tolist()]
    told = np.concatenate([demonstration.poses[:1], demonstration.actions[ends]])
    parts = []
    for first in range(0, len(ends), POSES):
        which = np.minimum(np.arange(first, first + POSES + 1), len(ends))
        views = [demonstration.images[frames[at]] for at in which]
        seen = [cv2.resize(view, FRONT[::-1], interpolation=cv2.INTER_AREA)[WINDOW] for view in views]
        parts.append(_plays(np.stack(seen), told[which]))
    return parts


def _play(rng: np.random.Generator, number: int) -> Plays:
    kind = list(KINDS.values())[number % len(KINDS)]
    setup = kind.setup(int(rng.integers(2**31)), int(rng.integers(kind.variations)))
    bench, plan = setup.bench(), list[NDArray[np.float64]]()

    def going() -> NDArray[np.float64]:
        while not plan:
            plan.extend(spoilt(_expert(kind, setup, bench, rng), rng))
        pose = plan.pop(0)
        bench.go(pose)
        return pose

    for _ in range(int(rng.integers(SKIPPED + 1))):
        going()
    told, seen = [bench.pose], [_view(bench)]
    for _ in range(POSES):
        told.append(going())
        seen.append(_view(bench))
    return _plays(np.stack(seen), np.stack(told))


def _plays(seen: NDArray[np.uint8], told: NDArray[np.float64]) -> Plays:
    """One play, with the arm alone at the same poses."""
    arms = list(sights(told, FRONT))
    return Plays(
        seen[None],
        np.stack([arm.color[WINDOW] for arm in arms])[None],
        np.stack([arm.arm[WINDOW] for arm in arms])[None],
        np.stack([arm.pose for arm in arms])[None],
    )


def _view(bench: Workbench) -> NDArray[np.uint8]:
    view: NDArray[np.uint8] = bench.picture("front", FRONT)["color"][WINDOW]
    return view


def _expert(kind: Kind, setup: Setup, bench: Workbench, rng: np.random.Generator) -> NDArray[np.float64]:
    """What an expert would do now, for the target that is asked for or, as often, another."""
    others = kind.alternatives(setup.objects, setup.target)
    target = others[rng.integers(len(others))] if rng.random() < 0.5 else setup.target
    return kind.expert(bench.places(setup.objects), target, bench.pose)


def spoilt(plan: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """A plan [K, 7] made wrong in one of six ways, or, three times in ten, left alone."""
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
        plan[rng.random(len(plan)) < 0.5] = _anywhere(rng)
    plan[:, 2] = np.maximum(plan[:, 2], TABLE + 0.002)
    return plan


def _anywhere(rng: np.random.Generator) -> NDArray[np.float64]:
    """A pose in reach, with the hand pointing down."""
    x, y, height = rng.uniform((0.0, -0.28, 0.01), (0.34, 0.28, 0.3))
    return np.array([x, y, TABLE + height, DOWN[0], DOWN[1], rng.uniform(-0.5, 0.5), float(rng.integers(2))])
