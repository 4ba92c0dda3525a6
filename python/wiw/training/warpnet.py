# SPDX-License-Identifier: Apache-2.0
"""Train warpnet on walks, and evaluate it on held-out walks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wiw import metrics, scenes
from wiw._core import core
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError
from wiw.networks import autocast_bfloat16
from wiw.reproject import pose, warp
from wiw.training.checkpoint import Checkpoint, ResumableTrainer, require_unfinished
from wiw.training.gather import gather_walks, require_held_out
from wiw.training.preparation import PREPARATION, Preparation, ProgressBar, show_no_bar
from wiw.training.reduced_frames import compute_log_distances
from wiw.training.trainer import apply_gradients, run_training, warmup_cosine_schedule
from wiw.training.walks import WalkRules, Walks, find_straight_paths
from wiw.typed_values import require_positive
from wiw.world_models.warpnet.model import WarpNet, to_network
from wiw.world_models.warpnet.network import Network, Prediction
from wiw.world_models.warpnet.weights import load, save

STRIDE = 0.2
"""Metres of a step ahead."""
EVALUATED_STEPS = (1, 3, 5, 8)
"""Numbers of steps ahead at which the model is evaluated."""


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters of the training."""

    epochs: int = 6
    """Number of times each panorama is used as a source, on average."""
    batch: int = 4
    widths: tuple[int, int, int] = (32, 64, 128)
    """Channels of the U-Nets' levels."""
    rate: float = 1.5e-3
    decay: float = 0.01
    warped: float = 0.5
    """Weight of the warped image's errors beside those of the final image."""
    distance: float = 0.3
    """Weight of errors of the log-distance."""
    edges: float = 1.0
    """Weight of errors of the differences between neighbouring pixels."""
    paint: float = 0.02
    """Penalty on painted rather than warped pixels: paint is blurred."""
    bfloat16: bool = True
    """Compute products in bfloat16 on CPUs that have instructions for it, where it is faster."""
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive("Recipe", self, "epochs", "batch", "widths")


def make_weights(
    out: Path,
    scenes: str,
    val: str,
    rules: WalkRules = WalkRules(),
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    preparation: Preparation = PREPARATION,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    bar: ProgressBar = show_no_bar,
) -> dict[str, Any]:
    """Record walks, train on them, or resume, evaluate on held-out scenes, and write the weights; return the card.

    Args:
        out: file of the weights; the state of training is kept beside it.
        scenes: training scenes, as in `wiw run --scenes`.
        val: held-out scenes.
        rules: which walks are recorded.
        recipe: how to train; its seed is that of the walks, too.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        preparation: how walks are recorded and cached.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        bar: shows the progress of recording and evaluation.

    Raises:
        ArgumentError: scenes that are both trained and evaluated on, or where nobody can walk straight ahead; finished
            weights in the file, or a state of another training.
        TrainingError: the loss or a gradient is not finite.
        FileError: a file cannot be written.
    """
    require_unfinished(out)
    require_held_out(scenes, val)
    walks = gather_walks(scenes, recipe.seed, rules, **preparation.list_arguments(bar))
    card: dict[str, Any] = {"scenes": scenes, "val": val, "ways": len(walks), "walks": asdict(rules)}
    checkpoint = Checkpoint.beside(out, {**card, "recipe": asdict(recipe), "minutes": minutes})
    network, recipe = train(walks, recipe, minutes, on_step, checkpoint)
    card |= {"recipe": asdict(recipe)}
    save(out, network, card)  # before the evaluation, which takes another minute
    card["held_out"] = evaluate(WarpNet(out), val, recipe.seed, bar=bar)
    save(out, load(out)[0], card)
    checkpoint.remove()
    return card


def train(
    walks: Walks,
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    checkpoint: Checkpoint | None = None,
) -> tuple[Network, Recipe]:
    """Train a network; return it with the recipe that reproduces it without a time limit.

    Args:
        walks: to learn from.
        recipe: how to train; see `Recipe`.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        checkpoint: where the state of training is saved, and from where it resumes.
    """
    steps_per_epoch = max(1, walks.places.size // recipe.batch)
    trainer, recipe = run_training(
        lambda: _Trainer(walks, recipe),
        recipe,
        steps_per_epoch,
        minutes,
        warmup_cosine_schedule(0.05),
        on_step,
        checkpoint,
    )
    return trainer.network.eval(), recipe


class _Trainer(ResumableTrainer):
    """The network in training, with everything that its next step depends on."""

    stateful_parts = ("network", "optimiser")

    def __init__(self, walks: Walks, recipe: Recipe) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0x4C11]) % 2**63)
        self.walks, self.recipe = walks, recipe
        self.network = Network(walks.images.shape[2], recipe.widths)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch of pairs and return its loss."""
        rng = np.random.default_rng(core.fold_key([self.recipe.seed, 0x4C12, self.step_count]))
        pairs = sample_pairs(self.walks, self.recipe.batch, rng)
        with autocast_bfloat16("cpu", self.recipe.bfloat16):
            found = self.network.train()(pairs.source, pairs.ahead)
        loss = compute_losses(found, pairs, self.recipe).mean()
        loss.backward()
        apply_gradients(self.optimiser, self.network, learning_rate)
        self.step_count += 1
        return float(loss.detach())


@dataclass(frozen=True)
class Pairs:
    """Panoramas, and the views `ahead` metres further ahead."""

    source: Tensor
    """[B, 3, H, W] in [-1, 1]."""
    ahead: Tensor
    """[B]."""
    target: Tensor
    log_distance: Tensor
    """[B, 1, H, W] of the target."""

    def to(self, device: torch.device) -> Pairs:
        """Return the pairs on a device."""
        return Pairs(*(getattr(self, field.name).to(device) for field in fields(self)))


def sample_pairs(walks: Walks, count: int, rng: np.random.Generator) -> Pairs:
    """Sample pairs of panoramas of a walk, in either direction."""
    stops = walks.places.shape[1]
    paths = rng.integers(0, len(walks), count)
    first = rng.integers(0, stops, count)
    second = (first + rng.integers(1, stops, count)) % stops
    ahead = walks.places[paths, second] - walks.places[paths, first]
    log_distances = compute_log_distances(walks.distances[paths, second])
    return build_pairs(walks.images[paths, first], walks.images[paths, second], log_distances, ahead, rng)


def build_pairs(
    source: NDArray[np.uint8],
    target: NDArray[np.uint8],
    log_distances: NDArray[Any],
    ahead: NDArray[Any],
    rng: np.random.Generator,
) -> Pairs:
    """Build pairs of panoramas, half of them mirrored, with other brightness and tint.

    Args:
        source: uint8 [B, H, W, 3].
        target: the same, seen from further ahead.
        log_distances: [B, H, W] of the target.
        ahead: [B]: metres; where below 0, the target is behind, and both are turned around.
        rng: draws the augmentation.
    """
    back, mirrored = ahead < 0, rng.random(len(ahead)) < 0.5
    light = rng.uniform(0.8, 1.2, (len(ahead), 1, 1, 1)) * rng.uniform(0.92, 1.08, (len(ahead), 1, 1, 3))
    gain = torch.from_numpy(light.astype(np.float32)).permute(0, 3, 1, 2)
    before, after = (
        (to_network(_augment_panoramas(images, back, mirrored)) + 1) * gain - 1 for images in (source, target)
    )
    distances = _augment_panoramas(log_distances, back, mirrored).astype(np.float32)
    return Pairs(
        before, torch.from_numpy(np.abs(ahead).astype(np.float32)), after, torch.from_numpy(distances)[:, None]
    )


def _augment_panoramas(panoramas: NDArray[Any], back: NDArray[np.bool_], mirrored: NDArray[np.bool_]) -> NDArray[Any]:
    """Turn panoramas [B, H, W, ...] backwards or mirror them, as each row's flags say."""
    made = panoramas.copy()
    made[back] = np.roll(made[back], made.shape[2] // 2, axis=2)
    made[mirrored] = made[mirrored, :, ::-1]
    return made


def compute_losses(found: Prediction, pairs: Pairs, recipe: Recipe) -> Tensor:
    """Return the loss of each pair, float32 [B]."""
    height, device = pairs.target.shape[2], pairs.target.device
    weights = torch.cos(torch.pi * ((torch.arange(height, device=device) + 0.5) / height - 0.5))[:, None]

    def average(values: Tensor, weights: Tensor) -> Tensor:
        return (values * weights).mean(dim=(1, 2, 3))

    def error(a: Tensor, b: Tensor) -> Tensor:
        return average((a - b).abs(), weights) / weights.mean()

    def edges(a: Tensor, b: Tensor) -> Tensor:
        across = error(a - a.roll(1, -1), b - b.roll(1, -1))
        return across + average(((a - b)[:, :, 1:] - (a - b)[:, :, :-1]).abs(), weights[1:]) / weights.mean()

    return (
        error(found.colours, pairs.target)
        + recipe.edges * edges(found.colours, pairs.target)
        + recipe.warped * error(found.warped, pairs.target)
        + recipe.distance * error(found.log_distance, pairs.log_distance)
        + recipe.paint * average(found.mask, weights) / weights.mean()
    )


# -- measuring ---------------------------------------------------------------------------------------------------------


def evaluate(
    model: WarpNet,
    specs: str,
    seed: int,
    paths: int = 3,
    bar: Callable[[Sequence[str], str, int], Iterable[str]] = lambda items, text, total: items,
) -> dict[str, Any]:
    """Measure PSNR in dB and SSIM of `copy`, this model and `warp` by the number of steps straight ahead.

    Returns:
        {"ways": N, "psnr": {"copy": {"1": dB, ...}, "warpnet": ..., "warp": ...}, "ssim": likewise}. Means over up to
        `paths` places of each scene with 1.6 m free ahead, over whole panoramas, weighted by latitude.

    Raises:
        ArgumentError: the scenes have no such place.
    """
    names = scenes.resolve(specs)
    rows = [
        row
        for name in bar(names, f"evaluating on {specs}", len(names))
        for row in _evaluate_scene(model, name, seed, paths)
    ]
    if not rows:
        raise ArgumentError(
            f"{specs}: nowhere is {EVALUATED_STEPS[-1] * STRIDE:.1f} m of free floor ahead; choose others (--val)"
        )
    means = {
        measure: {
            name: {
                str(steps): round(float(np.mean([row[measure, name, steps] for row in rows])), 4)
                for steps in EVALUATED_STEPS
            }
            for name in ("copy", "warpnet", "warp")
        }
        for measure in ("psnr", "ssim")
    }
    return {"ways": len(rows), **means}


def _evaluate_scene(model: WarpNet, name: str, seed: int, paths: int) -> list[dict[tuple[str, str, int], float]]:
    """Return both measures by model and steps, for each path of a scene."""
    here = world(name)
    length = EVALUATED_STEPS[-1] * STRIDE
    rows = []
    for path in find_straight_paths(here, paths, core.fold_key([seed, 0x4C13]), length, length):
        poses = path.camera_poses(here, np.array([0, *EVALUATED_STEPS]) * STRIDE)
        color = here.renderer.panorama(poses, outputs=("color",))["color"]
        depth = here.renderer.panorama(poses[:1], outputs=("depth",))["depth"]
        row = {}
        for steps, target in zip(EVALUATED_STEPS, color[1:], strict=True):
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
