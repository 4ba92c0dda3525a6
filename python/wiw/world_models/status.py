# SPDX-License-Identifier: Apache-2.0
"""What a world model lacks on this machine, without importing anything heavy."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from urllib.parse import urlsplit

from wiw.networks import in_hub_cache
from wiw.world_models.base import Requirements


def lacks(requires: Requirements) -> list[str]:
    """List what is missing, in a few words each; empty if the model is ready."""
    packages = requires.missing()
    found = [f"{', '.join(packages)} (pip install 'wiw[{requires.extra}]')"] if packages else []
    if requires.served and not is_served(requires.served, requires.server):
        found.append(f"a server at {requires.server}")
    if requires.weights and not requires.served and not in_hub_cache(requires.weights):
        found.append("weights")
    if requires.gpu and not has_gpu():
        found.append("a GPU")
    found += [f"{name} in the environment" for name in requires.variables if not os.environ.get(name)]
    return found + [f"{name}=..." for name in requires.options]


def is_served(name: str, address: str) -> bool:
    """Return whether the server at an address serves the model of that name; takes a second at most."""
    from wiw.errors import RemoteError
    from wiw.world_models.remote.model import Remote

    uri = urlsplit(address)
    try:
        socket.create_connection((uri.hostname or "", uri.port or 80), 0.2).close()
        remote = Remote(address, patience=0.8)
    except (OSError, RemoteError):
        return False
    served = remote.describe()["model"]
    remote.close()
    return bool(served.get("name") == name)


def has_gpu() -> bool:
    """Return whether the kernel shows a device that torch can compute on: NVIDIA's or AMD's."""
    return any(Path("/dev").glob("nvidia[0-9]*")) or Path("/dev/kfd").exists()
