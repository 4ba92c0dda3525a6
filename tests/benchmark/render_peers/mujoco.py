# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import mujoco
import numpy as np

from render_peers.cubemap import CONVERTED, FACE, Cubemap


class Peer:
    """Colour, depth, segmentation passes of mujoco.Renderer; headlight, no shadows, back faces culled."""

    def __init__(self, arrays):
        self.description = (
            f"texture under a headlight, depth and ids in three passes, back faces left out; panorama: {CONVERTED}; "
            f"mujoco {mujoco.__version__}, EGL"
        )
        self.model = self._model(arrays)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.renderers = {side: mujoco.Renderer(self.model, side, side) for side in (480, FACE)}
        for renderer in self.renderers.values():
            renderer.update_scene(self.data)
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                renderer.scene.flags[flag] = 0
        self.cubemap = Cubemap()

    @staticmethod
    def _model(arrays):
        spec = mujoco.MjSpec()
        spec.visual.global_.offwidth = spec.visual.global_.offheight = 480
        spec.visual.quality.offsamples = 0
        height, width = arrays.atlas.shape[:2]
        texture = spec.add_texture(
            name="atlas", type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3
        )
        texture.data = arrays.atlas.tobytes()
        material = spec.add_material(name="atlas")
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "atlas"
        for i in range(len(arrays.vertex_start) - 1):
            vertices = slice(arrays.vertex_start[i], arrays.vertex_start[i + 1])
            faces = arrays.triangles[arrays.triangle_start[i] : arrays.triangle_start[i + 1]] - arrays.vertex_start[i]
            mesh = spec.add_mesh(name=f"m{i}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
            mesh.uservert = arrays.positions[vertices].ravel()
            mesh.usernormal = arrays.normals[vertices].ravel()
            mesh.usertexcoord = arrays.uv[vertices].ravel()
            mesh.userface = faces.astype(np.int32).ravel()
            mesh.userfacenormal = mesh.userfacetexcoord = mesh.userface
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{i}", material="atlas", contype=0, conaffinity=0
            )
        return spec.compile()

    def draw(self, pose, side):
        renderer = self.renderers[side]
        extent = self.model.stat.extent
        near, far = self.model.vis.map.znear * extent, self.model.vis.map.zfar * extent
        for camera in renderer.scene.camera:
            camera.pos, camera.forward, camera.up = pose[:3, 3], -pose[:3, 2], pose[:3, 1]
            camera.frustum_near, camera.frustum_far = near, far
            camera.frustum_center, camera.frustum_width = 0, 0
            camera.frustum_bottom, camera.frustum_top = -near, near
        color = renderer.render()
        renderer.enable_depth_rendering()
        depth = renderer.render()
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        ids = renderer.render()[..., 0] + 1
        renderer.disable_segmentation_rendering()
        return color, depth, ids

    def perspective(self, pose):
        return self.draw(pose, 480)

    def panorama(self, pose):
        return self.cubemap.panorama(lambda face: self.draw(face, FACE), pose)
