# SPDX-License-Identifier: Apache-2.0
"""Names of rendered colours, by the rule that names the colours of generated apartments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.cameras import camera_pose
from wiw.datasets.questions.question import Viewpoint
from wiw.datasets.questions.survey import HFOV
from wiw.datasets.worlds import World

_GAMMA = 2.2
_HUES = (
    (12.0, "pink"),
    (40.0, "red"),
    (75.0, "orange"),
    (115.0, "yellow"),
    (165.0, "green"),
    (215.0, "turquoise"),
    (280.0, "blue"),
    (325.0, "purple"),
    (360.0, "pink"),
)
_SIZE = (160, 188)
LEAST_PIXELS = 20
"""Fewer are not enough to name a colour."""


def name_colors(pixels: NDArray[np.uint8]) -> NDArray[np.str_]:
    """Return the name of each pixel's colour, str [n] of uint8 [n, 3]."""
    linear = (np.asarray(pixels, np.float64) / 255) ** _GAMMA
    cones = np.cbrt(linear @ _TO_CONES.T)
    lightness, a, b = (cones @ _TO_OKLAB.T).T
    chroma, hue = np.hypot(a, b), np.degrees(np.arctan2(b, a)) % 360
    names = np.array([name for _, name in _HUES])[
        np.minimum(np.searchsorted([end for end, _ in _HUES], hue, side="right"), len(_HUES) - 1)
    ]
    warm = (hue > 30) & (hue < 105)
    names = np.where(warm & (chroma < 0.075), "beige", names)
    names = np.where(warm & (lightness < 0.68) & (chroma < 0.13), "brown", names)
    grey = np.where(lightness > 0.88, "white", np.where(lightness < 0.33, "black", "grey"))
    return np.where(chroma < 0.035, grey, names)


_TO_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)


_TO_OKLAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def name_rendered_color(
    world: World, instance: int, viewpoints: list[Viewpoint], share: float, exposures: Sequence[float] = (1.0,)
) -> str:
    """Return the name of an instance's colour as rendered from some viewpoints; empty if it has no clear one.

    It is clear where at least `share` of its pixels are of that name, from each viewpoint, and so is their mean, and
    would be if it were brighter by the factors in `exposures`.
    """
    poses = np.stack([camera_pose(np.array(at[:3]), at[3]) for at in viewpoints])
    views = world.renderer.perspective(poses, _SIZE, HFOV, outputs=("color", "instance"))
    found = set()
    for image, ids in zip(views["color"], views["instance"], strict=True):
        pixels = image[ids == instance][:, :3]
        if len(pixels) < LEAST_PIXELS:
            return ""
        names, counts = np.unique(name_colors(pixels), return_counts=True)
        mean = ((pixels / 255.0) ** _GAMMA).mean(axis=0) ** (1 / _GAMMA)
        name = str(names[counts.argmax()])
        means = np.clip(255 * np.outer(exposures, mean), 0, 255).astype(np.uint8)
        if counts.max() < share * len(pixels) or (name_colors(means) != name).any():
            return ""
        found.add(name)
    return found.pop() if len(found) == 1 else ""
