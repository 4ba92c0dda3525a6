# SPDX-License-Identifier: Apache-2.0
"""Train the recogniser on glimpse sets of varying size, so that it learns how much to trust each kind of glimpse."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.perception.calibration import calibration_error, fit_temperature, softmax
from wiw.perception.recogniser import Recogniser
from wiw.perception.recognition_network import Network, to_network_input
from wiw.training.glimpse_sets import NEAR, PERFECT, START, WARPED, GlimpseSets
from wiw.training.trainer import run_training, warmup_cosine_schedule

COLOUR_CHANNELS = [0, 1, 2, 4, 5, 6]
"""Channels of the network's input that are not boxes."""
REAL_COLUMN = 4
"""Column of `Glimpses.scalars` that marks real glimpses."""
MAX_EXTRA_GLIMPSES = 4
"""Most glimpses of a set that training adds to the first."""


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters of the training."""

    epochs: int = 25
    batch: int = 48
    """Glimpse sets in a batch."""
    width: int = 32
    """Channels of the first layer."""
    rate: float = 3e-3
    decay: float = 0.02
    smoothing: float = 0.05
    alone: float = 0.5
    """Weight of the loss of single glimpses beside that of sets."""
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch, self.width) < 1:
            raise ArgumentError(f"Recipe: epochs, batch and width must be positive, got {self}")


def train(
    data: GlimpseSets,
    categories: Sequence[str],
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
) -> tuple[Network, Recipe]:
    """Train a network; return it with the recipe that reproduces it without a time limit.

    Args:
        data: the sets to learn from.
        categories: what `data.labels` count.
        recipe: how to train; see `Recipe`.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
    """
    steps_per_epoch = max(1, len(data) // recipe.batch)
    trainer, recipe = run_training(
        lambda: _Trainer(data, categories, recipe),
        recipe,
        steps_per_epoch,
        minutes,
        warmup_cosine_schedule(0.15, 0.01),
        on_step,
    )
    return trainer.network.eval(), recipe


class _Trainer:
    """The network in training, with everything that its next step depends on."""

    def __init__(self, data: GlimpseSets, categories: Sequence[str], recipe: Recipe) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0x4C01]) % 2**63)
        self.data, self.recipe = data, recipe
        self.network = Network(len(categories), recipe.width).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._rng = np.random.default_rng(core.fold_key([recipe.seed, 0x4C02]))
        self._optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)
        self._sampling_weights = _compute_sampling_weights(data.labels)

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch of glimpse sets and return its loss."""
        for group in self._optimiser.param_groups:
            group["lr"] = learning_rate
        sets = self._rng.choice(len(self.data), self.recipe.batch, p=self._sampling_weights)
        loss = _compute_loss(self.network, self.data, sets, self.recipe, self._rng)
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._optimiser.step()
        return float(loss.detach())


def _compute_sampling_weights(labels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return each set's sampling probability: a category's total is proportional to the square root of its count."""
    weights = np.bincount(labels)[labels] ** -0.5
    return weights / weights.sum()


def _compute_loss(
    network: Network, data: GlimpseSets, sets: NDArray[np.int64], recipe: Recipe, rng: np.random.Generator
) -> Tensor:
    rows, owners = _sample_rows(data, sets, rng)
    shown, scalars = _augment(data, rows, owners, rng)
    logits, weights = network.train().encode_glimpses(shown, scalars)
    places = torch.from_numpy(owners)
    targets = torch.from_numpy(data.labels[sets])
    entropy = torch.nn.functional.cross_entropy
    together = entropy(network.fuse(logits, weights, places, len(sets)), targets, label_smoothing=recipe.smoothing)
    return together + recipe.alone * entropy(logits, targets[places], label_smoothing=recipe.smoothing)


def _sample_rows(
    data: GlimpseSets, sets: NDArray[np.int64], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sample rows of glimpses, and the index in `sets` of each: the first one and up to `MAX_EXTRA_GLIMPSES` more.

    The others are real ones and those of one world model, the perfect one or reprojection, as in an episode.
    """
    first = np.searchsorted(data.owners, sets)
    behind = np.searchsorted(data.owners, sets, side="right")
    counts, absent = rng.integers(0, MAX_EXTRA_GLIMPSES + 1, len(sets)), rng.choice([PERFECT, WARPED], len(sets))
    rows, owners = [], []
    for i, (start, end, count, model) in enumerate(zip(first, behind, counts, absent, strict=True)):
        others = np.arange(start + 1, end)
        others = rng.permutation(others[data.kinds[others] != model])[:count]
        rows.append(np.concatenate([[start], others]))
        owners.append(np.full(len(rows[-1]), i))
    return np.concatenate(rows), np.concatenate(owners)


def _augment(
    data: GlimpseSets,
    rows: NDArray[np.int64],
    owners: NDArray[np.int64],
    rng: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """Return pictures and scalars with other brightness and tint, boxes slightly off, and half of them mirrored."""
    found = data.glimpses[rows]
    extent = found.boxes[..., 2:] - found.boxes[..., :2]
    off = rng.uniform(-0.04, 0.04, (len(rows), 1, 4)) * np.concatenate([extent, extent], axis=-1)
    scalars = found.scalars * rng.uniform(0.96, 1.04, found.scalars.shape)
    scalars[:, REAL_COLUMN] = found.scalars[:, REAL_COLUMN]
    shown = to_network_input(torch.from_numpy(found.images), torch.from_numpy((found.boxes + off).astype(np.float32)))
    light = rng.uniform(0.8, 1.2, (owners.max() + 1, 1)) * rng.uniform(0.92, 1.08, (owners.max() + 1, 3))
    gain = torch.from_numpy(np.tile(light[owners], 2).astype(np.float32))[:, :, None, None]
    shown[:, COLOUR_CHANNELS] = (shown[:, COLOUR_CHANNELS] + 1) * gain - 1
    mirrored = torch.from_numpy(rng.random(len(rows)) < 0.5)
    shown = torch.where(mirrored[:, None, None, None], shown.flip(3), shown)
    return shown.contiguous(memory_format=torch.channels_last), torch.from_numpy(scalars.astype(np.float32))


# -- measuring ---------------------------------------------------------------------------------------------------------


def select_rows(data: GlimpseSets, kind: int, most: int) -> NDArray[np.int64]:
    """Return the rows of each set's first glimpse and of up to `most` more of a kind."""
    extra = data.kinds == kind
    before = np.concatenate([[0], np.cumsum(extra)])
    rank = before[:-1] - before[np.searchsorted(data.owners, data.owners)]
    return np.flatnonzero((data.kinds == START) | (extra & (rank < most)))


def compute_set_logits(network: Network, data: GlimpseSets, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return float64 [sets, categories], computed from the glimpses at `rows`."""
    found = data.glimpses[rows]
    parts = []
    with torch.inference_mode():
        for i in range(0, len(rows), 256):
            part = slice(i, i + 256)
            shown = to_network_input(torch.from_numpy(found.images[part]), torch.from_numpy(found.boxes[part]))
            parts.append(network.eval().encode_glimpses(shown, torch.from_numpy(found.scalars[part])))
        logits, weights = (torch.cat(column) for column in zip(*parts, strict=True))
        return network.fuse(logits, weights, torch.from_numpy(data.owners[rows]), len(data)).double().numpy()


GLIMPSE_MIXES = {"start": (START, 0)} | {
    f"start + {count} {name}": (kind, count)
    for name, kind in (("real", NEAR), ("perfect", PERFECT), ("warped", WARPED))
    for count in (1, 2, 3)
}
"""The inputs that accuracy is measured with: the kind of glimpses added to the first, and how many."""


def calibrate(
    network: Network, categories: Sequence[str], calibration: GlimpseSets, held_out: GlimpseSets, card: dict[str, Any]
) -> Recogniser:
    """Fit the temperature on `calibration`, and measure accuracy and calibration error on `held_out`."""
    recogniser = Recogniser(network, categories)
    fitting = np.concatenate(
        [compute_set_logits(network, calibration, select_rows(calibration, *view)) for view in GLIMPSE_MIXES.values()]
    )
    recogniser.temperature = fit_temperature(fitting, np.tile(calibration.labels, len(GLIMPSE_MIXES)))
    logits = {
        name: compute_set_logits(network, held_out, select_rows(held_out, *view))
        for name, view in GLIMPSE_MIXES.items()
    }
    pooled, labels = np.concatenate(list(logits.values())), np.tile(held_out.labels, len(logits))
    recogniser.card = {
        **card,
        "held_out_sets": len(held_out),
        "accuracy": {name: _compute_accuracy(values, held_out.labels) for name, values in logits.items()},
        "calibration_error": {
            "before": round(calibration_error(softmax(pooled), labels), 4),
            "after": round(calibration_error(softmax(pooled, recogniser.temperature), labels), 4),
        },
        "accuracy_by_category": {
            name: _compute_accuracy(logits["start"][held_out.labels == i], held_out.labels[held_out.labels == i])
            for i, name in enumerate(categories)
            if (held_out.labels == i).any()
        },
    }
    return recogniser


def _compute_accuracy(logits: NDArray[np.float64], labels: NDArray[np.int64]) -> float:
    return round(float((logits.argmax(axis=1) == labels).mean()), 4)
