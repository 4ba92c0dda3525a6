# SPDX-License-Identifier: Apache-2.0
"""Render a scene: colour, metric depth and instance ids, perspective or panoramic, a batch of poses per call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw import _core
from wiw.errors import ArgumentError
from wiw.scenes import Scene

Output = Literal["color", "depth", "instance"]
OUTPUTS: tuple[Output, ...] = ("color", "depth", "instance")

_DTYPES = {"color": np.uint8, "depth": np.float32, "instance": np.uint32}


class Renderer:
    """Renders one scene.

    `backend` is "cpu" (ray caster), "gpu" (EGL/OpenGL) or "auto": the GPU if there is a hardware device, otherwise the
    CPU. `samples` (1, 4, 9 or 16) colour samples per pixel smooth edges; depth and ids always come from the pixel's
    centre. Both sides of every triangle are drawn. Raises `BackendError` if the backend cannot run here, and
    `ArgumentError` for a scene without triangles.

    Every method returns a dict with the requested outputs: "color" uint8 [B, H, W, 3]; "depth" float32 [B, H, W] in
    metres, planar z for perspective and distance along the ray for panoramas, 0 where nothing is hit; "instance" uint32
    [B, H, W] ids of `scene.instances`, 0 for nothing.
    """

    def __init__(self, scene: Any, backend: Literal["auto", "cpu", "gpu"] = "auto", samples: int = 1) -> None:
        self.scene = scene
        self._renderer = _core.render.Renderer(scene, backend, samples)

    @property
    def core(self) -> _core.render.Renderer:
        """The compiled renderer, for other compiled rooms."""
        return self._renderer

    @property
    def description(self) -> str:
        """The backend in words, e.g. "cpu (Embree 3.13.5, avx512)"."""
        return self._renderer.description

    def perspective(
        self,
        T_world_camera: ArrayLike,
        size: tuple[int, int],
        hfov_deg: float,
        outputs: Sequence[Output] = OUTPUTS,
        out: Mapping[str, NDArray[Any]] | None = None,
    ) -> dict[str, NDArray[Any]]:
        """Render pinhole views.

        T_world_camera: float [B, 4, 4] (or [4, 4], a batch of one), cameras look down -Z with +Y up. size: (H, W).
        hfov_deg spans the outer pixel edges, pixels are square. `out` gives arrays to write into instead of new ones,
        by output name, with the right shape and dtype and C-contiguous.
        """
        poses, pictures = _prepare(T_world_camera, size, outputs, out)
        self._renderer.perspective(poses, size, hfov_deg, *(pictures.get(name) for name in OUTPUTS))
        return pictures

    def panorama(
        self,
        T_world_camera: ArrayLike,
        size: tuple[int, int] = (576, 1024),
        outputs: Sequence[Output] = OUTPUTS,
        out: Mapping[str, NDArray[Any]] | None = None,
    ) -> dict[str, NDArray[Any]]:
        """Render equirectangular views: columns cover 360 degrees with the front at the centre, rows 180 degrees.

        Arguments as in `perspective`.
        """
        poses, pictures = _prepare(T_world_camera, size, outputs, out)
        self._renderer.panorama(poses, size, *(pictures.get(name) for name in OUTPUTS))
        return pictures

    def set_poses(self, instance_ids: ArrayLike, T_world_instance: ArrayLike) -> None:
        """Move instances to new poses, leaving the others unchanged. Ids [N], transforms float [N, 4, 4]."""
        ids = np.asarray(instance_ids)
        if ids.size and (not np.issubdtype(ids.dtype, np.integer) or ids.min() < 0 or ids.max() > 0xFFFFFFFF):
            raise ArgumentError(f"expected instance_ids as unsigned integers [N], got {ids.dtype} {list(ids.shape)}")
        self._renderer.set_poses(ids.astype(np.uint32), np.asarray(T_world_instance, np.float32))


@cache
def resolve_backend(backend: Literal["auto", "cpu", "gpu"]) -> Literal["cpu", "gpu"]:
    """Return the backend that "auto" stands for on this machine; others unchanged."""
    if backend != "auto":
        return backend
    triangle = Scene.from_arrays([{"positions": np.eye(3, dtype=np.float32), "triangles": np.array([[0, 1, 2]])}])
    return "gpu" if Renderer(triangle).description.startswith("gpu") else "cpu"


def _prepare(
    T_world_camera: ArrayLike,
    size: tuple[int, int],
    outputs: Sequence[Output],
    out: Mapping[str, NDArray[Any]] | None,
) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]]]:
    poses = np.asarray(T_world_camera, np.float64)
    batch = len(poses) if poses.ndim == 3 else 1
    unknown = [name for name in (*outputs, *(out or {})) if name not in _DTYPES]
    if unknown:
        raise ArgumentError(f"expected outputs among {OUTPUTS}, got {unknown}")
    if len(size) != 2 or min(size) < 1:
        raise ArgumentError(f"expected size (H, W) of at least 1, got {size}")
    pictures: dict[str, NDArray[Any]] = {}
    for name in outputs:
        given = None if out is None else out.get(name)
        shape = (batch, *size, 3) if name == "color" else (batch, *size)
        pictures[name] = np.empty(shape, _DTYPES[name]) if given is None else given
    return poses, pictures
