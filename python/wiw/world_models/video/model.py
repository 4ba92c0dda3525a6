# SPDX-License-Identifier: Apache-2.0
"""A stock image-to-video pipeline as a world model: options, batches, and which frame shows which action."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, ContractError
from wiw.networks import resolve_device
from wiw.types import Conditioning, Control
from wiw.world_models.base import Requirements, WorldModel, accepts
from wiw.world_models.clips import frames_after_actions
from wiw.world_models.video import loading
from wiw.world_models.video.loading import Offload, Precision
from wiw.world_models.video.weights import fetch_weights, require_kind

Clips = NDArray[np.float32]
"""float32 [rows, frames, H, W, 3] from 0 to 1."""
PACKAGES = ("torch", "diffusers", "transformers", "accelerate")
"""Requirements of every pipeline."""
T = TypeVar("T", bound="VideoModel")


def declare_requirements(hub: str, packages: Sequence[str] = (), options: Sequence[str] = ()) -> Requirements:
    """Declare what a pipeline needs: its weights on the hub, packages beyond the usual, options without a default."""
    return Requirements((*PACKAGES, *packages), "diffusers", hub, gpu=True, options=tuple(options))


@dataclass(kw_only=True, eq=False)
class VideoModel(WorldModel):
    """Run a pipeline of `diffusers` as it is: the base of these world models.

    A subclass names the pipeline and says in `arguments` how an observation and a plan are put to it. Each row has a
    generator of its own, seeded with the row's seed, so that its frames do not depend on the rows beside it. The clip
    shows the plan evenly: with N frames, what follows action k of K is frame k (N - 1) / K, to the nearest. Frame 0 is
    the observation. Plans longer than N - 1 actions are imagined in parts by the loop, each from the last frame before.

    Args:
        weights: folder in the layout of `save_pretrained`, or name on the Hugging Face hub.
        revision: branch, tag or commit on the hub; pin a commit to run the same weights for ever.
        variant: of the weight files, such as "fp16".
        device: of torch; "cuda" if there is one, else "cpu".
        precision: of the weights; the model's usual half precision on a GPU, float32 on the CPU.
        offload: "model" keeps on the GPU only the network at work, "sequential" only the layer: less memory, slower.
        steps: denoising steps.
        guidance: scale of classifier-free guidance.
        size: (height, width) of input and output; rounded to what the networks can divide. A front view is 90 degrees
            wide whatever its shape: a wide one shows less above and below, which stays black in the agent's view.
        frames: of a clip, the observation included; rounded up to what the autoencoder can divide.
        batch: rows in one call of the pipeline.

    Raises:
        DependencyError: `diffusers` or what the pipeline needs beside it is not installed.
        WeightsError: the weights cannot be had or are another model's; its `kind` says why.
        DeviceMemoryError: they do not fit on the GPU.
        ArgumentError: an option out of range, or a device that torch does not have.
    """

    accepts = accepts(control="text", view="perspective", cacheable=True)
    version = "1"
    pipeline_class: ClassVar[str]
    """Name in `diffusers`."""
    compatible_pipelines: ClassVar[tuple[str, ...]] = ()
    """Other pipeline classes whose folders hold the same networks."""
    index_flags: ClassVar[Mapping[str, bool]] = {}
    """Settings in the folder's index that distinguish generations of a model: whether they are set."""
    guidance_argument: ClassVar[str] = "guidance_scale"
    """The pipeline's name of `guidance`."""
    half_precision: ClassVar[Precision] = "bfloat16"
    """Precision on a GPU unless the user says otherwise."""
    network_precisions: ClassVar[Mapping[str, Precision]] = {}
    """Networks that run in another precision where the others run in `half_precision`."""
    multiple: ClassVar[int] = 16
    """Height and width must be multiples of this."""
    stride: ClassVar[int] = 1
    """Frames that the autoencoder makes one of: clips have a multiple of it, and one more."""
    max_batch: ClassVar[int] = 1
    """Rows that one call of the pipeline can take."""
    frame_per_action: ClassVar[bool] = False
    """Whether frame k of a clip follows action k, however long the plan: for models that do not read it."""
    immaterial: ClassVar[tuple[str, ...]] = ("weights", "revision", "offload", "batch")
    """Options that frames do not depend on: where the weights lie, which have a digest, and how they are run."""
    wording_options: ClassVar[tuple[str, ...]] = ()
    """Options on how a plan is put into words and shown, which a model conditioned on actions does not have."""

    weights: str
    revision: str | None = None
    variant: str | None = None
    device: str | None = None
    precision: Precision | None = None
    offload: Offload = "none"
    steps: int
    guidance: float
    size: tuple[int, int] = (480, 480)
    frames: int
    batch: int = 1

    @classmethod
    def with_networks(cls: type[T], load: Callable[[T], Mapping[str, Any]], **options: Any) -> T:
        """Make the model with the networks that `load(model)` returns, by place, instead of those in its folder.

        `load` finds the model's device and precision resolved. Neither `describe` nor a pickle has these networks: the
        caller answers for their identity.
        """
        model = cls.__new__(cls)
        model.components = lambda: {**cls.components(model), **load(model)}  # type: ignore[method-assign]
        cls.__init__(model, **options)
        return model

    def __post_init__(self) -> None:
        self._check_options()
        self.weights = str(self.weights)
        self.size = (_round(self.size[0], self.multiple), _round(self.size[1], self.multiple))
        self.frames = 1 + -(-(self.frames - 1) // self.stride) * self.stride
        self.accepts = replace(type(self).accepts, size=self.size, frames=self.frames, best_batch=self.batch)
        self.requires.require()
        self.device = resolve_device(self.device)
        self.precision = self.precision or ("float32" if self.device == "cpu" else self.half_precision)
        components = self.components()
        self._weights = fetch_weights(self.weights, self.pipeline_class, self.revision, self.variant, components)
        require_kind(self._weights.folder, (self.pipeline_class, *self.compatible_pipelines), self.index_flags)
        self.pipeline: Any = loading.load_pipeline(self, self._weights.folder, components)

    @abstractmethod
    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """Return what one call of the pipeline takes for these rows beyond size, frames, steps, guidance, generators.

        `images` are of PIL, one per row.
        """
        raise NotImplementedError

    def components(self) -> dict[str, Any]:
        """Return parts of the pipeline, by their place, that are not in its folder."""
        return {}

    def generate(self, images: Sequence[Any], controls: Sequence[Control], generators: Sequence[Any]) -> Clips:
        """Return the clips of these rows from one call of the pipeline."""
        height, width = self.size
        common = {
            "height": height,
            "width": width,
            "num_frames": self.frames,
            "num_inference_steps": self.steps,
            self.guidance_argument: self.guidance,
            "generator": generators[0] if len(generators) == 1 else list(generators),
            "output_type": "np",
        }
        return np.asarray(self.pipeline(**{**common, **self.arguments(images, controls)}).frames)

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return one clip per row, `batch` rows at a time; padding repeats the last frame of the plan.

        Raises:
            DeviceMemoryError: the GPU's memory is full.
            ContractError: the networks gave NaN or another number of frames.
        """
        frames = np.empty((len(controls), self.accepts.frames, *observations.image.shape[1:]), np.uint8)
        for rows in self.batches(len(controls)):
            clips = self.make_clips(observations.image[rows], controls[rows], seeds[rows])
            for frame, clip, control in zip(frames[rows], clips, controls[rows], strict=True):
                frame[:] = np.rint(clip[self.choose_frames(control)] * 255)
        frames[:, 0] = observations.image
        return frames

    def choose_frames(self, control: Control) -> Any:
        """Return which frame of the clip each frame of the rollout is, as an index."""
        if self.frame_per_action:
            return slice(None)
        return frames_after_actions(control.length, self.frames, self.frames)

    def batches(self, rows: int) -> Iterator[slice]:
        """Yield the slices of rows that the pipeline takes in one call each."""
        for first in range(0, rows, self.batch):
            yield slice(first, first + self.batch)

    def make_clips(self, images: NDArray[np.uint8], controls: Sequence[Control], seeds: NDArray[np.uint64]) -> Clips:
        """Return one clip per row, each from a generator of its own, from one call of the pipeline.

        Raises:
            DeviceMemoryError: the GPU's memory is full.
            ContractError: the networks gave NaN or another number of frames.
        """
        import torch
        from PIL import Image

        generators = [torch.Generator("cpu").manual_seed(int(seed)) for seed in seeds]
        with loading.model_memory_guard(self):
            clips = self.generate([Image.fromarray(image) for image in images], controls, generators)
        require_no_nan(not np.isfinite(clips).all(), type(self).__name__, self.precision)
        expected = (len(images), self.frames, *self.size, 3)
        if clips.shape != expected:
            raise ContractError(f"{type(self).__name__}: expected clips {expected}, got {clips.shape}", "frames")
        return clips

    def describe(self) -> dict[str, Any]:
        """Return the options, and what identifies the weights: the hub's commit or a digest of the folder."""
        return {**super().describe(), "pipeline": self.pipeline_class, **self._weights.identity, **loading.versions()}

    def identity(self) -> dict[str, Any]:
        """Return options, weights and versions; which GPU it is does not count."""
        return {**super().identity(), "device": str(self.device).partition(":")[0]}

    @property
    def options(self) -> dict[str, Any]:
        """Options of the model, those that were left open as resolved."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __reduce__(self) -> Any:
        """Pickle the options: another process loads the weights itself."""
        return partial(type(self), **self.options), ()

    def _check_options(self) -> None:
        """Raise ArgumentError for options out of range."""
        name = type(self).__name__
        sides = self.size if isinstance(self.size, list | tuple) else ()
        if len(sides) != 2 or not all(isinstance(side, int) and side > 0 for side in sides):
            raise ArgumentError(f"{name}: expected size (height, width) in pixels, got {self.size!r}")
        for option, least in (("steps", 1), ("frames", 2), ("batch", 1)):
            value = getattr(self, option)
            if not isinstance(value, int) or value < least:
                raise ArgumentError(f"{name}: expected {option}, a whole number of at least {least}, got {value!r}")
        if self.batch > self.max_batch:
            raise ArgumentError(
                f"{name}: {self.pipeline_class} takes {self.max_batch} at a time, got batch={self.batch}"
            )
        for option, kinds in (("precision", Precision), ("offload", Offload)):
            allowed = get_args(kinds)
            if getattr(self, option) not in (None, *allowed):
                raise ArgumentError(f"{name}: expected {option} {', '.join(allowed)}, got '{getattr(self, option)}'")


def require_no_nan(is_found: bool, name: str, precision: Precision | None) -> None:
    """Raise ContractError where NaN is found in what the networks of a model, named by its class, gave."""
    if is_found:
        raise ContractError(f"{name}: the pipeline gave NaN in {precision}; use another precision", "nan")


def _round(pixels: int, multiple: int) -> int:
    return max(1, round(pixels / multiple)) * multiple
