# SPDX-License-Identifier: Apache-2.0
"""What a world model lacks on this machine, without importing anything heavy."""

from __future__ import annotations

import os
from pathlib import Path

from wiw.world_models.base import Requirements


def lacks(requires: Requirements) -> list[str]:
    """What is missing, in a few words each; empty where the model is ready."""
    packages = requires.missing()
    found = [f"{', '.join(packages)} (pip install 'wiw[{requires.extra}]')"] if packages else []
    if requires.weights and not in_hub_cache(requires.weights):
        found.append("weights")
    if requires.gpu and not has_gpu():
        found.append("a GPU")
    found += [f"{name} in the environment" for name in requires.variables if not os.environ.get(name)]
    return found + [f"{name}=..." for name in requires.options]


def in_hub_cache(repository: str) -> bool:
    """Whether some state of a repository lies in the Hugging Face cache."""
    snapshots = hub_cache() / f"models--{repository.replace('/', '--')}" / "snapshots"
    return any(snapshots.glob("*/*"))


def hub_cache() -> Path:
    """Where the hub's client keeps what it has downloaded."""
    home = os.environ.get("HF_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "huggingface"
    return Path(os.environ.get("HF_HUB_CACHE") or Path(home) / "hub").expanduser()


def has_gpu() -> bool:
    """Whether the kernel shows a device that torch can compute on: NVIDIA's or AMD's."""
    return any(Path("/dev").glob("nvidia[0-9]*")) or Path("/dev/kfd").exists()
