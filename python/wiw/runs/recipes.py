# SPDX-License-Identifier: Apache-2.0
"""How tasks and agents are made again: in worker processes, and when a run is resumed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from wiw.envs.base import Env
from wiw.errors import ArgumentError
from wiw.runs.sources import source_digests
from wiw.tasks.base import Task

NUMBERS = ("candidates", "horizon", "execute", "depth", "width")
"""Of an agent; where it leaves one open, the task's own is taken."""

PLACEBO, PLACEBO_MODEL = "placebo-", "warp"
"""What arms of placebos begin with, and the model that they are of where nobody names one."""
ELSEWHERE = ("vlm", "cache", "prices", "concurrency", "timeout", "attempts")
"""Options of a policy that change no answer: where and how its language model is asked."""
NO_LIMITS: Mapping[str, Any] = {}


@dataclass(frozen=True)
class TaskRecipe:
    """A task by name and options."""

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)

    def build(self) -> Task:
        """Return the task."""
        from wiw.registry import TASKS

        return cast(Task, TASKS.make(self.name, **self.options))

    def to_json(self) -> dict[str, Any]:
        """For the run store, the same in any folder; `TaskRecipe(**...)` is the way back."""
        from wiw.registry import task_class

        return {"name": absolute(self.name), "options": task_class(self.name).make_portable(self.options)}

    def sources(self) -> dict[str, str]:
        """Digests of the user's own source files, by path."""
        from wiw.registry import TASKS

        return {} if self.name in TASKS.built_in else source_digests(TASKS.find(self.name))


@dataclass(frozen=True)
class AgentRecipe:
    """An agent by the names (or `path.py:Class`) of its parts; see `wiw.Agent` for the rest.

    `wiw.evaluate` takes it wherever it takes an agent. Unlike an agent in memory it can always be sent to worker
    processes, and `wiw resume` can build it again.
    """

    policy: str
    model: str | None = None
    revision: str | None = None
    candidates: int | None = None
    horizon: int | None = None
    execute: int | None = None
    depth: int | None = None
    width: int | None = None
    placebo: str | None = None
    pool: int | None = None
    imagine_fraction: float | None = None
    model_options: Mapping[str, Any] = field(default_factory=dict)
    """What the world model is made with, by name."""
    policy_options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Of policies, by their names: {"vlm": {"vlm": "http://localhost:8000/v1"}}."""
    swaps: Sequence[str] | None = None
    semantics: str | None = None
    semantics_options: Mapping[str, Any] = field(default_factory=dict)
    """What the source of semantics is made with."""

    def __post_init__(self) -> None:
        for name in (name for name in NUMBERS if name != "execute"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ArgumentError(f"agent: expected {name} of at least 1, got {value}")

    def build(self, defaults: Mapping[str, Any], limits: Mapping[str, Any] = NO_LIMITS) -> Any:
        """The agent; what is None is taken from the task's defaults (M, L and the executed primitives).

        `limits` are what a run gives every agent beyond its identity: deadline, cache, fidelity and the like.
        """
        from wiw.loop.agent import Agent
        from wiw.loop.attempts import DEADLINE, make_model
        from wiw.registry import POLICIES, SEMANTICS

        given = {name: value for name, value in asdict(self).items() if value is not None}
        options = given.pop("model_options")
        if options:
            given["model"] = make_model(self.model, limits.get("deadline", DEADLINE), **options)
        semantics = given.pop("semantics_options")
        if self.model is None:  # nobody would look at them
            given.pop("semantics", None)
        elif semantics:
            given["semantics"] = SEMANTICS.make(self.semantics, **semantics)
        made = {name: POLICIES.make(name, **own) for name, own in given.pop("policy_options").items()}
        for part in ("policy", "revision"):
            given |= {part: made[given[part]]} if given.get(part) in made else {}
        space = {"space": defaults["space"]} if "space" in defaults else {}
        return Agent(**given, **space, **limits).settled(defaults)

    def with_model(self, model: str) -> AgentRecipe:
        """The same agent with another world model."""
        if model == self.model:
            return self
        return replace(self, model=None if model == "none" else model, model_options={})

    def as_placebo(self, kind: str, model: str | None = None) -> AgentRecipe:
        """The same agent, whose world model (or another one) imagines something else than the plans."""
        return replace(self.with_model(model or self.model or PLACEBO_MODEL), placebo=kind)

    def to_json(self) -> dict[str, Any]:
        """For the run store; `AgentRecipe(**...)` is the way back."""
        return asdict(self)

    def describe(self) -> dict[str, Any]:
        """Identity of the agent before it is built: a model is made once, when its turn comes.

        Raises:
            RegistryError: a part is not known, or takes other options.
        """
        from wiw.registry import POLICIES, SEMANTICS, WORLD_MODELS

        policies = [(POLICIES, name, self.policy_options.get(str(name), {})) for name in (self.policy, self.revision)]
        for registry, name, options in (*policies, (WORLD_MODELS, self.model, self.model_options)):
            if name is not None:
                registry.fitting(name, **options)
        if self.semantics_options:
            SEMANTICS.fitting(self.semantics, **self.semantics_options)
        elif self.semantics is not None:
            SEMANTICS.find(self.semantics)  # some are made of what an environment tells
        said = {name: value for name, value in asdict(self).items() if value not in (None, {})}
        if self.policy_options:
            said["policy_options"] = {
                policy: {name: value for name, value in options.items() if name not in ELSEWHERE}
                for policy, options in self.policy_options.items()
            }
        return said

    def sources(self) -> dict[str, str]:
        """Digests of the user's own source files of model, policies and source of semantics, by path."""
        from wiw.registry import POLICIES, SEMANTICS, WORLD_MODELS

        parts = [(WORLD_MODELS, self.model), (POLICIES, self.policy), (POLICIES, self.revision)]
        parts += [(SEMANTICS, None if self.model is None else self.semantics)]
        found: dict[str, str] = {}
        for registry, name in parts:
            if name is not None and name not in registry.built_in:
                found |= source_digests(registry.find(name))
        return found

    def require(self, task: Mapping[str, Any]) -> None:
        """Sees that the world model is made for a task that describes itself so.

        Raises:
            ArgumentError: it is not.
        """
        from wiw.registry import WORLD_MODELS

        _require(None if self.model is None else WORLD_MODELS.find(self.model), task)

    def replaying(self, run: Path) -> AgentRecipe:
        """The same agent with the answers that a run has recorded in the place of its language model."""
        replay = {"vlm": f"replay:{run}", "cache": "off"}
        named: dict[str, Mapping[str, Any]] = {name: {} for name in (self.policy, self.revision) if name == "vlm"}
        options = {
            policy: {**given, **(replay if policy == "vlm" or "vlm" in given else {})}
            for policy, given in (named | dict(self.policy_options)).items()
        }
        return replace(self, policy_options=options)

    @property
    def arm(self) -> str:
        """Short name of the world model: "none", "warp", the class behind a path, or a server's host and port."""
        if self.model is None:
            return "none"
        kind, scheme, host = self.model.partition("://")
        return f"{kind.partition(':')[0]}:{host}" if scheme else self.model.rpartition(":")[2]


def _require(model: Any, task: Mapping[str, Any]) -> None:
    """Asks a world model, or its class; a factory tells nothing before it is called."""
    if model is not None and hasattr(model, "require"):
        model.require(task)


@dataclass(frozen=True)
class Ready:
    """A task or an agent that exists in memory. It reaches worker processes by pickling, and no later process."""

    thing: Any

    def build(self, *_: Any) -> Any:
        """The thing itself."""
        return self.thing

    def describe(self) -> dict[str, Any]:
        """What the thing says of itself."""
        return dict(self.thing.describe())

    def require(self, task: Mapping[str, Any]) -> None:
        """See `AgentRecipe.require`."""
        _require(getattr(self.thing, "model", None), task)

    def to_json(self) -> None:
        """Nothing: an object in memory cannot be written down."""

    def sources(self) -> dict[str, str]:
        """Digests of the user's own source files, by path."""
        return source_digests(self.thing)


@dataclass(frozen=True)
class ReadyAgent(Ready):
    """A `wiw.Agent` in memory; what it leaves open is the task's."""

    def build(self, defaults: Mapping[str, Any], limits: Mapping[str, Any] = NO_LIMITS) -> Any:
        """The agent with the task's numbers where it has none of its own, under the run's limits."""
        return self.thing.but(**limits).settled(defaults)

    def describe(self) -> dict[str, Any]:
        """What the agent says of itself, less the numbers that it leaves open."""
        said, given = self.thing.describe(), self.thing.given
        return {name: value for name, value in said.items() if name not in NUMBERS or name in given}

    def sources(self) -> dict[str, str]:
        """Digests of the user's own source files of model, policies and source of semantics, by path."""
        agent, found = self.thing, dict[str, str]()
        for part in (agent.model, agent.policy, agent.revision, agent.semantics):
            found |= {} if part is None or isinstance(part, str) else source_digests(part)
        return found


def task_recipe(task: Any, options: Mapping[str, Any] | None = None) -> TaskRecipe | Ready:
    """Return a recipe of a task by name and options, of a task, or of an environment's task.

    Raises:
        ArgumentError: options for a task that is already made; something else than these.
    """
    if isinstance(task, str):
        from wiw.registry import task_name

        return TaskRecipe(task_name(task), dict(options or {}))
    if options:
        raise ArgumentError(f"the task is made already and cannot take {', '.join(options)}; give them to wiw.make")
    if isinstance(task, TaskRecipe):
        return task
    return Ready(task if isinstance(task, Task) else _task_of(task))


def _task_of(env: Any) -> Task:
    """Return the task of an environment, whatever gymnasium has wrapped around it."""
    import gymnasium

    from wiw.envs import ManipulationVectorEnv, VectorEnv

    bare = env.unwrapped if isinstance(env, gymnasium.Env | gymnasium.vector.VectorEnv) else env
    if isinstance(bare, Env | VectorEnv | ManipulationVectorEnv) and isinstance(bare.task, Task):
        return bare.task
    raise ArgumentError(f"expected a task (wiw.Task), the name of one, or an environment of wiw.make, got {env!r}")


def agent_recipe(agent: Any) -> AgentRecipe | Ready:
    """A recipe of an agent."""
    from wiw.loop.agent import Agent

    return agent if isinstance(agent, AgentRecipe) else ReadyAgent(agent) if isinstance(agent, Agent) else Ready(agent)


def arm_recipes(agent: Any, arms: Any) -> dict[str, AgentRecipe | Ready]:
    """The same agent with each of several world models, by arm name; with the model it has where `arms` is None.

    `arms` are names and world models (classes or instances), or a mapping of the arms' own names to these.

    Raises:
        ArgumentError: an arm is named twice, or none is; a world model in memory for an `AgentRecipe`.
    """
    if arms is None:
        return {_own_arm(agent): agent_recipe(agent)}
    given = arms.items() if isinstance(arms, Mapping) else [(None, model) for model in arms]
    pairs = [_arm(agent, name, model) for name, model in given]
    made = dict(pairs)
    if len(made) < max(1, len(pairs)):
        raise ArgumentError(f"arms: expected different world models, got {[name for name, _ in pairs]}")
    return made


def _arm(agent: Any, name: str | None, model: Any) -> tuple[str, AgentRecipe | Ready]:
    """Name and recipe of an arm."""
    if _is_in_memory(model):
        if isinstance(agent, AgentRecipe):
            raise ArgumentError(
                f"arms: a recipe's world models go by name or path.py:Class, got {model!r}; evaluate a wiw.Agent"
            )
        changed = agent.but(model=model)
        return name or _own_arm(changed), ReadyAgent(changed)
    policy, kind = _parts("none" if model is None else str(model))
    with_policy = _with_policy(agent, policy)
    return name or _arm_name(policy, kind), _with_model(with_policy, kind, getattr(agent, "model", None))


def _is_in_memory(model: Any) -> bool:
    """Whether a world model is given itself, or its class."""
    from wiw.world_models.base import WorldModel

    return isinstance(model, WorldModel) or (isinstance(model, type) and issubclass(model, WorldModel))


def _parts(name: str) -> tuple[str | None, str]:
    """Policy (None: the agent's own) and world model of "oracle" or "heuristic+oracle"."""
    from wiw.registry import POLICIES

    policy, plus, model = name.partition("+")
    return (policy, model) if plus and policy in POLICIES.names() else (None, name)


def _arm_name(policy: str | None, model: str) -> str:
    kind, named = placebo_of(model)
    short = AgentRecipe("", None if named in ("none", None) else named).arm
    if kind is not None:
        short = f"{PLACEBO}{kind}{f':{short}' if named else ''}"
    return short if policy is None else policy if model == "none" else f"{policy}+{short}"


def _with_policy(agent: Any, policy: str | None) -> Any:
    if policy is None:
        return agent
    if isinstance(agent, AgentRecipe):
        return replace(agent, policy=policy)
    return agent.but(policy=policy, model=None, revision=None)


def _own_arm(agent: Any) -> str:
    if isinstance(agent, AgentRecipe):
        return agent.arm
    model = getattr(agent, "model", None)
    return "none" if model is None else type(model).__name__.lower()


def _with_model(agent: Any, model: str, own: Any) -> AgentRecipe | ReadyAgent:
    kind, named = placebo_of(model)
    if isinstance(agent, AgentRecipe):
        return agent.with_model(model) if kind is None else agent.as_placebo(kind, named)
    if kind is not None:
        return ReadyAgent(agent.but(model=named or own or PLACEBO_MODEL, placebo=kind))
    return ReadyAgent(agent.but(model=None if model == "none" else model))


def placebo_of(arm: str) -> tuple[str | None, str | None]:
    """Kind and model of "placebo-shuffled:oracle"; no model where it names none, no kind for another arm.

    Raises:
        ArgumentError: an unknown kind of placebo.
    """
    from wiw.loop.placebo import PLACEBOS

    if not arm.startswith(PLACEBO):
        return None, arm
    kind, _, model = arm.removeprefix(PLACEBO).partition(":")
    if kind not in PLACEBOS or model == "none":
        known = " or ".join(f"{PLACEBO}{name}[:MODEL]" for name in PLACEBOS)
        raise ArgumentError(f"arms: expected {known}, of a world model, got '{arm}'")
    return kind, model or None


def absolute(model: str) -> str:
    """`path.py:Class` with its path made absolute, so that it means the same in any folder; other names as they are."""
    kind, named = placebo_of(model)
    if kind is not None and named is not None:
        return f"{PLACEBO}{kind}:{absolute(named)}"
    path, colon, name = model.rpartition(":")
    return f"{Path(path).expanduser().resolve()}:{name}" if colon and path.endswith(".py") else model
