# SPDX-License-Identifier: Apache-2.0
"""An image-and-text-to-video pipeline as a world model: the plan in words, and which frame shows which action."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.types import Control, View
from wiw.world_models.base import accepts
from wiw.world_models.clips import EVEN, Alignment
from wiw.world_models.plan_text import make_template, read_words, write_prompt
from wiw.world_models.video.loading import model_memory_guard
from wiw.world_models.video.model import VideoModel

SIZES: Mapping[str, tuple[int, int]] = {"perspective": (480, 480), "panorama": (576, 1024)}
"""(height, width) of each view unless the user says otherwise."""


@dataclass(kw_only=True, eq=False)
class TextVideoModel(VideoModel):
    """The base of models that take the plan in words.

    Args:
        view: "perspective", or "panorama" for weights or a LoRA that were trained on panoramas.
        size: (height, width) of input and output; 480x480, of a panorama 576x1024.
        template: the words for a plan: a prompt with {actions}; or a mapping, or a YAML file of one, of prompt,
            separator, merge_runs and the phrases forward, turn_left, turn_right, stop, with slots {metres}, {degrees}.
        alignment: which frame shows which action, "even" or "frames_per_action=N"; see `Alignment`.
        negative_prompt: what the clip is steered away from, in words; empty for nothing.
        lora: file of a LoRA of the denoiser, or a folder with one; see `wiw.world_models.video.lora`.

    Raises:
        ArgumentError: words without {actions}, or an alignment that clips are too short for.
        WeightsError: a LoRA that does not fit the denoiser.
    """

    accepts = accepts(control="text", view="perspective", cacheable=True)
    wording_options: ClassVar[tuple[str, ...]] = ("view", "template", "alignment", "lora")
    immaterial: ClassVar[tuple[str, ...]] = (*VideoModel.immaterial, "lora")

    view: View = "perspective"
    size: tuple[int, int] | None = None  # type: ignore[assignment]
    template: str | Path | Mapping[str, Any] | None = None
    alignment: str = EVEN
    negative_prompt: str = ""
    lora: str | Path | None = None

    def __post_init__(self) -> None:
        if self.view not in get_args(View):
            raise ArgumentError(f"{type(self).__name__}: expected view {', '.join(get_args(View))}, got '{self.view}'")
        self.size = self.size or SIZES[self.view]
        self.template = read_words(self.template)
        self._words = make_template(self.template)
        super().__post_init__()
        self._alignment = Alignment.parse(self.alignment, self.frames)
        shown = {"view": self.view, "template": self._words, "frames": self._alignment.frames}
        self.accepts = replace(self.accepts, **shown)  # type: ignore[arg-type]
        self._loras = {place: self._load_lora(place, file) for place, file in self.list_loras().items()}

    def list_loras(self) -> dict[str, str | Path]:
        """Return the LoRA files by the place of their denoiser in the pipeline."""
        return {} if self.lora is None else {"transformer": self.lora}

    def write_prompt(self, control: Control) -> str:
        """Return the prompt of a plan."""
        return write_prompt(control, self._words, self._alignment)

    def choose_frames(self, control: Control) -> NDArray[np.int64]:
        """Return which frame of the clip each frame of the rollout is."""
        return self._alignment.choose_frames(control.length)

    def describe(self) -> dict[str, Any]:
        """Return the options, less those on wording that are at their defaults, and digests of weights and LoRA."""
        usual = {each.name: each.default for each in fields(self) if each.name in self.wording_options}
        said = {name: value for name, value in super().describe().items() if name not in usual or value != usual[name]}
        return {**said, **{f"lora_digest_{place}": digest for place, digest in self._loras.items()}}

    def _load_lora(self, place: str, source: str | Path) -> str:
        """Put a LoRA into a denoiser and return the digest of its file."""
        from wiw.world_models.video.lora import find_lora, load_lora

        file = find_lora(source)
        with model_memory_guard(self):
            load_lora(file, place, self.pipeline)
        return blake2b(file.read_bytes(), digest_size=20).hexdigest()
