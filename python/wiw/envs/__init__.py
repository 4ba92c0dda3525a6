# SPDX-License-Identifier: Apache-2.0
"""Environments: `Env`, which the closed loop drives, and the gymnasium faces of the C++ environments.

Names are imported when first used: whoever needs `Env` alone does not wait for the simulators.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_HOME = {
    "Env": "wiw.envs.base",
    "Guide": "wiw.envs.base",
    "ManipulationEnv": "wiw.envs.manipulation",
    "ManipulationVectorEnv": "wiw.envs.manipulation_vector",
    "NavigationEnv": "wiw.envs.navigation",
    "Segment": "wiw.envs.base",
    "VectorEnv": "wiw.envs.vector",
}

__all__ = ["Env", "Guide", "ManipulationEnv", "ManipulationVectorEnv", "NavigationEnv", "Segment", "VectorEnv"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'wiw.envs' has no attribute '{name}'")


if TYPE_CHECKING:
    from wiw.envs.base import Env, Guide, Segment
    from wiw.envs.manipulation import ManipulationEnv
    from wiw.envs.manipulation_vector import ManipulationVectorEnv
    from wiw.envs.navigation import NavigationEnv
    from wiw.envs.vector import VectorEnv
