# SPDX-License-Identifier: Apache-2.0
"""Train armnet on plays, and evaluate it on held-out plays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.networks import has_bfloat16
from wiw.training.checkpoint import Checkpoint, ResumableTrainer
from wiw.training.plays import POSES, Plays
from wiw.training.trainer import apply_gradients, run_training, warmup_cosine_schedule
from wiw.typed_values import require_positive
from wiw.world_models.armnet.body import render_bare_table
from wiw.world_models.armnet.motion import motion as motion_of
from wiw.world_models.armnet.network import (
    FRONT,
    WINDOW,
    Arm,
    Motion,
    Network,
    build_sources,
    clear_arm,
    compose_static_view,
    compose_view,
    find_unoccluded_arm,
    find_visible_arm,
)

HELD_OUT = 150
"""Number of plays that the network is evaluated on."""
HELD_OUT_SEED_OFFSET = 1000
"""Added to the seed of the training plays to get the seed of the held-out ones."""
EVALUATED_STEPS = (1, 2, 3, 5)
"""Numbers of poses after the observation at which the network is evaluated."""
SOURCE_TOLERANCE, PAINT_PENALTY = 0.03, 0.02
"""Colour differences: sources closer together than the tolerance count as equally good; paint, which is blurred, is
taken to be farther off by the penalty.
"""
CHANGE_THRESHOLD = 0.06
"""A pixel counts as changed if one of its channels differs by more than this."""


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters of the training."""

    epochs: int = 4
    """How often each pose of each play is predicted, on average."""
    batch: int = 4
    """Plays in a batch."""
    steps: int = 3
    """Successive poses predicted for each play of a batch."""
    free: float = 0.25
    """Share of free-running batches, in which each prediction starts from the one before. The others are
    teacher-forced: they start from true views, so that the network is never asked for what it cannot know.
    """
    widths: tuple[int, int, int] = (32, 64, 96)
    """Channels of the U-Net's levels."""
    rate: float = 1.5e-3
    decay: float = 0.01
    changes: float = 15.0
    """Weight of pixels that neither stay as they were nor show the arm, beside 1 for all others."""
    edges: float = 1.0
    """Weight of errors of the differences between neighbouring pixels."""
    paint: float = 0.3
    """Weight of errors of the paint alone, where things change: the paint learns to predict before it is used."""
    shares: float = 0.05
    """Weight of the cross-entropy between the mixing shares and the nearest source, where things change."""
    bfloat16: bool = True
    """Compute products in bfloat16 on CPUs that have instructions for it, where it is faster."""
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive("Recipe", self, "epochs", "batch", "widths", "steps")
        if self.steps > POSES:
            raise ArgumentError(f"Recipe: expected at most {POSES} steps, got {self.steps}")


def train(
    plays: Plays,
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    checkpoint: Checkpoint | None = None,
) -> tuple[Network, Recipe]:
    """Train a network; return it with the recipe that reproduces it without a time limit.

    Args:
        plays: to learn from.
        recipe: how to train; see `Recipe`.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        checkpoint: where the state of training is saved, and from where it resumes.
    """
    steps_per_epoch = max(1, len(plays) * POSES // (recipe.batch * recipe.steps))
    trainer, recipe = run_training(
        lambda: _Trainer(plays, recipe),
        recipe,
        steps_per_epoch,
        minutes,
        warmup_cosine_schedule(0.03),
        on_step,
        checkpoint,
    )
    return trainer.network.eval(), recipe


class _Trainer(ResumableTrainer):
    """The network in training, with everything that its next step depends on."""

    stateful_parts = ("network", "optimiser")

    def __init__(self, plays: Plays, recipe: Recipe) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0xA111]) % 2**63)
        self.plays, self.recipe = plays, recipe
        self.network = Network(recipe.widths)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch of short sequences and return its loss."""
        recipe, total = self.recipe, 0.0
        rng = np.random.default_rng(core.fold_key([recipe.seed, 0xA112, self.step_count]))
        self.step_count += 1
        batch = sample_sequences(self.plays, recipe.batch, recipe.steps, rng)
        predict = predict_free_running if rng.random() < recipe.free else predict_teacher_forced
        network = self.network.train()
        for part in predict(network, batch, recipe.bfloat16 and has_bfloat16()):
            loss = _compute_loss(part, recipe) * len(part.prediction) / (recipe.batch * recipe.steps)
            loss.backward()
            total += float(loss.detach())
        apply_gradients(self.optimiser, self.network, learning_rate)
        return total


@dataclass(frozen=True)
class Sequences:
    """T poses reached one after another, with the views before and after each."""

    views: list[Tensor]
    """T + 1 tensors [B, 3, h, w]."""
    arms: list[Arm]
    """T + 1 renderings of the arm over the bare table."""
    motions: list[Motion]
    """T motions of the gripper."""


def sample_sequences(plays: Plays, count: int, steps: int, rng: np.random.Generator) -> Sequences:
    """Sample sequences of `steps` poses that begin anywhere in `count` random plays."""
    rows = rng.integers(0, len(plays), count)
    return build_sequences(plays, rows, rng.integers(0, POSES + 1 - steps, count), steps)


def build_sequences(plays: Plays, rows: NDArray[np.int64], first: NDArray[np.int64], steps: int) -> Sequences:
    """Return the sequences of the plays `rows` that begin with their views `first`."""
    at = [first + k for k in range(steps + 1)]
    arms = [
        Arm(_to_tensor(plays.bare[rows, t]), torch.from_numpy(plays.arm[rows, t][:, None].astype(np.float32)))
        for t in at
    ]
    poses = plays.poses
    motions = [motion_of(poses[rows, t], poses[rows, t + 1]) for t in at[:-1]]
    return Sequences([_to_tensor(plays.views[rows, t]) for t in at], arms, motions)


def _to_tensor(images: NDArray[np.uint8]) -> Tensor:
    """Convert images uint8 [B, H, W, 3] to float [B, 3, H, W] in [0, 1]."""
    return torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255


def load_bare_table() -> Tensor:
    """Return the network's window of the table without arm and objects, [1, 3, h, w]."""
    return _to_tensor(render_bare_table(FRONT).color[WINDOW][None].copy())


@dataclass(frozen=True)
class StepPrediction:
    """The network's prediction for one motion, with the true view."""

    prediction: Tensor
    target: Tensor
    static_view: Tensor
    """The view if nothing but the arm had moved."""
    shares: Tensor
    sources: Tensor
    """The images that `prediction` is mixed from."""


def predict_free_running(network: Network, sequences: Sequences, bfloat16: bool = False) -> Iterator[StepPrediction]:
    """Predict step after step, each from the canvas that the prediction before has left."""
    plate = load_bare_table()
    canvas = clear_canvas(sequences.views[0], sequences.arms[0], plate)
    for k, motion in enumerate(sequences.motions):
        before, arm = sequences.arms[k : k + 2]
        step = _predict_step(network, canvas, before.mask, arm, motion, sequences.views[k + 1], bfloat16)
        canvas = clear_arm(step.prediction.detach(), arm, find_visible_arm(step.shares.detach(), arm), plate, canvas)
        yield step


def clear_canvas(seen: Tensor, arm: Arm, before: Tensor) -> Tensor:
    """Return the canvas after a true view."""
    return clear_arm(seen, arm, find_unoccluded_arm(seen, arm), load_bare_table(), before)


def predict_teacher_forced(network: Network, sequences: Sequences, bfloat16: bool = False) -> Iterator[StepPrediction]:
    """Predict all steps at once, each from the canvas that the true views before it have left."""
    plate = load_bare_table()
    canvases = [plate.expand_as(sequences.views[0])]
    for seen, arm in zip(sequences.views[:-1], sequences.arms[:-1], strict=True):
        canvases.append(clear_canvas(seen, arm, canvases[-1]))
    arm = Arm(
        torch.cat([each.color for each in sequences.arms[1:]]), torch.cat([each.mask for each in sequences.arms[1:]])
    )
    before = torch.cat([each.mask for each in sequences.arms[:-1]])
    fields = ("before", "after", "scalars", "below")
    motion = Motion(*(torch.cat([getattr(each, name) for each in sequences.motions]) for name in fields))
    yield _predict_step(network, torch.cat(canvases[1:]), before, arm, motion, torch.cat(sequences.views[1:]), bfloat16)


def _predict_step(
    network: Network, canvas: Tensor, before: Tensor, arm: Arm, motion: Motion, target: Tensor, bfloat16: bool
) -> StepPrediction:
    plate = load_bare_table()
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        mixture = network(canvas, arm, before, motion, plate)
    parts = build_sources(mixture, canvas, arm, motion, plate)
    return StepPrediction(
        compose_view(mixture.shares, parts), target, compose_static_view(canvas, arm, plate), mixture.shares, parts
    )


def _compute_loss(step: StepPrediction, recipe: Recipe) -> Tensor:
    differs = ((step.target - step.static_view).abs().amax(1, keepdim=True) > CHANGE_THRESHOLD).float()
    weight = 1 + recipe.changes * functional.max_pool2d(differs, 3, 1, 1)
    gap = step.prediction - step.target

    def error(a: Tensor, w: Tensor) -> Tensor:
        return (a.abs() * w).sum() / (3 * weight.sum())

    across = gap[..., 1:] - gap[..., :-1], torch.maximum(weight[..., 1:], weight[..., :-1])
    down = gap[..., 1:, :] - gap[..., :-1, :], torch.maximum(weight[..., 1:, :], weight[..., :-1, :])
    off = (step.sources - step.target[:, None]).abs().mean(2)
    aside = off.detach() + PAINT_PENALTY * torch.tensor([0.0, 0.0, 0.0, 1.0])[:, None, None]
    choice = -((-aside / SOURCE_TOLERANCE).softmax(1) * (step.shares + 1e-6).log()).sum(1, keepdim=True)
    count = differs.sum() + 1
    return (
        error(gap, weight)
        + recipe.edges * (error(*across) + error(*down))
        + recipe.paint * (off[:, 3:] * differs).sum() / count
        + recipe.shares * (choice * differs).sum() / count
    )


# -- measuring ---------------------------------------------------------------------------------------------------------


def evaluate(network: Network, plays: Plays) -> dict[str, Any]:
    """Compare `copy`, the arm alone and the network with the true views, by the number of poses after the observation.

    Returns:
        {"plays": N, "changed": {"copy": {"1": error, ...}, "arm": ..., "armnet": ...}, "psnr": likewise}. "changed" is
        the mean absolute error, in units of 1/255, over the pixels whose true colour differs from the first view with
        only the arm moved; "psnr" is in dB over the whole window.
    """
    most = max(EVALUATED_STEPS)
    rows = np.arange(len(plays))
    errors: dict[str, dict[str, list[float]]] = {name: {} for name in ("copy", "arm", "armnet")}
    noise: dict[str, dict[str, list[float]]] = {name: {} for name in errors}
    for part in np.array_split(rows, max(1, len(rows) // 16)):
        batch = build_sequences(plays, part, np.zeros(len(part), np.int64), most)
        plate = load_bare_table()
        first = clear_canvas(batch.views[0], batch.arms[0], plate)
        with torch.inference_mode():
            for number, step in enumerate(predict_free_running(network, batch), 1):
                if number not in EVALUATED_STEPS:
                    continue
                arm = batch.arms[number]
                alone = compose_static_view(first, arm, plate)
                changed = (step.target - alone).abs().amax(1, keepdim=True) > CHANGE_THRESHOLD
                for name, made in (("copy", batch.views[0]), ("arm", alone), ("armnet", step.prediction)):
                    gap = made - step.target
                    wrong = (gap.abs().mean(1, keepdim=True) * changed).sum((1, 2, 3)), changed.sum((1, 2, 3))
                    errors[name].setdefault(str(number), []).extend(
                        (255 * w / n).item() for w, n in zip(*wrong, strict=True) if n
                    )
                    square = (gap**2).mean((1, 2, 3)).clamp_min(1e-6)
                    noise[name].setdefault(str(number), []).extend((-10 * square.log10()).tolist())

    def means(values: dict[str, dict[str, list[float]]]) -> dict[str, dict[str, float]]:
        return {name: {k: round(float(np.mean(v)), 3) for k, v in by.items()} for name, by in values.items()}

    return {"plays": len(plays), "changed": means(errors), "psnr": means(noise)}
