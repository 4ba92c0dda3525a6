# SPDX-License-Identifier: Apache-2.0
"""Trains warpnet on walks, and measures it on ways that it never saw."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wiw import metrics, scenes
from wiw._core import core
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError
from wiw.reproject import pose, warp
from wiw.training.course import taught, up_and_down
from wiw.training.walks import Walks, straight_ways
from wiw.world_models.warpnet.model import WarpNet, to_network
from wiw.world_models.warpnet.network import FARTHEST, NEAREST, Network, Prediction

STRIDE = 0.2
"""Metres of a step ahead."""
STEPS = (1, 3, 5, 8)
"""Ahead, that the model is measured after."""


@dataclass(frozen=True)
class Recipe:
    """How the network is trained."""

    epochs: int = 6
    """How often each panorama is walked away from, on average."""
    batch: int = 4
    widths: tuple[int, int, int] = (32, 64, 128)
    """Channels of the U-Nets."""
    rate: float = 1.5e-3
    decay: float = 0.01
    warped: float = 0.5
    """Weight of what geometry alone gets wrong, beside what is wrong in the end."""
    distance: float = 0.3
    """Weight of errors of log-distance."""
    edges: float = 1.0
    """Weight of errors of the differences between neighbouring pixels."""
    paint: float = 0.02
    """Price of what is painted rather than warped: painting is soft."""
    bfloat16: bool = True
    """Products in half the bits: 1.5 times faster on CPUs that can (AVX512-BF16), slower on others."""
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch, *self.widths) < 1:
            raise ArgumentError(f"Recipe: epochs, batch and widths must be positive, got {self}")


def train(
    walks: Walks,
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    show: Callable[[int, int, float], None] = lambda step, steps, loss: None,
) -> tuple[Network, Recipe]:
    """A trained network, and the recipe that would give the same one again.

    Args:
        walks: to learn from.
        recipe: see there.
        minutes: if given, epochs are left out so that training takes about as long, by the speed of some trial steps.
        show: called after each step with its number, how many there are, and a running mean of the loss.
    """
    an_epoch = max(1, walks.places.size // recipe.batch)
    lesson, recipe = taught(lambda: _Lesson(walks, recipe), recipe, an_epoch, minutes, up_and_down(0.05), show)
    return lesson.network.eval(), recipe


class _Lesson:
    """A network in training, with all that its next step depends on."""

    def __init__(self, walks: Walks, recipe: Recipe) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0x4C11]) % 2**63)
        self.walks, self.recipe = walks, recipe
        self.network = Network(walks.images.shape[2], recipe.widths)
        self._rng = np.random.default_rng(core.fold_key([recipe.seed, 0x4C12]))
        self._optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)

    def step(self, rate: float) -> float:
        """Learns from one batch of pairs; its loss."""
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        pairs = drawn(self.walks, self.recipe.batch, self._rng)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.recipe.bfloat16):
            found = self.network.train()(pairs.source, pairs.ahead)
        loss = _loss(found, pairs, self.recipe)
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimiser.step()
        return float(loss.detach())


@dataclass(frozen=True)
class Pairs:
    """Panoramas, and what is seen from `ahead` metres further ahead."""

    source: Tensor
    """[B, 3, H, W] in [-1, 1]."""
    ahead: Tensor
    """[B]."""
    target: Tensor
    log_distance: Tensor
    """[B, 1, H, W] of the target."""


def drawn(walks: Walks, count: int, rng: np.random.Generator) -> Pairs:
    """Any two panoramas of a way, in either direction, half of them mirrored, in other light."""
    stops = walks.places.shape[1]
    ways = rng.integers(0, len(walks), count)
    first = rng.integers(0, stops, count)
    second = (first + rng.integers(1, stops, count)) % stops
    ahead = walks.places[ways, second] - walks.places[ways, first]
    back, mirrored = ahead < 0, rng.random(count) < 0.5
    light = rng.uniform(0.8, 1.2, (count, 1, 1, 1)) * rng.uniform(0.92, 1.08, (count, 1, 1, 3))
    gain = torch.from_numpy(light.astype(np.float32)).permute(0, 3, 1, 2)
    source, target = (
        (to_network(_seen(walks.images[ways, stop], back, mirrored)) + 1) * gain - 1 for stop in (first, second)
    )
    metres = _seen(walks.distances[ways, second], back, mirrored).astype(np.float32)
    log_distance = np.log(np.clip(np.where(metres > 0, metres, FARTHEST), NEAREST, FARTHEST))
    return Pairs(source, torch.from_numpy(np.abs(ahead)), target, torch.from_numpy(log_distance)[:, None])


def _seen(panoramas: NDArray[Any], back: NDArray[np.bool_], mirrored: NDArray[np.bool_]) -> NDArray[Any]:
    """Panoramas [B, H, W, ...] by who goes the way back, or in a mirror."""
    made = panoramas.copy()
    made[back] = np.roll(made[back], made.shape[2] // 2, axis=2)
    made[mirrored] = made[mirrored, :, ::-1]
    return made


def _loss(found: Prediction, pairs: Pairs, recipe: Recipe) -> Tensor:
    height = pairs.target.shape[2]
    weights = torch.cos(torch.pi * ((torch.arange(height) + 0.5) / height - 0.5))[:, None]

    def error(a: Tensor, b: Tensor) -> Tensor:
        return ((a - b).abs() * weights).mean() / weights.mean()

    def edges(a: Tensor, b: Tensor) -> Tensor:
        across = error(a - a.roll(1, -1), b - b.roll(1, -1))
        return across + ((a - b)[:, :, 1:] - (a - b)[:, :, :-1]).abs().mul(weights[1:]).mean() / weights.mean()

    return (
        error(found.colours, pairs.target)
        + recipe.edges * edges(found.colours, pairs.target)
        + recipe.warped * error(found.warped, pairs.target)
        + recipe.distance * error(found.log_distance, pairs.log_distance)
        + recipe.paint * (found.mask * weights).mean() / weights.mean()
    )


# -- measuring ---------------------------------------------------------------------------------------------------------


def measured(
    model: WarpNet,
    specs: str,
    seed: int,
    ways: int = 3,
    bar: Callable[[Sequence[str], str, int], Iterable[str]] = lambda items, text, total: items,
) -> dict[str, Any]:
    """PSNR in dB and SSIM of `copy`, this model and `warp` by the number of steps straight ahead.

    {"ways": N, "psnr": {"copy": {"1": dB, ...}, "warpnet": ..., "warp": ...}, "ssim": likewise}. Means over up to
    `ways` places of each scene with 1.6 m free ahead, whole panoramas, weighted by latitude.

    Raises:
        ArgumentError: there is no such place in the scenes.
    """
    names = scenes.resolve(specs)
    rows = [row for name in bar(names, f"measuring on {specs}", len(names)) for row in _scene(model, name, seed, ways)]
    if not rows:
        raise ArgumentError(f"{specs}: nowhere are {STEPS[-1] * STRIDE:.1f} m free ahead; name others (--val)")
    means = {
        measure: {
            name: {str(steps): round(float(np.mean([row[measure, name, steps] for row in rows])), 4) for steps in STEPS}
            for name in ("copy", "warpnet", "warp")
        }
        for measure in ("psnr", "ssim")
    }
    return {"ways": len(rows), **means}


def _scene(model: WarpNet, name: str, seed: int, ways: int) -> list[dict[tuple[str, str, int], float]]:
    """Both measures by model and steps, for each way of a scene."""
    here = world(name)
    length = STEPS[-1] * STRIDE
    rows = []
    for way in straight_ways(here, ways, core.fold_key([seed, 0x4C13]), length, length):
        poses = way.poses(here, np.array([0, *STEPS]) * STRIDE)
        color = here.renderer.panorama(poses, outputs=("color",))["color"]
        depth = here.renderer.panorama(poses[:1], outputs=("depth",))["depth"]
        row = {}
        for steps, target in zip(STEPS, color[1:], strict=True):
            shown = {
                "copy": color[0],
                "warpnet": model.imagine_move(color[0], steps * STRIDE, 0.0),
                "warp": warp(color[:1], depth, pose(forward=steps * STRIDE)[None, None])[0, 0],
            }
            for made, image in shown.items():
                row["psnr", made, steps] = float(metrics.psnr(image, target, weights="latitude"))
                row["ssim", made, steps] = float(metrics.ssim(image, target, weights="latitude"))
        rows.append(row)
    return rows
