# SPDX-License-Identifier: Apache-2.0
"""Train the recogniser on glimpse sets of varying size, so that it learns how much to trust each kind of glimpse."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wiw._core import core
from wiw.datasets.ar import CATEGORIES
from wiw.errors import ArgumentError
from wiw.perception.calibration import calibration_error, fit_temperature, softmax
from wiw.perception.glimpses import EXTENT
from wiw.perception.recogniser import Recogniser
from wiw.perception.recognition_network import Network, to_network_input
from wiw.training.checkpoint import Checkpoint, ResumableTrainer, require_unfinished
from wiw.training.gather import gather_glimpse_sets, gather_hard_sets, require_held_out
from wiw.training.glimpse_sets import (
    NEAR,
    PERFECT,
    START,
    WARPED,
    GlimpseSetRules,
    GlimpseSets,
    merge_glimpse_sets,
    split_in_half,
)
from wiw.training.preparation import PREPARATION, Preparation, ProgressBar, show_no_bar
from wiw.training.trainer import apply_gradients, run_training, warmup_cosine_schedule
from wiw.typed_values import require_positive

REAL_COLUMN = 4
"""Column of `Glimpses.scalars` that marks real glimpses."""
MAX_EXTRA_GLIMPSES = 4
"""Maximum number of glimpses of a set that training adds to the first."""
CONFUSION_RATE = 0.05
"""Share by which a batch changes the running confusion of categories."""


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters of the training."""

    epochs: int = 25
    batch: int = 48
    """Glimpse sets in a batch."""
    width: int = 32
    """Channels of the first layer."""
    extents: bool = True
    """Whether the network is told sizes in metres, too."""
    rate: float = 3e-3
    decay: float = 0.02
    smoothing: float = 0.05
    hard: int = 4
    """Weight of sets whose first look is hard."""
    alone: float = 0.5
    """Weight of the loss of single glimpses beside that of sets."""
    recolor: float = 0.5
    """Share of sets whose colours change places, and of those whose target, or all of them, is grey or tinted."""
    transplant: float = 0.2
    """Share of glimpses whose surroundings are those of another one."""
    degrade: float = 0.25
    """Share of glimpses that are blurred, of those with noise, and of those with a part covered."""
    resize: float = 1.25
    """Greatest factor by which the measured extents of a set are multiplied or divided, along each axis."""
    unmeasured: float = 0.25
    """Share of sets whose extents are unknown."""
    swap: float = 0.3
    """With extents: share of glimpses whose picture is of something else, so that extents also count where furniture
    looks unlike any that was trained on."""
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive("Recipe", self, "epochs", "batch", "width")


def make_weights(
    out: Path,
    scenes: str,
    val: str,
    categories: Sequence[str] = CATEGORIES,
    rules: GlimpseSetRules = GlimpseSetRules(),
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    start: Recogniser | None = None,
    preparation: Preparation = PREPARATION,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    bar: ProgressBar = show_no_bar,
) -> Recogniser:
    """Record glimpses, train, or resume, calibrate and evaluate on halves of held-out scenes, and write the weights.

    Args:
        out: file of the weights; the state of training is kept beside it.
        scenes: training scenes, as in `wiw run --scenes`.
        val: held-out scenes.
        categories: the categories to distinguish.
        rules: which glimpses are recorded.
        recipe: how to train; its seed is that of the glimpses, too.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        start: recogniser to continue training from; None for random weights.
        preparation: how glimpses are recorded and cached.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        bar: shows the progress of recording.

    Returns:
        The recogniser in the file, with its card.

    Raises:
        ArgumentError: scenes that are both trained and evaluated on, or have no object of the categories; a start that
            does not fit; finished weights in the file, or a state of another training.
        TrainingError: the loss or a gradient is not finite.
        FileError: a file cannot be written.
    """
    require_unfinished(out)
    require_held_out(scenes, val)
    seed, gathering = recipe.seed, preparation.list_arguments(bar)
    sets = gather_glimpse_sets(scenes, categories, seed, rules, **gathering)
    hard = gather_hard_sets(scenes, categories, seed, **gathering)
    held_out = gather_glimpse_sets(val, categories, seed, replace(rules, reshape=1.0), **gathering)
    calibration, held_out = split_in_half(held_out)
    held_out_hard = gather_hard_sets(val, categories, seed, **gathering)
    samples = merge_glimpse_sets([sets, *[hard] * recipe.hard])
    card: dict[str, Any] = {"scenes": scenes, "val": val, "sets": len(sets), "hard_sets": len(hard)}
    card |= {"looks": asdict(rules), "began_with": None if start is None else start.card}
    resumable = {**card, "recipe": asdict(recipe), "minutes": minutes, "categories": list(categories)}
    checkpoint = Checkpoint.beside(out, resumable)
    network = None if start is None else start.network
    network, recipe = train(samples, categories, recipe, minutes, on_step, network, checkpoint)
    card |= {"recipe": asdict(recipe)}
    calibrated = calibrate(network, categories, calibration, held_out, card, held_out_hard)
    calibrated.save(out)
    checkpoint.remove()
    return calibrated


def train(
    data: GlimpseSets,
    categories: Sequence[str],
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    start: Network | None = None,
    checkpoint: Checkpoint | None = None,
) -> tuple[Network, Recipe]:
    """Train a network; return it with the recipe that reproduces it without a time limit.

    Args:
        data: the sets to learn from.
        categories: what `data.labels` count.
        recipe: how to train; see `Recipe`.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        start: network of the same kind whose training continues; None for a new one.
        checkpoint: where the state of training is saved, and from where it resumes.

    Raises:
        ArgumentError: `start` has other categories, another width, or is told sizes where this one is not.
    """
    expected = (len(categories), recipe.width, recipe.extents)
    if start is not None and (start.categories, start.width, start.extents) != expected:
        raise ArgumentError(
            f"recogniser: expected a start of {len(categories)} categories, width {recipe.width} and extents "
            f"{recipe.extents}, got {start.categories}, {start.width} and {start.extents}"
        )
    steps_per_epoch = max(1, len(data) // recipe.batch)
    trainer, recipe = run_training(
        lambda: _Trainer(data, categories, recipe, start),
        recipe,
        steps_per_epoch,
        minutes,
        warmup_cosine_schedule(0.15, 0.01),
        on_step,
        checkpoint,
    )
    return trainer.network.eval(), recipe


class _Trainer(ResumableTrainer):
    """The network in training, with everything that its next step depends on."""

    stateful_parts = ("network", "optimiser")

    def __init__(
        self, data: GlimpseSets, categories: Sequence[str], recipe: Recipe, start: Network | None = None
    ) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0x4C01]) % 2**63)
        self.data, self.recipe = data, recipe
        network = Network(len(categories), recipe.width, recipe.extents)
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if start is not None:
            self.network.load_state_dict(start.state_dict())
        self.optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)
        self._sampling_weights = _compute_sampling_weights(data.labels)
        self._confusion = np.full((len(categories), len(categories)), 1 / len(categories))

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch of glimpse sets and return its loss."""
        key = core.fold_key([self.recipe.seed, 0x4C02, self.step_count])
        rng = np.random.default_rng(key)
        torch.manual_seed(key % 2**63)  # of dropout
        sets = self._draw_sets(rng)
        loss, shares = _compute_loss(self.network, self.data, sets, self.recipe, rng)
        for label, row in zip(self.data.labels[sets], shares, strict=True):
            self._confusion[label] += CONFUSION_RATE * (row - self._confusion[label])
        loss.backward()
        apply_gradients(self.optimiser, self.network, learning_rate, math.inf)
        self.step_count += 1
        return float(loss.detach())

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next step depends on, except the data and the recipe."""
        return {**super().state_dict(), "confusion": torch.from_numpy(self._confusion)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
        super().load_state_dict(state)
        self._confusion = state["confusion"].numpy().copy()

    def _draw_sets(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """Draw a batch of hard pairs: a set, and one of a category that its own is at present confused with."""
        half = (self.recipe.batch + 1) // 2
        first = rng.choice(len(self.data), half, p=self._sampling_weights)
        paired = [self._draw_confused(int(label), rng) for label in self.data.labels[first]]
        return np.concatenate([first, paired])[: self.recipe.batch]

    def _draw_confused(self, label: int, rng: np.random.Generator) -> int:
        weights = self._confusion[label][self.data.labels] * self._sampling_weights
        weights[self.data.labels == label] = 0
        if not weights.any():  # there is one category alone
            weights = self._sampling_weights
        return int(rng.choice(len(self.data), p=weights / weights.sum()))


def _compute_sampling_weights(labels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return each set's sampling probability: a category's total is proportional to the square root of its count."""
    weights = np.bincount(labels)[labels] ** -0.5
    return weights / weights.sum()


def _compute_loss(
    network: Network, data: GlimpseSets, sets: NDArray[np.int64], recipe: Recipe, rng: np.random.Generator
) -> tuple[Tensor, NDArray[np.float64]]:
    """Return the loss of a batch and the probabilities that its sets get, float64 [sets, categories]."""
    rows, owners = _sample_rows(data, sets, rng)
    shown, scalars = _augment(data, rows, owners, recipe, rng)
    logits, weights = network.train().encode_glimpses(shown, scalars)
    places = torch.from_numpy(owners)
    targets = torch.from_numpy(data.labels[sets])
    entropy = torch.nn.functional.cross_entropy
    fused = network.fuse(logits, weights, places, len(sets))
    together = entropy(fused, targets, label_smoothing=recipe.smoothing)
    loss = together + recipe.alone * entropy(logits, targets[places], label_smoothing=recipe.smoothing)
    return loss, fused.detach().softmax(dim=1).double().numpy()


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
    recipe: Recipe,
    rng: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """Return pictures and scalars as of other furniture, light and cameras, boxes slightly off, and half mirrored.

    All glimpses of a set are recoloured alike, as they show one object; what degrades a picture is each one's own.
    """
    swapped = rng.random(len(rows)) < recipe.swap * recipe.extents
    pictured = np.where(swapped, rng.permutation(rows), rows)
    found = replace(data.glimpses[pictured], scalars=data.glimpses.scalars[rows])
    extent = found.boxes[..., 2:] - found.boxes[..., :2]
    off = rng.uniform(-0.04, 0.04, (len(rows), 1, 4)) * np.concatenate([extent, extent], axis=-1)
    scalars = found.scalars * rng.uniform(0.96, 1.04, found.scalars.shape)
    scalars[:, REAL_COLUMN] = found.scalars[:, REAL_COLUMN]
    scalars[:, EXTENT] *= _draw_extent_factors(int(owners.max()) + 1, recipe, rng)[owners]
    shown = to_network_input(torch.from_numpy(found.images), torch.from_numpy((found.boxes + off).astype(np.float32)))
    colours, boxes = _split_channels(shown)
    colours = _recolor(colours, boxes, owners, recipe.recolor, rng)
    colours = _degrade(_transplant(colours, boxes, recipe.transplant, rng), recipe.degrade, rng)
    shown = torch.cat([colours, boxes[:, :, None]], dim=2).flatten(1, 2)
    mirrored = torch.from_numpy(rng.random(len(rows)) < 0.5)
    shown = torch.where(mirrored[:, None, None, None], shown.flip(3), shown)
    return shown.contiguous(memory_format=torch.channels_last), torch.from_numpy(scalars.astype(np.float32))


def _draw_extent_factors(sets: int, recipe: Recipe, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return [sets, 4]: factors of furniture of other sizes, the two heights alike; 0 where extents are unknown."""
    factors = recipe.resize ** rng.uniform(-1, 1, (sets, 3))
    return factors[:, [0, 1, 2, 2]] * (rng.random((sets, 1)) >= recipe.unmeasured)


def _split_channels(shown: Tensor) -> tuple[Tensor, Tensor]:
    """Return colours [N, 2, 3, H, W], 0 to 1, and boxes [N, 2, H, W] of a network's input."""
    views = shown.unflatten(1, (2, 4))
    return (views[:, :, :3] + 1) / 2, views[:, :, 3]


def _recolor(
    colours: Tensor, boxes: Tensor, owners: NDArray[np.int64], share: float, rng: np.random.Generator
) -> Tensor:
    """Return colours 0 to 1 in another light, in part with other hues, inside the box otherwise than around it."""
    count = int(owners.max()) + 1
    around, inside = (_draw_color_matrices(count, share, rng)[owners] for _ in range(2))
    own = torch.from_numpy(rng.random(count) < share)[owners][:, None, None, None, None]
    everywhere = torch.einsum("nij,nvjhw->nvihw", around, colours)
    boxed = torch.where(own, torch.einsum("nij,nvjhw->nvihw", inside, colours), everywhere)
    mixed = torch.where((boxes > 0)[:, :, None], boxed, everywhere).clamp(0, 1)
    gamma = torch.from_numpy(rng.uniform(0.75, 1.35, count).astype(np.float32))[owners]
    return mixed.clamp_min(1e-3) ** gamma[:, None, None, None, None]


def _transplant(colours: Tensor, boxes: Tensor, share: float, rng: np.random.Generator) -> Tensor:
    """Return colours in which some boxes are surrounded by what surrounds those of other glimpses."""
    moved = torch.from_numpy(rng.random(len(colours)) < share)
    others = torch.from_numpy(rng.permutation(len(colours)))
    return torch.where(moved[:, None, None, None, None] & (boxes <= 0)[:, :, None], colours[others], colours)


def _draw_color_matrices(count: int, share: float, rng: np.random.Generator) -> Tensor:
    """Return [count, 3, 3]: brightness and tint, and for a share of them channels that change places or turn grey."""
    matrices = np.repeat(np.eye(3)[None], count, axis=0)
    for i in np.flatnonzero(rng.random(count) < share):
        matrices[i] = np.eye(3)[rng.permutation(3)]
        grey = rng.choice([0.0, rng.random(), 1.0])
        matrices[i] = (1 - grey) * matrices[i] + grey / 3
    light = rng.uniform(0.75, 1.25, (count, 1)) * rng.uniform(0.85, 1.15, (count, 3))
    return torch.from_numpy((light[:, :, None] * matrices).astype(np.float32))


def _degrade(colours: Tensor, share: float, rng: np.random.Generator) -> Tensor:
    """Return colours as network input, -1 to 1, some blurred, some noisy, some with a rectangle of one colour."""
    count, _, _, rows, columns = colours.shape
    blurred, noisy, covered = (np.flatnonzero(rng.random(count) < share) for _ in range(3))
    colours = colours.clone()
    if len(blurred):
        flat = colours[blurred].flatten(1, 2)
        colours[blurred] = torch.nn.functional.avg_pool2d(flat, 3, 1, 1, count_include_pad=False).unflatten(1, (2, 3))
    if len(noisy):
        shape = tuple(colours[noisy].shape)
        colours[noisy] += torch.from_numpy(rng.normal(0, 0.04, shape).astype(np.float32))
    for i in covered:
        height, width = rng.integers(rows // 8, rows // 2, 2)
        top, left = rng.integers(0, rows - height), rng.integers(0, columns - width)
        patch = torch.from_numpy(rng.random((3, 1, 1)).astype(np.float32))
        colours[i, int(rng.integers(2)), :, top : top + height, left : left + width] = patch
    return 2 * colours - 1


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
    network: Network,
    categories: Sequence[str],
    calibration: GlimpseSets,
    held_out: GlimpseSets,
    card: dict[str, Any],
    hard: GlimpseSets | None = None,
) -> Recogniser:
    """Fit the temperature on `calibration`, and measure accuracy and calibration error on `held_out`.

    Accuracy is also measured on `hard`, sets of held-out scenes whose first look is hard, if there are any.
    """
    recogniser = Recogniser(network, categories)
    fitting = np.concatenate(
        [compute_set_logits(network, calibration, select_rows(calibration, *view)) for view in GLIMPSE_MIXES.values()]
    )
    recogniser.temperature = fit_temperature(fitting, np.tile(calibration.labels, len(GLIMPSE_MIXES)))
    logits = _compute_mixed_logits(network, held_out)
    pooled, labels = np.concatenate(list(logits.values())), np.tile(held_out.labels, len(logits))
    recogniser.card = {
        **card,
        "held_out_sets": len(held_out),
        "accuracy": {name: _compute_accuracy(values, held_out.labels) for name, values in logits.items()},
        "accuracy_hard": measure_accuracy(network, hard) if hard else {},
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


def measure_accuracy(network: Network, data: GlimpseSets) -> dict[str, float]:
    """Return the share of sets that are recognised, with each of `GLIMPSE_MIXES`."""
    return {
        name: _compute_accuracy(values, data.labels) for name, values in _compute_mixed_logits(network, data).items()
    }


def _compute_mixed_logits(network: Network, data: GlimpseSets) -> dict[str, NDArray[np.float64]]:
    return {name: compute_set_logits(network, data, select_rows(data, *mix)) for name, mix in GLIMPSE_MIXES.items()}


def _compute_accuracy(logits: NDArray[np.float64], labels: NDArray[np.int64]) -> float:
    return round(float((logits.argmax(axis=1) == labels).mean()), 4)
