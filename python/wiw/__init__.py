# SPDX-License-Identifier: Apache-2.0
"""Closed-loop evaluation of visual world models: does a world model help an agent succeed, and by how much?

    env = wiw.make("ImageNav-v0", scenes="apartments:val", seed=0)
    agent = wiw.Agent(wiw.policy("matcher"), wiw.world_model("warp"))
    wiw.evaluate(env, agent, episodes=20).summary()

Names are imported when first used, so that `import wiw` stays fast and needs neither torch nor OpenGL.
"""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING, Any, Literal, overload

from wiw.gymnasium_ids import register_environments

__version__ = "0.1.0"

__all__ = [
    "Accepts",
    "Agent",
    "Env",
    "Metric",
    "Policy",
    "Task",
    "WorldModel",
    "accepts",
    "action",
    "annotate",
    "benchmark_device",
    "blame",
    "check_model",
    "collect",
    "collect_navigation",
    "compare",
    "data_scaling",
    "envs",
    "errors",
    "evaluate",
    "import_prompts",
    "judge",
    "load_run",
    "make",
    "make_vec",
    "merge",
    "metrics",
    "nav",
    "panorama",
    "physics",
    "policy",
    "power",
    "quality",
    "registry",
    "render",
    "reproject",
    "scale",
    "scenes",
    "show",
    "status",
    "study",
    "study_errors",
    "types",
    "verify",
    "world_model",
]

_HOME = {
    "Accepts": "wiw.world_models.base",
    "Agent": "wiw.loop.agent",
    "Env": "wiw.envs.base",
    "Metric": "wiw.metrics.metric",
    "Policy": "wiw.policies.base",
    "Task": "wiw.tasks.base",
    "WorldModel": "wiw.world_models.base",
    "accepts": "wiw.world_models.base",
    "benchmark_device": "wiw.studies.device_benchmark",
    "blame": "wiw.studies.blame",
    "check_model": "wiw.studies.model_check",
    "collect": "wiw.training.collect",
    "collect_navigation": "wiw.training.collect_navigation",
    "compare": "wiw.studies.compare",
    "data_scaling": "wiw.studies.data_scaling",
    "evaluate": "wiw.studies.evaluate",
    "import_prompts": "wiw.policies.vlm.prompt_import.importer",
    "judge": "wiw.studies.judge",
    "load_run": "wiw.studies.run_log",
    "make": "wiw.registry",
    "make_vec": "wiw.registry",
    "merge": "wiw.runs.merge",
    "policy": "wiw.registry",
    "power": "wiw.analysis.power",
    "quality": "wiw.studies.quality",
    "scale": "wiw.studies.scale",
    "show": "wiw.viz.show",
    "study": "wiw.studies.study",
    "status": "wiw.runs.status",
    "study_errors": "wiw.studies.errors",
    "verify": "wiw.runs.verify",
    "world_model": "wiw.registry",
}
"""Where a public name lives; the others in `__all__` are modules."""

_DEPRECATED = {"Headline": "Metric", "attribute": "blame"}
"""Old public names and what replaces them; they go with the next version."""


def __getattr__(name: str) -> Any:
    if name in _DEPRECATED:
        replacement = _DEPRECATED[name]
        message = f"wiw.{name} is now called wiw.{replacement}; the old name will be removed in the next version"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        name = replacement
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    if name in __all__:
        return importlib.import_module(f"wiw.{name}")
    raise AttributeError(f"module 'wiw' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)


register_environments()

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

    from wiw import (
        action,
        annotate,
        envs,
        errors,
        metrics,
        nav,
        panorama,
        physics,
        registry,
        render,
        reproject,
        scenes,
        types,
    )
    from wiw.analysis.power import power
    from wiw.envs.base import Env
    from wiw.loop.agent import Agent
    from wiw.metrics.metric import Metric
    from wiw.policies.base import Policy
    from wiw.policies.vlm.prompt_import.importer import import_prompts
    from wiw.runs.merge import merge
    from wiw.runs.status import status
    from wiw.runs.verify import verify
    from wiw.studies.blame import blame
    from wiw.studies.compare import compare
    from wiw.studies.data_scaling import data_scaling
    from wiw.studies.errors import study_errors
    from wiw.studies.evaluate import evaluate
    from wiw.studies.judge import judge
    from wiw.studies.model_check import check_model
    from wiw.studies.quality import quality
    from wiw.studies.run_log import load_run
    from wiw.studies.scale import scale
    from wiw.studies.study import study
    from wiw.tasks.base import Task
    from wiw.training.collect import collect
    from wiw.training.collect_navigation import collect_navigation
    from wiw.viz.show import show
    from wiw.world_models.base import Accepts, WorldModel, accepts

    # The registry lies below what it makes and names no types of it; these are the types for editors and checkers.
    class GymnasiumEnv(gymnasium.Env[Any, Any], Env): ...

    def make(task_id: str, depth: bool = True, **options: Any) -> GymnasiumEnv: ...
    def make_vec(task_id: str, num_envs: int, depth: bool = True, **options: Any) -> VectorEnv[Any, Any, Any]: ...
    def policy(name: Any, **options: Any) -> Policy: ...
    @overload
    def world_model(name: Literal["none"], **options: Any) -> None: ...
    @overload
    def world_model(name: Any, **options: Any) -> WorldModel: ...
    def world_model(name: Any, **options: Any) -> WorldModel | None: ...
