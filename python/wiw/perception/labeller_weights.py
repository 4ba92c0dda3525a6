# SPDX-License-Identifier: Apache-2.0
"""The file of the learned labeller's network."""

from __future__ import annotations

from wiw.perception.labelling_network import Network
from wiw.weight_file import WeightFile

_FILE = WeightFile(
    "perception",
    lambda network: {"categories": network.categories, "states": network.states, "widths": network.widths},
    lambda sizes: Network(int(sizes["categories"]), int(sizes["states"]), tuple(sizes["widths"]), normalised=False),
)
load, save = _FILE.load, _FILE.save
