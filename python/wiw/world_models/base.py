# SPDX-License-Identifier: Apache-2.0
"""What a world model is: one class, one method, one declaration of what it accepts."""

from __future__ import annotations

import importlib.util
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from wiw.action import TextTemplate
from wiw.errors import ArgumentError, ContractError
from wiw.types import Conditioning, Control, ControlKind, Space, View

CONTROLS = ("image", "text", "trajectory", "viewpoint", "action")
NEEDS = ("depth", "semantic", "history", "simulator")


@dataclass(frozen=True)
class Accepts:
    """A world model's declaration, read by the loop; made by `wiw.accepts(...)`, which checks it."""

    control: ControlKind
    space: Space
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


def accepts(
    control: ControlKind,
    view: View = "panorama",
    size: tuple[int, int] | None = None,
    frames: int = 0,
    *,
    space: Space = "discrete",
    needs: Sequence[str] = (),
    causal: bool = False,
    best_batch: int = 8,
    vocabulary: dict[int, Any] | None = None,
    null_first: bool = False,
    template: TextTemplate | None = None,
    cacheable: bool = False,
) -> Accepts:
    """Declares what a world model takes and gives (paper, section "Unified Action API").

    Args:
        control: which member of `Control` the model reads: "image" (none), "text", "trajectory", "viewpoint", "action".
        view: "perspective" (HFOV 90 front view) or "panorama" (equirectangular).
        size: (height, width) of its input and output; default 480x480 or 576x1024. A perspective view of any shape is
            90 degrees wide and has square pixels: what a wide one does not reach of an agent's view is black there.
        frames: length of a rollout with frame 0; 0 means any. Shorter plans are padded, longer ones chunked.
        space: "discrete" primitives or "pose7" poses; an agent says so where it cannot give them.
        needs: any of "depth", "semantic", "history", likewise; "simulator" is for `oracle` alone.
        causal: frame k depends on controls 1..k only, so shared prefixes are imagined once.
        best_batch: rows per call at which the model is most efficient.
        vocabulary: primitive id to the model's own id or vector, for control "action"; default: primitive ids.
        null_first: the model wants a null token for frame 0 in front of the actions.
        template: words of the prompt, for control "text"; see `wiw.action.TextTemplate`.
        cacheable: keep rollouts on disk and never ask twice. Say so for a model that takes long and whose answer is a
            function of what it is handed: not for one that draws without the seeds, nor for a server that may change.

    Raises:
        ArgumentError: a value is not one of the above.
    """
    size = size or ((480, 480) if view == "perspective" else (576, 1024))
    _check("control", control, CONTROLS)
    _check("view", view, ("perspective", "panorama"))
    _check("space", space, ("discrete", "pose7"))
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
    )


def _check(name: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise ArgumentError(f"accepts: {name} is '{value}', expected one of {', '.join(allowed)}")


@dataclass(frozen=True)
class Requirements:
    """What a world model needs of a machine; `wiw list world-models` says what of it is there."""

    packages: tuple[str, ...] = ()
    """Importable names."""
    extra: str = ""
    """Of wiw, which installs them: `pip install 'wiw[EXTRA]'`."""
    weights: str = ""
    """Name on the Hugging Face hub of what is loaded by default; of a served model, where its weights are published."""
    gpu: bool = False
    """Whether it is of no practical use without one."""
    variables: tuple[str, ...] = ()
    """Of the environment, such as the key of a service."""
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


class WorldModel(ABC):
    """Predicts what an agent would see. Subclasses set `accepts` and write `rollout`."""

    accepts: Accepts
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
            observations: B rows in the declared view and size.
            controls: B rows; frame k is what follows action k.
            seeds: uint64 [B], one per row, so that results do not depend on how rows are batched.

        Returns:
            uint8 [B, T, H, W, 3] with T = actions + 1; frame 0 is the observation. In memory that later calls leave
            alone: earlier answers are still looked at then.
        """
        raise NotImplementedError

    def for_space(self, space: Space) -> WorldModel:
        """The model for plans of primitives or of poses, where it is asked with both. Default: itself."""
        return self

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

    def fingerprint(self) -> str:
        """Text that changes with everything the answers depend on beside what the model is handed; names cached
        rollouts.

        Default: a digest of the class, its source file (in a notebook its code, and what that reads), `describe()` and
        all attributes, arrays and torch networks by content. Override it where that takes long, or where an attribute
        is of another kind.

        Raises:
            ArgumentError: an attribute's content cannot be told; names it.
        """
        from wiw.world_models.fingerprint import fingerprint

        return fingerprint(self)


_GIVE_UP: ContextVar[float] = ContextVar("wiw_give_up", default=math.inf)


@contextmanager
def patience(seconds: float) -> Iterator[None]:
    """Tells models that are asked inside for how long their answer is waited for."""
    token = _GIVE_UP.set(time.monotonic() + seconds)
    try:
        yield
    finally:
        _GIVE_UP.reset(token)


def seconds_left() -> float:
    """For how long the caller of `rollout` still waits for its answer: for models that wait for others themselves.

    Infinite where nobody has set a deadline.
    """
    return _GIVE_UP.get() - time.monotonic()


def _is_plain(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(isinstance(name, str) and _is_plain(item) for name, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or type(value) in (bool, int, float, str) or isinstance(value, Path)


def checked_rollout(
    model: WorldModel, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
) -> NDArray[np.uint8]:
    """`model.rollout` with its answer held to the contract.

    Raises:
        ContractError: wrong type, dtype, shape or number of frames, or NaN, named with what was expected.
    """
    frames = model.rollout(observations, controls, seeds)
    expected = (len(controls), len(controls[0].actions) + 1, *model.accepts.size, 3)
    if not isinstance(frames, np.ndarray) or frames.dtype != np.uint8 or frames.shape != expected:
        kind, came = _breach(frames, expected)
        raise ContractError(
            f"{type(model).__name__}.rollout: expected uint8 {expected} (batch, actions + 1, height, "
            f"width, 3), got {came}",
            kind,
        )
    return frames


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
