# SPDX-License-Identifier: Apache-2.0
"""Where a run departs from the paper's protocol, so that no number is set beside the paper's by mistake."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from wiw.loop.config import AgentConfig
from wiw.mapping_files import read_yaml_mapping
from wiw.policies.vlm.prompt_import.importer import CARD
from wiw.policies.vlm.prompts.templates import DEFAULT, SETS, Prompts
from wiw.registry import POLICIES, WORLD_MODELS, Registry
from wiw.runs.ready_parts import read_options, same_value
from wiw.runs.recipes import ELSEWHERE, REFERENCES, AgentRecipe, find_control, unwrap
from wiw.tasks import presets
from wiw.tasks.base import Task
from wiw.tasks.presets import PAPER, Preset

EPISODES = {
    "ar": (551, "Matterport3D"),
    "imagenav": (144, "HM3D"),
    "aeqa": (184, "HM3D"),
    "manipulation": (200, "RLBench"),
}
"""Episodes of the paper's tasks, and where they take place."""
POLICY_NAMES = {
    "ar": ("vlm", "heuristic"),
    "imagenav": ("vlm", "heuristic"),
    "aeqa": ("vlm",),
    "manipulation": ("vlm", "diffuser"),
}
"""The paper's base policies."""
REVISER = "vlm"
"""The paper's revision policy."""
SILENT = ("temperature", "revision_temperature", "tries")
"""Options of it that the paper does not name."""
SERVED = "they are its server's; whether they are the preset's is unknown"
UNCOUNTED = (*ELSEWHERE, "key", "model", "prompts", "task", "space")
"""Options of policy `vlm` that are not part of the protocol, or are looked at by themselves."""


@dataclass(frozen=True)
class Departure:
    """One thing that differs from the paper's protocol."""

    topic: str
    found: str = ""
    """The run's value beside the paper's; empty for what is not a setting."""
    reason: str = ""

    @property
    def short(self) -> str:
        """Topic and values."""
        return f"{self.topic} {self.found}" if self.found else self.topic

    def __str__(self) -> str:
        return f"{self.short}: {self.reason}" if self.reason else self.short


def find_departures(task: Task, agents: Mapping[str, Any], episodes: int | None = None) -> tuple[Departure, ...]:
    """Return where a run of these agents departs from the paper; nothing for a task that is none of the paper's.

    Args:
        task: as built.
        agents: recipes by arm.
        episodes: of the run; None means as many as the task has by default.

    Raises:
        PromptError: a prompt folder that cannot be used.
    """
    if task.name not in EPISODES:
        return ()
    own = [recipe for recipe in agents.values() if isinstance(recipe, AgentRecipe)]
    recipes = [named.without_secrets() for recipe in own for named in _name_objects(task, recipe)]
    paper = _load_protocol(task, recipes)
    count = task.default_episodes if episodes is None else episodes
    found = [*_compare_rules(task, paper), *_compare_episodes(task, count)]
    found += [Departure("agent", "of another method")] if len(own) < len(agents) else []
    for recipe in recipes:
        found += [*_compare_agent(task, recipe), *_compare_vlm(task, recipe, paper), *_compare_model(task, recipe)]
    settings = {*paper.rules, *_get_vlm_defaults()}  # a reason for one counts where its value is another
    for who in _list_concerned(recipes):
        reasons = task.departures.get(who, {})
        found += [Departure(topic, "", why) for topic, why in reasons.items() if topic not in settings]
    return tuple(dict.fromkeys(found))


def describe_departures(task: Task, agents: Mapping[str, Any], episodes: int) -> list[dict[str, str]]:
    """Return the departures of a run of so many episodes for its manifest."""
    return [asdict(departure) for departure in find_departures(task, agents, episodes)]


def read_departures(manifest: Mapping[str, Any]) -> tuple[Departure, ...]:
    """Return the departures that a run's manifest names; none for a run from before they were recorded."""
    return tuple(Departure(each["topic"], each["found"], each["reason"]) for each in manifest.get("departures", ()))


def _name_objects(task: Task, recipe: AgentRecipe) -> Iterator[AgentRecipe]:
    """Yield the agent with names and options in place of the objects that have a name: once, or once for the policy and
    once for the reviser where both are the same one with other options.
    """
    recipe = _name_model(task, recipe)
    parts = (recipe.policy, recipe.reviser)
    names = [part if part is None or isinstance(part, str) else _find_name(POLICIES, part) or part for part in parts]
    named = replace(recipe, policy=names[0], reviser=names[1])
    read = [
        {name: _read_policy(task, part)} if isinstance(name, str) and not isinstance(part, str) else {}
        for name, part in zip(names, parts, strict=True)
    ]
    is_one = isinstance(names[0], str) and isinstance(names[1], str) and names[0] == names[1]
    for options in read if is_one else [{**read[0], **read[1]}]:
        yield replace(named, policy_options={**recipe.policy_options, **options})


def _name_model(task: Task, recipe: AgentRecipe) -> AgentRecipe:
    """Return the agent with name and options in place of a world model that is an object and has a name."""
    model = unwrap(recipe.model)
    name = "" if model is None or isinstance(model, str) else _find_name(WORLD_MODELS, model)
    if not name:
        return recipe
    return replace(
        recipe,
        model=name,
        model_options=read_options(WORLD_MODELS, model, presets.get_options(task.model_options, name)),
    )


def _find_name(registry: Registry, part: Any) -> str:
    """Return the name of an object of wiw; empty for one of a user's, which says itself what it is."""
    name = registry.find_name(part)
    return "" if not name or registry.is_foreign(name) else name


def _read_policy(task: Task, policy: Any) -> dict[str, Any]:
    """Return the options of a policy that is an object and has a name."""
    name = POLICIES.find_name(policy)
    paper = presets.load_preset(presets.find_owner(type(task)), PAPER).policies
    names = [
        *presets.get_options(task.policy_options, name),
        *paper.get(name, {}),
        *(("prompts", *SILENT) if name == "vlm" else ()),
    ]
    options = read_options(POLICIES, policy, names)
    used = getattr(policy, "prompts", None)
    return {**options, "prompts": used.source} if isinstance(used, Prompts) else options


def _load_protocol(task: Task, recipes: list[AgentRecipe]) -> Preset:
    """Return the paper's preset of a task; it has one of its own for the diffusion policy."""
    owner, diffusion = presets.find_owner(type(task)), f"{PAPER}-diffusion"
    diffuses = any(recipe.policy == "diffuser" for recipe in recipes) and diffusion in presets.list_presets(owner)
    return presets.load_preset(owner, diffusion if diffuses else PAPER)


def _get_vlm_defaults() -> dict[str, Any]:
    return {name: each.default for name, each in inspect.signature(POLICIES.find("vlm")).parameters.items()}


def _list_concerned(recipes: list[AgentRecipe]) -> Iterator[str]:
    """Yield whom of `presets.CONCERNS` these agents are."""
    yield "rules"
    if any(_asks_vlm(recipe) for recipe in recipes):
        yield "vlm"
    models = [recipe.model for recipe in recipes if recipe.model is not None and recipe.model not in REFERENCES]
    if models:
        yield "models"
    if any(find_control(model) == "text" for model in models):
        yield "text models"


def _asks_vlm(recipe: AgentRecipe) -> bool:
    return "vlm" in (recipe.policy, recipe.reviser)


def _compare_rules(task: Task, paper: Preset) -> Iterator[Departure]:
    said, reasons, preset = task.describe(), task.departures.get("rules", {}), task.preset_settings.rules
    for name, value in paper.rules.items():
        ours = said.get(name)
        if ours != value:  # the preset's reason is for its own value
            yield _differ(name, ours, value, reasons if ours == preset.get(name) else {})


def _compare_episodes(task: Task, count: int) -> Iterator[Departure]:
    wanted, place = EPISODES[task.name]
    file, scenes = task.describe().get("episode_file"), task.describe().get("scenes")
    if file is None and task.name != "manipulation":
        tier = task.describe().get("generator", {}).get("tier")
        where = f"{scenes}, tier {tier}" if tier else scenes
        yield Departure("episodes", f"generated in {where} (paper: {wanted} of {place})")
    elif count != wanted:
        found = count if file is None else f"{count} of {Path(file).name}"
        yield Departure("episodes", f"{found} (paper: {wanted} of {place})")


def _compare_agent(task: Task, recipe: AgentRecipe) -> Iterator[Departure]:
    ours, theirs = (config.resolve(task.defaults).complete().describe() for config in (recipe.config, AgentConfig()))
    for name, value in theirs.items():
        if ours.get(name) != value and not (name == "width" and ours["depth"] == 1):
            yield _differ(name, ours.get(name), value, {})
    names = POLICY_NAMES[task.name]
    policy = recipe.policy if isinstance(recipe.policy, str) else type(recipe.policy).__name__
    if policy not in names:
        yield Departure("policy", f"{policy} (paper: {', '.join(names)})")
    elif recipe.model is not None and (recipe.reviser or policy) != REVISER:
        yield Departure("revision", f"{recipe.reviser or task.defaults.get('revision', policy)} (paper: {REVISER})")


def _compare_vlm(task: Task, recipe: AgentRecipe, paper: Preset) -> Iterator[Departure]:
    """Yield the options of policy `vlm` that are others than the paper's, or than their defaults where it is silent."""
    if not _asks_vlm(recipe):
        return
    ours, reasons = recipe.resolve_policy_options("vlm", task), task.departures.get("vlm", {})
    ours |= {"tracker": recipe.tracker} if recipe.tracker else {}
    defaults = _get_vlm_defaults()
    theirs = {**defaults, **dict.fromkeys(SILENT), **paper.policies.get("vlm", {})}
    for name in dict.fromkeys([*paper.policies.get("vlm", {}), *ours]):
        usual = defaults.get(name) if theirs.get(name) is None else theirs[name]
        if name not in UNCOUNTED and (value := ours.get(name, defaults.get(name))) != usual:
            is_presets = value == task.policy_options.get("vlm", {}).get(name, defaults.get(name))
            yield _differ(name, value, theirs.get(name), reasons if is_presets else {})
    yield from _compare_prompts(ours.get("prompts"), task.name, reasons.get("prompts", ""))


def _compare_model(task: Task, recipe: AgentRecipe) -> Iterator[Departure]:
    """Yield options of the world model that a preset sets and the run has otherwise, and how often it is asked."""
    theirs = presets.get_options(task.model_options, str(recipe.model))
    for name, value in recipe.model_options.items():
        if name in theirs and name != "weights" and not same_value(value, theirs[name]):
            yield Departure(f"{recipe.model} {name}", f"{value} (preset: {theirs[name]})")
    if str(recipe.model).startswith("remote:") and task.model_options:
        yield Departure("options of a served world model", "", SERVED)
    if recipe.imagine_fraction not in (None, 1):
        yield Departure("decisions with a world model", f"a share of {recipe.imagine_fraction} (paper: all)")


def _compare_prompts(prompts: Any, task: str, reason: str) -> Iterator[Departure]:
    """Yield prompts other than those that were imported for a task, and are as they were then."""
    own, remark = str(prompts or DEFAULT), ""
    digest = Prompts(own).digest
    if own not in SETS and (Path(own) / CARD).is_file():
        card = read_yaml_mapping(Path(own) / CARD, "where each prompt came from")
        if not any(str(name).startswith(f"{task}/") for name in card.get("imported", ())):
            remark = f", of whose source none is for {task}"
        elif card.get("digest") != digest:
            remark = ", changed since they were imported"
        else:
            return
    yield Departure("prompts", f"{own}{remark} (paper: its own)", reason)


def _differ(topic: str, ours: Any, theirs: Any, reasons: Mapping[str, str]) -> Departure:
    found, wanted = ("open" if value is None else value for value in (ours, theirs))
    return Departure(topic, f"{found} (paper: {wanted})", reasons.get(topic, ""))
