# SPDX-License-Identifier: Apache-2.0
"""The network's file."""

from __future__ import annotations

from wiw.weight_file import WeightFile
from wiw.world_models.armnet.network import Network

_FILE = WeightFile("armnet", lambda network: {"widths": network.widths}, lambda sizes: Network(tuple(sizes["widths"])))
load, save = _FILE.load, _FILE.save
