# SPDX-License-Identifier: Apache-2.0
"""Cosmos-Predict2, video to world."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

from wiw.errors import ArgumentError, DependencyError
from wiw.types import Control
from wiw.world_models.base import accepts
from wiw.world_models.video.model import declare_requirements, require_no_nan
from wiw.world_models.video.text import TextVideoModel

HUB = "nvidia/Cosmos-Predict2-2B-Video2World"


@dataclass(kw_only=True, eq=False)
class CosmosPredict2(TextVideoModel):
    """Cosmos-Predict2 2B: a clip from the front view and the plan in words (NVIDIA 2025).

    Args:
        guardrail: whether NVIDIA's filter looks at prompts and frames. It has to be said: the licence of the weights
            terminates if the filter is removed without a substitute, and the filter is a package (`cosmos_guardrail`)
            with its own gated weights and requirements.
        fps: frames a second that the clip is made for.
    """

    accepts = accepts(control="text", view="perspective", frames=33, cacheable=True)
    requires = declare_requirements(HUB, options=("guardrail",))
    pipeline_class = "Cosmos2VideoToWorldPipeline"
    stride = 4
    max_batch = 16

    weights: str = HUB
    steps: int = 35
    guidance: float = 7.0
    frames: int = 33
    guardrail: bool | None = None
    negative_prompt: str = "static, motion blur, shaky footage, low resolution, distorted, flickering, jump cuts"
    fps: int = 16

    def __post_init__(self) -> None:
        if not isinstance(self.guardrail, bool):
            raise ArgumentError(
                "CosmosPredict2: choose guardrail=True (NVIDIA's filter; pip install cosmos_guardrail) or "
                "guardrail=False (without it; the licence of the weights requires you to use your own filter)"
            )
        super().__post_init__()
        name, precision = type(self).__name__, self.precision
        # of the decoder's frames, as the pipeline makes bytes for the filter, in which NaN is black
        self.pipeline.vae.decoder.register_forward_hook(
            lambda _, __, frames: require_no_nan(bool(frames.isnan().any()), name, precision)
        )

    def components(self) -> dict[str, Any]:
        """Return what takes the filter's place in the pipeline, which must not stay empty."""
        if self.guardrail and importlib.util.find_spec("cosmos_guardrail") is None:
            raise DependencyError(
                "cosmos_guardrail not installed; pip install cosmos_guardrail (which needs torchvision), or "
                "guardrail=False"
            )
        replace_torchvision_resize()
        return {} if self.guardrail else {"safety_checker": make_empty_filter()}

    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """Give a picture and a prompt per row."""
        return {
            "image": list(images),
            "prompt": [self.write_prompt(control) for control in controls],
            "negative_prompt": [self.negative_prompt] * len(images),
            "fps": self.fps,
        }


def make_empty_filter() -> Any:
    """Return a filter of prompts and frames that lets all pass: the pipeline insists on an object in its place."""
    import torch

    class NoFilter(torch.nn.Module):
        dtype = torch.float32
        device = torch.device("cpu")

        def check_text_safety(self, prompt: str) -> bool:
            return True

        def check_video_safety(self, frames: Any) -> Any:
            return frames

    return NoFilter()


def replace_torchvision_resize() -> None:
    """Give the transformer's module a resize of its padding mask, for which it would take torchvision's."""
    from diffusers.models.transformers import transformer_cosmos

    if importlib.util.find_spec("torchvision") is None and not hasattr(transformer_cosmos, "transforms"):
        transformer_cosmos.transforms = SimpleNamespace(
            functional=SimpleNamespace(resize=_resize), InterpolationMode=SimpleNamespace(NEAREST="nearest")
        )


def _resize(mask: Any, size: list[int], interpolation: str) -> Any:
    import torch

    return torch.nn.functional.interpolate(mask, size, mode=interpolation)
