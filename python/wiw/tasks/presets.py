# SPDX-License-Identifier: Apache-2.0
"""Presets: rules of a task in a YAML file, shipped in `wiw/configs/<preset>/<task>.yaml` or written by the user.

base: official        # a shipped preset whose rules hold where this file says nothing; `paper` if left out
about: our long run   # one line for `wiw list`
decisions: 40
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from wiw.errors import ArgumentError, FileError

FOLDER = Path(__file__).parents[1] / "configs"
DEFAULT = "paper"

Rules = TypeVar("Rules")


def names(task: str) -> list[str]:
    """Shipped presets of a task, the default first."""
    found = sorted(path.parent.name for path in FOLDER.glob(f"*/{task}.yaml"))
    return sorted(found, key=lambda name: name != DEFAULT)


def about(task: str, preset: str) -> str:
    """What a shipped preset says of itself."""
    return str(_read(FOLDER / preset / f"{task}.yaml").get("about", ""))


def absolute(preset: str | Path) -> str:
    """The preset with its path, if it is one, made absolute, so that it means the same in any folder."""
    path = Path(preset).expanduser()
    return str(path.resolve()) if path.suffix in (".yaml", ".yml") else str(preset)


def rules(cls: type[Rules], task: str, preset: str | Path, overrides: Mapping[str, Any]) -> Rules:
    """The rules of a preset, by name or by the path of a YAML file, with `overrides` on top.

    Raises:
        ArgumentError: no such preset; a key that is no rule; a value of another type. Names the file or argument.
        FileError: the file cannot be read, or does not hold a mapping.
    """
    known = [field.name for field in fields(cls)]  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for path in _chain(task, preset):
        values |= _checked(cls, known, _without_header(_read(path)), str(path))
    values |= _checked(cls, known, overrides, f"options of {task}")
    missing = [name for name in known if name not in values]
    if missing:
        raise ArgumentError(f"preset '{preset}' of {task} leaves open {', '.join(missing)}; give `base: {DEFAULT}`")
    return cls(**values)


def _chain(task: str, preset: str | Path) -> list[Path]:
    """The files of a preset, what it is based on first."""
    path = _path(task, preset)
    base = _read(path).get("base", DEFAULT if path.parent.parent != FOLDER else None)
    if base is None:
        return [path]
    if base not in names(task) or _path(task, base) == path:
        raise ArgumentError(f"{path}: base '{base}' is not one of {', '.join(names(task))}")
    return [*_chain(task, base), path]


def _path(task: str, preset: str | Path) -> Path:
    if preset in names(task):
        return FOLDER / preset / f"{task}.yaml"
    path = Path(preset).expanduser()
    if path.suffix in (".yaml", ".yml"):
        return path.resolve()
    raise ArgumentError(
        f"{task}: no preset '{preset}'; there are {', '.join(names(task))}, or give the path of a .yaml file"
    )


def _read(path: Path) -> Mapping[str, Any]:
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise FileError(f"{path}: {error}") from error
    if not isinstance(content, Mapping):
        raise FileError(f"{path}: expected rules as `name: value` lines, got {type(content).__name__}")
    return content


def _without_header(content: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in content.items() if name not in ("base", "about")}


def _checked(cls: type, known: list[str], values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The values, with whole numbers made floats where a rule is a float."""
    unknown = [str(name) for name in values if name not in known]
    if unknown:
        raise ArgumentError(f"{where}: unknown rules {', '.join(unknown)}; there are {', '.join(known)}")
    types = get_type_hints(cls)
    return {name: _typed(types[name], value, f"{where}: {name}") for name, value in values.items()}


def _typed(kind: Any, value: Any, where: str) -> Any:
    if get_origin(kind) is Literal:
        fits, expected = value in get_args(kind), f"one of {', '.join(get_args(kind))}"
    else:
        numbers = (int, float) if kind is float else (kind,)
        fits, expected = isinstance(value, numbers) and not isinstance(value, bool), f"a value of type {kind.__name__}"
    if not fits:
        raise ArgumentError(f"{where}: expected {expected}, got {value!r}")
    return float(value) if kind is float else value
