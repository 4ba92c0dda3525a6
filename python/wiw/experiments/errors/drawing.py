# SPDX-License-Identifier: Apache-2.0
"""Render a world differently than it is: with instances elsewhere, or copies of them in addition to the originals.

Everything that renders a scene shares its renderer, so instances are moved during one call and then put back.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.tabletop.workbench import Workbench


class MovedRenderer:
    """A renderer that draws some instances elsewhere.

    Args:
        renderer: the compiled one (`wiw.render.Renderer.core`).
        ids: uint32 [N] instances that are moved.
        poses: float32 [N, 4, 4] where they are drawn.
        originals: float32 [N, 4, 4] where they are.
    """

    def __init__(
        self, renderer: Any, ids: NDArray[np.uint32], poses: NDArray[np.float32], originals: NDArray[np.float32]
    ) -> None:
        self._renderer, self._ids, self._poses, self._originals = renderer, ids, poses, originals

    def panorama(self, poses: ArrayLike, size: tuple[int, int], color: Any, depth: Any, instance: Any) -> None:
        """Render panoramas as `wiw._core.render.Renderer.panorama` does."""
        with self._move_instances():
            self._renderer.panorama(poses, size, color, depth, instance)

    def perspective(
        self, poses: ArrayLike, size: tuple[int, int], hfov: float, color: Any, depth: Any, instance: Any
    ) -> None:
        """Render perspective views as `wiw._core.render.Renderer.perspective` does."""
        with self._move_instances():
            self._renderer.perspective(poses, size, hfov, color, depth, instance)

    @contextmanager
    def _move_instances(self) -> Iterator[None]:
        if len(self._ids):
            self._renderer.set_poses(self._ids, self._poses)
        try:
            yield
        finally:
            if len(self._ids):
                self._renderer.set_poses(self._ids, self._originals)


class ComposedRenderer:
    """A renderer that draws a world as it is, and over it copies of some instances, behind what hides them.

    Args:
        renderer: the compiled one.
        moved: draws the same world with these instances where their copies are.
        ids: uint32 [N] the instances.
    """

    def __init__(self, renderer: Any, moved: MovedRenderer, ids: NDArray[np.uint32]) -> None:
        self._renderer, self._moved, self._ids = renderer, moved, ids

    def panorama(self, poses: ArrayLike, size: tuple[int, int], color: Any, depth: Any, instance: Any) -> None:
        """Render color panoramas, uint8 [B, H, W, 3]."""
        self._compose("panorama", (poses, size), color)

    def perspective(
        self, poses: ArrayLike, size: tuple[int, int], hfov: float, color: Any, depth: Any, instance: Any
    ) -> None:
        """Render color perspective views, uint8 [B, H, W, 3]."""
        self._compose("perspective", (poses, size, hfov), color)

    def _compose(self, kind: str, camera: tuple[Any, ...], color: Any) -> None:
        shape = color.shape[:3]
        true, there = np.empty(shape, np.float32), np.empty(shape, np.float32)
        copies, ids = np.empty_like(color), np.empty(shape, np.uint32)
        getattr(self._renderer, kind)(*camera, color, true, None)
        getattr(self._moved, kind)(*camera, copies, there, ids)
        paste_copies(color, true, copies, there, np.isin(ids, self._ids))


class DrawnBench:
    """A workbench some of whose things are drawn elsewhere, or twice, while its physics stays true.

    Args:
        bench: the workbench.
        offsets: transforms [4, 4] in the world's frame, by a thing's name.
        copies: whether things are also drawn where they are.
    """

    def __init__(self, bench: Workbench, offsets: Mapping[str, NDArray[np.float64]], copies: bool = False) -> None:
        self._bench, self._offsets, self._copies = bench, offsets, copies

    def fork(self) -> DrawnBench:
        """Return a copy that moves on its own."""
        return DrawnBench(self._bench.fork(), self._offsets, self._copies)

    def render_fronts_after(self, poses: ArrayLike, size: tuple[int, int], first: int = 0) -> NDArray[np.uint8]:
        """Move to each of the poses [K, 7] in turn; return the front views after `poses[first:]`, uint8 [N, H, W, 3]"""
        views = []
        for number, pose in enumerate(np.asarray(poses, np.float64)):
            self._bench.move_to(pose)
            if number >= first:
                views.append(self._render_front(size))
        return np.stack(views)

    def _render_front(self, size: tuple[int, int]) -> NDArray[np.uint8]:
        drawn = self._bench.draw_elsewhere(self._offsets)
        if not self._copies:
            return np.asarray(drawn.render_view("front", size)["color"])
        true = self._bench.render_view("front", size, ("color", "depth"))
        copies = drawn.render_view("front", size, ("color", "depth", "instance"))
        ids = 1 + np.flatnonzero(np.isin(drawn.instance_names, list(self._offsets)))
        paste_copies(true["color"], true["depth"], copies["color"], copies["depth"], np.isin(copies["instance"], ids))
        return true["color"]


def paste_copies(
    picture: NDArray[np.uint8],
    depth: NDArray[np.float32],
    copies: NDArray[np.uint8],
    copy_depth: NDArray[np.float32],
    shown: NDArray[np.bool_],
) -> None:
    """Paint copies into a picture [..., 3] in place, where they are shown and nearer than what is there.

    A depth of 0 means that nothing is hit.
    """
    nearer = shown & ((copy_depth < depth) | (depth == 0))
    picture[nearer] = copies[nearer]
