# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import open3d
from render_scene import panorama_rays, perspective_rays


class Peer:
    """RaycastingScene (Embree) for depth and ids; NumPy looks up the nearest texels of colour and light, no mips."""

    def __init__(self, arrays):
        self.description = (
            "rays; texture and lightmap, nearest texels, by NumPy; depth, ids; panorama: by rays; "
            f"open3d {open3d.__version__}"
        )
        self.scene = open3d.t.geometry.RaycastingScene()
        for i in range(len(arrays.vertex_start) - 1):
            vertices = slice(arrays.vertex_start[i], arrays.vertex_start[i + 1])
            faces = arrays.triangles[arrays.triangle_start[i] : arrays.triangle_start[i + 1]] - arrays.vertex_start[i]
            self.scene.add_triangles(
                open3d.core.Tensor(arrays.positions[vertices]), open3d.core.Tensor(faces.astype(np.uint32))
            )
        self.arrays = arrays
        self.triangle_start = arrays.triangle_start.astype(np.int64)
        self.rays = {"perspective": perspective_rays((480, 480), 90), "panorama": panorama_rays((576, 1024))}

    def _lookup(self, image, uv, corners, weights):
        at = (uv[corners] * weights[..., None]).sum(-2)
        side = image.shape[0]
        pixel = np.clip((at * side).astype(np.int32), 0, side - 1)
        return image[pixel[..., 1], pixel[..., 0]]

    def draw(self, pose, kind):
        directions = self.rays[kind] @ pose[:3, :3].T.astype(np.float32)
        rays = np.empty((*directions.shape[:2], 6), np.float32)
        rays[..., :3] = pose[:3, 3]
        rays[..., 3:] = directions
        cast = self.scene.cast_rays(open3d.core.Tensor(rays))
        depth = cast["t_hit"].numpy()
        hit = np.isfinite(depth)
        geometry = np.where(hit, cast["geometry_ids"].numpy(), 0)
        primitive = np.where(hit, cast["primitive_ids"].numpy(), 0)
        corners = self.arrays.triangles[self.triangle_start[geometry] + primitive]
        bary = cast["primitive_uvs"].numpy()
        weights = np.stack([1 - bary.sum(-1), bary[..., 0], bary[..., 1]], -1)
        texel = self._lookup(self.arrays.atlas, self.arrays.uv, corners, weights)
        light = self._lookup(self.arrays.lightmap, self.arrays.light_uv, corners, weights)
        color = np.minimum(texel.astype(np.uint16) * light // 127, 255).astype(np.uint8)
        return color, np.where(hit, depth, 0), np.where(hit, geometry + 1, 0).astype(np.uint32)

    def perspective(self, pose):
        return self.draw(pose, "perspective")

    def panorama(self, pose):
        return self.draw(pose, "panorama")
