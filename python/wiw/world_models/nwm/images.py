# SPDX-License-Identifier: Apache-2.0
"""Front views as NWM sees them: the middle in 4:3, squeezed into a square."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate


def rows_seen(height: int, width: int) -> slice:
    """Return the rows of an image that make its middle 4:3."""
    seen = min(height, round(width * 3 / 4))
    return slice((height - seen) // 2, (height - seen) // 2 + seen)


def to_network(images: NDArray[np.uint8], side: int) -> Tensor:
    """Convert uint8 [B, H, W, 3] to float32 [B, 3, side, side] in [-1, 1]."""
    seen = np.ascontiguousarray(images[:, rows_seen(*images.shape[1:3])])
    pixels = torch.from_numpy(seen).permute(0, 3, 1, 2).float() / 127.5 - 1
    return interpolate(pixels, (side, side), mode="bilinear", antialias=True)


def to_frames(pixels: Tensor, height: int, width: int) -> NDArray[np.uint8]:
    """Convert [B, 3, side, side] in [-1, 1] to uint8 [B, height, width, 3]; black above and below what is predicted."""
    rows = rows_seen(height, width)
    seen = interpolate(pixels.float(), (rows.stop - rows.start, width), mode="bilinear", antialias=True)
    frames = np.zeros((len(pixels), height, width, 3), np.uint8)
    frames[:, rows] = ((seen + 1) * 127.5).round().clamp(0, 255).byte().permute(0, 2, 3, 1).cpu().numpy()
    return frames
