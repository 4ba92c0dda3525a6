# SPDX-License-Identifier: Apache-2.0
"""The network's file."""

from __future__ import annotations

from wiw.weight_file import WeightFile
from wiw.world_models.warpnet.network import Network

_FILE = WeightFile(
    "warpnet",
    lambda network: {"height": network.height, "widths": network.widths},
    lambda sizes: Network(int(sizes["height"]), tuple(sizes["widths"])),
)
load, save = _FILE.load, _FILE.save
