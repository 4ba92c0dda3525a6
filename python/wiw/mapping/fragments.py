# SPDX-License-Identifier: Apache-2.0
"""Fragments: connected parts of a category in one view, and the space that each fills, as voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from wiw.errors import ArgumentError
from wiw.mapping.views import Views, unproject

VOXEL = 0.05
"""Metres."""
LEAST_PIXELS = 16
"""A fragment of fewer pixels is dropped."""
DEPTH_STEP = 0.06
"""Relative step of depth at which things of one category, one behind the other, are taken apart."""
STRIDE_PIXELS = (600, 8000)
STRIDES = (1, 2, 4)
"""Rows and columns between the pixels that are looked at, in fragments of up to 600, up to 8000, and more pixels."""
SPARSE = 100
"""Voxels of a thing below which what is seen of it from above is widened by one, so that gaps of 0.1 m are closed."""
SCRAP = 0.15
"""Share of the largest part's voxels below which a part is none."""
LEAST_COLUMN = 0.7
"""Share of the usual mean of the votes below which a column of what hangs on a wall is the wall between two things."""
_OFFSET = 1 << 15
_SHIFT = 16


class Labels(Protocol):
    """Per-pixel categories of N views, as `wiw.perception.scene_labels.SceneLabels` has them."""

    @property
    def category(self) -> NDArray[np.uint8]:
        """uint8 [N, H, W]: index of a category, 0 where nothing is known."""

    @property
    def confidence(self) -> NDArray[np.float32]:
        """float32 [N, H, W], 0 to 1."""

    @property
    def state(self) -> NDArray[np.uint8]:
        """uint8 [N, H, W]: index of a state, 0 where none is known."""


@dataclass(frozen=True)
class Fragments:
    """The fragments of one observation, numbered from 1 on; row 0 of each array belongs to none."""

    index: NDArray[np.int32]
    """int32 [4, H, W]: the fragment of each pixel, 0 if there is none."""
    view: NDArray[np.int64]
    category: NDArray[np.int64]
    pixels: NDArray[np.int64]
    confidence: NDArray[np.float64]
    """Mean of its pixels."""
    state: NDArray[np.float64]
    """float64 [N, states]: share of its pixels in each state."""
    voxels: tuple[NDArray[np.int64], ...]
    """Sorted keys of the voxels that it fills; see `pack_voxels`."""
    samples: tuple[NDArray[np.intp], ...]
    """Flat indices of the pixels that its voxels and its colour are taken from."""

    def __len__(self) -> int:
        return len(self.pixels) - 1


def find_fragments(
    views: Views, labels: Labels, things: NDArray[np.bool_], states: int, least_confidence: float
) -> Fragments:
    """Find the fragments of all categories that are `things` (bool [categories]).

    Raises:
        ArgumentError: labels of another shape than the views, or of unknown categories or states.
    """
    category = _check_labels(views, labels, len(things), states)
    wanted = np.where(things[category] & find_packable(views) & (labels.confidence >= least_confidence), category, 0)
    wanted[cut_depth_steps(wanted, views.depth)] = 0
    index = np.zeros(wanted.shape, np.int32)
    where, kinds = [0], [0]
    for view, picture in enumerate(wanted):
        for kind, part in _find_components(picture, index[view], len(where)):
            where.extend([view] * part)
            kinds.extend([kind] * part)
    flat = np.flatnonzero(index)
    owner = index.ravel()[flat]
    count = len(where)
    pixels = np.bincount(owner, minlength=count)
    confidence = np.bincount(owner, labels.confidence.ravel()[flat], count) / np.maximum(pixels, 1)
    state = np.bincount(owner * states + labels.state.ravel()[flat], minlength=count * states).reshape(count, states)
    samples, voxels = _fill_voxels(views, flat, owner, pixels)
    return Fragments(
        index,
        np.array(where),
        np.array(kinds),
        pixels,
        confidence,
        state / np.maximum(pixels, 1)[:, None],
        voxels,
        samples,
    )


def cut_depth_steps(category: NDArray[np.uint8], depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels at which a thing ends in front of another of the same category: bool, as `depth`.

    The inverse of planar depth is linear along any plane, however obliquely it is seen. A step is where it changes
    unlike both neighbouring changes; of the two pixels at a step, the farther is returned.
    """
    inverse = 1.0 / np.where(depth > 0, depth, 1e3).astype(np.float32)
    cut = np.zeros(category.shape, bool)
    _, height, width = depth.shape
    for step, axis_length in ((1, width), (width, height)):
        q, c = inverse.ravel(), category.ravel()
        near = np.abs(q[step:] - q[:-step]) > DEPTH_STEP * q[step:]
        first = np.flatnonzero(near & (c[step:] == c[:-step]) & (c[step:] > 0))
        along = first // step % axis_length
        first = first[(along >= 1) & (along < axis_length - 2)]
        change = q[first + step] - q[first]
        before, after = q[first] - q[first - step], q[first + 2 * step] - q[first + step]
        unlike = np.minimum(np.abs(change - before), np.abs(change - after))
        edge = unlike > DEPTH_STEP * np.minimum(q[first], q[first + step])
        cut.ravel()[np.where(change < 0, first + step, first)[edge]] = True
    return cut


def find_packable(views: Views) -> NDArray[np.bool_]:
    """Return the pixels that show something so near the start that `pack_voxels` has a key for it: bool [N, H, W]."""
    height, width = views.size
    slant = np.sqrt(1 + (width**2 + height**2) / (2 * views.focal) ** 2)  # of the ray through a corner
    away = np.linalg.norm(views.T_start_camera[:, :3, 3], axis=1)
    most = ((_OFFSET * VOXEL - away) / slant).astype(np.float32)
    return (views.depth > 0) & (views.depth < most[:, None, None])


def pack_voxels(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the key of the voxel of each of N points; equal keys are equal voxels, within 1.6 km of the start."""
    cells = np.floor(points / VOXEL).astype(np.int64) + _OFFSET
    return (cells[:, 0] << 2 * _SHIFT) | (cells[:, 1] << _SHIFT) | cells[:, 2]


def unpack_voxels(keys: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the middles of voxels, float64 [N, 3] in metres."""
    mask = (1 << _SHIFT) - 1
    cells = np.stack([keys >> 2 * _SHIFT, (keys >> _SHIFT) & mask, keys & mask], axis=1)
    return (cells - _OFFSET + 0.5) * VOXEL


def split_voxels(keys: NDArray[np.int64], bridged: bool = True) -> list[NDArray[np.int64]]:
    """Return the parts of a thing that stand apart as seen from above, the largest first.

    What stands apart on the floor, or in its upper third, as the backs of chairs do; the rest joins the nearest part.

    Args:
        keys: sorted keys of its voxels.
        bridged: whether the parts of a sparse thing are joined across gaps of up to two voxels.
    """
    points = unpack_voxels(keys)
    low, high = points[:, 2].min(), points[:, 2].max()
    whole, upper = (_find_parts(points[points[:, 2] >= level], bridged) for level in (low, low + (high - low) * 2 / 3))
    parts = max(whole, upper, key=len)
    if len(parts) < 2:
        return [keys]
    away = np.stack([cKDTree(part).query(points[:, :2])[0] for part in parts])
    owner = away.argmin(axis=0)
    found = [keys[owner == number] for number in range(len(parts))]
    return sorted(found, key=lambda own: (-len(own), int(own[0])))


def split_along_wall(keys: NDArray[np.int64], shares: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Return the parts of what hangs on a wall between which views mostly saw the wall, the largest first.

    Scraps are left out.

    Args:
        keys: sorted keys of its voxels.
        shares: float64 [N], of the votes for each voxel those that say what the thing is.
    """
    places = np.floor(unpack_voxels(keys)[:, :2] / VOXEL).astype(np.intp)
    column = places[:, int(np.ptp(places, axis=0).argmax())]
    column = column - column.min()
    count = np.bincount(column)
    mean = np.bincount(column, shares) / np.maximum(count, 1)
    solid = mean >= LEAST_COLUMN * np.median(mean[count > 0])
    run = np.cumsum(np.diff(solid, prepend=False) & solid) * solid  # 1 or more within a run, 0 between
    sizes = np.bincount(run, count)
    sizes[0] = 0
    kept = np.flatnonzero(sizes >= max(1.0, SCRAP * sizes.max()))
    found = [keys[run[column] == number] for number in kept]
    return sorted(found, key=lambda own: (-len(own), int(own[0]))) or [keys]


def _find_parts(points: NDArray[np.float64], bridged: bool) -> list[NDArray[np.float64]]:
    """Return the points [n, 2] of each part that stands apart as seen from above, scraps left out."""
    cells = np.floor(points[:, :2] / VOXEL).astype(np.intp)
    cells -= cells.min(axis=0) - 1
    plan = np.zeros(cells.max(axis=0) + 2, np.uint8)
    plan[cells[:, 0], cells[:, 1]] = 1
    if bridged and len(points) < SPARSE:
        plan = cv2.dilate(plan, np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(plan, connectivity=8)
    part = labels[cells[:, 0], cells[:, 1]]
    counts = np.bincount(part)
    return [points[part == number, :2] for number in np.flatnonzero(counts >= max(1.0, SCRAP * counts.max()))]


def _check_labels(views: Views, labels: Labels, categories: int, states: int) -> NDArray[np.uint8]:
    shapes = [array.shape for array in (labels.category, labels.confidence, labels.state)]
    if any(shape != views.depth.shape for shape in shapes):
        raise ArgumentError(f"labels: expected category, confidence and state of {views.depth.shape}, got {shapes}")
    if labels.category.max(initial=0) >= categories:
        raise ArgumentError(f"labels: expected categories below {categories}, got {labels.category.max()}")
    if labels.state.max(initial=0) >= states:
        raise ArgumentError(f"labels: expected states below {states}, got {labels.state.max()}")
    return labels.category


def _find_components(picture: NDArray[np.uint8], index: NDArray[np.int32], first: int) -> list[tuple[int, int]]:
    """Number the components of each category in `index` from `first` on; return each category and their number."""
    found = []
    boxes: Sequence[Any] = ndimage.find_objects(picture)
    for kind, box in enumerate(boxes, start=1):
        if box is None:
            continue
        count, parts = cv2.connectedComponents((picture[box] == kind).view(np.uint8), connectivity=8, ltype=cv2.CV_16U)
        large = np.bincount(parts.ravel(), minlength=count) >= LEAST_PIXELS
        large[0] = False
        names = np.where(large, np.cumsum(large) - 1 + first, 0).astype(np.int32)
        index[box] += names[parts]
        if large.any():
            found.append((kind, int(large.sum())))
            first += int(large.sum())
    return found


def _fill_voxels(
    views: Views, flat: NDArray[np.intp], owner: NDArray[np.int32], pixels: NDArray[np.int64]
) -> tuple[tuple[NDArray[np.intp], ...], tuple[NDArray[np.int64], ...]]:
    """Return the sampled pixels of each fragment, and the voxels that they fill."""
    height, width = views.size
    view, rest = np.divmod(flat, height * width)
    rows, columns = np.divmod(rest, width)
    stride = np.array(STRIDES)[np.searchsorted(STRIDE_PIXELS, pixels)][owner]
    kept = ((rows | columns) & (stride - 1)) == 0
    flat, owner, view, rows, columns = (array[kept] for array in (flat, owner, view, rows, columns))
    points = unproject(views, view, rows, columns)
    keys = np.unique(pack_voxels(points) | (owner.astype(np.int64) << 3 * _SHIFT))
    return _group(flat, owner, len(pixels)), _split_keys(keys, len(pixels))


def _group(values: NDArray[np.intp], owner: NDArray[np.int32], count: int) -> tuple[NDArray[np.intp], ...]:
    order = np.argsort(owner, kind="stable")
    ends = np.cumsum(np.bincount(owner, minlength=count))
    return tuple(np.split(values[order], ends[:-1]))


def _split_keys(keys: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], ...]:
    """Split sorted keys by the fragment in their upper bits, which are taken off."""
    starts = np.searchsorted(keys, np.arange(1, count) << 3 * _SHIFT)
    return tuple(np.split(keys & ((1 << 3 * _SHIFT) - 1), starts))
