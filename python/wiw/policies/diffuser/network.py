# SPDX-License-Identifier: Apache-2.0
"""The network: predicts the clean path from a noised one, given the scene.

After "3D Diffuser Actor" (Ke, Gkanatsios, Fragkiadaki 2024): image features become tokens at their 3D positions, the
noised poses of a path are tokens at theirs, and attention relates them by relative positions alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from wiw.errors import ArgumentError
from wiw.policies.diffuser.attention import RelativeAttention
from wiw.policies.diffuser.diffusion import NOISE_LEVELS
from wiw.policies.diffuser.paths import MIDDLE, SCALE
from wiw.policies.diffuser.workspace import CELL, WorkspaceView
from wiw.typed_values import require_positive


@dataclass(frozen=True)
class Shape:
    """Size of the network.

    Raises:
        ArgumentError: a number below 1, or a width that is no multiple of 6 heads.
    """

    width: int = 96
    heads: int = 4
    layers: int = 4
    """Layers of the denoiser."""
    tokens: int = 640
    """Most tokens of a view."""
    poses: int = 6
    """Poses of a path."""
    wrist: bool = False
    """Whether scenes are seen by the wrist camera, too."""

    def __post_init__(self) -> None:
        require_positive("diffuser", self, "width", "heads", "layers", "tokens", "poses")
        if self.width % (6 * self.heads):
            raise ArgumentError(
                f"diffuser: expected a width divisible by 6 times the number of heads, got {self.width} with "
                f"{self.heads} heads"
            )


@dataclass(frozen=True)
class Views:
    """The images of B scenes by one camera, as in `WorkspaceView`."""

    image: Tensor
    """uint8 [B, h, w, 3]."""
    height: Tensor
    """[B, h, w]."""
    places: Tensor
    """[B, h / CELL, w / CELL, 3]."""


@dataclass(frozen=True)
class EncodedScene:
    """The condition of denoising: tokens [B, N, width] at positions [B, N, 3], the hand's last; `hidden` [B, N] are
    padding.
    """

    tokens: Tensor
    places: Tensor
    hidden: Tensor
    hand: Tensor
    """[B, width]: the gripper's rotation and opening."""


class Network(nn.Module):
    """Encodes a scene once, then denoises any number of paths. Attribute names are keys of the weight file.

    Args:
        shape: size of the network.
    """

    def __init__(self, shape: Shape = Shape()) -> None:
        super().__init__()
        width, self.shape = shape.width, shape
        fine, coarse = width // 3, 2 * width // 3
        self.encoder = nn.Sequential(
            nn.Conv2d(4, fine, CELL // 2, CELL // 2),
            Block(fine),
            nn.Conv2d(fine, coarse, 3, 2, padding=1),
            Block(coarse),
            Block(coarse, 2),
            nn.Conv2d(coarse, width, 1),
        )
        self.embed_hand = nn.Sequential(nn.Linear(7, width), nn.SiLU(), nn.Linear(width, width))
        self.embed_rotation = nn.Linear(6, width)
        self.order_embedding = nn.Parameter(torch.randn(shape.poses, width) * 0.5)
        self.embed_level = nn.Sequential(nn.Linear(32, width), nn.SiLU(), nn.Linear(width, width))
        self.layers = nn.ModuleList(Layer(width, shape.heads) for _ in range(shape.layers))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, 10)

    def encode_scene(self, views: Sequence[Views], now: Tensor) -> EncodedScene:
        """Encode what each camera sees, by the same convolutions, and the gripper's pose.

        Args:
            views: one of the front camera, and one of the wrist camera where `shape.wrist` says so.
            now: [B, 10], the gripper's present vector.
        """
        seen = [self._encode_view(each) for each in views]
        hand = self.embed_hand(now[:, 3:])
        tokens = torch.cat([*(tokens for tokens, _, _ in seen), hand[:, None]], dim=1)
        places = torch.cat([*(places for _, places, _ in seen), to_metres(now[:, None, :3])], dim=1)
        hidden = torch.cat([hidden for _, _, hidden in seen], dim=1)
        return EncodedScene(tokens, places, functional.pad(hidden, (0, 1), value=False), hand)

    def _encode_view(self, view: Views) -> tuple[Tensor, Tensor, Tensor]:
        """Return the tokens of one camera's view: features, positions, and which are padding."""
        seen = torch.cat([view.image / 127.5 - 1, view.height[..., None].float()], dim=-1).permute(0, 3, 1, 2)
        features = self.encoder(seen).flatten(2).transpose(1, 2)
        return _select_workspace_tokens(features, view.places.flatten(1, 2), self.shape.tokens)

    def denoise(self, scene: EncodedScene, noised: Tensor, level: Tensor) -> tuple[Tensor, Tensor]:
        """Return clean vectors [B, R, L, 9] and the gripper's logits [B, R, L].

        Args:
            scene: B scenes.
            noised: [B, R, L, 9], R paths per scene.
            level: int64 [B, R], their noise levels.
        """
        condition = self.embed_level(_encode_level(level)) + scene.hand[:, None]
        tokens = self.embed_rotation(noised[..., 3:]) + self.order_embedding
        places = to_metres(noised[..., :3])
        for layer in self.layers:
            tokens = layer(tokens, places, scene, condition=condition)
        found = self.head(self.norm(tokens))
        clean = torch.cat([noised[..., :3] + found[..., :3], found[..., 3:9]], dim=-1)
        return clean, found[..., 9]


class Layer(nn.Module):
    """Attention to the scene, attention among the poses of a path, and a feed-forward network, with modulated norms."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.cross_attention, self.self_attention = RelativeAttention(width, heads), RelativeAttention(width, heads)
        self.feed_forward = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
        self.norms = nn.ModuleList(nn.LayerNorm(width, elementwise_affine=False) for _ in range(3))
        self.modulation = nn.Linear(width, 6 * width)

    def forward(self, tokens: Tensor, places: Tensor, scene: EncodedScene, condition: Tensor) -> Tensor:
        """Update tokens [B, R, L, width] of R paths per scene; `condition` [B, R, width] encodes noise level and
        hand.
        """
        scales = self.modulation(condition)[..., None, :].chunk(6, dim=-1)

        def normalise(which: int) -> Tensor:
            return self.norms[which](tokens) * (1 + scales[2 * which]) + scales[2 * which + 1]

        queries, positions = normalise(0).flatten(1, 2), places.flatten(1, 2)  # all paths of a scene in one go
        tokens = tokens + self.cross_attention(queries, positions, scene.tokens, scene.places, scene.hidden).view_as(
            tokens
        )
        path, positions = normalise(1).flatten(0, 1), places.flatten(0, 1)
        tokens = tokens + self.self_attention(path, positions, path, positions).view_as(tokens)
        return tokens + self.feed_forward(normalise(2))


class Block(nn.Module):
    """Two 3x3 convolutions with a residual connection."""

    def __init__(self, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.inner = nn.Sequential(
            nn.GroupNorm(4, width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation),
            nn.GroupNorm(4, width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation),
        )

    def forward(self, image: Tensor) -> Tensor:
        """Return [B, width, H, W]."""
        return image + self.inner(image)


def to_tensors(views: WorkspaceView) -> Views:
    """Return views of B scenes by one camera as tensors."""
    return Views(*(torch.from_numpy(each) for each in (views.image, views.height, views.places)))


def to_metres(vectors: Tensor) -> Tensor:
    """Return the positions in metres of vectors' first three numbers."""
    return vectors * SCALE + torch.as_tensor(MIDDLE, dtype=vectors.dtype)


def _select_workspace_tokens(features: Tensor, places: Tensor, most: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the tokens in the workspace, padded to equal number: features, positions, and which are padding."""
    outside = places[..., 2] < 0
    count = min(most, max(1, int((~outside).sum(dim=1).max())))
    order = outside.to(torch.uint8).argsort(dim=1, stable=True)[:, :count, None]
    hidden = outside.gather(1, order[..., 0])
    places = places.gather(1, order.expand(-1, -1, 3)).masked_fill(hidden[..., None], 0.0)
    return features.gather(1, order.expand(-1, -1, features.shape[2])), places, hidden


def _encode_level(level: Tensor) -> Tensor:
    """Encode a noise level as sines and cosines, [..., 32]."""
    rates = torch.logspace(0, 2, 16)
    angles = level[..., None] / NOISE_LEVELS * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)
