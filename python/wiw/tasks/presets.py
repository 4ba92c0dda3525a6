# SPDX-License-Identifier: Apache-2.0
"""Presets: all that a task's numbers depend on, in a YAML file: shipped as `wiw/configs/<preset>/<task>.yaml`, or the
user's.

base: official        # a shipped preset that holds where this file says nothing; `default` if left out
about: our long run   # one line for `wiw list`
policy: navigator     # which policy runs the task where none is named; the task's own if left out
decisions: 40         # rules of the task
generator:            # rules that generated episodes satisfy
  farthest: 4.0
policies:             # options of policies by name, where the command line gives no others; files are beside this one
  vlm: {history: 0}
models:               # options of world models, likewise; or a YAML file beside this one
  wan2.1: {frames: 33}
departures:           # why it departs from the paper, by whom that concerns (`CONCERNS`); null: it no longer does
  rules: {decisions: "we have more time"}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from wiw.errors import ArgumentError
from wiw.mapping_files import read_yaml_mapping
from wiw.registry import ISOLATED, POLICIES, WORLD_MODELS, Registry
from wiw.suggestions import did_you_mean
from wiw.typed_values import read_values

FOLDER = Path(__file__).parents[1] / "configs"
DEFAULT, PAPER = "default", "paper"
HEADER = ("base", "about", "policy", "generator", "policies", "models", "departures")
"""Keys that are not rules."""
CONCERNS = ("rules", "vlm", "models", "text models")
"""Whom a departure concerns: every run, runs with policy `vlm`, with a world model, with one that is told words."""

Rules = TypeVar("Rules")


Options = Mapping[str, Mapping[str, Any]]
"""Options of parts by their names."""


@dataclass(frozen=True)
class Preset:
    """All that a preset sets, those that it is based on included."""

    rules: Mapping[str, Any] = field(default_factory=dict)
    generator: Mapping[str, Any] = field(default_factory=dict)
    """Rules of generated episodes, checked by the task that generates them."""
    policies: Options = field(default_factory=dict)
    models: Options = field(default_factory=dict)
    policy: str | None = None
    """Name of the policy that runs the task where none is named; the task's own if None."""
    departures: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Reasons for departures from the paper, by whom they concern (`CONCERNS`) and what they are about."""


def load_preset(task: str, preset: str | Path) -> Preset:
    """Return what a preset sets, by name or by the path of a YAML file.

    Raises:
        ArgumentError: no such preset, a section of another form, or options of an unknown policy or world model; names
            the file.
        FileError: a file cannot be read, or does not hold a mapping.
    """
    rules: dict[str, Any] = {}
    generator: dict[str, Any] = {}
    policies: dict[str, dict[str, Any]] = {}
    models: dict[str, dict[str, Any]] = {}
    reasons: dict[str, dict[str, Any]] = {}
    policy: str | None = None
    for path in _list_files(task, preset):
        content = _read(path)
        policy = _read_policy(content, path) or policy
        rules |= _drop_header(content)
        generator |= _read_generator_rules(content, path)
        _add_options(policies, _read_options(content, "policies", path, POLICIES))
        _add_options(models, _read_options(content, "models", path, WORLD_MODELS))
        _add_options(reasons, _read_departures(content, path))
    given = {who: {topic: str(why) for topic, why in own.items() if why} for who, own in reasons.items()}
    return Preset(rules, generator, policies, models, policy, given)


def get_options(options: Options, name: str) -> Mapping[str, Any]:
    """Return the options of a part by name, or by `path.py:Class` as seen from here; none if there are none."""
    return options.get(name, options.get(_place_file(name, Path.cwd()), {}))


def list_presets(task: str) -> list[str]:
    """Return the shipped presets of a task, the default first."""
    found = sorted(path.parent.name for path in FOLDER.glob(f"*/{task}.yaml"))
    return sorted(found, key=lambda name: (name != DEFAULT, name != PAPER))


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

    Anything that neither sets is the default of `cls`, so a user's task needs no preset: for a task that ships none,
    the default preset stands for these values.

    Raises:
        ArgumentError: no such preset; an unknown rule; a value of another type. Names the file or argument.
        FileError: the file cannot be read, or does not hold a mapping.
    """
    values: dict[str, Any] = {}
    for path in _list_files(task, preset):
        values |= read_values(cls, _drop_header(_read(path)), str(path), "rule")
    values |= read_values(cls, overrides, f"options of {task}", "rule")
    missing = [field.name for field in _open_fields(cls) if field.name not in values]
    if missing:
        ships = f"; give `base: {DEFAULT}`" if list_presets(task) else f", or give {cls.__name__} defaults"
        raise ArgumentError(f"preset '{preset}' of {task} leaves open {', '.join(missing)}{ships}")
    return cls(**values)


def rule_names(cls: type) -> list[str]:
    """Return the names of the rules that a dataclass declares."""
    return [field.name for field in fields(cls)]


def _open_fields(cls: type) -> list[Field[Any]]:
    """Return the rules that have no default."""
    return [field for field in fields(cls) if field.default is MISSING and field.default_factory is MISSING]


def _list_files(task: str, preset: str | Path) -> list[Path]:
    """Return the files of a preset, those it is based on first."""
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
    return [*_list_files(task, base), path]


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
    there = f"choose from {', '.join(shipped)}, or give" if shipped else "it has none of its own; give"
    raise ArgumentError(
        f"{task}: no preset '{preset}'; {there} the path of a .yaml file.{did_you_mean(str(preset), shipped)}"
    )


def _read(path: Path) -> Mapping[str, Any]:
    return read_yaml_mapping(path, "rules as `name: value` lines")


def _drop_header(content: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in content.items() if name not in HEADER}


def _read_policy(content: Mapping[str, Any], path: Path) -> str | None:
    policy = content.get("policy")
    if not isinstance(policy, str | None):
        raise ArgumentError(f"{path}: policy: expected the name of a policy, see `wiw list policies`, got {policy!r}")
    return policy


def _read_generator_rules(content: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    rules = content.get("generator", {})
    if not isinstance(rules, Mapping):
        raise ArgumentError(f"{path}: generator: expected rules for generated episodes as `name: value`, got {rules!r}")
    return {str(name): value for name, value in rules.items()}


def _read_options(content: Mapping[str, Any], section: str, path: Path, registry: Registry) -> Options:
    """Return a section with options of registered parts, from a separate file where it names one."""
    options = content.get(section, {})
    if isinstance(options, str):
        path = path.parent / options
        options = _read(path)
    if not isinstance(options, Mapping) or not all(isinstance(own, Mapping) for own in options.values()):
        raise ArgumentError(f"{path}: {section}: expected options by name, `NAME: {{option: 0}}`, got {options!r}")
    for name in map(str, options):
        _require_part(name, registry, f"{path}: {section}")
    return {_place_file(str(name), path.parent): own for name, own in options.items()}


def _place_file(name: str, folder: Path) -> str:
    """Return `path.py:Class` with its path made absolute, as seen from a folder; other names as they are."""
    prefix = ISOLATED if name.startswith(ISOLATED) else ""
    path, colon, kind = name.removeprefix(prefix).rpartition(":")
    if not colon or not path.endswith(".py"):
        return name
    return f"{prefix}{(folder / Path(path).expanduser()).resolve()}:{kind}"


def _require_part(name: str, registry: Registry, where: str) -> None:
    """Check that a part is known by its name, or named with its file or module, which are looked at when it is made."""
    path, colon, kind = name.rpartition(":")
    if name in registry.built_in or (colon and path and kind) or name in (known := registry.names()):
        return
    raise ArgumentError(
        f"{where}: no {registry.kind} is named '{name}'; expected path.py:Class or one of "
        f"{', '.join(known)}.{did_you_mean(name, known)}"
    )


def _add_options(known: dict[str, dict[str, Any]], more: Options) -> None:
    for name, options in more.items():
        known[str(name)] = {**known.get(str(name), {}), **options}


def _read_departures(content: Mapping[str, Any], path: Path) -> Options:
    reasons = content.get("departures", {})
    fits = isinstance(reasons, Mapping) and all(
        who in CONCERNS and isinstance(own, Mapping) and all(isinstance(why, str | None) for why in own.values())
        for who, own in reasons.items()
    )
    if not fits:
        raise ArgumentError(
            f"{path}: departures: expected reasons, grouped by whom they concern ({', '.join(CONCERNS)}), such as "
            f"`rules: {{decisions: why}}`, got {reasons!r}"
        )
    return dict(reasons)
