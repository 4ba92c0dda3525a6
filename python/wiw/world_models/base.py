# SPDX-License-Identifier: Apache-2.0
"""The interface of world models: one class, one method, one declaration of what it accepts."""

from __future__ import annotations

import importlib.util
import inspect
import json
import math
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from wiw.action import (
    GripperTextTemplate,
    GripperVocabulary,
    TextTemplate,
    Vocabulary,
    parse_action,
    to_controls,
)
from wiw.errors import ArgumentError, ContractError, DependencyError
from wiw.registry import PLAN_SPACES, SOURCES
from wiw.types import GRIPPER_POSES, PRIMITIVES, Conditioning, Control, ControlKind, View
from wiw.world_models.pictures import check_pictures, sample

if TYPE_CHECKING:
    from typing_extensions import Self

CONTROLS = ("image", "text", "trajectory", "viewpoint", "action")
NEEDS = ("depth", "semantic", "history", "simulator")
HISTORY = 4
"""Default number of frames in a history."""
SMALLEST_PANORAMA = (16, 32)
"""Smallest (height, width) of the built-in models that can draw in any size."""


@dataclass(frozen=True)
class Accepts:
    """A world model's declaration, read by the loop; created and checked by `wiw.accepts(...)`."""

    control: ControlKind
    space: str
    view: View
    size: tuple[int, int]
    frames: int
    needs: tuple[str, ...]
    causal: bool
    best_batch: int
    vocabulary: dict[int, Any] | GripperVocabulary | None
    null_first: bool
    template: TextTemplate | GripperTextTemplate | None
    cacheable: bool = False
    history: int = 0
    """Frames of `Conditioning.history`, including the observation; 0 if the model needs none."""
    seeded: bool = True
    """Whether outputs depend on the seeds; a model without random numbers gets zeros."""
    smallest: tuple[int, int] | None = None
    """Smallest (height, width) that may be requested, up to `size`; None for a model with only one size."""

    @property
    def is_scalable(self) -> bool:
        """Whether the model supports a range of sizes."""
        return self.smallest is not None

    def takes_size(self, size: Sequence[int]) -> bool:
        """Return whether frames of this (height, width) may be requested."""
        return tuple(size) == self.fit_size(size)

    def fit_size(self, size: Sequence[int] | None) -> tuple[int, int]:
        """Return the supported (height, width) nearest to `size`; for None the default one, the largest."""
        if size is None or self.smallest is None:
            return self.size
        ranges = zip(self.smallest, size, self.size, strict=True)
        height, width = (min(max(least, own), most) for least, own, most in ranges)
        return height, width

    def at_size(self, size: Sequence[int] | None) -> Accepts:
        """Return the declaration for a single size, the one nearest to `size`."""
        return replace(self, size=self.fit_size(size), smallest=None)


def accepts(
    control: ControlKind,
    view: View = "panorama",
    size: tuple[int, int] | None = None,
    frames: int = 0,
    *,
    space: str = PRIMITIVES,
    needs: Sequence[str] = (),
    causal: bool = False,
    best_batch: int = 8,
    vocabulary: Vocabulary | GripperVocabulary | None = None,
    null_first: bool = False,
    template: TextTemplate | GripperTextTemplate | None = None,
    cacheable: bool = False,
    history: int | None = None,
    seeded: bool = True,
    smallest: tuple[int, int] | None = None,
) -> Accepts:
    """Declare what a world model takes and returns (paper, section "Unified Action API").

    Args:
        control: which field of `Control` the model reads: "image" (none), "text", "trajectory", "viewpoint" or
            "action".
        view: "perspective" (HFOV 90 front view) or "panorama" (equirectangular).
        size: (height, width) of its input and output, or the largest of a range; default 480x480 or 576x1024. A
            perspective view of any shape is 90 degrees wide and has square pixels: the parts of an agent's view that a
            wide one does not cover are black.
        frames: length of a rollout including frame 0; 0 means any. Shorter plans are padded, longer ones chunked.
        space: the kind of actions it follows, a name from `wiw.loop.plan_space`: "discrete" primitives, or "pose7"
            gripper poses. An agent that plans in another space refuses the model.
        needs: any of "depth", "semantic", "history" (the latest observations, `wiw.types.History`); "simulator" is for
            `oracle` only.
        causal: frame k depends only on controls 1..k, so shared prefixes are imagined once.
        best_batch: number of rows per call at which the model is most efficient.
        vocabulary: for control "action": map from primitive (id or name, such as "turn_left") to the model's own id or
            vector, or a `wiw.action.GripperVocabulary` for space "pose7"; default: primitive ids, or poses as they are.
        null_first: the model expects a null token for frame 0 before the actions.
        template: wording of the prompt, for control "text": a `wiw.action.TextTemplate`, or a `GripperTextTemplate` for
            space "pose7". A plan of poses to which its policy gave a text keeps that text.
        cacheable: cache rollouts on disk by default, so that none is computed twice; needs a `version`. Set it for a
            slow model whose output is a function of its inputs: not for one that draws random numbers without the
            seeds, nor for a server that may change.
        history: frames of the history with needs=("history",), including the observation; None means 4.
        seeded: whether outputs depend on the seeds. For a model without random numbers, set False: it gets zeros, and
            its cached rollouts can be reused in every run, whatever the salt of its seeds.
        smallest: smallest (height, width) of panoramas for a model that can draw in any size from there to `size`: it
            is asked for no more than its frames' readers need (`wiw.policies.base.FrameSpec.source_size`), and takes
            the size from the observations. None: it has only one size.

    Raises:
        ArgumentError: a value is not one of the above, or a history is given but not declared in `needs`.
    """
    size = size or ((480, 480) if view == "perspective" else (576, 1024))
    _check("control", control, CONTROLS)
    _check("view", view, ("perspective", "panorama"))
    _check("space", space, PLAN_SPACES.names())
    needs = (needs,) if isinstance(needs, str) else needs
    for need in needs:
        _check("needs", need, NEEDS)
    if not _is_size(size):
        raise ArgumentError(f"accepts: expected size (height, width) in pixels, got {size!r}")
    if not _is_whole(frames) or frames < 0 or frames == 1:
        raise ArgumentError(f"accepts: frames includes the observation: expected 0 (any) or at least 2, got {frames!r}")
    if not _is_whole(best_batch) or best_batch < 1:
        raise ArgumentError(f"accepts: expected best_batch of at least 1, got {best_batch!r}")
    if null_first and space == GRIPPER_POSES:
        raise ArgumentError("accepts: null_first is for primitives: plans of poses begin with that of frame 0")
    _check_template(template, space)
    history = _check_history(history, needs)
    size = (int(size[0]), int(size[1]))
    return Accepts(
        control,
        space,
        view,
        size,
        int(frames),
        tuple(needs),
        causal,
        int(best_batch),
        _check_vocabulary(vocabulary, space),
        null_first,
        template,
        cacheable,
        history,
        seeded,
        _check_smallest(smallest, size, view),
    )


def _check_template(template: Any, space: str) -> None:
    kind = GripperTextTemplate if space == GRIPPER_POSES else TextTemplate
    if template is not None and not isinstance(template, kind):
        raise ArgumentError(f"accepts: expected template wiw.action.{kind.__name__}, got {type(template).__name__}")


def _check_vocabulary(vocabulary: Any, space: str) -> dict[int, Any] | GripperVocabulary | None:
    """Return the vocabulary, with ids for the names of primitives."""
    if vocabulary is None:
        return None
    if space == GRIPPER_POSES:
        if not isinstance(vocabulary, GripperVocabulary):
            raise ArgumentError(
                f"accepts: expected vocabulary wiw.action.GripperVocabulary, got {type(vocabulary).__name__}"
            )
        to_controls(np.zeros((1, 7)), vocabulary)
        return vocabulary
    if not isinstance(vocabulary, Mapping):
        raise ArgumentError(
            f"accepts: expected vocabulary as a map from primitives to the model's own, got {type(vocabulary).__name__}"
        )
    own = {int(parse_action(key)): value for key, value in vocabulary.items()}
    for key, value in vocabulary.items():
        if not _is_number_or_vector(value):
            raise ArgumentError(f"accepts: vocabulary: expected a number or a vector for {key}, got {value!r}")
    to_controls(list(own), own)
    return own


def _is_number_or_vector(value: Any) -> bool:
    try:
        array = np.asarray(value)
    except ValueError:  # of rows of different lengths
        return False
    return array.ndim <= 1 and array.dtype.kind in "biuf"


def _check_smallest(smallest: Any, size: tuple[int, int], view: View) -> tuple[int, int] | None:
    if smallest is None:
        return None
    if view != "panorama":
        raise ArgumentError("accepts: smallest is for panoramas; a perspective model has only one size")
    if not _is_size(smallest) or not all(least <= most for least, most in zip(smallest, size, strict=True)):
        raise ArgumentError(f"accepts: expected smallest (height, width) of at most {size} pixels, got {smallest}")
    return int(smallest[0]), int(smallest[1])


def _check_history(history: int | None, needs: Sequence[str]) -> int:
    if "history" not in needs:
        if history:
            raise ArgumentError(f"accepts: history={history} without needs=('history',); declare both or neither")
        return 0
    if history is None:
        return HISTORY
    if not _is_whole(history) or history < 1:
        raise ArgumentError(
            "accepts: history includes the observation: with needs=('history',), expected a whole number of at least "
            f"1, got {history!r}"
        )
    return int(history)


def _is_size(value: Any) -> bool:
    return isinstance(value, Sequence) and len(value) == 2 and all(_is_whole(side) and side >= 1 for side in value)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _check(name: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise ArgumentError(f"accepts: {name} is '{value}', expected one of {', '.join(allowed)}")


@dataclass(frozen=True)
class Requirements:
    """Requirements of a world model on the machine; `wiw list world-models` shows what is missing."""

    packages: tuple[str, ...] = ()
    """Importable names."""
    extra: str = ""
    """Extra of wiw that installs them: `pip install 'wiw[EXTRA]'`."""
    weights: str = ""
    """Name on the Hugging Face hub of the default weights; for a served model, where its weights are published."""
    gpu: bool = False
    """Whether it is impractical without a GPU."""
    variables: tuple[str, ...] = ()
    """Environment variables, such as the key of a service."""
    options: tuple[str, ...] = ()
    """Options without which it cannot be built."""
    served: str = ""
    """Name of the model that a server must run, with the server's own weights."""
    server: str = ""
    """The server's default address."""

    def missing(self) -> list[str]:
        """Packages that are not installed; nothing is imported."""
        return [name for name in self.packages if not _is_installed(name)]

    def require(self) -> None:
        """Check that the packages are installed.

        Raises:
            DependencyError: one is missing; says how to install it.
        """
        if missing := self.missing():
            raise DependencyError(f"{', '.join(missing)} not installed; pip install 'wiw[{self.extra}]'")


def _is_installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # of the package that it would be in
        return False


def find_accepts(model: Any) -> Accepts | None:
    """Return what a model, its class or a factory declares; None where only the model, once made, can say."""
    declared = getattr(model, "accepts", None)
    return declared if isinstance(declared, Accepts) else None


class _Signature:
    """Arguments of a model's class: none where it has no constructor, though `__new__` would take anything."""

    def __get__(self, instance: Any, owner: type[Any]) -> inspect.Signature | None:
        is_plain = owner.__init__ is object.__init__ and owner.__new__ is WorldModel.__new__
        return inspect.Signature() if is_plain else None


class WorldModel(ABC):
    """Predicts what an agent would see. Subclasses set `accepts` and implement `rollout`."""

    accepts: Accepts
    version: ClassVar[str] = ""
    """Version of the outputs: the author raises it whenever a code change alters them. It is part of the rollout
    cache's keys; a model without one is not cached."""
    immaterial: ClassVar[tuple[str, ...]] = ()
    """Options in `describe()` that the outputs do not depend on, such as the path of the weights."""
    requires: ClassVar[Requirements] = Requirements()
    credits: float | None = None
    """Credits that a paid service has charged so far; None if imagining is free."""
    __signature__: ClassVar[Any] = _Signature()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        is_base = "accepts" in inspect.get_annotations(cls)
        if "rollout" in cls.__dict__ and not is_base:
            cls._require_declaration()

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Make an instance that knows what a user's class was constructed with.

        Raises:
            ContractError: the class leaves its declaration to classes derived from it.
            TypeError: there are arguments, and the class has no constructor.
        """
        cls._require_declaration()
        if (args or kwargs) and cls.__init__ is object.__init__:
            raise TypeError(f"{cls.__name__}() takes no arguments")
        made = super().__new__(cls)
        if not cls.__module__.startswith("wiw."):
            made._constructed_with = _list_arguments(cls, args, kwargs)
        return made

    @classmethod
    def _require_declaration(cls) -> None:
        if not isinstance(declared := getattr(cls, "accepts", None), Accepts | property):
            raise ContractError(
                f"{cls.__name__}: expected the class attribute `accepts = wiw.accepts(...)`, got {declared!r}; a class "
                "that is only a base of others says `accepts: wiw.Accepts`"
            )

    _constructed_with: tuple[dict[str, Any], tuple[str, ...]] = ({}, ())
    """The constructor's arguments that are plain values, by name, and the names of others."""

    @abstractmethod
    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Imagine one future per row.

        Args:
            observations: B rows in the declared view and size; with a range of sizes, in the size of the frames to
                return.
            controls: B rows; frame k is what follows action k.
            seeds: uint64 [B], one per row, so that results do not depend on how rows are batched; 0 if `accepts` has
                seeded=False.

        Returns:
            uint8 [B, T, H, W, 3] with T = actions + 1; frame 0 is the observation. Later calls must not overwrite its
                memory, as earlier results are still in use.
        """
        raise NotImplementedError

    @property
    def unwrapped(self) -> WorldModel:
        """The model itself, without any wrappers."""
        return self

    @property
    def spent(self) -> Mapping[str, float]:
        """Resources that the model has used so far, for the cost ledger (`Decision.spent`)."""
        return {} if self.credits is None else {"credits": self.credits}

    @classmethod  # noqa: B027 - most models have nothing to say
    def require(cls, task: Mapping[str, Any]) -> None:
        """Check, before a run begins, that the model suits a task with this description. Default: any task.

        Raises:
            ArgumentError: it does not.
        """

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity for the run's manifest: the class and its options.

        Default: public attributes that are plain values (numbers, text, paths, lists and mappings of them); networks
        and arrays are left out. Override it to say what they were loaded from.
        """
        public = {name: value for name, value in vars(self).items() if not name.startswith("_") and _is_plain(value)}
        options = {name: str(value) if isinstance(value, Path) else value for name, value in public.items()}
        return {"name": type(self).__name__, **options}

    def files(self) -> Sequence[Path]:
        """Return the files whose content the outputs depend on, such as weights.

        Default: arguments of the constructor and public attributes that name a file, except the `immaterial` ones.
        Override it for a folder, or if `describe()` contains a digest.
        """
        named = [
            Path(value).expanduser()
            for name, value in sorted({**self._constructed_with[0], **vars(self)}.items())
            if not name.startswith("_") and name not in self.immaterial and isinstance(value, str | Path) and value
        ]
        return [path for path in named if _is_file(path)]

    def identity(self) -> dict[str, Any]:
        """Return the part of `describe()` that the outputs depend on: all but the `immaterial` options."""
        return {name: value for name, value in self.describe().items() if name not in self.immaterial}

    def fingerprint(self) -> str:
        """Return the digest that identifies cached rollouts; empty for a model that cannot be identified.

        That is one without a `version`, or one made with an object that is no plain value, network of torch or array
        and whose class does not override `describe()`.

        It covers the class, its version, `identity()`, the plain arguments of a user's constructor (which may be
        secret, and are not described) and the content of `files()`; for a class in a file (`path.py:Class`), the name
        and content of that file and of those next to it that it imports, wherever they are. Where a user's class does
        not override `describe()`, the parameters of torch networks in its attributes count, too. Anything else that
        outputs depend on belongs in `describe()`.
        """
        kind = type(self)
        describes_itself = kind.describe is not WorldModel.describe
        if not self.version or not (describes_itself or all(map(self._is_held, self._constructed_with[1]))):
            return ""
        module = getattr(sys.modules.get(kind.__module__), SOURCES, kind.__module__)
        files = list(self.files())
        given = {
            name: value
            for name, value in self._constructed_with[0].items()
            if name not in self.immaterial and not (isinstance(value, str | Path) and Path(value).expanduser() in files)
        }
        known = [module, kind.__qualname__, self.version, self.identity(), *([given] if given else [])]
        digest = blake2b(json.dumps(known, sort_keys=True, default=str).encode(), digest_size=20)
        for file in files:
            status = file.stat()
            digest.update(_file_digest(file.resolve(), status.st_size, status.st_mtime_ns))
        if not describes_itself and not kind.__module__.startswith("wiw."):
            for name, value in sorted(vars(self).items()):
                digest.update(_digest_tensors(name, value))
        return digest.hexdigest()

    def _is_held(self, argument: str) -> bool:
        """Return whether an attribute of an argument's name, or one with an underscore, is a network or an array."""
        return any(_is_tensors(vars(self).get(name)) for name in (argument, f"_{argument}"))


_DEADLINE: ContextVar[float] = ContextVar("wiw_give_up", default=math.inf)


@contextmanager
def answer_deadline(seconds: float) -> Iterator[None]:
    """Set the deadline of model calls inside the block, in seconds from now; models read it with `seconds_left`."""
    token = _DEADLINE.set(time.monotonic() + seconds)
    try:
        yield
    finally:
        _DEADLINE.reset(token)


def seconds_left() -> float:
    """Return how many seconds the caller of `rollout` will still wait, for models that wait for servers themselves.

    Infinite if no deadline is set.
    """
    return _DEADLINE.get() - time.monotonic()


@lru_cache(64)
def _file_digest(path: Path, size: int, changed: int) -> bytes:
    """Return the digest of a file's content; a file with unchanged size and modification time is not read again."""
    digest = blake2b(digest_size=20)
    with path.open("rb") as content:
        while chunk := content.read(2**22):
            digest.update(chunk)
    return digest.digest()


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long for a name, or with a null byte: an option that is no path
        return False


def _list_arguments(
    kind: Any, args: Sequence[Any], kwargs: Mapping[str, Any]
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a constructor's arguments, defaults included: plain values by name, and the names of others."""
    try:
        bound = inspect.signature(kind.__init__).bind(None, *args, **kwargs)
    except (TypeError, ValueError):  # the constructor refuses them itself
        return {}, ()
    bound.apply_defaults()
    given: dict[str, Any] = {}
    for name, value in list(bound.arguments.items())[1:]:
        given |= value if bound.signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD else {name: value}
    plain = {name: value for name, value in given.items() if _is_plain(value)}
    return plain, tuple(name for name in given if name not in plain)


def _is_tensors(value: Any) -> bool:
    """Return whether a value is an array, or a tensor or network of torch."""
    torch = sys.modules.get("torch")
    return isinstance(value, np.ndarray) or (torch is not None and isinstance(value, torch.nn.Module | torch.Tensor))


def _digest_tensors(name: str, value: Any) -> bytes:
    """Return a digest of an array's, tensor's or network's numbers; nothing for anything else."""
    if not _is_tensors(value):
        return b""
    digest = blake2b(name.encode(), digest_size=20)
    tensors = {"": value} if not hasattr(value, "state_dict") else value.state_dict()
    for part, numbers in tensors.items():
        digest.update(part.encode())
        if not _is_tensors(numbers):  # what a layer adds of its own
            digest.update(repr(numbers).encode())
            continue
        digest.update(f"{numbers.dtype} {tuple(numbers.shape)}".encode())
        if isinstance(numbers, np.ndarray):
            digest.update(numbers.tobytes())
        else:
            flat = numbers.detach().cpu().contiguous().reshape(-1)
            digest.update(flat.view(sys.modules["torch"].uint8).numpy().data)
    return digest.digest()


def _is_plain(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(isinstance(name, str) and _is_plain(item) for name, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or type(value) in (bool, int, float, str) or isinstance(value, Path)


def ask(
    model: WorldModel, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
) -> NDArray[np.uint8]:
    """Return a model's frames, checked against the contract: by the model's wrapper, or else here."""
    return (check_rollout if model is model.unwrapped else type(model).rollout)(model, observations, controls, seeds)


def check_rollout(
    model: WorldModel,
    observations: Conditioning,
    controls: Sequence[Control],
    seeds: NDArray[np.uint64],
    checks_pictures: bool = True,
) -> NDArray[np.uint8]:
    """Call a model and check its output against the contract.

    Raises:
        ContractError: wrong type, dtype, shape or number of frames, or NaN, with what was expected; or, where that is
            checked, frames that do not show the observed place (`pictures.check_pictures`).
    """
    observed = sample(observations.image).copy()  # a model may write into what it is handed
    frames = model.rollout(observations, controls, seeds)
    require_frames(model, frames, observations, controls)
    if checks_pictures:
        check_pictures(type(model.unwrapped).__name__, observed, frames, controls)
    return frames


def require_frames(model: WorldModel, frames: Any, observations: Conditioning, controls: Sequence[Control]) -> None:
    """Check that frames have the requested type, dtype, shape and number, in the size of the observations.

    Raises:
        ContractError: they do not, or contain NaN.
    """
    expected = (len(controls), len(controls[0].actions) + 1, *observations.image.shape[1:])
    if not isinstance(frames, np.ndarray) or frames.dtype != np.uint8 or frames.shape != expected:
        kind, came = _breach(frames, expected)
        raise ContractError(
            f"{type(model.unwrapped).__name__}.rollout: expected uint8 {expected} (batch, actions + 1, height, "
            f"width, 3), got {came}{_advise(kind, frames)}",
            kind,
        )


def _advise(kind: str, frames: Any) -> str:
    """Return what to do about frames of the wrong type or dtype; empty if that depends on the model."""
    if kind == "type" and hasattr(frames, "numpy"):
        return ". Give a NumPy array; for a torch tensor, use frames.detach().cpu().numpy()"
    if kind == "dtype" and np.issubdtype(frames.dtype, np.floating):
        scaled = "255 * frames" if frames.size and frames.min() >= 0 and frames.max() <= 1 else "frames"
        return f". Round, clip and convert: ({scaled}).round().clip(0, 255).astype(numpy.uint8)"
    return ""


def _breach(frames: Any, expected: tuple[int, ...]) -> tuple[str, str]:
    """Return how an output breaks the contract: in one word, and in detail."""
    if not isinstance(frames, np.ndarray):
        return "type", type(frames).__name__
    came = f"{frames.dtype} {frames.shape}"
    if np.issubdtype(frames.dtype, np.floating) and np.isnan(frames).any():
        return "nan", f"{came} with NaN"
    if frames.dtype != np.uint8:
        return "dtype", came
    other = frames.ndim == 5 and (*frames.shape[:1], *frames.shape[2:]) == (*expected[:1], *expected[2:])
    return ("frames" if other else "shape"), came
