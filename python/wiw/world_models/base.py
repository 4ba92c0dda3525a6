# SPDX-License-Identifier: Apache-2.0
"""What a world model is: one class, one method, one declaration of what it accepts."""

from __future__ import annotations

import importlib.util
import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from wiw.action import TextTemplate
from wiw.errors import ArgumentError, ContractError
from wiw.registry import PLAN_SPACES
from wiw.types import PRIMITIVES, Conditioning, Control, ControlKind, View
from wiw.world_models.pictures import check_pictures, sample

CONTROLS = ("image", "text", "trajectory", "viewpoint", "action")
NEEDS = ("depth", "semantic", "history", "simulator")
HISTORY = 4
"""Frames of a history where a model does not say how many."""
SMALLEST_PANORAMA = (16, 32)
"""Least (height, width) of the built-in models that draw in any size."""


@dataclass(frozen=True)
class Accepts:
    """A world model's declaration, read by the loop; made by `wiw.accepts(...)`, which checks it."""

    control: ControlKind
    space: str
    view: View
    size: tuple[int, int]
    frames: int
    needs: tuple[str, ...]
    causal: bool
    best_batch: int
    vocabulary: dict[int, Any] | None
    null_first: bool
    template: TextTemplate | None
    cacheable: bool = False
    history: int = 0
    """Frames of `Conditioning.history`, the observation included; 0 where the model needs none."""
    seeded: bool = True
    """Whether answers depend on the seeds; a model without random numbers is handed zeros."""
    smallest: tuple[int, int] | None = None
    """Least (height, width) that the model may be asked for, up to `size`; None for a model of one size."""

    @property
    def is_scalable(self) -> bool:
        """Whether the model draws in a range of sizes."""
        return self.smallest is not None

    def takes_size(self, size: Sequence[int]) -> bool:
        """Return whether the model may be asked for frames of this (height, width)."""
        return tuple(size) == self.fit_size(size)

    def fit_size(self, size: Sequence[int] | None) -> tuple[int, int]:
        """Return the (height, width) nearest to `size` that the model draws in; for None its usual one, the largest."""
        if size is None or self.smallest is None:
            return self.size
        ranges = zip(self.smallest, size, self.size, strict=True)
        height, width = (min(max(least, own), most) for least, own, most in ranges)
        return height, width

    def at_size(self, size: Sequence[int] | None) -> Accepts:
        """Return the declaration for one size alone, the nearest to `size`."""
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
    vocabulary: dict[int, Any] | None = None,
    null_first: bool = False,
    template: TextTemplate | None = None,
    cacheable: bool = False,
    history: int | None = None,
    seeded: bool = True,
    smallest: tuple[int, int] | None = None,
) -> Accepts:
    """Declares what a world model takes and gives (paper, section "Unified Action API").

    Args:
        control: which member of `Control` the model reads: "image" (none), "text", "trajectory", "viewpoint", "action".
        view: "perspective" (HFOV 90 front view) or "panorama" (equirectangular).
        size: (height, width) of its input and output, the largest of a range; default 480x480 or 576x1024. A
            perspective view of any shape is 90 degrees wide and has square pixels: what a wide one does not reach of an
            agent's view is black there.
        frames: length of a rollout with frame 0; 0 means any. Shorter plans are padded, longer ones chunked.
        space: what the actions are that it follows, a name of `wiw.loop.plan_space`: "discrete" primitives, or "pose7"
            poses of a gripper. An agent that plans in others refuses the model.
        needs: any of "depth", "semantic", "history" (the latest observations, `wiw.types.History`); "simulator" is for
            `oracle` alone.
        causal: frame k depends on controls 1..k only, so shared prefixes are imagined once.
        best_batch: rows per call at which the model is most efficient.
        vocabulary: primitive id to the model's own id or vector, for control "action"; default: primitive ids.
        null_first: the model wants a null token for frame 0 in front of the actions.
        template: words of the prompt, for control "text"; see `wiw.action.TextTemplate`.
        cacheable: keep rollouts on disk by default and never ask twice; needs a `version`. Say so for a model that
            takes long and whose answer is a function of what it is handed: not for one that draws without the seeds,
            nor for a server that may change.
        history: frames of the history with needs=("history",), the observation included; None means 4.
        seeded: whether answers depend on the seeds. A model that draws no random numbers says False: it is handed
            zeros, and its cached rollouts serve every run, whatever the salt of its seeds.
        smallest: least (height, width) of panoramas of a model that draws in any size from there to `size`: it is asked
            for no more than who looks at its frames needs (`wiw.policies.base.FrameSpec.source_size`), and finds the
            size by the observations. None: it has one size.

    Raises:
        ArgumentError: a value is not one of the above, or a history is given that is not needed.
    """
    size = size or ((480, 480) if view == "perspective" else (576, 1024))
    _check("control", control, CONTROLS)
    _check("view", view, ("perspective", "panorama"))
    _check("space", space, PLAN_SPACES.names())
    for need in needs:
        _check("needs", need, NEEDS)
    if len(size) != 2 or min(size) < 1:
        raise ArgumentError(f"accepts: expected size (height, width) in pixels, got {size}")
    if frames < 0 or frames == 1:
        raise ArgumentError(f"accepts: frames counts the observation too: expected 0 (any) or at least 2, got {frames}")
    if best_batch < 1:
        raise ArgumentError(f"accepts: expected best_batch of at least 1, got {best_batch}")
    if template is not None and not isinstance(template, TextTemplate):
        raise ArgumentError(f"accepts: expected template wiw.action.TextTemplate, got {type(template).__name__}")
    history = _check_history(history, needs)
    size = (int(size[0]), int(size[1]))
    return Accepts(
        control,
        space,
        view,
        size,
        frames,
        tuple(needs),
        causal,
        best_batch,
        vocabulary,
        null_first,
        template,
        cacheable,
        history,
        seeded,
        _check_smallest(smallest, size, view),
    )


def _check_smallest(smallest: Sequence[int] | None, size: tuple[int, int], view: View) -> tuple[int, int] | None:
    if smallest is None:
        return None
    if view != "panorama":
        raise ArgumentError("accepts: smallest is for panoramas; a perspective model has one size")
    if len(smallest) != 2 or not all(1 <= least <= most for least, most in zip(smallest, size, strict=True)):
        raise ArgumentError(f"accepts: expected smallest (height, width) of at most {size} pixels, got {smallest}")
    return int(smallest[0]), int(smallest[1])


def _check_history(history: int | None, needs: Sequence[str]) -> int:
    if "history" not in needs:
        if history:
            raise ArgumentError(f"accepts: history={history} without needs=('history',); declare both, or neither")
        return 0
    if history is None:
        return HISTORY
    if isinstance(history, bool) or not isinstance(history, int | np.integer) or history < 1:
        raise ArgumentError(
            f"accepts: history counts the observation too: with needs=('history',), expected a whole number of at "
            f"least 1, got {history!r}"
        )
    return int(history)


def _check(name: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise ArgumentError(f"accepts: {name} is '{value}', expected one of {', '.join(allowed)}")


@dataclass(frozen=True)
class Requirements:
    """What a world model needs of a machine; `wiw list world-models` says what of it is there."""

    packages: tuple[str, ...] = ()
    """Importable names."""
    extra: str = ""
    """Extra of wiw that installs them: `pip install 'wiw[EXTRA]'`."""
    weights: str = ""
    """Name on the Hugging Face hub of what is loaded by default; of a served model, where its weights are published."""
    gpu: bool = False
    """Whether it is of no practical use without one."""
    variables: tuple[str, ...] = ()
    """Environment variables, such as the key of a service."""
    options: tuple[str, ...] = ()
    """Without which it cannot be made."""
    served: str = ""
    """Name of the model that a server has to compute, with weights of its own."""
    server: str = ""
    """Where it is looked for by default."""

    def missing(self) -> list[str]:
        """Packages that are not installed; nothing is imported."""
        return [name for name in self.packages if not _is_installed(name)]


def _is_installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # of the package that it would be in
        return False


def find_accepts(model: Any) -> Accepts | None:
    """Return what a model, its class or a factory declares; None where only the model, once made, can say."""
    declared = getattr(model, "accepts", None)
    return declared if isinstance(declared, Accepts) else None


class WorldModel(ABC):
    """Predicts what an agent would see. Subclasses set `accepts` and write `rollout`."""

    accepts: Accepts
    version: ClassVar[str] = ""
    """Version of the answers: the author raises it with every change of code that changes one. The rollout cache
    names what it keeps by it, and keeps nothing of a model without one."""
    immaterial: ClassVar[tuple[str, ...]] = ()
    """Options in `describe()` that the answers do not depend on, such as where the weights lie."""
    requires: ClassVar[Requirements] = Requirements()
    credits: float | None = None
    """What a paid service has charged so far, in its credits; None where imagining costs nothing."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "rollout" in cls.__dict__ and not isinstance(getattr(cls, "accepts", None), Accepts | property):
            raise ContractError(f"{cls.__name__}: set the class attribute `accepts = wiw.accepts(...)`")

    @abstractmethod
    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Imagines one future per row.

        Args:
            observations: B rows in the declared view and size; of a range of sizes, in that of the frames wanted.
            controls: B rows; frame k is what follows action k.
            seeds: uint64 [B], one per row, so that results do not depend on how rows are batched; 0 where `accepts`
                says seeded=False.

        Returns:
            uint8 [B, T, H, W, 3] with T = actions + 1; frame 0 is the observation. In memory that later calls leave
            alone: earlier answers are still looked at then.
        """
        raise NotImplementedError

    @property
    def unwrapped(self) -> WorldModel:
        """The model itself, behind everything that wraps it."""
        return self

    @property
    def spent(self) -> Mapping[str, float]:
        """Resources that the model has used up so far, for the cost ledger (`Decision.spent`)."""
        return {} if self.credits is None else {"credits": self.credits}

    @classmethod  # noqa: B027 - most models have nothing to say
    def require(cls, task: Mapping[str, Any]) -> None:
        """Asked before a run begins, with what its task says of itself. Default: any task will do.

        Raises:
            ArgumentError: the model is not made for it.
        """

    def describe(self) -> dict[str, Any]:
        """JSON-able identity for the run's manifest: the class and its options.

        Default: public attributes that are plain values (numbers, text, paths, lists and mappings of them); networks
        and arrays are left out. Override it to name what they were loaded from.
        """
        public = {name: value for name, value in vars(self).items() if not name.startswith("_") and _is_plain(value)}
        options = {name: str(value) if isinstance(value, Path) else value for name, value in public.items()}
        return {"name": type(self).__name__, **options}

    def files(self) -> Sequence[Path]:
        """Return the files whose content the answers depend on, such as weights.

        Default: public attributes that name a file, less the `immaterial` ones. Override it for a folder, or where
        `describe()` has a digest.
        """
        named = [
            Path(value).expanduser()
            for name, value in sorted(vars(self).items())
            if not name.startswith("_") and name not in self.immaterial and isinstance(value, str | Path) and value
        ]
        return [path for path in named if _is_file(path)]

    def identity(self) -> dict[str, Any]:
        """Return what of `describe()` the answers depend on: all but the `immaterial` options."""
        return {name: value for name, value in self.describe().items() if name not in self.immaterial}

    def fingerprint(self) -> str:
        """Return the digest that names cached rollouts; empty for a model without a `version`.

        It is made of the class, its version, `identity()` and the content of `files()`. A class in a file
        (`path.py:Class`) counts with the file's path and time of change. What else answers depend on, such as a network
        that was handed over in memory, belongs into `describe()`.
        """
        if not self.version:
            return ""
        kind = type(self)
        known = [kind.__module__, kind.__qualname__, self.version, self.identity()]
        digest = blake2b(json.dumps(known, sort_keys=True, default=str).encode(), digest_size=20)
        for file in self.files():
            status = file.stat()
            digest.update(_file_digest(file.resolve(), status.st_size, status.st_mtime_ns))
        return digest.hexdigest()


_DEADLINE: ContextVar[float] = ContextVar("wiw_give_up", default=math.inf)


@contextmanager
def answer_deadline(seconds: float) -> Iterator[None]:
    """Set the deadline of calls to models inside the block, in seconds from now; models read it by `seconds_left`."""
    token = _DEADLINE.set(time.monotonic() + seconds)
    try:
        yield
    finally:
        _DEADLINE.reset(token)


def seconds_left() -> float:
    """Return the seconds that the caller of `rollout` still waits: for models that wait for servers themselves.

    Infinite where no deadline is set.
    """
    return _DEADLINE.get() - time.monotonic()


@lru_cache(64)
def _file_digest(path: Path, size: int, changed: int) -> bytes:
    """Return the digest of a file's content; a file of the same size and time of change is not read again."""
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


def _is_plain(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(isinstance(name, str) and _is_plain(item) for name, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or type(value) in (bool, int, float, str) or isinstance(value, Path)


def ask(
    model: WorldModel, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
) -> NDArray[np.uint8]:
    """Return a model's frames, held to the contract: by what wraps the model, or else here."""
    return (check_rollout if model is model.unwrapped else type(model).rollout)(model, observations, controls, seeds)


def check_rollout(
    model: WorldModel, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
) -> NDArray[np.uint8]:
    """Ask a model and hold its answer to the contract.

    Raises:
        ContractError: wrong type, dtype, shape or number of frames, or NaN, named with what was expected; frames that
            are no pictures of what was observed (`pictures.check_pictures`).
    """
    observed = sample(observations.image).copy()  # a model may write into what it is handed
    frames = model.rollout(observations, controls, seeds)
    require_frames(model, frames, observations, controls)
    check_pictures(type(model.unwrapped).__name__, observed, frames, controls)
    return frames


def require_frames(model: WorldModel, frames: Any, observations: Conditioning, controls: Sequence[Control]) -> None:
    """Require the type, dtype, shape and number of frames that were asked for, in the size of the observations.

    Raises:
        ContractError: they are others, or there are NaN.
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
    """Return what to do about frames of another type or dtype; empty where that depends on the model."""
    if kind == "type" and hasattr(frames, "numpy"):
        return ". Give a NumPy array, as frames.detach().cpu().numpy() of a torch tensor"
    if kind == "dtype" and np.issubdtype(frames.dtype, np.floating):
        scaled = "255 * frames" if frames.size and frames.min() >= 0 and frames.max() <= 1 else "frames"
        return f". Round, clip and convert: ({scaled}).round().clip(0, 255).astype(numpy.uint8)"
    return ""


def _breach(frames: Any, expected: tuple[int, ...]) -> tuple[str, str]:
    """How an answer breaks the contract: in one word, and as seen."""
    if not isinstance(frames, np.ndarray):
        return "type", type(frames).__name__
    came = f"{frames.dtype} {frames.shape}"
    if np.issubdtype(frames.dtype, np.floating) and np.isnan(frames).any():
        return "nan", f"{came} with NaN"
    if frames.dtype != np.uint8:
        return "dtype", came
    other = frames.ndim == 5 and (*frames.shape[:1], *frames.shape[2:]) == (*expected[:1], *expected[2:])
    return ("frames" if other else "shape"), came
