# SPDX-License-Identifier: Apache-2.0
"""One small registry: a kind of thing is found by name in its own folder of `wiw`, by entry point, or by path.

wiw.world_model("warp")                  python/wiw/world_models/warp/   (its class is named in `BUILT_IN`)
wiw.world_model("mine")                  entry point group "wiw.world_models"
wiw.world_model("model.py:MyModel")      a class in a file
wiw.world_model("mypkg.models:MyModel")  a class in an importable module
wiw.world_model(MyModel)                 the class itself, or an instance
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
import sys
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from wiw.errors import RegistryError


@dataclass(frozen=True)
class Registry:
    """Names of one kind. Modules are imported when a name is first used, so that `import wiw` stays light."""

    kind: str
    """As in messages: "world model"."""
    group: str
    """Entry-point group."""
    built_in: dict[str, str]
    """Name to `module:attribute`."""

    def names(self) -> list[str]:
        """All registered names, built-in ones first."""
        return [*self.built_in, *sorted(set(self._plugins()) - set(self.built_in))]

    def find(self, name: str) -> Any:
        """The class or factory behind a name or path.

        Raises:
            RegistryError: unknown name, missing file, module or attribute; the message says which names exist.
        """
        if name in self.built_in:
            return self._load(name, self.built_in[name])
        plugins = self._plugins()
        if name in plugins:
            return plugins[name].load()
        if ":" in name:
            return self._load(name, name)
        near = difflib.get_close_matches(name, self.names(), n=3)
        hint = f" Did you mean {' or '.join(near)}?" if near else ""
        raise RegistryError(
            f"no {self.kind} is named '{name}'.{hint} Known: {', '.join(self.names())}; "
            f"or give path.py:Class, package.module:Class, or an entry point in '{self.group}'."
        )

    def make(self, what: Any, **options: Any) -> Any:
        """An instance from a name, path, class, factory, or instance (returned as it is).

        Raises:
            RegistryError: see `find`; also when the options do not fit the constructor.
        """
        factory = self.find(what) if isinstance(what, str) else what
        if not callable(factory) or (not inspect.isclass(factory) and not inspect.isfunction(factory)):
            if options:
                raise RegistryError(f"options {sorted(options)} cannot be applied to a ready-made {self.kind}")
            return factory
        try:
            inspect.signature(factory).bind(**options)
        except TypeError as error:
            raise RegistryError(f"{self.kind} '{what}': {error}; it takes {inspect.signature(factory)}") from None
        return factory(**options)

    def _plugins(self) -> dict[str, Any]:
        return {point.name: point for point in entry_points(group=self.group)}

    def _load(self, name: str, path: str) -> Any:
        module_name, _, attribute = path.rpartition(":")
        try:
            module = (
                _import_file(Path(module_name)) if module_name.endswith(".py") else importlib.import_module(module_name)
            )
            return getattr(module, attribute)
        except (FileNotFoundError, ModuleNotFoundError, AttributeError) as error:
            raise RegistryError(f"{self.kind} '{name}' cannot be loaded: {error}") from error


def _import_file(path: Path) -> Any:
    """The module in a Python file, under a name of its own so that worker processes can load it again."""
    path = path.expanduser().resolve()
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    name = f"wiw_user_{path.stem}_{abs(hash(path)):x}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


WORLD_MODELS = Registry(
    "world model",
    "wiw.world_models",
    {
        "none": "wiw.world_models.none:none",
        "copy": "wiw.world_models.copy:Copy",
        "warp": "wiw.world_models.warp:Warp",
        "oracle": "wiw.world_models.oracle:Oracle",
    },
)
POLICIES = Registry(
    "policy",
    "wiw.policies",
    {
        "heuristic": "wiw.policies.heuristic:Heuristic",
        "matcher": "wiw.policies.matcher:Matcher",
        "climber": "wiw.policies.matcher.climber:Climber",
        "geometric": "wiw.policies.geometric:Geometric",
    },
)
TASKS = Registry("task", "wiw.tasks", {"imagenav": "wiw.tasks.imagenav:ImageNav"})
METRICS = Registry(
    "metric",
    "wiw.metrics",
    {
        "success": "wiw.metrics.navigation:success_rate",
        "spl": "wiw.metrics.navigation:spl",
        "mean_trajectory": "wiw.metrics.navigation:mean_trajectory",
    },
)


def list_world_models() -> list[str]:
    """Names that `wiw.world_model` takes."""
    return WORLD_MODELS.names()


def list_policies() -> list[str]:
    """Names that `wiw.policy` takes."""
    return POLICIES.names()


def list_tasks() -> list[str]:
    """Names of the tasks; their gymnasium ids are `ImageNav-v0` and so on."""
    return TASKS.names()


def list_metrics() -> list[str]:
    """Names of the task metrics."""
    return METRICS.names()


def world_model(name: Any, **options: Any) -> Any:
    """A world model by name, `path.py:Class`, class or instance; None for "none".

    Raises:
        RegistryError: unknown name, or options that do not fit; the message says what is known.
    """
    return WORLD_MODELS.make(name, **options)


def policy(name: Any, **options: Any) -> Any:
    """A policy by name, `path.py:Class`, class or instance.

    Raises:
        RegistryError: unknown name, or options that do not fit; the message says what is known.
    """
    return POLICIES.make(name, **options)


def make(task_id: str, depth: bool = True, **options: Any) -> Any:
    """A gymnasium environment of a task, e.g. `wiw.make("ImageNav-v0", scenes="apartments:val", seed=0)`.

    Observations carry depth unless `depth=False`: the matcher maps with it and `warp` imagines with it.

    Raises:
        RegistryError: unknown task, or options that do not fit; the message says what is known.
    """
    return _task(task_id, options).environment(depth=depth)


def make_vec(task_id: str, num_envs: int, depth: bool = True, **options: Any) -> Any:
    """A gymnasium vector environment of a task: `num_envs` episodes at a time, stepped and observed as a batch.

    Raises:
        RegistryError: unknown task, or options that do not fit; the message says what is known.
        ArgumentError: `num_envs` below 1.
    """
    return _task(task_id, options).vector_environment(num_envs, depth=depth)


def _task(task_id: str, options: dict[str, Any]) -> Any:
    return TASKS.make(task_id.removesuffix("-v0").lower(), **options)
