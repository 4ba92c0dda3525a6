# SPDX-License-Identifier: Apache-2.0
"""What Cosmos2VideoToWorldPipeline takes for granted, where it is absent."""

from __future__ import annotations

import importlib.util
from types import SimpleNamespace
from typing import Any


def no_filter() -> Any:
    """A filter of prompts and frames that lets all pass: the pipeline insists on an object in its place."""
    import torch

    class NoFilter(torch.nn.Module):
        dtype = torch.float32
        device = torch.device("cpu")

        def check_text_safety(self, prompt: str) -> bool:
            return True

        def check_video_safety(self, frames: Any) -> Any:
            return frames

    return NoFilter()


def resize_without_torchvision() -> None:
    """Gives the transformer's module a resize of its padding mask, for which it would take torchvision's."""
    from diffusers.models.transformers import transformer_cosmos

    if importlib.util.find_spec("torchvision") is None and not hasattr(transformer_cosmos, "transforms"):
        transformer_cosmos.transforms = SimpleNamespace(
            functional=SimpleNamespace(resize=_resize), InterpolationMode=SimpleNamespace(NEAREST="nearest")
        )


def _resize(mask: Any, size: list[int], interpolation: str) -> Any:
    import torch

    return torch.nn.functional.interpolate(mask, size, mode=interpolation)
