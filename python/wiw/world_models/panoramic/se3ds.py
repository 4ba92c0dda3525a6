# SPDX-License-Identifier: Apache-2.0
"""SE3DS (Koh et al., 2022): colours and depth in one step, from a memory of points."""

from __future__ import annotations

from wiw.world_models.base import Requirements, accepts
from wiw.world_models.panoramic.served import ADDRESS, Served


class SE3DS(Served):
    """SE3DS: panoramas with depth, from the official code served by `server/shim.py`."""

    accepts = accepts("viewpoint", needs=("depth",), causal=True, best_batch=1, cacheable=True)
    requires = Requirements(
        served="SE3DS", server=ADDRESS, weights="storage.googleapis.com/gresearch/se3ds/mp3d_ckpt.tar"
    )
