# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import moderngl
import numpy as np

from render_peers.cubemap import FACE, Cubemap

VERTEX = """
#version 330
uniform mat4 T_clip_world;
in vec3 position; in vec2 uv; in vec2 light_uv; in uint instance;
out vec2 v_uv; out vec2 v_light_uv; flat out uint v_instance;
void main() {
  gl_Position = T_clip_world * vec4(position, 1);
  v_uv = uv; v_light_uv = light_uv; v_instance = instance;
}
"""
FRAGMENT = """
#version 330
uniform sampler2D atlas; uniform sampler2D lightmap;
in vec2 v_uv; in vec2 v_light_uv; flat in uint v_instance;
layout(location = 0) out vec4 color; layout(location = 1) out float depth; layout(location = 2) out uint instance;
void main() {
  color = vec4(texture(atlas, v_uv).rgb * texture(lightmap, v_light_uv).rgb * 2.0, 1.0);
  depth = 1.0 / gl_FragCoord.w;
  instance = v_instance;
}
"""


class Target:
    def __init__(self, context, side):
        size = (side, side)
        color = context.renderbuffer(size, 3)
        depth = context.renderbuffer(size, 1, dtype="f4")
        instance = context.renderbuffer(size, 1, dtype="u4")
        self.frame = context.framebuffer([color, depth, instance], context.depth_renderbuffer(size))
        self.color = np.empty((side, side, 3), np.uint8)
        self.depth = np.empty((side, side), np.float32)
        self.instance = np.empty((side, side), np.uint32)


class Peer:
    """One draw call into three attachments, both faces, trilinear mips; the rows come bottom up and are turned."""

    def __init__(self, arrays):
        self.context = context = moderngl.create_context(standalone=True, backend="egl")
        self.description = f"moderngl {moderngl.__version__}, {context.info['GL_RENDERER']}"
        self.program = context.program(VERTEX, FRAGMENT)
        counts = np.diff(arrays.vertex_start)
        vertices = np.zeros(len(arrays.positions), [("p", "3f4"), ("uv", "2f4"), ("luv", "2f4"), ("id", "u4")])
        vertices["p"], vertices["uv"], vertices["luv"] = arrays.positions, arrays.uv, arrays.light_uv
        vertices["id"] = np.repeat(np.arange(1, len(counts) + 1), counts)
        layout = (context.buffer(vertices), "3f 2f 2f 1u", "position", "uv", "light_uv", "instance")
        self.mesh = context.vertex_array(self.program, [layout], context.buffer(arrays.triangles))
        for unit, (name, image) in enumerate((("atlas", arrays.atlas), ("lightmap", arrays.lightmap))):
            texture = context.texture(image.shape[1::-1], 3, np.ascontiguousarray(image), alignment=1)
            if name == "atlas":
                texture.build_mipmaps()
                texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
            texture.use(unit)
            self.program[name].value = unit
            setattr(self, name, texture)
        self.targets = {side: Target(context, side) for side in (480, FACE)}
        self.cubemap = Cubemap()

    def draw(self, pose, side):
        target = self.targets[side]
        near, far = 0.01, 100.0
        projection = np.zeros((4, 4))
        projection[[0, 1, 3], [0, 1, 2]] = 1, 1, -1
        projection[2, 2:] = (far + near) / (near - far), 2 * far * near / (near - far)
        matrix = (projection @ np.linalg.inv(pose)).astype(np.float32)
        self.program["T_clip_world"].write(np.ascontiguousarray(matrix.T))
        target.frame.use()
        target.frame.clear()
        self.context.enable_only(moderngl.DEPTH_TEST)
        self.mesh.render()
        for i, image in enumerate((target.color, target.depth, target.instance)):
            kind = ("f1", "f4", "u4")[i]
            target.frame.read_into(image, components=3 if i == 0 else 1, attachment=i, alignment=1, dtype=kind)
        return target.color[::-1], target.depth[::-1], target.instance[::-1]

    def perspective(self, pose):
        return self.draw(pose, 480)

    def panorama(self, pose):
        return self.cubemap.panorama(lambda face: [image.copy() for image in self.draw(face, FACE)], pose)
