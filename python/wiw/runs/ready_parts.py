# SPDX-License-Identifier: Apache-2.0
"""Policies and world models that exist before a run: their names, and whether they have the options of its preset.

A part by name is made with the preset's options. One that was made before keeps its own: where the preset has options
for it, a run begins only if it was made with each of them, whatever their values.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from typing import Any

from wiw.errors import ArgumentError
from wiw.registry import POLICIES, WORLD_MODELS, Registry, find_options
from wiw.tasks import presets
from wiw.tasks.base import Task

UNKNOWN = "unknown"
"""Stands for the value of an option that an object does not show."""
PLAIN = (str, int, float, bool, type(None), tuple, list, dict)


def require_preset(task: Task, policies: Iterable[Any], model: Any, ignored: Iterable[str] = ()) -> None:
    """Check that parts made before a run were made with the options that the task's preset has for them.

    Options that the default preset has likewise count as the part's own.

    Args:
        task: as built.
        policies: by name, or as objects; only these are looked at.
        model: likewise.
        ignored: options that change no answer.

    Raises:
        ArgumentError: one was made without such an option; says which, and what to write instead.
    """
    parts = [*((POLICIES, each) for each in policies), (WORLD_MODELS, model)]
    for registry, part in parts:
        if part is None or isinstance(part, str) or not (name := registry.find_name(part)):
            continue
        wanted = _list_own_options(task, registry, name)
        missing = {
            option: value
            for option, value in wanted.items()
            if option not in ignored and not _is_made_with(registry, part, name, option, value)
        }
        if missing:
            raise ArgumentError(_refuse(task, registry, name, missing))


def read_options(registry: Registry, part: Any, names: Iterable[str]) -> dict[str, Any]:
    """Return the options of an object: those it was made with, and the values of `names`, `UNKNOWN` where it shows
    none.
    """
    given = _find_given(part) or {}
    name = registry.find_name(part)
    return {**{option: _read_value(registry, part, name, option) for option in names}, **given}


def same_value(a: Any, b: Any) -> bool:
    """Return whether two values of an option are the same in YAML, which has no tuples."""
    return bool(_make_plain(a) == _make_plain(b))


def _list_own_options(task: Task, registry: Registry, name: str) -> dict[str, Any]:
    """Return the options that the task's preset has for a part, without those that the default one has likewise."""
    found = _get_options(task.preset_settings, registry, name)
    if not found:
        return {}
    usual = _get_options(presets.load_preset(presets.find_owner(type(task)), presets.DEFAULT), registry, name)
    return {key: value for key, value in found.items() if key not in usual or not same_value(usual[key], value)}


def _get_options(preset: presets.Preset, registry: Registry, name: str) -> Mapping[str, Any]:
    return presets.get_options(preset.policies if registry is POLICIES else preset.models, name)


def _is_made_with(registry: Registry, part: Any, name: str, option: str, wanted: Any) -> bool:
    """Return whether an object was given an option, or has the wanted value without."""
    given = _find_given(part)
    if given is not None and option in given:
        return True
    value = _read_value(registry, part, name, option)
    if same_value(value, wanted):
        return True
    usual = _find_default(registry, name, option)
    return given is None and UNKNOWN not in (usual, value) and not same_value(value, usual)


def _find_given(part: Any) -> Mapping[str, Any] | None:
    """Return the options that a part was given; none for a class; None for an object that no registry has made."""
    made = find_options(part)
    return made[1] if made else {} if inspect.isclass(part) else None


def _read_value(registry: Registry, part: Any, name: str, option: str) -> Any:
    """Return the value of an option that an object was not given through a registry; `UNKNOWN` if it shows none."""
    usual = _find_default(registry, name, option)
    if usual != UNKNOWN and _find_given(part) is not None:
        return usual
    holders = (each for each in (part, getattr(part, "options", None)) if hasattr(each, "__dict__"))
    shown = [vars(each)[option] for each in holders if option in vars(each)]
    return next((value for value in shown if isinstance(value, PLAIN)), UNKNOWN)


def _find_default(registry: Registry, name: str, option: str) -> Any:
    """Return the value that an option has where it is not given; `UNKNOWN` for one that is required, or not named."""
    parameter = inspect.signature(registry.find(name)).parameters.get(option)
    return UNKNOWN if parameter is None or parameter.default is parameter.empty else parameter.default


def _make_plain(value: Any) -> Any:
    """Return a value with lists in place of tuples."""
    if isinstance(value, Mapping):
        return {key: _make_plain(each) for key, each in value.items()}
    return [_make_plain(each) for each in value] if isinstance(value, list | tuple) else value


def _refuse(task: Task, registry: Registry, name: str, missing: Mapping[str, Any]) -> str:
    """Return what to write instead of an object without options that the preset has."""
    values = ", ".join(f"{option}={value!r}" for option, value in missing.items())
    if registry is POLICIES:
        make, call = f'wiw.policy("{name}", ...', f'wiw.Agent("{name}", ...)'
        more = f', or an AgentRecipe with policy_options={{"{name}": {{...}}}} where it has other options,'
    else:
        make, call, more = f'wiw.world_model("{name}", ...', f'its name, "{name}",', ""
    return (
        f"preset {task.preset} sets {', '.join(missing)} of {registry.kind} {name}, which this object was built "
        f"without: write {call}{more} so that the preset applies, or build it as {make}, {values}), with these values "
        "or your own"
    )
