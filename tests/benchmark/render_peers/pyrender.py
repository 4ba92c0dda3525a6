# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pyrender
from PIL import Image

from render_peers.cubemap import CONVERTED, FACE, Cubemap


class Peer:
    """One pass for colour and depth (flat shading), a second for segmentation."""

    def __init__(self, arrays):
        self.description = (
            f"texture without light, depth and ids in two passes, back faces left out; panorama: {CONVERTED}; "
            f"pyrender {pyrender.__version__}, EGL"
        )
        self.scene = pyrender.Scene(bg_color=[0.8, 0.85, 0.9, 1])
        texture = pyrender.Texture(source=Image.fromarray(arrays.atlas), source_channels="RGB")
        material = pyrender.MetallicRoughnessMaterial(baseColorTexture=texture)
        self.colors = {}
        for i in range(len(arrays.vertex_start) - 1):
            vertices = slice(arrays.vertex_start[i], arrays.vertex_start[i + 1])
            faces = arrays.triangles[arrays.triangle_start[i] : arrays.triangle_start[i + 1]] - arrays.vertex_start[i]
            primitive = pyrender.Primitive(
                positions=arrays.positions[vertices], normals=arrays.normals[vertices],
                texcoord_0=arrays.uv[vertices], indices=faces, material=material,
            )  # fmt: skip
            node = self.scene.add(pyrender.Mesh([primitive]))
            self.colors[node] = ((i + 1) & 255, (i + 1) >> 8, 0)
        camera = pyrender.PerspectiveCamera(np.pi / 2, znear=0.01, zfar=100, aspectRatio=1)
        self.camera = self.scene.add(camera)
        self.renderer = pyrender.OffscreenRenderer(480, 480)
        self.cubemap = Cubemap()

    def draw(self, pose, side):
        self.renderer.viewport_width = self.renderer.viewport_height = side
        self.scene.set_pose(self.camera, pose)
        color, depth = self.renderer.render(self.scene, pyrender.RenderFlags.FLAT)
        codes, _ = self.renderer.render(self.scene, pyrender.RenderFlags.SEG, self.colors)
        return color, depth, codes[..., 0].astype(np.uint32) | (codes[..., 1].astype(np.uint32) << 8)

    def perspective(self, pose):
        return self.draw(pose, 480)

    def panorama(self, pose):
        return self.cubemap.panorama(lambda face: self.draw(face, FACE), pose)
