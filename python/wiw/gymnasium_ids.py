# SPDX-License-Identifier: Apache-2.0
"""`gymnasium.make("wiw/ImageNav-v0", scenes=...)`: the environments in gymnasium's own registry.

`import wiw` does not import gymnasium: if it has not been imported yet, the environments are registered once it is.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

NAMESPACE = "wiw"
_REGISTRY = "gymnasium.envs"


def list_ids() -> dict[str, str]:
    """Return the names of the built-in tasks by gymnasium's: "ImageNav-v0", after its class, is "imagenav"."""
    from wiw.registry import TASKS

    return {f"{place.rpartition(':')[2]}-v0": name for name, place in TASKS.built_in.items()}


def register_environments() -> None:
    """Register the environments with gymnasium, now or as soon as it is imported."""
    if _REGISTRY in sys.modules:
        _register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


class _AfterGymnasium(MetaPathFinder):
    """An import hook that registers the environments once gymnasium has registered its own."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != _REGISTRY:
            return None
        sys.meta_path.remove(self)
        spec = PathFinder.find_spec(fullname, path)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                _register()

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


def _register() -> None:
    from gymnasium.envs.registration import register, registry

    for name, task in list_ids().items():
        if f"{NAMESPACE}/{name}" not in registry:
            register(
                f"{NAMESPACE}/{name}",
                entry_point="wiw.gymnasium_ids:make_env",
                vector_entry_point="wiw.gymnasium_ids:make_vector_env",
                kwargs={"task": task},
            )


def make_env(task: str, render_mode: str | None = None, **options: Any) -> Any:
    """Return an environment as `wiw.make` does; gymnasium calls it.

    Raises:
        ArgumentError: another render mode than "rgb_array".
        RegistryError: options that do not fit.
    """
    from wiw.registry import make

    _check_render_mode(render_mode)
    return make(task, **options)


def make_vector_env(task: str, num_envs: int = 1, render_mode: str | None = None, **options: Any) -> Any:
    """Return a vector environment as `wiw.make_vec` does; gymnasium calls it.

    Raises:
        ArgumentError: another render mode than "rgb_array"; fewer than one environment.
        RegistryError: options that do not fit.
    """
    from wiw.registry import make_vec

    _check_render_mode(render_mode)
    return make_vec(task, num_envs, **options)


def _check_render_mode(mode: str | None) -> None:
    from wiw.errors import ArgumentError

    if mode not in (None, "rgb_array"):
        raise ArgumentError(f"render_mode: expected 'rgb_array', got '{mode}'")
