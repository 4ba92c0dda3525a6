# SPDX-License-Identifier: Apache-2.0
"""The network's file."""

from __future__ import annotations

from wiw.policies.navigator.network import Network, get_sizes
from wiw.weight_file import WeightFile

_FILE = WeightFile("navigator", get_sizes, lambda sizes: Network(int(sizes["width"]), int(sizes["heads"])))
load, save = _FILE.load, _FILE.save
