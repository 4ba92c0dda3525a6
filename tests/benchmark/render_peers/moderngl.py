# SPDX-License-Identifier: Apache-2.0
"""Colour, depth and ids by one draw call into three attachments (multiple render targets).

"moderngl" does all that ours does. The lean ones are the least that a user could write who needs no more: pixels of
four channels, which are read without conversion, and six faces of 256x256 in place of a panorama.
"""

from __future__ import annotations

import moderngl
import numpy as np

from render_peers.cubemap import CONVERTED, FACE, FACES, Cubemap

LEAN_FACE = 256  # six have two thirds of the pixels of a 576x1024 panorama

VERTEX = """
#version 330
uniform mat4 T_clip_world;
in vec3 position; in uint instance;
flat out uint v_instance;
#ifdef TEXTURED
in vec2 uv; in vec2 light_uv;
out vec2 v_uv; out vec2 v_light_uv;
#endif
void main() {
  gl_Position = T_clip_world * vec4(position, 1);
  v_instance = instance;
#ifdef TEXTURED
  v_uv = uv; v_light_uv = light_uv;
#endif
}
"""
FRAGMENT = """
#version 330
flat in uint v_instance;
layout(location = 0) out vec4 color; layout(location = 1) out float depth; layout(location = 2) out uint instance;
#ifdef TEXTURED
uniform sampler2D atlas; uniform sampler2D lightmap;
in vec2 v_uv; in vec2 v_light_uv;
#endif
void main() {
#ifdef TEXTURED
  color = vec4(texture(atlas, v_uv).rgb * texture(lightmap, v_light_uv).rgb * 2.0, 1.0);
#else
  color = vec4(vec3(v_instance & 7u, (v_instance >> 3) & 7u, (v_instance >> 6) & 7u) / 7.0, 1.0);
#endif
  depth = 1.0 / gl_FragCoord.w;
  instance = v_instance;
}
"""


def with_define(source, textured):
    return source.replace("#version 330", "#version 330\n#define TEXTURED" if textured else "#version 330")


class Target:
    def __init__(self, context, side, channels):
        size = (side, side)
        color = context.renderbuffer(size, channels)
        depth = context.renderbuffer(size, 1, dtype="f4")
        instance = context.renderbuffer(size, 1, dtype="u4")
        self.frame = context.framebuffer([color, depth, instance], context.depth_renderbuffer(size))
        self.color = np.empty((side, side, channels), np.uint8)
        self.depth = np.empty((side, side), np.float32)
        self.instance = np.empty((side, side), np.uint32)


class Peer:
    """Both faces of triangles, trilinear mips where textured; the rows come bottom up and are turned."""

    def __init__(self, arrays, variant="converted"):
        lean, textured = variant.startswith("lean"), variant != "lean-untextured"
        self.context = context = moderngl.create_context(standalone=True, backend="egl")
        self.description = (
            f"{'texture, lightmap' if textured else 'a colour per object'}, depth, ids; panorama: "
            f"{f'six {LEAN_FACE}x{LEAN_FACE} faces, not converted' if lean else CONVERTED}; "
            f"moderngl {moderngl.__version__}, {context.info['GL_RENDERER']}"
        )
        self.program = context.program(with_define(VERTEX, textured), with_define(FRAGMENT, textured))
        self.mesh = self._upload_mesh(arrays, textured)
        if textured:
            self.textures = [
                self._bind_texture(unit, name, getattr(arrays, name)) for unit, name in enumerate(("atlas", "lightmap"))
            ]
        self.channels = 4 if lean else 3
        self.face = LEAN_FACE if lean else FACE
        self.targets = {side: Target(context, side, self.channels) for side in (480, self.face)}
        self.cubemap = None if lean else Cubemap()

    def _upload_mesh(self, arrays, textured):
        counts = np.diff(arrays.vertex_start)
        columns = {"position": arrays.positions, "instance": np.repeat(np.arange(1, len(counts) + 1), counts)}
        types, layout = [("position", "3f4"), ("instance", "u4")], "3f 1u"
        if textured:
            columns |= {"uv": arrays.uv, "light_uv": arrays.light_uv}
            types, layout = [*types, ("uv", "2f4"), ("light_uv", "2f4")], "3f 1u 2f 2f"
        vertices = np.zeros(len(arrays.positions), types)
        for name, values in columns.items():
            vertices[name] = values
        content = (self.context.buffer(vertices), layout, *columns)
        return self.context.vertex_array(self.program, [content], self.context.buffer(arrays.triangles))

    def _bind_texture(self, unit, name, image):
        texture = self.context.texture(image.shape[1::-1], 3, np.ascontiguousarray(image), alignment=1)
        if name == "atlas":
            texture.build_mipmaps()
            texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        texture.use(unit)
        self.program[name].value = unit
        return texture

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
            channels = self.channels if i == 0 else 1
            target.frame.read_into(image, components=channels, attachment=i, alignment=1, dtype=kind)
        return target.color[::-1, :, :3], target.depth[::-1], target.instance[::-1]

    def perspective(self, pose):
        return self.draw(pose, 480)

    def panorama(self, pose):
        if self.cubemap is not None:
            return self.cubemap.panorama(lambda face: [image.copy() for image in self.draw(face, FACE)], pose)
        faces = [[image.copy() for image in self.draw(pose @ face, self.face)] for face in FACES]
        return [np.stack(images) for images in zip(*faces, strict=True)]
