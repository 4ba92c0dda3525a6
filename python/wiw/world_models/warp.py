# SPDX-License-Identifier: Apache-2.0
"""Depth reprojection: how far geometry alone goes, with no learning."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wiw.reproject import warp
from wiw.types import Conditioning, Control, View
from wiw.world_models.base import SMALLEST_PANORAMA, WorldModel, accepts


class Warp(WorldModel):
    """Warp the RGB-D panorama's depth mesh to the new pose, and fill what was hidden from the background.

    Depth is the simulator's, as the paper grants every depth-aware model. The reference between floor and ceiling: a
    video generator that scores lower has not learnt what a single depth image already shows.
    """

    accepts = accepts(
        control="trajectory",
        view="panorama",
        needs=("depth",),
        causal=True,
        best_batch=64,
        seeded=False,
        smallest=SMALLEST_PANORAMA,
    )
    version = "1"

    def __init__(self, view: View = "panorama", size: tuple[int, int] | None = None) -> None:
        """Make the model.

        Args:
            view: "panorama", or "perspective" for a model that sees and draws the front view alone.
            size: (height, width) of input and output, whoever looks at them; if not given, up to 576x1024 as the
                reviser needs, in a front view 480x480.
        """
        if (view, size) != ("panorama", None):  # named in the manifest only where they are chosen
            self.view, self.size = view, size
            self.accepts = accepts(
                control="trajectory", view=view, size=size, needs=("depth",), causal=True, best_batch=64, seeded=False
            )

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return reprojected views; frames that another row answers and frames of padding are left unwritten."""
        assert observations.depth is not None
        frames = np.empty((len(controls), 1 + len(controls[0].actions), *observations.image.shape[1:]), np.uint8)
        frames[:, 0] = observations.image
        for row, control in enumerate(controls):
            wanted = slice(control.shared, control.length)
            if wanted.start < wanted.stop:
                frames[row, 1 + control.shared : 1 + control.length] = warp(
                    observations.image[row : row + 1],
                    observations.depth[row : row + 1],
                    control.viewpoints[None, wanted],
                    hfov_deg=90.0 if self.accepts.view == "perspective" else None,
                )[0]
        return frames
