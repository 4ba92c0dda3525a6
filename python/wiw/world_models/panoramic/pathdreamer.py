# SPDX-License-Identifier: Apache-2.0
"""PathDreamer (Koh et al., ICCV 2021): structure first, then colours, from a memory of points."""

from __future__ import annotations

from wiw.world_models.base import Requirements, accepts
from wiw.world_models.panoramic.served import ADDRESS, Served


class PathDreamer(Served):
    """PathDreamer: panoramas with depth and semantics, from the official code served by `server/shim.py`."""

    accepts = accepts("viewpoint", needs=("depth", "semantic"), causal=True, best_batch=1, cacheable=True)
    requires = Requirements(
        served="PathDreamer", server=ADDRESS, weights="storage.googleapis.com/gresearch/pathdreamer/ckpt.tar"
    )
