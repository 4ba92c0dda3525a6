# SPDX-License-Identifier: Apache-2.0
"""Train the learned labeller on views of scenes, and evaluate it on held-out ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.networks import autocast_bfloat16, resolve_device, single_thread
from wiw.perception.labeller_weights import load, save
from wiw.perception.labelling_network import FINE_CELLS, PIXELS, Network, Pointwise, fuse, group_cells
from wiw.perception.learned_labeller import LearnedLabeller
from wiw.perception.scene_labels import CATEGORIES, STATES
from wiw.training import color_naming
from wiw.training.checkpoint import Checkpoint, ResumableTrainer, require_unfinished
from wiw.training.gather import gather_views, require_held_out
from wiw.training.labelled_views import HELD_OUT_FIELD, LabelledViews, ViewRules
from wiw.training.preparation import PREPARATION, Preparation, ProgressBar, show_no_bar
from wiw.training.trainer import apply_gradients, run_training, warmup_cosine_schedule
from wiw.training.view_batches import (
    ViewTensors,
    compute_sampling_weights,
    count_pairs,
    degrade_views,
    sample_batch,
)
from wiw.typed_values import require_positive

LEAST_CELLS = 40
"""Cells that an object must fill for its state to be evaluated."""
DEGRADED_AT_ONCE = 16
"""Held-out views that are degraded at a time."""
AUGMENTATION = 2
"""Version of how batches are made, by which checkpoints are told apart."""


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters of the training."""

    epochs: int = 4
    """Number of times each view is used, on average."""
    batch: int = 4
    widths: tuple[int, int, int, int] = (48, 96, 160, 224)
    """Channels of the U-Net's levels."""
    rate: float = 2e-3
    decay: float = 0.01
    balance: float = 0.4
    """Weight of a category's pixels is their frequency to minus this."""
    states: float = 0.3
    """Weight of the states' loss beside that of the categories. Each state of each category counts by its frequency to
    minus a half, so that a lamp that is off weighs as much as many doors that are closed.
    """
    coarse: float = 0.75
    """While the learning rate is above this share of its peak, views are shown at half size, twice as many in a batch:
    several times as many views in the same time. The rest of the training is at full size.
    """
    auxiliary: float = 0.25
    """Weight of the losses of the network's coarser levels, which speed up its training."""
    imagined: float = 0.3
    """Share of views without depth, as imagined ones are; two thirds of them are warped, blurred and noisy too."""
    bfloat16: bool = True
    """Compute products in bfloat16 on GPUs, and on CPUs that have instructions for it, where it is faster."""
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive("Recipe", self, "epochs", "batch", "widths")
        if not (self.rate > 0 and np.isfinite(self.rate)):
            raise ArgumentError(f"Recipe: expected a finite learning rate above 0, got {self.rate}")


def make_weights(
    out: Path,
    scenes: str,
    val: str,
    rules: ViewRules = ViewRules(),
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    preparation: Preparation = PREPARATION,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    bar: ProgressBar = show_no_bar,
    device: str | None = None,
) -> dict[str, Any]:
    """Record views, train on them, or resume, calibrate colour words, evaluate on held-out scenes, and write both.

    Colour words go into `OUT.colors.json`, without the suffix of `out`.

    Args:
        out: file of the weights; the state of training is kept beside it.
        scenes: training scenes, as in `wiw run --scenes`.
        val: held-out scenes.
        rules: which views are recorded.
        recipe: how to train; its seed is that of the views, too.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        preparation: how views are recorded and cached.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        bar: shows the progress of recording.
        device: of torch, for training; "cuda" if there is one, else "cpu".

    Returns:
        The card in the file.

    Raises:
        ArgumentError: scenes that are both trained and evaluated on; finished weights in the file, or a state of
            another training; no such device.
        TrainingError: the loss or a gradient is not finite.
        FileError: a file cannot be written.
    """
    require_unfinished(out)
    require_held_out(scenes, val)
    device = resolve_device(device)
    gathering = preparation.list_arguments(bar)
    views = gather_views(scenes, recipe.seed, rules, **gathering, change=True)
    held_out_rules = replace(rules, fields=(HELD_OUT_FIELD, HELD_OUT_FIELD))
    held_out = gather_views(val, recipe.seed, held_out_rules, **gathering, change=True)
    card: dict[str, Any] = {"scenes": scenes, "val": val, "views": len(views), "sampling": asdict(rules)}
    resumable = {**card, "recipe": asdict(recipe), "minutes": minutes, "augmentation": AUGMENTATION}
    checkpoint = Checkpoint.beside(out, resumable)
    with single_thread():
        held = ViewTensors.of(views, device)
        network, recipe = train(held, recipe, minutes, on_step, checkpoint, device)
        namer = color_naming.calibrate(views, recipe.seed)
    card |= {"recipe": asdict(recipe), "categories": list(CATEGORIES), "states": find_possible_states(views)}
    save(out, network, card)  # before the evaluation, which takes another minute
    colors = name_colors_file(out)
    namer.save(colors)
    network = load(out)[0]  # as it is stored, in half precision
    card["held_out"] = evaluate(network, card["states"], held_out, recipe.seed)
    card["held_out"]["colors"] = color_naming.evaluate(namer.load(colors), held_out)
    save(out, network, card)
    checkpoint.remove()
    return card


def name_colors_file(weights: Path) -> Path:
    """Return the file of the colour words that belong to a file of weights."""
    return weights.with_suffix(".colors.json")


def train(
    views: ViewTensors,
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    checkpoint: Checkpoint | None = None,
    device: str = "cpu",
) -> tuple[Network, Recipe]:
    """Train a network; return it without batch normalisation, and the recipe that reproduces it without a time limit.

    Args:
        views: to learn from.
        recipe: how to train; see `Recipe`.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        checkpoint: where the state of training is saved, and from where it resumes.
        device: of torch, where the network is trained; it is returned on the CPU.
    """
    steps_per_epoch = max(1, len(views) // recipe.batch)
    trainer, recipe = run_training(
        lambda: _Trainer(views, recipe, device),
        recipe,
        steps_per_epoch,
        minutes,
        warmup_cosine_schedule(0.05),
        on_step,
        checkpoint,
    )
    return fuse(trainer.network.cpu()), recipe


class _Trainer(ResumableTrainer):
    """The network in training, with everything that its next step depends on."""

    stateful_parts: ClassVar[tuple[str, ...]] = ("network", "_auxiliary", "_optimiser")

    def __init__(self, views: ViewTensors, recipe: Recipe, device: str) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0x4C21]) % 2**63)
        self.views, self.recipe, self.device = views, recipe, device
        self.network = Network(len(CATEGORIES), len(STATES), recipe.widths)
        coarser = [Pointwise(width, len(CATEGORIES)) for width in reversed(recipe.widths[1:])]
        self._auxiliary = torch.nn.ModuleList(coarser).to(device)
        self.network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        pairs = count_pairs(views.category, views.state, len(STATES))
        self._set_prior(coarser, pairs.sum(axis=1))
        parameters = [*self.network.parameters(), *self._auxiliary.parameters()]
        self._optimiser = torch.optim.AdamW(parameters, recipe.rate, weight_decay=recipe.decay)
        self._sampling_weights = compute_sampling_weights(views.category)
        category_weights = _compute_category_weights(pairs.sum(axis=1), recipe.balance)
        self._category_weights = torch.from_numpy(category_weights).to(device)
        self._state_weights = torch.from_numpy(_compute_state_weights(pairs)).to(device)

    def _compute_category_loss(self, logits: Tensor, category: Tensor) -> Tensor:
        """Return the loss of logits [..., categories]."""
        return functional.cross_entropy(logits.float().flatten(0, -2), category.flatten(), self._category_weights)

    def _compute_state_loss(self, logits: Tensor, category: Tensor, state: Tensor) -> Tensor:
        """Return the loss of logits [..., states], of cells that show something with a state."""
        known = state > 0
        weights = self._state_weights[category[known], state[known]]
        losses = functional.cross_entropy(logits[known].float(), state[known], reduction="none")
        return (losses * weights).sum() / weights.sum()

    def _set_prior(self, coarser: Sequence[Pointwise], counts: NDArray[np.int64]) -> None:
        """Let all heads start from the categories' frequencies, as they are weighted."""
        prior = torch.from_numpy(np.log(_compute_shares(counts) ** (1 - self.recipe.balance)))
        with torch.no_grad():
            for head in coarser:
                head.bias[:] = prior
            self.network.head.bias.view(FINE_CELLS, -1)[:, : len(CATEGORIES)] = prior

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch of views and return its loss."""
        rng = np.random.default_rng(core.fold_key([self.recipe.seed, 0x4C22, self.step_count]))
        recipe = self.recipe
        coarse = learning_rate > recipe.coarse * recipe.rate
        batch = sample_batch(
            self.views, recipe.batch, recipe.imagined, self._sampling_weights, rng, self.device, coarse
        )
        with autocast_bfloat16(self.device, self.recipe.bfloat16):
            features = self.network.train().compute_features(batch.shown)
            category_logits, state_logits = self.network.compute_logits(features[-1])
            coarser = [head(each) for head, each in zip(self._auxiliary, features[:-1], strict=True)]
        some = rng.choice(FINE_CELLS, FINE_CELLS // 2, replace=False)  # neighbouring cells teach nearly the same
        category_logits, state_logits = category_logits[..., some, :], state_logits[..., some, :]
        category, state = (group_cells(labels)[..., some] for labels in (batch.category, batch.state))
        loss = self._compute_category_loss(category_logits, category)
        for logits in coarser:
            factor = batch.category.shape[1] // logits.shape[2]
            middles = batch.category[:, factor // 2 :: factor, factor // 2 :: factor]
            loss = loss + self.recipe.auxiliary * self._compute_category_loss(logits.permute(0, 2, 3, 1), middles)
        if (state > 0).any():
            loss = loss + self.recipe.states * self._compute_state_loss(state_logits, category, state)
        loss.backward()
        apply_gradients(self._optimiser, self.network, learning_rate)
        self.step_count += 1
        return float(loss.detach())


def _compute_shares(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the share of each category among all cells, at least a small one."""
    return np.asarray(np.maximum(counts / counts.sum(), 1e-5))


def _compute_category_weights(counts: NDArray[np.int64], balance: float) -> NDArray[np.float32]:
    """Return the weights of the categories' cells; their mean over all cells is 1."""
    weights = _compute_shares(counts) ** -balance
    return np.asarray(weights / (weights * counts / counts.sum()).sum(), np.float32)


def _compute_state_weights(pairs: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the weights of the states of each category, float32 [categories, states]."""
    return np.asarray(np.maximum(pairs, 1) ** -0.5, np.float32)


def find_possible_states(views: LabelledViews) -> dict[str, list[str]]:
    """Return the states that each category is shown in, in the order of `STATES`; only categories that have some."""
    pairs = np.unique(views.category.astype(np.int64) * len(STATES) + views.state)
    found: dict[str, list[str]] = {}
    for category, state in zip(*np.divmod(pairs, len(STATES)), strict=True):
        if category and state:
            found.setdefault(CATEGORIES[category], []).append(STATES[state])
    return found


# -- measuring ---------------------------------------------------------------------------------------------------------


def evaluate(network: Network, states: dict[str, list[str]], views: LabelledViews, seed: int) -> dict[str, Any]:
    """Measure the labeller on held-out views, as they are, without depth, and without depth and degraded.

    Returns:
        {"views": N, "plain": measures, "no_depth": measures, "degraded": measures}; see `_measure`.
    """
    labeller = LearnedLabeller.of(network, {"categories": list(CATEGORIES), "states": states})
    nothing = np.zeros_like(views.depth)
    return {
        "views": len(views),
        "plain": _measure(labeller, views),
        "no_depth": _measure(labeller, replace(views, depth=nothing)),
        "degraded": _measure(labeller, replace(_degrade(views, seed), depth=nothing)),
    }


def _degrade(views: LabelledViews, seed: int) -> LabelledViews:
    """Return the views degraded, with the depth of what they were."""
    key = core.fold_key([seed, 0x4C23])
    rng, random = np.random.default_rng(key), torch.Generator().manual_seed(key % 2**63)
    labels = np.stack([views.category, views.state], axis=-1)
    images, moved = np.empty_like(views.images), np.empty_like(labels)
    for first in range(0, len(views), DEGRADED_AT_ONCE):
        part = slice(first, first + DEGRADED_AT_ONCE)
        shown = torch.from_numpy(views.images[part]).permute(0, 3, 1, 2).float()
        shown, found = degrade_views(shown, torch.from_numpy(labels[part]), rng, random)
        images[part], moved[part] = shown.permute(0, 2, 3, 1).round().byte().numpy(), found.numpy()
    return replace(views, images=images, category=moved[..., 0], state=moved[..., 1])


def _measure(labeller: LearnedLabeller, views: LabelledViews) -> dict[str, Any]:
    """Return pixel accuracy, IoU by category and its mean, and the accuracy of states by category and its mean.

    A state counts as right where most pixels that the labeller gives an object's category have its state; objects
    without such pixels do not count. The means are over categories that are shown, those of states over categories
    that are shown in more than one.
    """
    confusion = np.zeros((len(CATEGORIES), len(CATEGORIES)), np.int64)
    right: dict[str, dict[str, list[bool]]] = {}
    for image, depth, truth, states, angle in zip(
        views.images, views.depth, views.category, views.state, views.hfov_deg, strict=True
    ):
        pixel_depth = depth.astype(np.float32).repeat(PIXELS, axis=0).repeat(PIXELS, axis=1)
        found = labeller.label(image[None], float(angle), depth=pixel_depth[None])
        predicted, predicted_state = (array[0, ::PIXELS, ::PIXELS] for array in (found.category, found.state))
        pairs = truth.astype(np.int64) * len(CATEGORIES) + predicted
        confusion += np.bincount(pairs.ravel(), minlength=confusion.size).reshape(confusion.shape)
        for name, value, correct in _judge_states(truth, states, predicted, predicted_state):
            right.setdefault(name, {}).setdefault(value, []).append(correct)
    shown, hits = confusion.sum(axis=1), np.diag(confusion)
    union = shown + confusion.sum(axis=0) - hits
    iou = {name: round(float(hits[i] / union[i]), 4) for i, name in enumerate(CATEGORIES) if shown[i]}
    by_state = {
        name: {value: round(float(np.mean(flags)), 4) for value, flags in sorted(values.items())}
        for name, values in sorted(right.items())
    }
    varied = [np.mean(list(values.values())) for values in by_state.values() if len(values) > 1]
    named = [value for name, value in iou.items() if name]
    return {
        "pixel_accuracy": round(float(hits.sum() / max(1, confusion.sum())), 4),
        "mean_iou": round(float(np.mean(named)), 4) if named else None,
        "iou": iou,
        "state_accuracy": round(float(np.mean(varied)), 4) if varied else None,
        "states": by_state,
    }


def _judge_states(
    truth: NDArray[np.uint8],
    states: NDArray[np.uint8],
    predicted: NDArray[np.uint8],
    predicted_state: NDArray[np.uint8],
) -> list[tuple[str, str, bool]]:
    """Return category, true state and whether it was found, for what fills `LEAST_CELLS` of a view."""
    judged = []
    stateful = np.where(states > 0, truth.astype(np.int64) * len(STATES) + states, 0)
    for pair, count in zip(*np.unique(stateful, return_counts=True), strict=True):
        category, state = divmod(int(pair), len(STATES))
        votes = predicted_state[(stateful == pair) & (predicted == category)]
        if pair and count >= LEAST_CELLS and len(votes):
            most = int(np.bincount(votes, minlength=len(STATES)).argmax())
            judged.append((CATEGORIES[category], STATES[state], most == state))
    return judged
