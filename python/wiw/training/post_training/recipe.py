# SPDX-License-Identifier: Apache-2.0
"""Recipes of post-training: `wiw/configs/post-training/NAME.yaml`, a file of one's own, and options on top."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, overload

from wiw.errors import ArgumentError
from wiw.mapping_files import read_yaml_mapping
from wiw.typed_values import read_values

FOLDER = Path(__file__).parents[2] / "configs" / "post-training"
Schedule = Literal["constant", "linear", "cosine"]
Precision = Literal["bfloat16", "float32"]
OptimizerName = Literal["adamw", "adamw8bit"]


@dataclass(frozen=True, kw_only=True)
class ClipRecipe(ABC):
    """Numbers of any training on clips of frames and actions.

    Raises:
        ArgumentError: a number is out of range.
    """

    frames: int
    """Frames of a clip."""
    size: tuple[int, int] | None = None
    """Height and width in pixels that clips are brought to; those of the world model if None."""
    rate: float
    """Peak learning rate."""
    clips: int | None = 40_000
    """Number of clips in training; all there are if None. Fewer clips are always among the more."""
    epochs: int = 1
    batch: int = 16
    """Clips per step of the optimiser."""
    shift: float = 1.0
    """How far noise levels are moved towards noise, where the model's schedule has a shift."""
    clip_norm: float = 1.0
    """Largest norm of the gradient."""
    weight_decay: float = 0.01
    optimizer: OptimizerName = "adamw"
    """AdamW; "adamw8bit" keeps its moments in 8 bits, 2 bytes a parameter instead of 8."""
    ema: float = 0.0
    """Decay a step of averaged weights, which are what is kept; 0 averages nothing. After n updates it is at most
    (1 + n) / (10 + n), so that averages soon forget the weights that training began with."""
    precision: Precision = "bfloat16"
    """Precision of matrix products and of frozen weights; trained weights are float32."""
    seed: int = 0
    held_out: float = 0.05
    """Share of the scenes or demonstrations, chosen by a hash of their names, that are left out for validation."""
    validate_every: int | None = 500
    """Steps between two validations; none if None."""
    validate_clips: int = 8
    """Held-out clips of a validation."""

    def __post_init__(self) -> None:
        if self.size is not None:
            object.__setattr__(self, "size", tuple(self.size))
        self._require_counts("clips", "epochs", "batch", "validate_every", "validate_clips")
        self._require_shares("ema", "held_out")
        if self.frames < 2:
            raise ArgumentError(f"recipe: frames: expected 2 or more, got {self.frames}")
        for name in ("rate", "clip_norm", "shift"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ArgumentError(f"recipe: {name}: expected a finite number above 0, got {getattr(self, name)}")
        if not 0 <= self.weight_decay < math.inf or not 0 <= self.seed < 2**63:
            raise ArgumentError(
                "recipe: expected a finite weight_decay of 0 or more, and a seed from 0 to 2**63 - 1, got "
                f"{self.weight_decay} and {self.seed}"
            )
        if self.size is not None and (len(self.size) != 2 or min(self.size) < 8):
            raise ArgumentError(f"recipe: size: expected height and width in pixels, got {self.size}")

    @property
    def clip_size(self) -> tuple[int, int]:
        """Height and width of clips, once it is known which model they are for."""
        assert self.size is not None, "the family fills it in"
        return self.size

    @abstractmethod
    def scale_rate(self, progress: float) -> float:
        """Return the factor of the learning rate after a share of the steps, 0 to 1."""

    def describe(self) -> dict[str, Any]:
        """Return the recipe as JSON values."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    def _require_counts(self, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ArgumentError(f"recipe: {name}: expected 1 or more, got {value}")

    def _require_shares(self, *names: str) -> None:
        for name in names:
            if not 0 <= getattr(self, name) < 1:
                raise ArgumentError(f"recipe: {name}: expected a share from 0 to below 1, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class PostTrainingRecipe(ClipRecipe):
    """Numbers of one post-training.

    Raises:
        ArgumentError: a number is out of range.
    """

    schedule: Schedule = "constant"
    warmup: float = 0.0
    """Share of the steps in which the learning rate grows from 0."""
    rows: int = 1
    """Clips in one pass through the networks; gradients of several passes are added up."""
    lora: int = 0
    """Rank of the LoRA; 0 trains the whole denoiser."""
    drop: float = 0.1
    """Share of clips whose actions are replaced by the null token."""
    mirror: float = 0.0
    """Share of clips whose left and right are exchanged, in frames and primitives."""
    still: float = 0.0
    """NWM: share of clips whose context is its last frame, repeated, as at the first decision of an episode."""
    checkpointing: bool = True
    """Whether activations are computed again in the backward pass, which takes less memory."""
    shard: bool = False
    """Whether several processes have a part of weights, gradients and moments each (FSDP2), or all have the whole."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_counts("rows")
        self._require_shares("warmup", "drop", "mirror", "still")
        if self.lora < 0:
            raise ArgumentError(f"recipe: lora: expected 0 or more, got {self.lora}")
        if self.shard and self.optimizer == "adamw8bit":
            raise ArgumentError("recipe: shard: moments in 8 bits cannot be sharded; expected optimizer=adamw")
        if self.batch % self.rows:
            raise ArgumentError(f"recipe: rows: expected a divisor of batch ({self.batch}), got {self.rows}")

    def scale_rate(self, progress: float) -> float:
        """Return the factor of the learning rate after a share of the steps, 0 to 1."""
        if progress < self.warmup:
            return progress / self.warmup
        left = 1 - (progress - self.warmup) / (1 - self.warmup)
        factors: dict[Schedule, Callable[[], float]] = {
            "constant": lambda: 1.0,
            "linear": lambda: left,
            "cosine": lambda: 0.5 * (1 - math.cos(math.pi * left)),
        }
        return factors[self.schedule]()


R = TypeVar("R", bound=ClipRecipe)


@overload
def load_recipe(
    name: str, file: str | Path | None = None, options: Mapping[str, Any] | None = None
) -> PostTrainingRecipe: ...
@overload
def load_recipe(
    name: str, file: str | Path | None = None, options: Mapping[str, Any] | None = None, *, kind: type[R]
) -> R: ...
def load_recipe(
    name: str,
    file: str | Path | None = None,
    options: Mapping[str, Any] | None = None,
    *,
    kind: type[ClipRecipe] = PostTrainingRecipe,
) -> ClipRecipe:
    """Return the recipe of a model: shipped, with a YAML file of one's own and options on top.

    Args:
        name: of the model.
        file: YAML.
        options: by name.
        kind: of recipe that the model has.

    Raises:
        ArgumentError: a key that no recipe has, or a value of another type.
        FileError: the file cannot be read.
    """
    values: dict[str, Any] = {}
    for path in (FOLDER / f"{name}.yaml", *([Path(file)] if file else [])):
        values |= read_values(kind, read_yaml_mapping(path, "a recipe, `name: value` lines"), str(path))
    values |= read_values(kind, options or {}, "recipe")
    return kind(**values)
