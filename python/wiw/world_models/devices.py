# SPDX-License-Identifier: Apache-2.0
"""Requirements of a world model's networks on the machine."""

from __future__ import annotations

from wiw.errors import DependencyError
from wiw.networks import memory_guard
from wiw.networks import resolve_device as device
from wiw.world_models.base import Requirements

__all__ = ["device", "memory_guard", "require"]


def require(requirements: Requirements) -> None:
    """Raise DependencyError where a package is missing."""
    if missing := requirements.missing():
        raise DependencyError(f"{', '.join(missing)} not installed; pip install 'wiw[{requirements.extra}]'")
