# SPDX-License-Identifier: Apache-2.0
"""Imagine a plan: the network in small, its composition in full size."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from wiw.world_models.armnet.body import ArmView, render_arm, render_bare_table
from wiw.world_models.armnet.motion import motion
from wiw.world_models.armnet.network import (
    FRONT,
    WINDOW,
    Arm,
    Mixture,
    Motion,
    Network,
    build_sources,
    clear_arm,
    compose_static_view,
    compose_view,
    find_unoccluded_arm,
    find_visible_arm,
)


def imagine_views(
    network: Network, image: NDArray[np.uint8], poses: NDArray[np.float64]
) -> Iterator[NDArray[np.uint8]]:
    """Yield a view, uint8 [H, W, 3], after each pose but the first of [N, 7], from the view at the first.

    H and W are the same whole multiple of the network's front view.
    """
    size = image.shape[0], image.shape[1]
    scale = size[0] // FRONT[0]
    bare = _image(render_bare_table(size).color)
    arms = render_arm(poses, size)
    here = next(arms)
    with torch.inference_mode():
        view, before = _image(image), _arm(here)
        canvas = clear_arm(view, before, find_unoccluded_arm(view, before), bare, bare)
        for there in arms:
            arm, way = _arm(there), motion(here.pose[None], there.pose[None])
            seen = compose_static_view(canvas, arm, bare)
            inner = Arm(_window(arm.color, scale), _window(arm.mask, scale))
            around, table = _window(canvas, scale), _window(bare, scale)
            mixture = _mix_views(network, around, inner, _window(before.mask, scale), way, table, scale)
            _window(seen, scale)[:] = compose_view(
                mixture.shares, build_sources(mixture, around, inner, way, table, scale)
            )
            hidden = arm.mask > 0.5
            _window(hidden, scale)[:] = find_visible_arm(mixture.shares, inner)
            canvas = clear_arm(seen, arm, hidden, bare, canvas)
            here, before = there, arm
            yield (seen[0].permute(1, 2, 0) * 255).round().byte().numpy()


def _mix_views(
    network: Network, canvas: Tensor, arm: Arm, before: Tensor, way: Motion, bare: Tensor, scale: int
) -> Mixture:
    """Return how the network composes the window, in full size."""

    def small(image: Tensor) -> Tensor:
        return functional.avg_pool2d(image, scale)

    def large(image: Tensor) -> Tensor:
        return functional.interpolate(image, scale_factor=scale, mode="bilinear", align_corners=False)

    now = Arm(small(arm.color), (small(arm.mask) > 0.5).float())
    found = network(small(canvas), now, (small(before) > 0.5).float(), way, small(bare))
    return Mixture(large(found.shares), large(found.paint), large(found.flow))


def _window(image: Tensor, scale: int) -> Tensor:
    """Return the network's part of a front view that is so many times as large as it sees it."""
    rows, columns = (slice(side.start * scale, side.stop * scale) for side in WINDOW)
    return image[..., rows, columns]


def _arm(sight: ArmView) -> Arm:
    return Arm(_image(sight.color), torch.from_numpy(sight.arm.astype(np.float32))[None, None])


def _image(image: NDArray[np.uint8]) -> Tensor:
    """Return the image as float [1, 3, H, W] in [0, 1]."""
    return torch.from_numpy(np.array(image)).permute(2, 0, 1)[None].float() / 255
