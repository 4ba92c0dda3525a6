# SPDX-License-Identifier: Apache-2.0
"""Paths of a gripper: made dense from the poses that matter, thinned to them again, and as vectors that are diffused.

A path is float64 [L, 7]: x, y, z, roll, pitch, yaw, gripper. A vector is x, y, z in units of `SCALE` from `MIDDLE`,
then the first two columns of the rotation, then the gripper: its rotations have no seam and no gimbal.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from wiw.tabletop.workbench import SHUT, TABLE

MIDDLE = np.array([0.15, 0.0, TABLE + 0.15])
SCALE = 0.25
"""Metres."""
RADIAN = 0.1
"""Metres that a turn by a radian counts as, where a path's shape is measured."""
STILL = 0.015
"""Metres; a way that is shorter leads nowhere."""

Path = NDArray[np.float64]


def dense(start: NDArray[np.float64], poses: Path, length: int) -> Path:
    """The straight ways from a pose [7] to one after another of `poses` [K, 7], at `length` places, as many a way.

    The gripper is as it was until a pose is reached.
    """
    stops = np.concatenate([start[None], poses])
    ends = np.rint(length * np.arange(len(stops)) / len(poses))
    at = np.arange(1, length + 1)
    path = np.empty((length, 7))
    path[:, :3] = np.stack([np.interp(at, ends, stops[:, axis]) for axis in range(3)], axis=1)
    path[:, 3:6] = Slerp(ends, _rotations(stops))(at).as_euler("xyz")
    path[:, 6] = np.where(stops[:, 6] < SHUT, 0.0, 1.0)[np.searchsorted(ends, at, side="right") - 1]
    return path


def moving(start: NDArray[np.float64], poses: Path) -> Path:
    """Those of `poses` [K, 7] that are no repetition of the one before, at least one."""
    stops = np.concatenate([start[None], poses])
    rotations = _rotations(stops)
    turns = RADIAN * (rotations[1:] * rotations[:-1].inv()).magnitude()
    moves = np.linalg.norm(np.diff(stops[:, :3], axis=0), axis=1) + turns > STILL
    grips = np.diff(stops[:, 6] < SHUT)
    return poses[moves | grips] if (moves | grips).any() else poses[:1]


def thinned(start: NDArray[np.float64], path: Path, most: int) -> Path:
    """So many poses of a path [L, 7] that lead along it, or all of them where there are fewer.

    These are its last, those where the gripper opens or shuts, then one by one those where the straight ways between
    them leave the path furthest.
    """
    if len(path) <= most:
        return path
    stops = np.concatenate([start[None], path])
    shut = stops[:, 6] < SHUT
    kept = [0, len(path)]
    for change in 1 + np.flatnonzero(shut[1:] != shut[:-1]):
        if len(kept) <= most and change not in kept:
            kept.append(int(change))
    while len(kept) <= most:
        kept.append(int(np.argmax(_off(stops, sorted(kept)))))
    return stops[sorted(kept)[1:]]


def _off(stops: Path, kept: list[int]) -> NDArray[np.float64]:
    """[L + 1]: metres that each pose is off the straight ways between those kept; -1 of these."""
    places, rotations, off = stops[:, :3], _rotations(stops), np.full(len(stops), -1.0)
    for first, last in pairwise(kept):
        between = np.arange(first + 1, last)
        way = places[last] - places[first]
        along = ((places[between] - places[first]) @ way / max(float(way @ way), 1e-12)).clip(0, 1)
        turn = (rotations[last] * rotations[first].inv()).as_rotvec()
        missing = Rotation.from_rotvec(along[:, None] * turn) * rotations[first] * rotations[between].inv()
        aside = places[between] - places[first] - along[:, None] * way
        off[between] = np.linalg.norm(aside, axis=1) + RADIAN * missing.magnitude()
    return off


def to_vectors(poses: Path) -> NDArray[np.float32]:
    """float32 [..., 10] of poses [..., 7]."""
    flat = poses.reshape(-1, 7)
    columns = _rotations(flat).as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(-1, 6)
    vectors = np.concatenate([(flat[:, :3] - MIDDLE) / SCALE, columns, flat[:, 6:]], axis=1)
    return vectors.reshape(*poses.shape[:-1], 10).astype(np.float32)


def to_poses(vectors: NDArray[np.float32]) -> Path:
    """The other way round; columns that are not quite a rotation's are made so, the gripper is opened or shut."""
    flat = vectors.reshape(-1, 10).astype(np.float64)
    first = flat[:, 3:6] / np.linalg.norm(flat[:, 3:6], axis=1, keepdims=True)
    second = flat[:, 6:9] - (first * flat[:, 6:9]).sum(axis=1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    angles = Rotation.from_matrix(np.stack([first, second, np.cross(first, second)], axis=2)).as_euler("xyz")
    gripper = np.where(flat[:, 9:] < SHUT, 0.0, 1.0)
    return np.concatenate([MIDDLE + SCALE * flat[:, :3], angles, gripper], axis=1).reshape(*vectors.shape[:-1], 7)


def _rotations(poses: Path) -> Rotation:
    return Rotation.from_euler("xyz", poses[:, 3:6])
