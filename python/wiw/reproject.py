# SPDX-License-Identifier: Apache-2.0
"""Reproject RGB-D images to other camera poses: what a moving camera would see of what is already known.

A source is a panorama (depth is the distance along the ray) or, with a field of view given, a perspective view (depth
is planar z). Depth is in metres, 0 where nothing is hit. A wrong shape, size, type or transform raises
``wiw.errors.ArgumentError``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw._core import reproject as _core
from wiw.errors import ArgumentError

__all__ = ["pose", "warp"]

Size = tuple[int, int]
OUTPUTS = ("color", "depth", "hole")


@lru_cache(maxsize=16)
def _warp(source: Size, source_hfov: float | None, target: Size, target_hfov: float | None, cut: float) -> Any:
    return _core.Warp(source, source_hfov, target, target_hfov, cut)


def pose(forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_deg: float = 0.0) -> NDArray[np.float64]:
    """Return the pose [4, 4] of a camera moved in the frame of another: metres, and a turn to the left after the
    move.
    """
    yaw = np.radians(yaw_deg)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, 0, sin, -left], [0, 1, 0, up], [-sin, 0, cos, -forward], [0, 0, 0, 1.0]])


def warp(
    color: NDArray[np.uint8],
    depth: NDArray[np.float32],
    T_source_target: ArrayLike,
    *,
    hfov_deg: float | None = None,
    size: Size | None = None,
    target_hfov_deg: float | None = None,
    outputs: tuple[str, ...] = ("color",),
    cut: float = 0.1,
) -> Any:
    """Warp B images to T poses each.

    A mesh through the depth of each source is rendered from the new pose; each pixel takes its colour from the source
    in one bilinear look-up. What the source did not see, or saw only from the other side, is a hole: its colour is a
    mean of its surroundings in which farther ones weigh more; its depth is that of the background next to it.

    Args:
        color: uint8 [B, H, W, 3].
        depth: float32 [B, H, W], or another floating type.
        T_source_target: [B, T, 4, 4], pose of each new camera in the frame of its source (see :func:`pose`).
        hfov_deg: None for panoramas; for perspective views their horizontal field of view between pixel edges.
        size: (h, w) of the results; None means the source's.
        target_hfov_deg: field of view of the results, if it differs from the source's; this renders perspective views
            of a panorama directly from its depth mesh.
        outputs: any of "color" (uint8 [B, T, h, w, 3]), "depth" (float32 [B, T, h, w], planar z in perspective views
            and distance along the ray in panoramas, guesses included) and "hole" (bool [B, T, h, w], True where colour
            and depth are guessed).
        cut: the mesh is cut where neighbouring depths differ by more than this fraction and no plane explains it.

    Returns:
        The colour if ``outputs`` is ``("color",)``, otherwise a dict of the outputs.
    """
    color = np.asarray(color)
    if color.dtype != np.uint8 or color.ndim != 4:
        raise ArgumentError(f"color: expected uint8 [B, H, W, 3], got {color.dtype} {list(color.shape)}")
    depth = np.asarray(depth)
    if not np.issubdtype(depth.dtype, np.floating):
        raise ArgumentError(
            f"depth: expected metres in a floating type, got {depth.dtype}; convert it first, such as millimetres by "
            "depth.astype(np.float32) / 1000"
        )
    if unknown := [name for name in outputs if name not in OUTPUTS]:
        raise ArgumentError(f"outputs: expected any of {OUTPUTS}, got {unknown}")
    source = (int(color.shape[1]), int(color.shape[2]))
    target = source if size is None else (int(size[0]), int(size[1]))
    target_hfov = hfov_deg if target_hfov_deg is None else target_hfov_deg
    plan = _warp(source, hfov_deg, target, target_hfov, float(cut))
    found = plan(color, depth, T_source_target, "depth" in outputs, "hole" in outputs)
    return found["color"] if tuple(outputs) == ("color",) else {name: found[name] for name in outputs}
