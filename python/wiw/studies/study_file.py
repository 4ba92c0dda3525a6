# SPDX-License-Identifier: Apache-2.0
"""Studies as YAML files: runs, what is compared, and what is plotted. Shipped ones lie in `wiw/configs/studies`.

title: Front view or panorama?       # heading of the page
about: one line for `wiw list studies`
text: what to bear in mind           # a paragraph of the page
variables: {model: warp, episodes: 60}   # stand for {model}, {episodes} below; `wiw study --set NAME=VALUE`
small: {episodes: 4}                 # their values with `--small`
settings: {seed: 0}                  # of all runs, as of `wiw run`: episodes, seed, keep_images, fidelity, ...
runs:
  imagenav:                          # a run: arms on the same episodes of one task
    task: imagenav
    task_options: {scenes: "apartments:val:12", tier: near}
    settings: {episodes: "{episodes}"}
    agent: {policy: matcher}         # what the arms share: fields of `wiw.runs.recipes.AgentRecipe`
    arms:                            # or as for `wiw run --arms`: "none,copy,big=warpnet?weights=big.npz"
      none: {model: none}
      front: {model: "{model}", model_options: {view: perspective}}
      other: {model: "{other}", when: "{other}"}   # left out where `when` is empty
      more: {model_options: {view: panorama}, with: {model_options: "{options}"}}   # `with` is merged with the rest
    compare: [[front, none]]         # further paired differences, the first minus the second
    plots: [success, rollouts, quality]
    quality: {frames: 200}           # options of `wiw.quality`, for the plot of that name
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from wiw.errors import ArgumentError
from wiw.mapping_files import parse_yaml, read_yaml_mapping
from wiw.runs.arm_text import check_arm_name, split_arms
from wiw.runs.config import RunConfig
from wiw.runs.recipes import AgentRecipe, TaskRecipe, absolute, arm_recipes, require_reference
from wiw.suggestions import did_you_mean
from wiw.typed_values import read_values, require_known

FOLDER = Path(__file__).parents[1] / "configs" / "studies"
FUNCTIONS = {"errors": "wiw.study_errors(out, settings)", "data-scaling": "wiw.data_scaling(data, out)"}
"""Studies that are no files but functions, by their names on the command line."""
PLOTS = ("success", "rollouts", "quality")
"""Figures of a run: success by arm; against imagined futures; against quality and controllability."""
_KEYS = ("title", "about", "text", "variables", "small", "settings", "runs")
_RUN_KEYS = ("task", "task_options", "settings", "agent", "arms", "compare", "plots", "quality")
_AGENT_KEYS = tuple(field.name for field in fields(AgentRecipe) if field.name != "observers")
_OWN_SETTINGS = ("out", "resume", "progress", "workers", "shard")
"""Settings of a run that the study decides."""
_VARIABLE = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True)
class _QualityOptions:
    """Options of `wiw.quality` that a study may give."""

    scorers: tuple[str, ...]
    frames: int
    lpips: str | None
    deadline: float


@dataclass(frozen=True)
class StudyRun:
    """One run of a study: arms on the same episodes of a task."""

    name: str
    task: TaskRecipe
    agents: Mapping[str, AgentRecipe]
    """By arm."""
    settings: RunConfig
    compare: tuple[tuple[str, str], ...] = ()
    """Arms, each with the one that it is compared with."""
    plots: tuple[str, ...] = ("success",)
    quality: Mapping[str, Any] | None = None
    """Options of `wiw.quality`; None if it is not asked for."""


@dataclass(frozen=True)
class StudyPlan:
    """A study with its variables filled in."""

    title: str
    text: str
    variables: Mapping[str, Any]
    runs: tuple[StudyRun, ...]
    content: Mapping[str, Any]
    """The file, with the variables filled in."""


def list_studies() -> dict[str, str]:
    """Return what each shipped study says of itself, by name."""
    return {path.stem: str(_read(path).get("about", "")) for path in sorted(FOLDER.glob("*.yaml"))}


def find_study(study: str | Path) -> Path:
    """Return the file of a study, by name or path.

    Raises:
        ArgumentError: no shipped study has that name, and it is no YAML file; or it is a function of its own.
    """
    path = Path(study).expanduser()
    if path.suffix in (".yaml", ".yml"):
        return path
    if call := FUNCTIONS.get(str(study)):
        raise ArgumentError(f"study: '{study}' is a function of its own: call {call} instead")
    known = list_studies()
    if str(study) not in known:
        raise ArgumentError(
            f"study: no study '{study}'; choose from {', '.join(known)}, or give the path of a .yaml "
            f"file.{did_you_mean(str(study), list(known))}"
        )
    return FOLDER / f"{study}.yaml"


def parse_variables(pairs: Sequence[str]) -> dict[str, Any]:
    """Return the variables that NAME=VALUE texts give, their values read as YAML.

    Raises:
        ArgumentError: no "=", no name, a name given twice, or a value that is no YAML.
    """
    found: dict[str, Any] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name.strip() or name.strip() in found:
            raise ArgumentError(f"study: --set: expected NAME=VALUE, each name once, got '{pair}'")
        try:
            found[name.strip()] = parse_yaml(value)
        except (ValueError, yaml.YAMLError) as error:
            raise ArgumentError(f"study: --set: {pair}: the value is not valid YAML ({error})") from None
    return found


def load_study(study: str | Path, variables: Mapping[str, Any] | None = None, small: bool = False) -> StudyPlan:
    """Return a study by name or from a YAML file.

    Args:
        study: name of a shipped one, or path.
        variables: values in place of the file's.
        small: whether to take the file's small values, where `variables` has none.

    Raises:
        ArgumentError: no such study, or a file that says something else than a study can; names the place in it.
        FileError: the file cannot be read, or does not hold a mapping.
    """
    path = find_study(study)
    content = _read(path)
    require_known(content, _KEYS, str(path))
    values = _fill_variables(content, variables or {}, small, str(path))
    filled = {name: _substitute(content.get(name), values, f"{path}: {name}") for name in _KEYS[:3] + _KEYS[5:]}
    runs = _require_mapping(filled["runs"], f"{path}: runs")
    shared = _require_mapping(filled["settings"] or {}, f"{path}: settings")
    for name in runs:
        _require_text(name, f"{path}: runs")
    made = tuple(_read_run(str(name), each, shared, f"{path}: runs: {name}") for name, each in runs.items())
    if not made:
        raise ArgumentError(f"{path}: runs: expected at least one run by name, got none")
    title, text = str(filled["title"] or path.stem), str(filled["text"] or "")
    return StudyPlan(title, text, values, made, {key: value for key, value in filled.items() if value})


def _read(path: Path) -> dict[str, Any]:
    return read_yaml_mapping(path, "a study: title, variables, runs and so on")


def _fill_variables(content: Mapping[str, Any], given: Mapping[str, Any], small: bool, where: str) -> dict[str, Any]:
    """Return the value of each variable: given, else the small one if asked for, else the file's own."""
    own = _require_mapping(content.get("variables") or {}, f"{where}: variables")
    less = _require_mapping(content.get("small") or {}, f"{where}: small")
    for name in own:
        _require_text(name, f"{where}: variables")
    require_known(less, own, f"{where}: small")
    require_known(given, own, "study: --set")
    return {**own, **(less if small else {}), **given}


def _substitute(value: Any, variables: Mapping[str, Any], where: str) -> Any:
    """Return a value of the file with variables in place of their names; a name alone keeps the variable's type."""
    if isinstance(value, Mapping):
        return {name: _substitute(each, variables, f"{where}: {name}") for name, each in value.items()}
    if isinstance(value, list):
        return [_substitute(each, variables, where) for each in value]
    if not isinstance(value, str):
        return value
    require_known(_VARIABLE.findall(value), variables, where)
    whole = _VARIABLE.fullmatch(value)
    return variables[whole[1]] if whole else _VARIABLE.sub(lambda found: str(variables[found[1]]), value)


def _read_run(name: str, content: Any, shared: Mapping[str, Any], where: str) -> StudyRun:
    """Return one run of a study; `shared` are settings of all runs."""
    require_known(_require_mapping(content, where), _RUN_KEYS, where)
    check_arm_name(name, where)
    agents = _read_arms(content.get("arms"), content.get("agent") or {}, where)
    pairs = tuple((str(arm), str(base)) for arm, base in _require_pairs(content.get("compare") or [], where))
    named = content["arms"] if isinstance(content.get("arms"), Mapping) else agents
    pairs = tuple(pair for pair in pairs if all(arm in agents for arm in pair) or _refuse_pair(pair, named, where))
    plots = _require_names(content.get("plots", ["success"]), f"{where}: plots")
    require_known(plots, PLOTS, f"{where}: plots")
    quality = _read_quality(content.get("quality") or {}, plots, f"{where}: quality")
    settings = {**shared, **_require_mapping(content.get("settings") or {}, f"{where}: settings")}
    known = [field.name for field in fields(RunConfig) if field.name not in _OWN_SETTINGS]
    require_known(settings, known, f"{where}: settings")
    settings = read_values(RunConfig, settings, f"{where}: settings")
    if quality is not None and settings.get("keep_images") == 0:
        raise ArgumentError(
            f"{where}: the plot 'quality' scores pictures, of which keep_images: 0 keeps none; leave the setting "
            "out, or omit the plot"
        )
    options = _require_mapping(content.get("task_options") or {}, f"{where}: task_options")
    task = TaskRecipe(str(content.get("task", "imagenav")), dict(options))
    return StudyRun(name, _give_seed(task, settings), agents, RunConfig(**settings), pairs, plots, quality)


def _read_quality(options: Any, plots: Sequence[str], where: str) -> Mapping[str, Any] | None:
    """Return the options of `wiw.quality`, or None where no plot asks for it."""
    values = read_values(_QualityOptions, _require_mapping(options, where), where)
    if values and "quality" not in plots:
        raise ArgumentError(f"{where}: nothing is scored without its plot; add `quality` to plots, or omit the options")
    return values if "quality" in plots else None


def _give_seed(task: TaskRecipe, settings: Mapping[str, Any]) -> TaskRecipe:
    """Return the task with its episodes from the run's seed, as on the command line."""
    seed = {} if settings.get("seed") is None else {"seed": settings["seed"]}
    return TaskRecipe(task.name, {**seed, **task.options}).with_default_seed()


def _read_arms(arms: Any, agent: Any, where: str) -> dict[str, AgentRecipe]:
    """Return the agent of each arm, from a mapping of arms or from text as for `wiw run --arms`."""
    base = _require_mapping(agent, f"{where}: agent")
    if isinstance(arms, str):
        return dict(arm_recipes(_make_agent(base, f"{where}: agent"), split_arms(arms)))  # type: ignore[arg-type]
    found = {}
    for name, own in _require_mapping(arms, f"{where}: arms").items():
        place = f"{where}: arms: {name}"
        _require_text(name, place)
        check_arm_name(str(name), place)
        changes = dict(_require_mapping(own or {}, place))
        if changes.pop("when", True):
            more = _require_mapping(changes.pop("with", None) or {}, f"{place}: with")
            found[str(name)] = require_reference(str(name), _make_agent(_merge(_merge(base, changes), more), place))
    if not found:
        raise ArgumentError(f"{where}: arms: expected at least one, by name or as for `wiw run --arms`, got none")
    return found


def _make_agent(values: Mapping[str, Any], where: str) -> AgentRecipe:
    require_known(values, _AGENT_KEYS, where)
    values = read_values(AgentRecipe, values, where)
    if "policy" not in values:
        raise ArgumentError(f"{where}: expected a policy, here or in `agent`, got none")
    parts = {name: absolute(str(values[name])) for name in ("policy", "model", "reviser") if values.get(name)}
    none = {"model": None} if parts.get("model") == "none" else {}
    return AgentRecipe(**{**values, **parts, **none})


def _merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return both, with mappings that both have merged as well."""
    both = {
        name: _merge(base[name], own) if isinstance(own, Mapping) and isinstance(base.get(name), Mapping) else own
        for name, own in changes.items()
    }
    return {**base, **both}


def _refuse_pair(pair: tuple[str, str], named: Mapping[str, Any], where: str) -> bool:
    """Return False for a pair with an arm that is left out by `when`, of those that the file names.

    Raises:
        ArgumentError: the file names no such arm.
    """
    require_known(pair, named, f"{where}: compare")
    return False


def _require_pairs(value: Any, where: str) -> Sequence[Sequence[Any]]:
    if not isinstance(value, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in value):
        raise ArgumentError(f"{where}: compare: expected pairs of arms, such as [[front, none]], got {value!r}")
    return value


def _require_text(name: Any, where: str) -> None:
    """Refuse a name that YAML reads as something else, such as `no`, `off` or `null`."""
    if name is None or isinstance(name, bool):
        raise ArgumentError(f"{where}: expected a name, got one that YAML reads as {name}; put it in quotes")


def _require_names(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise ArgumentError(f"{where}: expected a list of names, got {value!r}")
    return tuple(value)


def _require_mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ArgumentError(f"{where}: expected `name: value` lines, got {value!r}")
    return value
