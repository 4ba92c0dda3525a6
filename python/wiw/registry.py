# SPDX-License-Identifier: Apache-2.0
"""A small registry that finds world models, policies and so on by name, by entry point, or by path.

wiw.world_model("warp")                  python/wiw/world_models/warp.py  (its class is named in `WORLD_MODELS`)
wiw.world_model("remote:ws://HOST:1234") what follows the name is its first argument, for those that end with a colon
wiw.world_model("mine")                  entry point group "wiw.world_models"
wiw.world_model("model.py:MyModel")      a class in a file
wiw.world_model("mypkg.models:MyModel")  a class in an importable module
wiw.world_model(MyModel)                 the class itself, or an instance
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from hashlib import blake2b
from importlib.machinery import SourceFileLoader
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from wiw.errors import (
    ArgumentError,
    ConstructionError,
    Error,
    RegistryError,
    describe_exception,
    is_stop_request,
    read_text,
)
from wiw.source_files import digest_imports
from wiw.suggestions import did_you_mean

CALLED_LIKE_ROLLOUT = (
    "A function that is itself called like WorldModel.rollout needs its declaration: wiw.world_model(function, "
    "accepts=wiw.accepts(...))."
)


@dataclass(frozen=True)
class Registry:
    """The names of one kind of part. Modules are imported on first use, so that `import wiw` stays light."""

    kind: str
    """The kind as named in messages: "world model"."""
    group: str
    """Entry-point group; empty if packages add none."""
    built_in: dict[str, str]
    """Name to `module:attribute`. For a name that ends with a colon, what follows it is the first argument."""
    base: str = ""
    """`module:class` that parts of this kind must derive from, if any."""
    registered: dict[str, Any] = field(default_factory=dict)
    """Parts that programs have added under their own names (`register`)."""
    door: str = ""
    """`module:function` that returns a proxy for an external part, given its name, so that its code is imported and run
    in a separate process; empty if external parts run in this one."""
    prefix: str = ""
    """Prefix of the names that go through the door; empty if all external parts do."""
    factories: dict[str, str] = field(default_factory=dict)
    """`module:class` of what a built-in factory makes, to its name: the class itself is not named in `built_in`."""

    def names(self) -> list[str]:
        """Return all registered names, built-in ones first."""
        return [*self.built_in, *sorted(({*self._list_plugins(), *self.registered}) - set(self.built_in))]

    def register(self, name: str, thing: Any) -> None:
        """Add a class or factory under a name, in this process; what was added under it before is replaced, as by a
        notebook's cell that runs again.

        Raises:
            RegistryError: the name is taken by wiw or a package, or the class is of another kind.
        """
        if name in self.names() and name not in self.registered:
            raise RegistryError(f"the {self.kind} '{name}' already exists; choose another name")
        self.registered[name] = self._check_kind(name, thing)

    def find_name(self, part: Any) -> str:
        """Return the name of an instance or class: what it was made by, or is registered under; empty for any other."""
        if made := find_options(part):
            return made[0] or self._name_class(type(part))
        return self._name_class(part if inspect.isclass(part) else type(part))

    def _name_class(self, kind: type) -> str:
        """Return the registered name of a class; one of wiw without a name has that of the class it derives from."""
        plugins = {point.value: name for name, point in self._list_plugins().items()}
        paths = {**plugins, **self.factories, **{path: name for name, path in self.built_in.items()}}
        for base in kind.__mro__ if kind.__module__.startswith("wiw.") else (kind,):
            if name := paths.get(f"{base.__module__}:{base.__qualname__}"):
                return name
        return next((name for name, thing in self.registered.items() if thing is kind), "")

    def find(self, name: str) -> Any:
        """Return the class or factory behind a name or path.

        Raises:
            RegistryError: unknown name; missing file, module or attribute; an exception during import (the cause); a
                class of another kind.
        """
        if self.door and (name.startswith(self.prefix) if self.prefix else self.is_foreign(name)):
            return _attribute(self.door)(name.removeprefix(self.prefix))
        return self.find_here(name)

    def is_foreign(self, name: str) -> bool:
        """Return whether a name refers to code in a file or package that does not ship with wiw."""
        if name in self.registered or name in self.built_in or name.partition(":")[0] + ":" in self.built_in:
            return False
        plugins = self._list_plugins()
        path = plugins[name].value if name in plugins else name
        return ":" in path and path.partition(":")[0].partition(".")[0] != "wiw"

    def find_here(self, name: str) -> Any:
        """Return the class or factory behind a name or path, imported into this process; errors as of `find`."""
        if name in self.registered:
            return self.registered[name]
        if name in self.built_in:
            return self._load(name, partial(_attribute, self.built_in[name]))
        plugins = self._list_plugins()
        if name in plugins:
            return self._load(name, plugins[name].load)
        prefix, colon, argument = name.partition(":")
        if prefix + colon in self.built_in and argument:
            return partial(self.find_here(prefix + colon), argument)
        if colon:
            return self._load(name, partial(_attribute, name))
        hint = (
            f" To use a file, name one of its classes: {name}:CLASS."
            if name.endswith(".py")
            else did_you_mean(name, self.names())
        )
        raise RegistryError(
            f"no {self.kind} is named '{name}'.{hint} Known: {', '.join(self.names())}; "
            + "or give path.py:Class, package.module:Class"
            + (f", or an entry point in '{self.group}'." if self.group else ".")
        )

    def make(self, what: Any, **options: Any) -> Any:
        """Return an instance from a name, path, class, factory, or instance (returned unchanged).

        Raises:
            RegistryError: see `find`; also when the options do not fit the constructor.
            ConstructionError: the constructor raised an exception that is not an error of wiw (the cause).
        """
        return self._make(what, self.fitting(what, **options), options)

    def make_here(self, what: Any, **options: Any) -> Any:
        """Return an instance like `make`, whose code runs in this process."""
        found = self.find_here(what) if isinstance(what, str) else what
        return self._make(what, self._require_fitting(what, found, options), options)

    def fitting(self, what: Any, **options: Any) -> Any:
        """Return what `make` would call with these options, or the instance that it would return.

        Raises:
            RegistryError: like `make`, except for what only construction reveals.
        """
        return self._require_fitting(what, self.find(what) if isinstance(what, str) else what, options)

    def _make(self, what: Any, found: Any, options: dict[str, Any]) -> Any:
        if not _makes(found):
            return self._check_kind(what, found)
        made = self._check_kind(what, self._construct(what, found, options))
        _note_options(made, what if isinstance(what, str) else "", options)
        return made

    def _require_fitting(self, what: Any, found: Any, options: dict[str, Any]) -> Any:
        if _makes(found):
            try:
                inspect.signature(found).bind(**options)
            except TypeError as error:
                is_rollout = inspect.isfunction(what) and self.base.endswith(":WorldModel")
                hint = f". {CALLED_LIKE_ROLLOUT}" if is_rollout else ""
                takes = f"it takes {inspect.signature(found)}{hint}"
                raise RegistryError(f"{self.kind} '{what}': {error}; {takes}") from None
        elif options:
            raise RegistryError(f"options {sorted(options)} cannot be applied to a ready-made {self.kind}")
        return found

    def _construct(self, what: Any, factory: Callable[..., Any], options: dict[str, Any]) -> Any:
        try:
            return factory(**options)
        except BaseException as error:
            if isinstance(error, Error) or is_stop_request(error):
                raise
            name = what if isinstance(what, str) else getattr(what, "__qualname__", repr(what))
            raise ConstructionError(f"{self.kind} '{name}' cannot be built: {_describe_error(error)}") from error

    def _list_plugins(self) -> dict[str, Any]:
        return {point.name: point for point in entry_points(group=self.group)} if self.group else {}

    def _load(self, name: str, load: Callable[[], Any]) -> Any:
        try:
            found = load()
        except BaseException as error:  # SystemExit too: a module must not end the process that imports it
            if is_stop_request(error):
                raise
            raise RegistryError(f"{self.kind} '{name}' cannot be loaded: {_describe_error(error)}") from error
        return self._check_kind(name, found) if inspect.isclass(found) else found

    def _check_kind(self, name: Any, thing: Any) -> Any:
        """Return the class or instance, if it is of this kind; None stands for "without"."""
        if not self.base or thing is None:
            return thing
        module, _, attribute = self.base.partition(":")
        base = getattr(importlib.import_module(module), attribute)
        if issubclass(thing, base) if inspect.isclass(thing) else isinstance(thing, base):
            return thing
        raise RegistryError(
            f"'{name}' is not a {self.kind}: expected a class derived from wiw.{attribute}, got {thing!r}"
        )


_MADE: dict[int, tuple[weakref.ref[Any], str, dict[str, Any]]] = {}
"""Parts that registries have made and that are still in use, by identity: name, empty for a class, and options."""


def find_options(part: Any) -> tuple[str, Mapping[str, Any]] | None:
    """Return name (empty for a class) and options by which a registry made a part; None for one made otherwise."""
    made = _MADE.get(id(part))
    return made[1:] if made and made[0]() is part else None


def _note_options(part: Any, name: str, options: dict[str, Any]) -> None:
    """Keep what a part was made with, as long as it is in use."""
    place = id(part)
    try:
        _MADE[place] = weakref.ref(part, lambda _: _MADE.pop(place, None)), name, options
    except TypeError:  # None, or a class whose instances cannot be referred to
        return


def _makes(thing: Any) -> bool:
    """Return whether a thing is a class or a factory, rather than an instance."""
    return inspect.isclass(thing) or inspect.isfunction(thing) or isinstance(thing, partial)


def _attribute(path: str) -> Any:
    """Return the object that `path.py:Name` or `package.module:Name` names."""
    module_name, _, attribute = path.rpartition(":")
    if not module_name.endswith(".py"):
        return getattr(importlib.import_module(module_name), attribute)
    module = _import_file(Path(module_name))
    if not hasattr(module, attribute):
        own = [name for name, thing in vars(module).items() if getattr(thing, "__module__", "") == module.__name__]
        raise AttributeError(f"{module_name} defines no '{attribute}'" + (f"; it has {', '.join(own)}" if own else ""))
    return getattr(module, attribute)


SOURCES = "__wiw_sources__"
"""Attribute of a module from a file: the file's name, and a digest of it and the user's files that it imports."""


def _import_file(path: Path) -> Any:
    """Return the module in a Python file; an edited file is imported again.

    Its folder is put first on the path, as for a script, so that it finds the modules next to it.
    """
    path = path.expanduser().resolve()
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    status = path.stat()
    identity = f"{path} {status.st_mtime_ns} {status.st_size}".encode()
    name = f"wiw_user_{path.stem}_{blake2b(identity, digest_size=8).hexdigest()}"
    if name in sys.modules:
        return sys.modules[name]
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))
    loader = SourceFileLoader(name, str(path))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(name, loader))  # type: ignore[arg-type]
    module.__dict__[SOURCES] = f"{path.name} {digest_imports(path)}"
    sys.modules[name] = module
    # From the source itself, and nothing is written for modules next to it: bytecode on disk tells edits of the same
    # length in the same second not apart.
    writes_nothing, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        exec(loader.source_to_code(path.read_bytes(), str(path)), module.__dict__)  # noqa: S102 - named by the user
    except BaseException:
        del sys.modules[name]
        raise
    finally:
        sys.dont_write_bytecode = writes_nothing
    return module


def _describe_error(error: BaseException) -> str:
    """Return the exception, and where it failed unless its text says so."""
    if isinstance(error, SyntaxError | FileNotFoundError | AttributeError):
        return f"{type(error).__name__}: {read_text(error)}"
    return describe_exception(error)


WORLD_MODELS = Registry(
    "world model",
    "wiw.world_models",
    {
        "none": "wiw.world_models.none:none",
        "copy": "wiw.world_models.copy:make_copy",
        "warp": "wiw.world_models.warp:Warp",
        "oracle": "wiw.world_models.oracle:make_oracle",
        "svd": "wiw.world_models.video.svd:SVD",
        "ltx": "wiw.world_models.video.ltx:LTX",
        "hunyuan": "wiw.world_models.video.hunyuan:Hunyuan",
        "wan2.1": "wiw.world_models.video.wan:Wan21",
        "wan2.2-5b": "wiw.world_models.video.wan:Wan22Small",
        "wan2.2-a14b": "wiw.world_models.video.wan:Wan22",
        "cosmos-predict2": "wiw.world_models.video.cosmos:CosmosPredict2",
        "sana-wm": "wiw.world_models.video.sana:SanaWM",
        "runway-gen4": "wiw.world_models.runway_gen4.model:RunwayGen4",
        "nwm": "wiw.world_models.nwm.model:NWM",
        "pathdreamer": "wiw.world_models.panoramic.pathdreamer:PathDreamer",
        "se3ds": "wiw.world_models.panoramic.se3ds:SE3DS",
        "svd-action": "wiw.world_models.video.actions.variants:SVDAction",
        "ltx-action": "wiw.world_models.video.actions.variants:LTXAction",
        "wan2.1-action": "wiw.world_models.video.actions.variants:Wan21Action",
        "wan2.2-5b-action": "wiw.world_models.video.actions.variants:Wan22SmallAction",
        "wan2.2-a14b-action": "wiw.world_models.video.actions.variants:Wan22Action",
        "cosmos-predict2-action": "wiw.world_models.video.actions.variants:CosmosPredict2Action",
        "warpnet": "wiw.world_models.warpnet.model:WarpNet",
        "pocket": "wiw.world_models.pocket.model:Pocket",
        "armnet": "wiw.world_models.armnet.model:ArmNet",
        "remote:": "wiw.world_models.remote.model:Remote",
    },
    "wiw.world_models.base:WorldModel",
    door="wiw.isolation.models:find_isolated_model",
    factories={"wiw.world_models.copy:Copy": "copy", "wiw.world_models.oracle:Oracle": "oracle"},
)
ISOLATED = "isolated:"
"""Prefix of the name of a policy that is to run in a separate process."""
FUNCTION = "wiw.world_models.function:Function"
"""Class that turns a function into a world model."""
POLICIES = Registry(
    "policy",
    "wiw.policies",
    {
        "heuristic": "wiw.policies.heuristic:Heuristic",
        "matcher": "wiw.policies.matcher.policy:Matcher",
        "climber": "wiw.policies.matcher.climber:Climber",
        "geometric": "wiw.policies.geometric:Geometric",
        "navigator": "wiw.policies.navigator.policy:Navigator",
        "recogniser": "wiw.policies.recogniser.policy:Recognition",
        "vlm": "wiw.policies.vlm.make:make_vlm",
        "scripted": "wiw.policies.scripted:Scripted",
        "diffuser": "wiw.policies.diffuser.policy:Diffuser",
        "explorer": "wiw.policies.explorer.policy:Explorer",
        "explorer-oracle": "wiw.experiments.privileged_explorers:OracleExplorer",
        "explorer-tour": "wiw.experiments.privileged_explorers:TourExplorer",
        "explorer-oracle-tour": "wiw.experiments.privileged_explorers:OracleTourExplorer",
    },
    "wiw.policies.base:Policy",
    door="wiw.isolation.policies:find_isolated_policy",
    prefix=ISOLATED,
    factories={"wiw.policies.vlm.policy:VLM": "vlm"},
)
TASKS = Registry(
    "task",
    "wiw.tasks",
    {
        "imagenav": "wiw.tasks.imagenav:ImageNav",
        "ar": "wiw.tasks.ar:AR",
        "aeqa": "wiw.tasks.aeqa:AEQA",
        "manipulation": "wiw.tasks.manipulation:Manipulation",
    },
    "wiw.tasks.base:Task",
)
TRACKERS = Registry(
    "tracker",
    "",
    {
        "frames": "wiw.perception.make_tracker:make_frame_tracker",
        "sam2": "wiw.perception.sam2:Sam2",
        "flow": "wiw.perception.flow:Flow",
        "reprojection": "wiw.perception.tracking:Reprojection",
        "growing": "wiw.perception.growing:Growing",
    },
    "wiw.perception.tracking:Tracker",
)
DETECTORS = Registry(
    "detector",
    "",
    {
        "owlvit": "wiw.perception.owlvit:OwlViT",
        "grounding-dino": "wiw.perception.grounding_dino:GroundingDino",
        "simulator": "wiw.perception.simulator:TrueBoxes",
        "remote:": "wiw.perception.remote:Remote",
    },
)
SEGMENTERS = Registry(
    "segmenter",
    "",
    {"sam2": "wiw.perception.sam2_image:Sam2Image", "simulator": "wiw.perception.simulator:TrueMasks"},
)
LABELLERS = Registry(
    "labeller",
    "",
    {
        "learned": "wiw.perception.learned_labeller:LearnedLabeller",
        "oracle": "wiw.perception.oracle_labeller:OracleLabeller",
        "detector": "wiw.perception.detector_labeller:DetectorLabeller",
    },
    "wiw.perception.scene_labels:Labeller",
)
SEMANTICS = Registry(
    "source of semantics",
    "",
    {"rednet": "wiw.perception.rednet:RedNet", "simulator": "wiw.perception.semantics:TrueSemantics"},
)
METRICS = Registry(
    "metric",
    "wiw.metrics",
    {
        "success": "wiw.metrics.metric:SUCCESS",
        "answer_score": "wiw.metrics.metric:ANSWER_SCORE",
        "spl": "wiw.metrics.metric:SPL",
        "answered": "wiw.metrics.metric:ANSWERED",
        "grounded": "wiw.metrics.metric:GROUNDED",
        "path_length": "wiw.metrics.metric:PATH_LENGTH",
        "mean_trajectory": "wiw.metrics.metric:MEAN_TRAJECTORY",
        "refused": "wiw.metrics.metric:REFUSED",
    },
    "wiw.metrics.metric:Metric",
)


PLAN_SPACES = Registry(
    "plan space",
    "wiw.plan_spaces",
    {
        "discrete": "wiw.loop.primitives:Primitives",
        "pose7": "wiw.loop.gripper_poses:GripperPoses",
    },
    "wiw.loop.plan_space:PlanSpace",
)


def list_world_models() -> list[str]:
    """Return the names that `wiw.world_model` takes."""
    return WORLD_MODELS.names()


def list_policies() -> list[str]:
    """Return the names that `wiw.policy` takes."""
    return POLICIES.names()


def list_tasks() -> list[str]:
    """Return the names of the tasks; their gymnasium ids are `ImageNav-v0` and so on."""
    return TASKS.names()


def list_metrics() -> list[str]:
    """Return the names of the metrics that tables show."""
    return METRICS.names()


def world_model(name: Any, **options: Any) -> Any:
    """Return a world model by name, `path.py:Class`, class or instance; None for "none".

    `wiw.world_model(function, accepts=wiw.accepts(...))` turns a function that is called like `WorldModel.rollout` into
    one.

    Raises:
        RegistryError: unknown name, or options that do not fit; the message lists the known ones.
    """
    if "accepts" in options and not isinstance(name, str) and not inspect.isclass(name):
        return _attribute(FUNCTION)(name, **options)
    return WORLD_MODELS.make(name, **options)


def policy(name: Any, **options: Any) -> Any:
    """Return a policy by name, `path.py:Class`, class or instance.

    Raises:
        RegistryError: unknown name, or options that do not fit; the message lists the known ones.
    """
    return POLICIES.make(name, **options)


def make(task_id: str, depth: bool = True, **options: Any) -> Any:
    """Return a gymnasium environment of a task, e.g. `wiw.make("ImageNav-v0", scenes="apartments:val", seed=0)`.

    Observations carry depth unless `depth=False`: the matcher maps with it and `warp` imagines with it. Other things to
    observe may be among the task's options (such as `cameras` for `Manipulation-v0`). A task of your own
    ("path.py:Class") has whatever its `environment` returns: a `wiw.Env` need only `begin` and `run` episodes.

    Raises:
        ArgumentError: something else than a name.
        RegistryError: unknown task, or options that do not fit; the message lists the known ones.
    """
    task, own = _make_task(task_id, options)
    return task.environment(depth=depth, **own)


def make_vec(task_id: str, num_envs: int, depth: bool = True, **options: Any) -> Any:
    """Return a gymnasium vector environment of a task: `num_envs` episodes, stepped and observed as a batch.

    Raises:
        RegistryError: unknown task, or options that do not fit; the message lists the known ones.
        ArgumentError: something else than a name; `num_envs` below 1.
    """
    task, own = _make_task(task_id, options)
    return task.vector_environment(num_envs, depth=depth, **own)


def _make_task(task_id: str, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return the task, and the options that belong to its environments.

    Raises:
        ArgumentError: see `make`.
        RegistryError: see `make`.
    """
    if options.pop("render_mode", None) not in (None, "rgb_array"):
        raise ArgumentError("render_mode: expected 'rgb_array'; environments draw into arrays alone")
    name = task_name(task_id)
    sensors = task_class(name).sensor_options
    task = TASKS.make(name, **{key: value for key, value in options.items() if key not in sensors})
    return task, {key: value for key, value in options.items() if key in sensors}


def task_class(name: str) -> Any:
    """Return the class behind a task's name; `wiw.Task` for a factory, whose class is unknown before it is called."""
    found = TASKS.find(name)
    return found if inspect.isclass(found) else _attribute(TASKS.base)


def task_name(task_id: str) -> str:
    """Return the registered name of a gymnasium id: "imagenav" for "ImageNav-v0". Other names and paths are
    unchanged.

    Raises:
        ArgumentError: something else than a name.
    """
    if not isinstance(task_id, str):
        raise ArgumentError(
            f"expected the name of a task, such as 'ImageNav-v0' or 'path.py:Class', got {task_id!r}; of a task that "
            "exists, call `environment()`"
        )
    return task_id if ":" in task_id or task_id in TASKS.names() else task_id.removesuffix("-v0").lower()
