# SPDX-License-Identifier: Apache-2.0
"""Train warpnet on windows of a navigation dataset, each of them one example of a batch.

Of a window, the first frame and a later one from another place make a pair, both rolled so that they face from one to
the other; in either direction, half of them mirrored, with other brightness and tint, as in training on walks.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from wiw import action
from wiw.datasets.shrunk_navigation import ShrunkNavigation
from wiw.training.held_out_clips import APART, Frames, Imagine, turn_panoramas
from wiw.training.post_training.clip_order import ClipOrder
from wiw.training.trainer import warmup_cosine_schedule
from wiw.training.warpnet import Pairs, Recipe, WarpNetTrainer, build_pairs
from wiw.world_models.warpnet.model import to_network
from wiw.world_models.warpnet.network import Network
from wiw.world_models.warpnet.weights import load, save


class WarpNetLearner:
    """warpnet as `wiw study data-scaling` trains it; see `wiw.training.learners.Learner`."""

    name = "warpnet"
    needs_depth = True

    def train(
        self,
        data: ShrunkNavigation,
        windows: NDArray[np.int64],
        order: ClipOrder,
        steps: int,
        seed: int,
        on_step: Callable[[int], None],
    ) -> Network:
        """Train a network of random weights on windows, in an order, for so many steps."""
        recipe, schedule = Recipe(batch=order.batch, seed=seed), warmup_cosine_schedule(0.05)
        batches = (windows[order.select(step)] for step in range(steps))
        trainer = WarpNetTrainer(lambda _, rng: draw_pairs(data, next(batches), rng), data.size[0], recipe)
        for step in range(steps):
            trainer.train_step(recipe.rate * schedule(step / steps))
            on_step(step + 1)
        return trainer.network.eval()

    def save(self, network: Any, path: Path, card: dict[str, Any]) -> None:
        """Write the weights, as `wiw.world_model("warpnet", weights=path)` reads them."""
        save(path, network, card)

    def load(self, path: Path) -> Network:
        """Read the weights."""
        return load(path)[0].eval()

    def imagine(self, network: Any) -> Imagine:
        """Return how a network imagines, all frames of a call in one batch and in the network's own size."""
        return lambda images, plans, seeds, wanted: imagine_frames(network, images, plans, wanted)


def draw_pairs(data: ShrunkNavigation, windows: NDArray[np.int64], rng: np.random.Generator) -> Pairs:
    """Draw a pair from each window: its first frame and a later one, from another place where there is one."""
    paths = action.to_trajectory(data.plans(windows))
    moved = np.linalg.norm(paths[..., :2], axis=-1) > APART
    later = np.where(moved, rng.random(moved.shape), -1.0).argmax(axis=1)
    rows = np.arange(len(windows))
    x, y, azimuth = paths[rows, later].T
    frames = np.stack([np.zeros_like(later), later + 1], axis=1)
    heading = np.arctan2(y, x)
    turns = np.stack([heading, heading - azimuth], axis=1)
    images = turn_panoramas(data.show(windows, frames), turns)
    distances = turn_panoramas(data.show_distances(windows, frames)[..., None], turns)[..., 0]
    back = rng.random(len(windows)) < 0.5
    first, second = back.astype(np.int64), 1 - back.astype(np.int64)
    ahead = np.hypot(x, y).astype(np.float32)
    return build_pairs(
        images[rows, first], images[rows, second], distances[rows, second], np.where(back, -ahead, ahead), rng
    )


@torch.inference_mode()
def imagine_frames(network: Network, images: Frames, plans: NDArray[np.int8], wanted: NDArray[np.int64]) -> Frames:
    """Return the frames [B, S, H, W, 3] after `wanted` [B, S] actions of plans [B, K], for images [B, H, W, 3]."""
    places = np.take_along_axis(action.to_trajectory(plans), wanted[..., None] - 1, axis=1)
    x, y, azimuth = np.moveaxis(places, -1, 0)
    heading = np.where(np.hypot(x, y) > APART, np.arctan2(y, x), 0.0)
    sources = np.repeat(images[:, None], wanted.shape[1], axis=1)
    facing = turn_panoramas(sources, heading)
    moved = np.hypot(x, y) > APART
    if moved.any():
        ahead = torch.from_numpy(np.hypot(x, y)[moved].astype(np.float32))
        colours = network(to_network(facing[moved]), ahead).colours.permute(0, 2, 3, 1)
        facing[moved] = (colours * 127.5 + 127.5).round().clamp(0, 255).byte().numpy()
    return turn_panoramas(facing, azimuth - heading)
