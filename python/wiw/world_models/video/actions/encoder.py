# SPDX-License-Identifier: Apache-2.0
"""Encode actions as one vector per latent frame, which is added to the diffusion time's embedding in a denoiser."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from wiw.errors import ArgumentError
from wiw.world_models.video.actions.config import ActionConfig

HIDDEN = 256
"""Width of one action's embedding."""


class ActionEncoder(nn.Module):
    """Encode one action per frame as one vector per latent frame: zero until trained, which changes nothing at first.

    The autoencoder makes one latent of the first frame and one of each `stride` frames after it. A latent reads the
    actions of its own frames, one after the other; the first one reads its frame's action `stride` times.
    """

    low: Tensor
    high: Tensor

    def __init__(self, config: ActionConfig) -> None:
        super().__init__()
        self.config = config
        if config.kind == "discrete":
            self.embed: nn.Module = nn.Embedding(len(config.vocabulary), HIDDEN)
        else:
            self.embed = nn.Linear(10, HIDDEN)
            self.null = nn.Parameter(torch.randn(HIDDEN))
            self.register_buffer("low", torch.tensor(config.low), persistent=False)
            self.register_buffer("high", torch.tensor(config.high), persistent=False)
        last = nn.Linear(config.width, config.width)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.mlp = nn.Sequential(nn.Linear(config.stride * HIDDEN, config.width), nn.SiLU(), last)

    def forward(self, actions: Tensor, dropped: Tensor | None = None) -> Tensor:
        """Return vectors [B, L, width] for L = 1 + (N - 1) / stride latent frames.

        Args:
            actions: ids [B, N] with the null token in front, or poses [B, N, 7] (x, y, z, roll, pitch, yaw, gripper) in
                metres and radians; entry k belongs to frame k.
            dropped: bool [B]: rows that get the null token instead, for guidance and its training.

        Raises:
            ArgumentError: another shape, or N that the autoencoder cannot divide.
        """
        self._check_shape(actions)
        each = self._embed_actions(actions, dropped)
        stride = self.config.stride
        first = each[:, :1].repeat(1, stride, 1)
        return self.mlp(torch.cat([first, each[:, 1:]], dim=1).unflatten(1, (-1, stride)).flatten(2))

    def _embed_actions(self, actions: Tensor, dropped: Tensor | None) -> Tensor:
        """Return each action's embedding, [B, N, HIDDEN]."""
        if self.config.kind == "discrete":
            ids = actions if dropped is None else actions.masked_fill(dropped[:, None], self.config.null)
            return self.embed(ids.long())
        each = self.embed(self._normalize_poses(actions))
        return each if dropped is None else torch.where(dropped[:, None, None], self.null.to(each.dtype), each)

    def _normalize_poses(self, poses: Tensor) -> Tensor:
        """Return [..., 10]: position in the workspace from -1 to 1, sines and cosines of the angles, gripper."""
        place = 2 * (poses[..., :3] - self.low) / (self.high - self.low) - 1
        angles = poses[..., 3:6]
        parts = torch.cat([place, angles.sin(), angles.cos(), poses[..., 6:]], dim=-1)
        return parts.to(self.null.dtype)

    def _check_shape(self, actions: Tensor) -> None:
        expected = "ids [B, N]" if self.config.kind == "discrete" else "poses [B, N, 7]"
        fits = actions.ndim == 2 if self.config.kind == "discrete" else actions.ndim == 3 and actions.shape[-1] == 7
        if not fits or (actions.shape[1] - 1) % self.config.stride:
            raise ArgumentError(
                f"ActionEncoder: expected {expected} with N one more than a multiple of {self.config.stride}, got "
                f"{tuple(actions.shape)}"
            )
