# SPDX-License-Identifier: Apache-2.0
"""A stock image-to-video pipeline as a world model: options, batches, and which frame shows which action."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, ContractError
from wiw.types import Conditioning, Control
from wiw.world_models import devices
from wiw.world_models.base import WorldModel, accepts
from wiw.world_models.clips import shown
from wiw.world_models.video import loading
from wiw.world_models.video.loading import Offload, Precision
from wiw.world_models.video.weights import fetch, require_kind

Clips = NDArray[np.float32]
"""float32 [rows, frames, H, W, 3] from 0 to 1."""


@dataclass(kw_only=True, eq=False)
class VideoModel(WorldModel):
    """Base of the world models that run a pipeline of `diffusers` as it is.

    A subclass names the pipeline and says in `arguments` how an observation and a plan are put to it. Each row has a
    generator of its own, seeded with the row's seed, so that its frames do not depend on the rows beside it. The clip
    shows the plan evenly: with N frames, what follows action k of K is frame k (N - 1) / K, to the nearest. Frame 0 is
    the observation. Plans longer than N - 1 actions are imagined in parts by the loop, each from the last frame before.

    Args:
        weights: folder in the layout of `save_pretrained`, or name on the Hugging Face hub.
        revision: branch, tag or commit on the hub; pin a commit to run the same weights for ever.
        variant: of the weight files, such as "fp16".
        device: of torch; "cuda" where there is one, else "cpu".
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
    pipeline: ClassVar[str]
    """Class in `diffusers`."""
    kin: ClassVar[tuple[str, ...]] = ()
    """Other classes whose folders hold the same networks."""
    marks: ClassVar[Mapping[str, bool]] = {}
    """Settings in the folder's index that tell its generation: whether they are set."""
    guided_by: ClassVar[str] = "guidance_scale"
    """The pipeline's name of `guidance`."""
    half: ClassVar[Precision] = "bfloat16"
    """Precision on a GPU unless the user says otherwise."""
    parts: ClassVar[Mapping[str, Precision]] = {}
    """Networks that run in another precision than `half`."""
    multiple: ClassVar[int] = 16
    """What height and width are multiples of."""
    stride: ClassVar[int] = 1
    """Frames that the autoencoder makes one of: clips have a multiple of it, and one more."""
    most_rows: ClassVar[int] = 1
    """Rows that one call of the pipeline can take."""
    every_frame: ClassVar[bool] = False
    """Whether frame k of a clip follows action k, however long the plan: for models that know nothing of it."""
    immaterial: ClassVar[tuple[str, ...]] = ("weights", "revision", "offload", "batch")
    """Options that frames do not depend on: where the weights lie, which tell themselves, and how they are run."""

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

    def __post_init__(self) -> None:
        self._check()
        self.weights = str(self.weights)
        self.size = (_rounded(self.size[0], self.multiple), _rounded(self.size[1], self.multiple))
        self.frames = 1 + -(-(self.frames - 1) // self.stride) * self.stride
        self.accepts = replace(type(self).accepts, size=self.size, frames=self.frames, best_batch=self.batch)
        devices.require(self.requires)
        self.device = devices.device(self.device)
        self.precision = self.precision or ("float32" if self.device == "cpu" else self.half)
        components = self.components()
        self._weights = fetch(self.weights, self.pipeline, self.revision, self.variant, components)
        require_kind(self._weights.folder, (self.pipeline, *self.kin), self.marks)
        self._pipeline = loading.load(self, self._weights.folder, components)

    @abstractmethod
    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """What a call of the pipeline is given for these rows, beyond size, frames, steps, guidance and generators.

        `images` are of PIL, one a row.
        """
        raise NotImplementedError

    def components(self) -> dict[str, Any]:
        """Parts of the pipeline that are not in its folder."""
        return {}

    def generate(self, images: Sequence[Any], controls: Sequence[Control], generators: Sequence[Any]) -> Clips:
        """Clips of these rows from one call of the pipeline."""
        height, width = self.size
        common = {
            "height": height,
            "width": width,
            "num_frames": self.frames,
            "num_inference_steps": self.steps,
            self.guided_by: self.guidance,
            "generator": generators[0] if len(generators) == 1 else list(generators),
            "output_type": "np",
        }
        return np.asarray(self._pipeline(**{**common, **self.arguments(images, controls)}).frames)

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """One clip a row, `batch` rows at a time; padding repeats the last frame of the plan.

        Raises:
            DeviceMemoryError: the GPU's memory is full.
            ContractError: the networks gave NaN or another number of frames.
        """
        frames = np.empty((len(controls), self.frames, *observations.image.shape[1:]), np.uint8)
        for first in range(0, len(controls), self.batch):
            rows = slice(first, first + self.batch)
            with loading.memory_guard(self):
                clips = self._clips(observations.image[rows], controls[rows], seeds[rows])
            for frame, clip, control in zip(frames[rows], clips, controls[rows], strict=True):
                chosen = slice(None) if self.every_frame else shown(control.length, self.frames, self.frames)
                frame[:] = np.rint(clip[chosen] * 255)
        frames[:, 0] = observations.image
        return frames

    def _clips(self, images: NDArray[np.uint8], controls: Sequence[Control], seeds: NDArray[np.uint64]) -> Clips:
        import torch
        from PIL import Image

        generators = [torch.Generator("cpu").manual_seed(int(seed)) for seed in seeds]
        clips = self.generate([Image.fromarray(image) for image in images], controls, generators)
        if not np.isfinite(clips).all():
            raise ContractError(
                f"{type(self).__name__}: the pipeline gave NaN in {self.precision}; use another precision", "nan"
            )
        expected = (len(images), self.frames, *self.size, 3)
        if clips.shape != expected:
            raise ContractError(f"{type(self).__name__}: expected clips {expected}, got {clips.shape}", "frames")
        return clips

    def describe(self) -> dict[str, Any]:
        """Options, and what identifies the weights: the hub's commit or a digest of the folder."""
        return {**super().describe(), "pipeline": self.pipeline, **self._weights.identity, **loading.versions()}

    def identity(self) -> dict[str, Any]:
        """Return options, weights and versions; which GPU it is does not count."""
        return {**super().identity(), "device": str(self.device).partition(":")[0]}

    def __reduce__(self) -> Any:
        """As options: another process loads the weights itself."""
        return partial(type(self), **{field.name: getattr(self, field.name) for field in fields(self)}), ()

    def _check(self) -> None:
        """Raises ArgumentError for options out of range."""
        name = type(self).__name__
        sides = self.size if isinstance(self.size, list | tuple) else ()
        if len(sides) != 2 or not all(isinstance(side, int) and side > 0 for side in sides):
            raise ArgumentError(f"{name}: expected size (height, width) in pixels, got {self.size!r}")
        for option, least in (("steps", 1), ("frames", 2), ("batch", 1)):
            value = getattr(self, option)
            if not isinstance(value, int) or value < least:
                raise ArgumentError(f"{name}: expected {option}, a whole number of at least {least}, got {value!r}")
        if self.batch > self.most_rows:
            raise ArgumentError(f"{name}: {self.pipeline} takes {self.most_rows} at a time, got batch={self.batch}")
        for option, kinds in (("precision", Precision), ("offload", Offload)):
            allowed = get_args(kinds)
            if getattr(self, option) not in (None, *allowed):
                raise ArgumentError(f"{name}: expected {option} {', '.join(allowed)}, got '{getattr(self, option)}'")


def _rounded(pixels: int, multiple: int) -> int:
    return max(1, round(pixels / multiple)) * multiple
