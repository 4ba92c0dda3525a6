# SPDX-License-Identifier: Apache-2.0
"""Presets: rules of a task in a YAML file, shipped in `wiw/configs/<preset>/<task>.yaml` or written by the user.

base: official        # a shipped preset whose rules hold where this file says nothing; `paper` if left out
about: our long run   # one line for `wiw list`
decisions: 40
policies:             # options of policies by name, where the command line gives no others
  vlm: {history: 0}
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from wiw.errors import ArgumentError
from wiw.mapping_files import read_yaml_mapping
from wiw.suggestions import did_you_mean

FOLDER = Path(__file__).parents[1] / "configs"
DEFAULT = "paper"

Rules = TypeVar("Rules")


def list_presets(task: str) -> list[str]:
    """Return the shipped presets of a task, the default first."""
    found = sorted(path.parent.name for path in FOLDER.glob(f"*/{task}.yaml"))
    return sorted(found, key=lambda name: name != DEFAULT)


def describe_preset(task: str, preset: str) -> str:
    """Return what a shipped preset says of itself."""
    return str(_read(FOLDER / preset / f"{task}.yaml").get("about", ""))


def make_absolute(preset: str | Path) -> str:
    """Return the preset with its path, if it is one, made absolute, so that it means the same in any folder."""
    path = Path(preset).expanduser()
    return str(path.resolve()) if path.suffix in (".yaml", ".yml") else str(preset)


def find_owner(task: type) -> str:
    """Return whose presets a task has: its own, else those of the nearest task it derives from that has some."""
    names = [str(vars(base)["name"]) for base in task.__mro__ if isinstance(vars(base).get("name"), str)]
    return next((name for name in names if list_presets(name)), names[0] if names else task.__name__)


def load_rules(cls: type[Rules], task: str, preset: str | Path, overrides: Mapping[str, Any]) -> Rules:
    """Return the rules of a preset, by name or by the path of a YAML file, with `overrides` on top.

    What neither says is the default of `cls`, so that a task of one's own needs no preset: for a task that ships none,
    the default preset stands for these values.

    Raises:
        ArgumentError: no such preset; a key that is no rule; a value of another type. Names the file or argument.
        FileError: the file cannot be read, or does not hold a mapping.
    """
    values: dict[str, Any] = {}
    for path in _chain(task, preset):
        values |= check_values(cls, _without_header(_read(path)), str(path))
    values |= check_values(cls, overrides, f"options of {task}")
    missing = [field.name for field in _open_fields(cls) if field.name not in values]
    if missing:
        ships = f"; give `base: {DEFAULT}`" if list_presets(task) else f", or give {cls.__name__} defaults"
        raise ArgumentError(f"preset '{preset}' of {task} leaves open {', '.join(missing)}{ships}")
    return cls(**values)


def load_policy_options(task: str, preset: str | Path) -> dict[str, dict[str, Any]]:
    """Return the options that a preset gives policies, by name, on top of those of the presets it is based on.

    Raises:
        ArgumentError: no such preset, or something else than options by name; names the file.
        FileError: see `load_rules`.
    """
    found: dict[str, dict[str, Any]] = {}
    for path in _chain(task, preset):
        policies = _read(path).get("policies", {})
        if not isinstance(policies, Mapping) or not all(isinstance(own, Mapping) for own in policies.values()):
            raise ArgumentError(
                f"{path}: policies: expected options by policy, `vlm: {{history: 0}}`, got {policies!r}"
            )
        for policy, options in policies.items():
            found[str(policy)] = {**found.get(str(policy), {}), **options}
    return found


def rule_names(cls: type) -> list[str]:
    """Return the names of the rules that a dataclass declares."""
    return [field.name for field in fields(cls)]


def check_values(cls: type, values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the values, with whole numbers made floats where a rule is a float.

    Raises:
        ArgumentError: a name that is no rule, or a value of another type; names `where`.
    """
    refuse_unknown(values, rule_names(cls), where)
    types = get_type_hints(cls)
    return {name: _typed(types[name], value, f"{where}: {name}") for name, value in values.items()}


def refuse_unknown(values: Iterable[str], known: Sequence[str], where: str) -> None:
    """Check that all names are known.

    Raises:
        ArgumentError: some are not; names `where`, what is like them, and what there is.
    """
    unknown = [str(name) for name in values if name not in known]
    if unknown:
        hint = did_you_mean(unknown[0], known)
        raise ArgumentError(f"{where}: unknown rules {', '.join(unknown)}; there are {', '.join(known)}.{hint}")


def _open_fields(cls: type) -> list[Field[Any]]:
    """Return the rules that have no default."""
    return [field for field in fields(cls) if field.default is MISSING and field.default_factory is MISSING]


def _chain(task: str, preset: str | Path) -> list[Path]:
    """Return the files of a preset, what it is based on first."""
    path = _find(task, preset)
    if path is None:
        return []
    shipped = list_presets(task)
    base = _read(path).get("base", DEFAULT if shipped and path.parent.parent != FOLDER else None)
    if base is None:
        return [path]
    if base not in shipped or _find(task, base) == path:
        raise ArgumentError(
            f"{path}: base '{base}' is not one of {', '.join(shipped) or '(none)'}.{did_you_mean(str(base), shipped)}"
        )
    return [*_chain(task, base), path]


def _find(task: str, preset: str | Path) -> Path | None:
    """Return a preset's file; None for the default preset of a task that ships none."""
    shipped = list_presets(task)
    if preset in shipped:
        return FOLDER / preset / f"{task}.yaml"
    path = Path(preset).expanduser()
    if path.suffix in (".yaml", ".yml"):
        return path.resolve()
    if not shipped and preset == DEFAULT:
        return None
    there = f"there are {', '.join(shipped)}, or give" if shipped else "it ships none; give"
    raise ArgumentError(
        f"{task}: no preset '{preset}'; {there} the path of a .yaml file.{did_you_mean(str(preset), shipped)}"
    )


def _read(path: Path) -> Mapping[str, Any]:
    return read_yaml_mapping(path, "rules as `name: value` lines")


def _without_header(content: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in content.items() if name not in ("base", "about", "policies")}


def _typed(kind: Any, value: Any, where: str) -> Any:
    if get_origin(kind) is Literal:
        fits, expected = value in get_args(kind), f"one of {', '.join(get_args(kind))}"
    else:
        numbers = (int, float) if kind is float else (kind,)
        fits, expected = isinstance(value, numbers) and not isinstance(value, bool), f"a value of type {kind.__name__}"
    if not fits:
        raise ArgumentError(f"{where}: expected {expected}, got {value!r}")
    return float(value) if kind is float else value
