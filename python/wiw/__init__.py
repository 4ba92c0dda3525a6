# SPDX-License-Identifier: Apache-2.0
"""Closed-loop evaluation of visual world models: does a world model help an agent succeed, and by how much?

    env = wiw.make("ImageNav-v0", scenes="apartments:val", seed=0)
    agent = wiw.Agent(wiw.policy("matcher"), wiw.world_model("warp"))
    wiw.evaluate(env, agent, episodes=20).summary()

Names are imported when first used, so that `import wiw` stays fast and needs neither torch nor OpenGL.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_PUBLIC = {
    "Accepts": "wiw.world_models.base",
    "Agent": "wiw.loop.agent",
    "Policy": "wiw.policies.base",
    "WorldModel": "wiw.world_models.base",
    "accepts": "wiw.world_models.base",
    "evaluate": "wiw.evaluation.evaluate",
    "load_run": "wiw.evaluation.runlog",
    "make": "wiw.registry",
    "policy": "wiw.registry",
    "show": "wiw.viz.show",
    "world_model": "wiw.registry",
}
_MODULES = ("action", "annotate", "errors", "metrics", "nav", "panorama", "registry", "render", "scenes", "types")

__all__ = [*_PUBLIC, *_MODULES]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    if name in _MODULES:
        return importlib.import_module(f"wiw.{name}")
    raise AttributeError(f"module 'wiw' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)


if TYPE_CHECKING:
    from wiw import action, annotate, errors, metrics, nav, panorama, registry, render, scenes, types
    from wiw.evaluation.evaluate import evaluate
    from wiw.evaluation.runlog import load_run
    from wiw.loop.agent import Agent
    from wiw.policies.base import Policy
    from wiw.registry import make, policy, world_model
    from wiw.viz.show import show
    from wiw.world_models.base import Accepts, WorldModel, accepts
