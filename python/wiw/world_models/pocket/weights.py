# SPDX-License-Identifier: Apache-2.0
"""The denoiser's file."""

from __future__ import annotations

from wiw.weight_file import WeightFile
from wiw.world_models.pocket.network import Denoiser

_FILE = WeightFile(
    "pocket",
    lambda network: {"height": network.height, "widths": network.widths},
    lambda sizes: Denoiser(int(sizes["height"]), tuple(sizes["widths"])),
)
load, save = _FILE.load, _FILE.save
