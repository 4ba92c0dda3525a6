# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from render_scene import to_scene

from render_peers.cubemap import CONVERTED


class Peer:
    """Ours; the instruction set comes from WIW_ISA."""

    def __init__(self, arrays, backend="cpu"):
        from wiw.render import Renderer

        how = "by rays" if backend == "cpu" else CONVERTED
        self.renderer = Renderer(to_scene(arrays), backend)
        self.description = f"texture, lightmap, depth, ids; panorama: {how}; {self.renderer.description}"
        self.views = self._buffers((480, 480))
        self.panoramas = self._buffers((576, 1024))

    @staticmethod
    def _buffers(size):
        return {
            "color": np.empty((1, *size, 3), np.uint8),
            "depth": np.empty((1, *size), np.float32),
            "instance": np.empty((1, *size), np.uint32),
        }

    def perspective(self, pose):
        return [image[0] for image in self.renderer.perspective(pose, (480, 480), 90, out=self.views).values()]

    def panorama(self, pose):
        return [image[0] for image in self.renderer.panorama(pose, (576, 1024), out=self.panoramas).values()]
