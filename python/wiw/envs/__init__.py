# SPDX-License-Identifier: Apache-2.0
"""The gymnasium faces of the C++ environments: one episode, or many as a batch."""

from wiw.envs.navigation import NavigationEnv, Segment
from wiw.envs.vector import VectorEnv

__all__ = ["NavigationEnv", "Segment", "VectorEnv"]
