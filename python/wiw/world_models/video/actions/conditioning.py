# SPDX-License-Identifier: Apache-2.0
"""Condition the denoisers of a video pipeline on actions: an encoder and an injection for each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from numpy.typing import NDArray

from wiw.world_models.video.actions.encoder import ActionEncoder
from wiw.world_models.video.actions.injection import Injection


class ActionConditioning:
    """Give the denoisers of one pipeline each frame's action.

    Args:
        encoders: one for each denoiser, by its place in the pipeline; they are moved to the device.
        pipeline: holds the denoisers.
        device: of torch, on which the denoisers work.

    Raises:
        ArgumentError: a denoiser of a class that cannot be conditioned.
    """

    def __init__(self, encoders: Mapping[str, ActionEncoder], pipeline: Any, device: str | None) -> None:
        self.encoders = {place: encoder.to(device) for place, encoder in encoders.items()}
        self.injections = {place: Injection(getattr(pipeline, place)) for place in encoders}
        self._device = device

    @contextmanager
    def apply(self, actions: NDArray[Any]) -> Iterator[None]:
        """Condition calls of the pipeline on actions, ids [B, N] or poses [B, N, 7], as long as the context lasts."""
        with ExitStack() as stack, torch.inference_mode():
            tensor = torch.from_numpy(actions).to(self._device)
            for place, encoder in self.encoders.items():
                stack.enter_context(self.injections[place].inject(encoder(tensor)))
            yield
