# SPDX-License-Identifier: Apache-2.0
"""A panorama from six perspective faces, for renderers that have no equirectangular camera."""

from __future__ import annotations

import cv2
import numpy as np
from render_scene import panorama_rays

HEIGHT, WIDTH = 576, 1024
CONVERTED = "converted from six faces"
FACE = 384  # as many pixels a radian at a face's centre (192) as the panorama has (183)


def _turn(forward, up):
    forward, up = np.asarray(forward, float), np.asarray(up, float)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(forward, up), up, -forward], 1)
    return pose


FACES = [
    _turn(forward, up)
    for forward, up in (
        ((0, 0, -1), (0, 1, 0)), ((0, 0, 1), (0, 1, 0)), ((1, 0, 0), (0, 1, 0)), ((-1, 0, 0), (0, 1, 0)),
        ((0, 1, 0), (0, 0, 1)), ((0, -1, 0), (0, 0, -1)),
    )
]  # fmt: skip


class Cubemap:
    """Cached tables from panorama pixels to the six faces stacked on top of each other."""

    def __init__(self):
        rays = panorama_rays((HEIGHT, WIDTH))
        along = np.stack([rays @ face[:3, :3] * [1, 1, -1] for face in FACES])  # right, up, forward of each face
        face = along[..., 2].argmax(0)
        right, up, forward = np.moveaxis(np.take_along_axis(along, face[None, ..., None], 0)[0], -1, 0)
        x = (right / forward + 1) / 2 * FACE - 0.5
        y = (1 - up / forward) / 2 * FACE - 0.5
        self.x = x.astype(np.float32)
        self.y = (np.clip(y, 0, FACE - 1) + face * FACE).astype(np.float32)
        nearest = np.clip(np.rint(y), 0, FACE - 1) + face * FACE, np.clip(np.rint(x), 0, FACE - 1)
        self.nearest = (nearest[0] * FACE + nearest[1]).astype(np.int64)
        self.to_distance = (1 / forward).astype(np.float32)

    def panorama(self, draw_face, pose):
        faces = [draw_face(pose @ face) for face in FACES]
        color, depth, ids = (np.concatenate(images) for images in zip(*faces, strict=True))
        return (
            cv2.remap(color, self.x, self.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
            depth.ravel()[self.nearest] * self.to_distance,
            ids.ravel()[self.nearest],
        )
