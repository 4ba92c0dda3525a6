# SPDX-License-Identifier: Apache-2.0
"""The diffuser's weight file."""

from __future__ import annotations

from dataclasses import asdict

from wiw.policies.diffuser.network import Network, Shape
from wiw.weight_file import WeightFile

_FILE = WeightFile(
    "diffuser", lambda network: {"shape": asdict(network.shape)}, lambda header: Network(Shape(**header["shape"]))
)
load, save = _FILE.load, _FILE.save
