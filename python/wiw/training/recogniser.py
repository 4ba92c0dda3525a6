# SPDX-License-Identifier: Apache-2.0
"""Trains the recogniser: every step shows it sets of looks of changing size, so that it learns what to trust."""

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
from wiw.perception.calibration import calibration_error, fitted_temperature, softmax
from wiw.perception.recogniser import Recogniser
from wiw.perception.recognition_network import Network, pictures
from wiw.training.course import taught, up_and_down
from wiw.training.looks import NEAR, PERFECT, START, WARPED, Looks

COLOURS = [0, 1, 2, 4, 5, 6]
"""Channels of `pictures` that are not boxes."""
REAL = 4
"""Column of `Glimpses.scalars`."""
MOST = 4
"""Looks of a set that training adds to the first."""


@dataclass(frozen=True)
class Recipe:
    """How the network is trained."""

    epochs: int = 25
    batch: int = 48
    """Sets a step."""
    width: int = 32
    """Channels of the first layer."""
    rate: float = 3e-3
    decay: float = 0.02
    smoothing: float = 0.05
    alone: float = 0.5
    """Weight of the loss of single looks beside that of sets."""
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch, self.width) < 1:
            raise ArgumentError(f"Recipe: epochs, batch and width must be positive, got {self}")


def train(
    looks: Looks,
    categories: Sequence[str],
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    show: Callable[[int, int, float], None] = lambda step, steps, loss: None,
) -> tuple[Network, Recipe]:
    """A trained network, and the recipe that would give the same one again.

    Args:
        looks: to learn from.
        categories: what `looks.labels` count.
        recipe: see there.
        minutes: if given, epochs are left out so that training takes about as long, by the speed of some trial steps.
        show: called after each step with its number, how many there are, and a running mean of the loss.
    """
    an_epoch = max(1, len(looks) // recipe.batch)
    lesson, recipe = taught(
        lambda: _Lesson(looks, categories, recipe), recipe, an_epoch, minutes, up_and_down(0.15, 0.01), show
    )
    return lesson.network.eval(), recipe


class _Lesson:
    """A network in training, with all that its next step depends on."""

    def __init__(self, looks: Looks, categories: Sequence[str], recipe: Recipe) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0x4C01]) % 2**63)
        self.looks, self.recipe = looks, recipe
        self.network = Network(len(categories), recipe.width).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._rng = np.random.default_rng(core.fold_key([recipe.seed, 0x4C02]))
        self._optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)
        self._chances = _chances(looks.labels)

    def step(self, rate: float) -> float:
        """Learns from one batch of sets; its loss."""
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        sets = self._rng.choice(len(self.looks), self.recipe.batch, p=self._chances)
        loss = _loss(self.network, self.looks, sets, self.recipe, self._rng)
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._optimiser.step()
        return float(loss.detach())


def _chances(labels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Of each set to be drawn: categories weigh as the square root of their number."""
    weights = np.bincount(labels)[labels] ** -0.5
    return weights / weights.sum()


def _loss(network: Network, looks: Looks, sets: NDArray[np.int64], recipe: Recipe, rng: np.random.Generator) -> Tensor:
    rows, owners = _drawn(looks, sets, rng)
    shown, scalars = _varied(looks, rows, owners, rng)
    logits, weights = network.train().looks(shown, scalars)
    places = torch.from_numpy(owners)
    targets = torch.from_numpy(looks.labels[sets])
    entropy = torch.nn.functional.cross_entropy
    together = entropy(network.fused(logits, weights, places, len(sets)), targets, label_smoothing=recipe.smoothing)
    return together + recipe.alone * entropy(logits, targets[places], label_smoothing=recipe.smoothing)


def _drawn(
    looks: Looks, sets: NDArray[np.int64], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of looks, and which of `sets` they are of: the first look, and up to `MOST` more.

    They are real ones and those of one world model, the perfect one or reprojection, as in an episode.
    """
    first = np.searchsorted(looks.owners, sets)
    behind = np.searchsorted(looks.owners, sets, side="right")
    counts, absent = rng.integers(0, MOST + 1, len(sets)), rng.choice([PERFECT, WARPED], len(sets))
    rows, owners = [], []
    for i, (start, end, count, model) in enumerate(zip(first, behind, counts, absent, strict=True)):
        others = np.arange(start + 1, end)
        others = rng.permutation(others[looks.kinds[others] != model])[:count]
        rows.append(np.concatenate([[start], others]))
        owners.append(np.full(len(rows[-1]), i))
    return np.concatenate(rows), np.concatenate(owners)


def _varied(
    looks: Looks,
    rows: NDArray[np.int64],
    owners: NDArray[np.int64],
    rng: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """Pictures and scalars in other light, with boxes a little off, and half of them mirrored."""
    found = looks.glimpses[rows]
    extent = found.boxes[..., 2:] - found.boxes[..., :2]
    off = rng.uniform(-0.04, 0.04, (len(rows), 1, 4)) * np.concatenate([extent, extent], axis=-1)
    scalars = found.scalars * rng.uniform(0.96, 1.04, found.scalars.shape)
    scalars[:, REAL] = found.scalars[:, REAL]
    shown = pictures(torch.from_numpy(found.images), torch.from_numpy((found.boxes + off).astype(np.float32)))
    light = rng.uniform(0.8, 1.2, (owners.max() + 1, 1)) * rng.uniform(0.92, 1.08, (owners.max() + 1, 3))
    gain = torch.from_numpy(np.tile(light[owners], 2).astype(np.float32))[:, :, None, None]
    shown[:, COLOURS] = (shown[:, COLOURS] + 1) * gain - 1
    mirrored = torch.from_numpy(rng.random(len(rows)) < 0.5)
    shown = torch.where(mirrored[:, None, None, None], shown.flip(3), shown)
    return shown.contiguous(memory_format=torch.channels_last), torch.from_numpy(scalars.astype(np.float32))


# -- measuring ---------------------------------------------------------------------------------------------------------


def rows_of(looks: Looks, kind: int, most: int) -> NDArray[np.int64]:
    """Rows of the first look of each set and of up to `most` more of a kind."""
    extra = looks.kinds == kind
    before = np.concatenate([[0], np.cumsum(extra)])
    rank = before[:-1] - before[np.searchsorted(looks.owners, looks.owners)]
    return np.flatnonzero((looks.kinds == START) | (extra & (rank < most)))


def set_logits(network: Network, looks: Looks, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Float64 [sets, categories] from the looks at `rows`."""
    found = looks.glimpses[rows]
    parts = []
    with torch.inference_mode():
        for i in range(0, len(rows), 256):
            part = slice(i, i + 256)
            shown = pictures(torch.from_numpy(found.images[part]), torch.from_numpy(found.boxes[part]))
            parts.append(network.eval().looks(shown, torch.from_numpy(found.scalars[part])))
        logits, weights = (torch.cat(column) for column in zip(*parts, strict=True))
        return network.fused(logits, weights, torch.from_numpy(looks.owners[rows]), len(looks)).double().numpy()


VIEWS = {"start": (START, 0)} | {
    f"start + {count} {name}": (kind, count)
    for name, kind in (("real", NEAR), ("perfect", PERFECT), ("warped", WARPED))
    for count in (1, 2, 3)
}
"""What accuracy is measured with: the kind of the looks added to the first, and how many."""


def calibrated(
    network: Network, categories: Sequence[str], calibration: Looks, held_out: Looks, card: dict[str, Any]
) -> Recogniser:
    """A recogniser whose temperature suits `calibration`, with its accuracy and calibration error on `held_out`."""
    recogniser = Recogniser(network, categories)
    fitting = np.concatenate([set_logits(network, calibration, rows_of(calibration, *view)) for view in VIEWS.values()])
    recogniser.temperature = fitted_temperature(fitting, np.tile(calibration.labels, len(VIEWS)))
    logits = {name: set_logits(network, held_out, rows_of(held_out, *view)) for name, view in VIEWS.items()}
    pooled, labels = np.concatenate(list(logits.values())), np.tile(held_out.labels, len(logits))
    recogniser.card = {
        **card,
        "held_out_sets": len(held_out),
        "accuracy": {name: _accuracy(values, held_out.labels) for name, values in logits.items()},
        "calibration_error": {
            "before": round(calibration_error(softmax(pooled), labels), 4),
            "after": round(calibration_error(softmax(pooled, recogniser.temperature), labels), 4),
        },
        "accuracy_by_category": {
            name: _accuracy(logits["start"][held_out.labels == i], held_out.labels[held_out.labels == i])
            for i, name in enumerate(categories)
            if (held_out.labels == i).any()
        },
    }
    return recogniser


def _accuracy(logits: NDArray[np.float64], labels: NDArray[np.int64]) -> float:
    return round(float((logits.argmax(axis=1) == labels).mean()), 4)
