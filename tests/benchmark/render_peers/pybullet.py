# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib.util
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pybullet

from render_peers.cubemap import CONVERTED, FACE, Cubemap

NEAR, FAR = 0.01, 100.0


class Peer:
    """getCameraImage without shadows: the EGL plugin, or TinyRenderer with backend="tiny"."""

    def __init__(self, arrays, backend="egl"):
        self.client = pybullet.connect(pybullet.DIRECT)
        self.kind = pybullet.ER_TINY_RENDERER
        if backend == "egl":
            plugin = importlib.util.find_spec("eglRenderer")
            if pybullet.loadPlugin(plugin.origin, "_eglRendererPlugin") < 0:
                raise RuntimeError("pybullet's EGL plugin does not load")
            self.kind = pybullet.ER_BULLET_HARDWARE_OPENGL
        self.description = (
            f"texture under its light, depth, ids; panorama: {CONVERTED}; "
            f"pybullet {pybullet.getAPIVersion()}, {backend}"
        )
        with tempfile.TemporaryDirectory() as folder:
            self._load(arrays, Path(folder))
        self.cubemap = Cubemap()

    @staticmethod
    def _load(arrays, folder):
        cv2.imwrite(str(folder / "atlas.png"), arrays.atlas[..., ::-1])
        texture = pybullet.loadTexture(str(folder / "atlas.png"))
        for i in range(len(arrays.vertex_start) - 1):
            vertices = slice(arrays.vertex_start[i], arrays.vertex_start[i + 1])
            faces = arrays.triangles[arrays.triangle_start[i] : arrays.triangle_start[i + 1]] - arrays.vertex_start[i]
            path = folder / f"{i}.obj"
            with path.open("w") as file:
                np.savetxt(file, arrays.positions[vertices], "v %.6f %.6f %.6f")
                np.savetxt(file, arrays.uv[vertices] * [1, -1] + [0, 1], "vt %.6f %.6f")
                np.savetxt(file, arrays.normals[vertices], "vn %.5f %.5f %.5f")
                np.savetxt(file, np.repeat(faces.astype(np.int64) + 1, 3, 1), "f %d/%d/%d %d/%d/%d %d/%d/%d")
            shape = pybullet.createVisualShape(pybullet.GEOM_MESH, fileName=str(path))
            body = pybullet.createMultiBody(baseVisualShapeIndex=shape)
            pybullet.changeVisualShape(body, -1, textureUniqueId=texture)

    def draw(self, pose, side):
        view = np.linalg.inv(pose).T.ravel().tolist()
        projection = pybullet.computeProjectionMatrixFOV(90, 1, NEAR, FAR)
        _, _, rgba, depth, ids = pybullet.getCameraImage(side, side, view, projection, shadow=0, renderer=self.kind)
        rgba = np.reshape(rgba, (side, side, 4))
        metric = FAR * NEAR / (FAR - (FAR - NEAR) * np.reshape(depth, (side, side)))
        return (
            np.ascontiguousarray(rgba[..., :3], np.uint8),
            metric.astype(np.float32),
            np.reshape(ids, (side, side)) + 1,
        )

    def perspective(self, pose):
        return self.draw(pose, 480)

    def panorama(self, pose):
        return self.cubemap.panorama(lambda face: self.draw(face, FACE), pose)
