# SPDX-License-Identifier: Apache-2.0
"""Gripper paths: interpolated between key poses, thinned to key poses again, and as vectors for diffusion.

A path is float64 [L, 7]: x, y, z, roll, pitch, yaw, gripper. A vector is x, y, z in units of `SCALE` from `MIDDLE`,
then the first two columns of the rotation, then the gripper: its rotations have no seam and no gimbal lock.
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
METRES_PER_RADIAN = 0.1
"""Metres that a rotation by one radian counts as, where a path's shape is measured."""
MIN_MOVE = 0.015
"""Metres; a shorter move counts as none."""
DEVIATION_DIGITS = 6
"""Decimals that count of a deviation in metres; what is less is rounding, which depends on machine and batch."""

Path = NDArray[np.float64]


def densify_path(start: NDArray[np.float64], poses: Path, length: int) -> Path:
    """Interpolate linearly from a pose [7] through `poses` [K, 7], at `length` points, equally many per move.

    The gripper changes only when a pose is reached.
    """
    stops = np.concatenate([start[None], poses])
    ends = np.rint(length * np.arange(len(stops)) / len(poses))
    at = np.arange(1, length + 1)
    path = np.empty((length, 7))
    path[:, :3] = np.stack([np.interp(at, ends, stops[:, axis]) for axis in range(3)], axis=1)
    path[:, 3:6] = Slerp(ends, _to_rotations(stops))(at).as_euler("xyz")
    path[:, 6] = np.where(stops[:, 6] < SHUT, 0.0, 1.0)[np.searchsorted(ends, at, side="right") - 1]
    return path


def drop_repeated_poses(start: NDArray[np.float64], poses: Path) -> Path:
    """Drop those of `poses` [K, 7] that repeat the one before; keep at least one."""
    stops = np.concatenate([start[None], poses])
    rotations = _to_rotations(stops)
    turns = METRES_PER_RADIAN * (rotations[1:] * rotations[:-1].inv()).magnitude()
    moves = np.linalg.norm(np.diff(stops[:, :3], axis=0), axis=1) + turns > MIN_MOVE
    grips = np.diff(stops[:, 6] < SHUT)
    return poses[moves | grips] if (moves | grips).any() else poses[:1]


def thin_path(start: NDArray[np.float64], path: Path, most: int) -> Path:
    """Choose `most` poses of a path [L, 7] that keep its shape, or all of them where there are fewer.

    These are its last pose, those where the gripper opens or closes, and then, one by one, those where straight moves
    deviate most from the path. Where none deviate, they are in the middle of the longest moves.
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
        kept.append(_choose_next(stops, sorted(kept)))
    return stops[sorted(kept)[1:]]


def _choose_next(stops: Path, kept: list[int]) -> int:
    """Return the first of the poses that deviate most; the middle of the longest move where none does."""
    deviation = _measure_deviation(stops, kept).round(DEVIATION_DIGITS)
    if deviation.max() > 0:
        return int(deviation.argmax())
    longest = int(np.diff(kept).argmax())
    return (kept[longest] + kept[longest + 1]) // 2


def _measure_deviation(stops: Path, kept: list[int]) -> NDArray[np.float64]:
    """Return the metres by which each pose deviates from straight moves between the kept ones, [L + 1]; -1 for
    these.
    """
    places, rotations, off = stops[:, :3], _to_rotations(stops), np.full(len(stops), -1.0)
    for first, last in pairwise(kept):
        between = np.arange(first + 1, last)
        way = places[last] - places[first]
        along = ((places[between] - places[first]) @ way / max(float(way @ way), 1e-12)).clip(0, 1)
        turn = (rotations[last] * rotations[first].inv()).as_rotvec()
        missing = Rotation.from_rotvec(along[:, None] * turn) * rotations[first] * rotations[between].inv()
        aside = places[between] - places[first] - along[:, None] * way
        off[between] = np.linalg.norm(aside, axis=1) + METRES_PER_RADIAN * missing.magnitude()
    return off


def to_vectors(poses: Path) -> NDArray[np.float32]:
    """Convert poses [..., 7] to vectors float32 [..., 10]."""
    flat = poses.reshape(-1, 7)
    columns = _to_rotations(flat).as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(-1, 6)
    vectors = np.concatenate([(flat[:, :3] - MIDDLE) / SCALE, columns, flat[:, 6:]], axis=1)
    return vectors.reshape(*poses.shape[:-1], 10).astype(np.float32)


def to_poses(vectors: NDArray[np.float32]) -> Path:
    """Convert vectors to poses; orthonormalise the rotations, and open or close the gripper."""
    flat = vectors.reshape(-1, 10).astype(np.float64)
    first = flat[:, 3:6] / np.linalg.norm(flat[:, 3:6], axis=1, keepdims=True)
    second = flat[:, 6:9] - (first * flat[:, 6:9]).sum(axis=1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    angles = Rotation.from_matrix(np.stack([first, second, np.cross(first, second)], axis=2)).as_euler("xyz")
    gripper = np.where(flat[:, 9:] < SHUT, 0.0, 1.0)
    return np.concatenate([MIDDLE + SCALE * flat[:, :3], angles, gripper], axis=1).reshape(*vectors.shape[:-1], 7)


def _to_rotations(poses: Path) -> Rotation:
    return Rotation.from_euler("xyz", poses[:, 3:6])
