# SPDX-License-Identifier: Apache-2.0
"""Recipes that rebuild tasks and agents: in worker processes, and when a run is resumed."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast

from wiw.envs.base import Env
from wiw.errors import ArgumentError
from wiw.experiments.counterparts import is_counterpart
from wiw.experiments.errors.erroneous import require_error
from wiw.experiments.errors.kinds import make_error
from wiw.experiments.placebos import PLACEBOS, require_words
from wiw.loop.agent import Agent
from wiw.loop.agent_spec import AgentSpec, space_option
from wiw.loop.base import BaseAgent
from wiw.loop.config import AgentConfig
from wiw.loop.imagination import Imaginer
from wiw.loop.observers import Observer
from wiw.policies.base import Policy
from wiw.registry import ISOLATED, POLICIES, SEMANTICS, TRACKERS, WORLD_MODELS
from wiw.runs.arm_text import EXAMPLE, ArmText, check_arm_name, parse_arm, split_arms
from wiw.runs.compose import Experiment, RunContext, compose, make_for_space, require_placebo
from wiw.runs.limits import Limits
from wiw.runs.part_options import parse_options
from wiw.runs.ready_parts import require_preset
from wiw.runs.sources import source_digests
from wiw.suggestions import did_you_mean
from wiw.tasks.base import Task
from wiw.tasks.presets import get_options
from wiw.types import PRIMITIVES
from wiw.wire.address_book import find_announcements
from wiw.world_models.base import WorldModel, find_accepts

PLACEBO, PLACEBO_MODEL = "placebo-", "warp"
"""Beginning of the names of placebo arms, and the model that they use where nobody names one."""
RESEEDED = "reseeded"
"""Begins arms that repeat another with other random numbers: the noise floor."""
CHANGES = ("placebo", "error", "reseed")
"""Settings of an agent that make it a control: they change what is done with its world model."""
ERROR, ERROR_MODEL = "error-", "oracle"
"""Beginning of the names of arms with an error, and the model that they use where nobody names one."""
REFERENCES = ("none", "copy", "oracle")
"""Arms that reports know by name: no world model, floor and ceiling."""
REMOTE = "remote:"
"""Beginning of world models that servers compute, before their addresses or the folder that announces them."""
ELSEWHERE = ("vlm", "cache", "prices", "concurrency", "timeout", "attempts", "patience")
"""Options of a policy that change no answer: where and how its language model is asked."""
NO_RESULT = (*(name for name in ELSEWHERE if name != "vlm"), "key", "token")
"""Options that an object need not share with a preset; `vlm` is the server whose model answers."""
NO_LIMITS = Limits()
NOTHING: Mapping[str, Any] = {}


@dataclass(frozen=True)
class TaskRecipe:
    """A task by name and options."""

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)

    def build(self) -> Task:
        """Return the task."""
        from wiw.registry import TASKS

        return cast(Task, TASKS.make(self.name, **self.options))

    def with_default_seed(self) -> TaskRecipe:
        """Return the task with seed 0 where its options have none, if it takes a seed."""
        from wiw.registry import TASKS

        is_open = "seed" not in self.options and _takes_option(TASKS.find(self.name), "seed")
        return replace(self, options={**self.options, "seed": 0}) if is_open else self

    def find_policy(self) -> str:
        """Return the policy that runs the task where nobody names one: the preset's, or else the task's.

        Raises:
            ArgumentError: they name none either; or no such preset.
        """
        from wiw.registry import task_class
        from wiw.tasks.presets import DEFAULT, find_owner, load_preset

        kind = task_class(self.name)
        preset = load_preset(find_owner(kind), self.options.get("preset") or DEFAULT)
        policy = preset.policy or kind.default_policy
        if policy is None:
            raise ArgumentError(
                f"--policy: task '{self.name}' has no default policy; choose one from `wiw list policies`"
            )
        return str(policy)

    def to_json(self) -> dict[str, Any]:
        """Return JSON for the run store, the same in any folder; `TaskRecipe(**...)` is the way back."""
        from wiw.registry import task_class

        return {"name": absolute(self.name), "options": task_class(self.name).make_portable(self.options)}

    def sources(self) -> dict[str, str]:
        """Return digests of the user's own source files, by path."""
        from wiw.registry import TASKS

        return {} if self.name in TASKS.built_in else source_digests(TASKS.find(self.name))


@dataclass(frozen=True)
class AgentRecipe(AgentConfig):
    """An agent by its parts: names (or `path.py:Class`), or objects in memory; with the numbers of `AgentConfig`.

    `wiw.evaluate` takes it wherever it takes an agent. One of names alone can always be sent to worker processes, and
    `wiw resume` can build it again.
    """

    policy: Any
    model: Any = None
    reviser: Any = None
    placebo: str | None = None
    error: str | None = None
    """KIND@DOSE of an error that the world model's futures have (`wiw.experiments.errors`)."""
    imagine_fraction: float | None = None
    model_options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the world model, by name."""
    policy_options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Options of policies, by their names: {"vlm": {"vlm": "http://localhost:8000/v1"}}."""
    ground_truth: Sequence[str] = ()
    """Stages that are given the ground truth (`wiw.experiments.ground_truth`)."""
    semantics: Any = None
    semantics_options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the source of semantics."""
    tracker: Any = None
    """Finds the target in imagined frames, for the policy that revises; None: that policy's own."""
    tracker_options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the tracker."""
    observers: Sequence[Observer] = ()
    """Measure decisions; objects in memory."""
    reseed: int | None = None
    """Number that is mixed into the run's seed for all that policy and model draw; None: the run's seed as it is."""

    def build(self, context: RunContext, limits: Limits = NO_LIMITS) -> Agent:
        """Return the agent; numbers that are open are the task's."""
        space = self.find_space(context.task)
        model: Any = self.model
        if options := self.resolve_model_options(context.task):
            model = make_for_space(self.model, space, limits.deadline, **options)
        semantics = None if self.model is None else self.semantics  # nobody would look at them
        if semantics is not None and self.semantics_options:
            semantics = SEMANTICS.make(self.semantics, **self.semantics_options)
        policy, reviser = self._make_policies(space, context.task)
        experiment = Experiment(self.placebo, self.imagine_fraction, tuple(self.ground_truth), semantics, self.error)
        return compose(
            AgentSpec(policy, model, reviser, self.config, tuple(self.observers)), experiment, limits, context
        )

    def resolve_model_options(self, task: Task) -> dict[str, Any]:
        """Return what the world model is made with on a task: the options of its preset, and on top those given."""
        return {**get_options(task.model_options, str(self.model)), **self.model_options}

    def resolve_policy_options(self, policy: str, task: Task) -> dict[str, Any]:
        """Return what a named policy is made with on a task, likewise."""
        return {**get_options(task.policy_options, policy), **self.policy_options.get(policy, {})}

    @property
    def config(self) -> AgentConfig:
        """The numbers alone."""
        return AgentConfig(**self.numbers)

    def with_model(self, model: Any) -> AgentRecipe:
        """Return the same agent with another world model."""
        if model is self.model or (isinstance(model, str) and model == self.model):
            return self
        none = isinstance(model, str) and model == "none"
        return replace(self, model=None if none else model, model_options={})

    def with_policy(self, policy: str) -> AgentRecipe:
        """Return the same agent with another policy; a privileged counterpart takes the options of its original."""
        if not is_counterpart(policy, self.policy) or self.policy not in self.policy_options:
            return replace(self, policy=policy)
        options = {policy: self.policy_options[self.policy], **self.policy_options}
        return replace(self, policy=policy, policy_options=options)

    def as_placebo(self, kind: str, model: Any = None) -> AgentRecipe:
        """Return the same agent with a placebo of its world model (or of another one)."""
        own = PLACEBO_MODEL if self.model is None else self.model
        return replace(self.with_model(own if model is None else model), placebo=kind)

    def with_error(self, error: str, model: Any = None) -> AgentRecipe:
        """Return the same agent whose world model is the oracle (or another one) with an error."""
        return replace(self.with_model(ERROR_MODEL if model is None else model), error=error)

    @property
    def is_named(self) -> bool:
        """Whether all parts are names, so that any process can make them again."""
        parts = (self.policy, self.model, self.reviser, self.semantics, self.tracker)
        return not self.observers and all(part is None or isinstance(part, str) for part in parts)

    def to_json(self) -> dict[str, Any] | None:
        """Return the recipe for the run store; `AgentRecipe.from_json` is the way back. None with objects in memory."""
        own = self.without_secrets()
        return {name: getattr(own, name) for name in _FIELDS} if self.is_named else None

    def without_secrets(self) -> AgentRecipe:
        """Return the same agent without servers' keys and tokens: records are shown and passed on."""
        policies: dict[str, Any] = dict(self.policy_options)
        for name, own in self.policy_options.items():
            if name == "vlm" or "vlm" in own:
                policies[name] = _leave_out(own, "key")
                if isinstance(roles := own.get("roles"), Mapping):  # anything else is refused by the policy
                    policies[name]["roles"] = {
                        role: _leave_out(each, "key") if isinstance(each, Mapping) else each
                        for role, each in roles.items()
                    }
        named = self.model if isinstance(self.model, str) else ""
        is_own = named in WORLD_MODELS.built_in or named.startswith(REMOTE)  # others may mean something else by it
        options = _leave_out(self.model_options, "token") if is_own else self.model_options
        return replace(self, policy_options=policies, model_options=options)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> AgentRecipe:
        """Return the recipe that a run store keeps."""
        return cls(**{name: value for name, value in data.items() if value is not None})

    def describe(self) -> dict[str, Any]:
        """Return the identity of the agent before it is built: a model is made once, when its turn comes.

        Raises:
            RegistryError: a part is not known, or takes other options.
        """
        policies = [(POLICIES, name, self.policy_options.get(str(name), {})) for name in (self.policy, self.reviser)]
        for registry, part, options in (*policies, (WORLD_MODELS, self.model, self.model_options)):
            if isinstance(part, str):
                registry.fitting(part, **options)
        if isinstance(self.tracker, str):
            TRACKERS.fitting(self.tracker, **self.tracker_options)
        if isinstance(self.semantics, str):
            if self.semantics_options:
                SEMANTICS.fitting(self.semantics, **self.semantics_options)
            else:
                SEMANTICS.find(self.semantics)  # some are made of what an environment tells
        own = self.without_secrets()
        said = {name: _describe(getattr(own, name)) for name in _FIELDS}
        if own.policy_options:
            said["policy_options"] = {
                policy: _leave_out(options, *ELSEWHERE) for policy, options in own.policy_options.items()
            }
        return {name: value for name, value in said.items() if value not in (None, {}, [], ())}

    def sources(self) -> dict[str, str]:
        """Return digests of the user's own source files of all parts, by path."""
        parts = [(WORLD_MODELS, self.model), (POLICIES, self.policy), (POLICIES, self.reviser)]
        parts += [(TRACKERS, self.tracker)]
        parts += [(SEMANTICS, None if self.model is None else self.semantics)]
        found: dict[str, str] = {}
        for registry, part in parts:
            if isinstance(part, str):
                found |= {} if part in registry.built_in else source_digests(registry.find(part))
            elif part is not None:
                found |= source_digests(unwrap(part))
        return found

    def require(self, task: Task, episodes: int) -> None:
        """Require that world model, policies, tracker and placebo are made for a run of so many episodes of a task, and
        those that are objects with the options that its preset has for them.

        Raises:
            ArgumentError: one of them is not.
        """
        require_preset(task, (self.policy, self.reviser), unwrap(self.model), NO_RESULT)
        said = task.describe()
        if (self.tracker or self.tracker_options) and not said.get("categories"):
            raise ArgumentError(
                f"tracker: task '{said.get('task', 'of this run')}' has no target to track; give a tracker only for "
                "task ar"
            )
        if self.placebo is not None:
            require_placebo(self.placebo, self.find_space(task), episodes)
        if self.placebo == "blind" and (control := find_control(self.model)):
            require_words(control)
        if self.error is not None:
            require_error(make_error(self.error), self.find_space(task), _has_simulator(self.model))
        parts = ((WORLD_MODELS, self.model), (POLICIES, self.policy), (POLICIES, self.reviser))
        for registry, part in parts:
            found = registry.find(part) if isinstance(part, str) else part
            kind = found if isinstance(found, type) else type(found)
            if issubclass(kind, WorldModel | Policy):
                found.require(said)

    def replaying(self, run: Path) -> AgentRecipe:
        """Return the same agent with a run's recorded answers in place of its language models."""
        named: dict[str, Mapping[str, Any]] = {name: {} for name in (self.policy, self.reviser) if name == "vlm"}
        options = {
            policy: _replay(own, run) if policy == "vlm" or "vlm" in own else own
            for policy, own in (named | dict(self.policy_options)).items()
        }
        return replace(self, policy_options=options)

    @property
    def arm(self) -> str:
        """Short name of the world model: "none", "warp", the class behind a path, or servers' hosts and ports, or the
        folder in which they announce themselves.
        """
        if self.model is None:
            return "none"
        if not isinstance(self.model, str):
            return (self.model if isinstance(self.model, type) else type(self.model)).__name__.lower()
        kind, scheme, _ = self.model.partition("://")
        hosts = ";".join(address.partition("://")[2] for address in self.model.split(","))
        if scheme:
            return f"{kind.partition(':')[0]}:{hosts}"
        name = self.model.rpartition(":")[2]
        return Path(name).name if self.model.startswith(REMOTE) else name

    def find_space(self, task: Task) -> str:
        """Return the plan space: the agent's own, or the task's."""
        return self.space or task.defaults.get("space") or PRIMITIVES

    def _make_policies(self, space: str, task: Task) -> tuple[Any, Any]:
        """Return policy and reviser (None: the policy's or the task's own); the one that revises has the tracker.

        Raises:
            ArgumentError: there is a tracker, and the policy that revises takes none.
        """
        given = {"tracker": self.tracker, "tracker_options": dict(self.tracker_options)}
        tracker = {name: value for name, value in given.items() if value}
        revising = self._find_reviser(task)
        if not tracker:
            reviser = revising if self._has_own_options(revising, task) else self.reviser
            return self._make_policy(self.policy, space, task), self._make_policy(reviser, space, task)
        if not isinstance(revising, str) or "tracker" not in inspect.signature(POLICIES.find(revising)).parameters:
            raise ArgumentError(
                f"tracker: policy {revising if isinstance(revising, str) else type(revising).__name__} does not use "
                "one; expected a revision policy given by name that looks for a target in imagined frames, such as "
                "vlm or recogniser"
            )
        if revising is self.policy:
            return self._make_policy(revising, space, task, tracker), None
        return self._make_policy(self.policy, space, task), self._make_policy(revising, space, task, tracker)

    def _find_reviser(self, task: Task) -> Any:
        """Return the policy that revises; where none is named, the policy itself if it can, else the task's."""
        if self.reviser is not None:
            return self.reviser
        kind = POLICIES.find(self.policy) if isinstance(self.policy, str) else type(self.policy)
        if isinstance(kind, type) and issubclass(kind, Policy) and kind.score is Policy.score:
            return task.defaults.get("revision") or kind.default_revision
        return self.policy

    def _has_own_options(self, reviser: Any, task: Task) -> bool:
        """Return whether a reviser that nobody has named has options, so that it cannot be made by its bare name."""
        revises = self.model is not None or bool(task.defaults.get("revision"))
        is_default = self.reviser is None and reviser is not self.policy and isinstance(reviser, str)
        return is_default and revises and bool(self.resolve_policy_options(reviser, task))

    def _make_policy(self, policy: Any, space: str, task: Task, more: Mapping[str, Any] = NOTHING) -> Any:
        """Return a policy with the options of its name, the task's and more; others are made with the agent."""
        options = {**self.resolve_policy_options(policy, task), **more} if isinstance(policy, str) else {}
        if not options:
            return policy
        return POLICIES.make(policy, **{**space_option(POLICIES, policy, space), **options})


_FIELDS = tuple(field.name for field in fields(AgentRecipe) if field.name != "observers")


def _takes_option(found: Any, name: str) -> bool:
    """Return whether a class or factory takes an argument of a name; something that is already made takes none."""
    parameters = inspect.signature(found).parameters if callable(found) else {}
    return name in parameters or any(one.kind is one.VAR_KEYWORD for one in parameters.values())


def _replay(options: Mapping[str, Any], run: Path) -> dict[str, Any]:
    """Return a policy's options with a run's recorded answers in place of all models, those of its roles included."""
    replayed = {**options, "vlm": f"replay:{run}", "cache": "off"}
    if roles := options.get("roles"):
        replayed["roles"] = {role: _replay_role(own, options.get("vlm"), run) for role, own in roles.items()}
    return replayed


def _replay_role(own: Mapping[str, Any], main: Any, run: Path) -> dict[str, Any]:
    """Return a role's options. If it has a server of its own, the run's path is spelt differently from the main
    server's, so that the role does not get the options that describe that server.
    """
    if own.get("vlm") in (None, main):
        return _leave_out(own, "vlm")
    return {**own, "vlm": f"replay:{run / 'run.sqlite'}"}


def _leave_out(options: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in options.items() if name not in names}


def unwrap(part: Any) -> Any:
    """Return the model or policy behind everything that wraps it."""
    model = part.model if isinstance(part, Imaginer) else part
    return model.unwrapped if isinstance(model, Policy | WorldModel) else model


def find_control(model: Any) -> str:
    """Return how a world model, or one of that name, is told plans; empty if only the model itself can say."""
    declared = find_accepts(WORLD_MODELS.find(model) if isinstance(model, str) else model)
    return declared.control if declared else ""


def _has_simulator(model: Any) -> bool:
    """Return whether a world model, or one of that name, is given the simulator; of the built-in ones oracle is."""
    declared = find_accepts(WORLD_MODELS.find(model) if isinstance(model, str) else model)
    return model == ERROR_MODEL or (declared is not None and "simulator" in declared.needs)


def _describe(part: Any) -> Any:
    """Return a part's name, or an object's own description."""
    if isinstance(part, Policy | WorldModel | Imaginer):
        return part.describe()
    return part.__name__ if isinstance(part, type) else part


@dataclass(frozen=True)
class TaskInMemory:
    """A task that exists in memory. It reaches worker processes by pickling, and no later process."""

    task: Any

    def build(self) -> Any:
        """Return the task itself."""
        return self.task

    def to_json(self) -> None:
        """Return nothing: an object in memory cannot be written down."""

    def sources(self) -> dict[str, str]:
        """Return digests of the user's own source files, by path."""
        return source_digests(self.task)


@dataclass(frozen=True)
class AgentInMemory:
    """An agent of another method than `wiw.Agent`'s; like a task in memory."""

    agent: BaseAgent
    reseed: None = None

    def build(self, context: RunContext, limits: Limits = NO_LIMITS) -> BaseAgent:
        """Return the agent itself."""
        return self.agent

    def describe(self) -> dict[str, Any]:
        """Return the agent's own description."""
        return dict(self.agent.describe())

    def require(self, task: Task, episodes: int) -> None:
        """Require that parts of a `wiw.Agent` of one's own have the options of the task's preset; of another method,
        nothing.

        Raises:
            ArgumentError: they have not.
        """
        if isinstance(self.agent, Agent):
            require_preset(task, (self.agent.policy, self.agent.reviser), self.agent.model, NO_RESULT)

    def to_json(self) -> None:
        """Return nothing: an object in memory cannot be written down."""

    def sources(self) -> dict[str, str]:
        """Return digests of the user's own source files, by path."""
        return source_digests(self.agent)


def task_recipe(task: Any, options: Mapping[str, Any] | None = None) -> TaskRecipe | TaskInMemory:
    """Return a recipe of a task by name and options, of a task, or of an environment's task.

    Raises:
        ArgumentError: options for a task that is already made; something else than these.
    """
    if isinstance(task, str):
        from wiw.registry import task_name

        return TaskRecipe(task_name(task), dict(options or {}))
    if options:
        raise ArgumentError(f"the task already exists and cannot take {', '.join(options)}; give them to wiw.make")
    if isinstance(task, TaskRecipe):
        return task
    return TaskInMemory(task if isinstance(task, Task) else _task_of(task))


def _task_of(env: Any) -> Task:
    """Return the task of an environment, whatever gymnasium has wrapped around it."""
    import gymnasium

    from wiw.envs import ManipulationVectorEnv, VectorEnv

    bare = env.unwrapped if isinstance(env, gymnasium.Env | gymnasium.vector.VectorEnv) else env
    if isinstance(bare, Env | VectorEnv | ManipulationVectorEnv) and isinstance(bare.task, Task):
        return bare.task
    raise ArgumentError(f"expected a task (wiw.Task), its name, or an environment from wiw.make, got {env!r}")


def agent_recipe(agent: Any) -> AgentRecipe | AgentInMemory:
    """Return a recipe of an agent.

    Raises:
        ArgumentError: it is not an agent.
    """
    if isinstance(agent, AgentRecipe):
        return agent
    if type(agent) is Agent:  # a subclass may decide otherwise, and is taken as it is
        spec = agent.spec
        return AgentRecipe(spec.policy, spec.model, spec.reviser, observers=spec.observers, **spec.config.numbers)
    if isinstance(agent, BaseAgent):
        return AgentInMemory(agent)
    raise ArgumentError(f"expected a wiw.Agent, an AgentRecipe or a BaseAgent, got {type(agent).__name__}")


def arm_recipes(agent: Any, arms: Any) -> dict[str, AgentRecipe | AgentInMemory]:
    """Return the same agent with each of several world models, by arm name; with its own where `arms` is None.

    `arms` are texts (see `wiw.runs.arm_text`) and world models (classes or instances), a mapping of the arms' own
    names to these, or one text as of the command line, such as "none,copy".

    Raises:
        ArgumentError: an arm is named twice, or none is; a name that is empty, has forbidden characters or is a
            reference's; options that are not KEY=VALUE; an agent of another method, which has no world model.
    """
    recipe = agent_recipe(agent)
    if arms is None:
        return {_name_own_arm(agent, recipe): recipe}
    if not isinstance(recipe, AgentRecipe):
        raise ArgumentError(f"arms: {type(agent).__name__} has no world model to replace")
    arms = split_arms(arms) if isinstance(arms, str) else arms
    pairs = arms.items() if isinstance(arms, Mapping) else [(None, model) for model in arms]
    made = [_make_arm(recipe, name, model) for name, model in pairs]
    if len(dict(made)) < max(1, len(made)):
        raise ArgumentError(
            f"arms: expected different world models, got {[name for name, _ in made]}; to run one model as several "
            f"arms, name them: {EXAMPLE}"
        )
    return dict(made)


def _name_own_arm(agent: Any, recipe: AgentRecipe | AgentInMemory) -> str:
    """Return the name of an agent's own model: a recipe's as its user writes it, else its class behind all wrappers."""
    if isinstance(agent, Agent):
        return "none" if agent.model is None else type(agent.model.unwrapped).__name__.lower()
    if not isinstance(recipe, AgentRecipe):
        return "none"
    return _add_changes(recipe.arm, recipe.placebo, recipe.error, recipe.reseed is not None)


def _make_arm(agent: AgentRecipe, name: str | None, model: Any) -> tuple[str, AgentRecipe]:
    """Return name and recipe of an arm."""
    if name is not None:
        check_arm_name(name)
    if isinstance(model, BaseAgent | AgentRecipe | Policy):
        raise ArgumentError(
            f"arms: expected world models, got {type(model).__name__}; give agents runs of their own (wiw.compare)"
        )
    if model is not None and not isinstance(model, str):
        changed = agent.with_model(model)
        return changed.arm if name is None else name, changed
    arm = parse_arm(model or "none")
    if name is not None and arm.name is not None:
        raise ArgumentError(f"arms: '{model}' is named both '{name}' and '{arm.name}'; give one name")
    policy, rest = _split_policy(arm.model)
    repeats, of_model = _split_repeat(rest)
    own = agent if policy is None else agent.with_policy(policy)
    changed = own if of_model is None else _change_model(own, of_model)
    changed = _with_options(replace(changed, reseed=1) if repeats else changed, arm)
    given = arm.name if name is None else name
    name = given or _name_arm(policy, changed.arm if of_model is None else of_model, repeats)
    return name, changed if given is None else require_reference(given, changed)


def require_reference(name: str, agent: AgentRecipe) -> AgentRecipe:
    """Return an arm's agent as it is.

    Raises:
        ArgumentError: the arm has the name of a reference, and the agent another world model, or one that is changed.
    """
    is_changed = any(getattr(agent, name) is not None for name in CHANGES)
    if name in REFERENCES and (agent.arm != name or is_changed):
        raise ArgumentError(
            f"arms: the name '{name}' is reserved for the reference '{name}', got {agent.model}; choose another name"
        )
    return agent


def require_semantics_use(agents: Mapping[str, AgentRecipe | AgentInMemory]) -> None:
    """Check that a source of semantics has a world model to label views for.

    Raises:
        ArgumentError: semantics are named, and no arm has a world model, or every arm's is known to need no labels.
    """
    recipes = [recipe for recipe in agents.values() if isinstance(recipe, AgentRecipe) and recipe.semantics is not None]
    if recipes and all(recipe.model is None for recipe in recipes):
        raise ArgumentError(
            "semantics: labels are for a world model, but no arm has one: give --world-model or leave semantics out"
        )
    if recipes and not any(map(_may_need_labels, recipes)):
        models = ", ".join(dict.fromkeys(str(recipe.model) for recipe in recipes if recipe.model is not None))
        raise ArgumentError(
            f"semantics: labels are for a world model that needs them, but no arm has one: {models} would not look at "
            "them; give one that does, such as pathdreamer, or leave semantics out"
        )


def _may_need_labels(agent: AgentRecipe) -> bool:
    """Return whether an agent's world model may need semantic labels: one that is not built in may say so once made."""
    if agent.model is None or agent.model in REFERENCES:
        return False
    if not isinstance(agent.model, str) or agent.model not in WORLD_MODELS.built_in:
        return True
    declared = find_accepts(WORLD_MODELS.find(agent.model))
    return declared is None or "semantic" in declared.needs


def _change_model(agent: AgentRecipe, text: str) -> AgentRecipe:
    """Return the agent with the world model of an arm, or with a placebo or an error of it."""
    kind, named = placebo_of(text)
    if kind is not None:
        return agent.as_placebo(kind, named)
    error, named = error_of(text)
    return agent.with_model(text) if error is None else agent.with_error(error, named)


def _with_options(agent: AgentRecipe, arm: ArmText) -> AgentRecipe:
    """Return the agent whose world model takes an arm's options besides those that it has.

    Raises:
        ArgumentError: there is no world model that could take them.
    """
    if not arm.options:
        return agent
    if not isinstance(agent.model, str):
        raise ArgumentError(f"arms: '{arm}' has options but no named world model to take them")
    options = parse_options(arm.options, WORLD_MODELS.find(agent.model), f"arms: '{arm}'")
    return replace(agent, model_options={**agent.model_options, **options})


def make_arm_absolute(text: str) -> str:
    """Return an arm's text with the path of its model made absolute."""
    arm = parse_arm(text)
    policy, model = _split_policy(arm.model)
    return str(replace(arm, model=f"{f'{policy}+' if policy else ''}{absolute(model)}"))


def _split_repeat(model: str) -> tuple[bool, str | None]:
    """Return whether an arm repeats another with other random numbers, and the model; None for the agent's own."""
    if model == RESEEDED:
        return True, None
    repeats = model.startswith(f"{RESEEDED}:")
    return repeats, model.removeprefix(f"{RESEEDED}:") if repeats else model


def _split_policy(name: str) -> tuple[str | None, str]:
    """Return policy (None: the agent's own) and world model of "oracle" or "heuristic+oracle".

    Raises:
        ArgumentError: a known world model is preceded by a name that is no policy's.
    """
    policy, plus, model = name.partition("+")
    if plus and policy in POLICIES.names():
        return policy, model
    if plus and not {":", "/"} & {*policy} and model in WORLD_MODELS.names():
        known = POLICIES.names()
        hint = did_you_mean(policy, known)
        raise ArgumentError(f"arms: '{name}': no policy is named '{policy}'.{hint} Known: {', '.join(known)}")
    return None, name


def _name_arm(policy: str | None, model: str, repeats: bool) -> str:
    kind, named = placebo_of(model)
    error, named = (None, named) if kind is not None else error_of(model)
    short = AgentRecipe("", None if named in ("none", None) else named).arm
    short = _add_changes(short if named else "", kind, error, repeats)
    return short if policy is None else policy if model == "none" and not repeats else f"{policy}+{short}"


def _add_changes(model: str, placebo: str | None, error: str | None, repeats: bool) -> str:
    """Return an arm's name: a model's, with what is done to the model in front; an empty one is left out."""
    changes = [RESEEDED] if repeats else []
    changes += [] if placebo is None else [f"{PLACEBO}{placebo}"]
    changes += [] if error is None else [f"{ERROR}{error}"]
    return ":".join([*changes, *([model] if model else [])])


def placebo_of(arm: str) -> tuple[str | None, str | None]:
    """Return kind and model of "placebo-shuffled:oracle"; no model where it names none, no kind for another arm.

    Raises:
        ArgumentError: an unknown kind of placebo.
    """
    if not arm.startswith(PLACEBO):
        return None, arm
    kind, _, model = arm.removeprefix(PLACEBO).partition(":")
    if kind not in PLACEBOS or model == "none":
        known = " or ".join(f"{PLACEBO}{name}[:MODEL]" for name in PLACEBOS)
        raise ArgumentError(f"arms: expected {known}, of a world model, got '{arm}'")
    return kind, model or None


def error_of(arm: str) -> tuple[str | None, str | None]:
    """Return error and model of "error-blur@16:warp"; no model where it names none, no error for another arm.

    Raises:
        ArgumentError: an unknown kind of error, or a dose out of range.
    """
    if not arm.startswith(ERROR):
        return None, arm
    text, _, model = arm.removeprefix(ERROR).partition(":")
    if model == "none":
        raise ArgumentError(f"arms: expected {ERROR}KIND@DOSE[:MODEL], of a world model, got '{arm}'")
    return str(make_error(text)), model or None


def absolute(model: str) -> str:
    """`path.py:Class` and `remote:FOLDER` with their paths made absolute, so that they mean the same in any folder;
    other names as they are.
    """
    if model.startswith(REMOTE):
        folder = find_announcements(model.removeprefix(REMOTE))
        return model if folder is None else f"{REMOTE}{folder}"
    if model.startswith(ISOLATED):
        return f"{ISOLATED}{absolute(model.removeprefix(ISOLATED))}"
    repeats, named = _split_repeat(model)
    if repeats:
        return model if named is None else f"{RESEEDED}:{absolute(named)}"
    kind, named = placebo_of(model)
    if kind is not None and named is not None:
        return f"{PLACEBO}{kind}:{absolute(named)}"
    error, named = error_of(model)
    if error is not None:
        return f"{ERROR}{error}{f':{absolute(named)}' if named else ''}"
    path, colon, name = model.rpartition(":")
    return f"{Path(path).expanduser().resolve()}:{name}" if colon and path.endswith(".py") else model
