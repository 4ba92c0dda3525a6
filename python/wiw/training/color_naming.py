# SPDX-License-Identifier: Apache-2.0
"""Calibrate colour naming on things whose colours are known, and evaluate it on held-out ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.perception.colors import COLORS, FEATURES, ColorNamer, compute_features
from wiw.perception.scene_labels import CATEGORIES, STRUCTURE
from wiw.training.labelled_views import LabelledViews

HIDDEN = 48
STEPS, BATCH, RATE, DECAY = 3000, 256, 3e-3, 1e-3
UNKNOWN = 0.15
"""Share of the sets of pixels whose category is withheld, so that colours can be named without it."""
BALANCE = 0.5
"""Sets of pixels are sampled with the frequency of their category and colour to minus this."""


def calibrate(views: LabelledViews, seed: int, steps: int = STEPS) -> ColorNamer:
    """Train a namer on the pixels of the views' instances.

    Raises:
        ArgumentError: the views have no object of a known colour.
    """
    if not len(views.pixels):
        raise ArgumentError("expected scenes with objects of known colours, got none; choose others (--scenes)")
    features = compute_features(views.pixels)
    shift, scale = features.mean(axis=0), 1 / (features.std(axis=0) + 1e-3)
    inputs = torch.from_numpy(((features - shift) * scale).astype(np.float32))
    targets, categories = (torch.from_numpy(each.astype(np.int64)) for each in (views.color, views.colored_category))
    torch.manual_seed(core.fold_key([seed, 0x4C24]) % 2**63)
    first, last = torch.nn.Linear(FEATURES, HIDDEN), torch.nn.Linear(HIDDEN, len(COLORS))
    category_hidden, category_output = (
        torch.zeros(len(CATEGORIES), size, requires_grad=True) for size in (HIDDEN, len(COLORS))
    )
    parts: tuple[torch.Tensor, ...] = (*first.parameters(), *last.parameters(), category_hidden, category_output)
    optimiser = torch.optim.AdamW(parts, RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    rng = np.random.default_rng(core.fold_key([seed, 0x4C25]))
    weights = _compute_weights(views)
    for _ in range(steps):
        rows = torch.from_numpy(rng.choice(len(inputs), BATCH, p=weights))
        known = torch.where(torch.from_numpy(rng.random(BATCH) < UNKNOWN), 0, categories[rows])
        logits = last(torch.relu(first(inputs[rows]) + category_hidden[known])) + category_output[known]
        loss = torch.nn.functional.cross_entropy(logits, targets[rows])
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    return ColorNamer(CATEGORIES, shift, scale, *(each.detach().double().numpy() for each in parts))


def _compute_weights(views: LabelledViews) -> NDArray[np.float64]:
    """Return the sampling probability of each set of pixels."""
    pairs = views.colored_category.astype(np.int64) * len(COLORS) + views.color
    weights = np.bincount(pairs)[pairs] ** -BALANCE
    return np.asarray(weights / weights.sum())


def evaluate(namer: ColorNamer, views: LabelledViews) -> dict[str, Any]:
    """Measure accuracy on held-out things.

    Returns:
        {"things": N, "accuracy": of things in rooms, "structure": of walls, floors and the like, "by_category",
        "by_color"}: shares of the sets of pixels whose colour was named as the scene names it, None if there are
        none.
    """
    if not len(views.pixels):
        return {"things": 0, "accuracy": None, "structure": None, "by_category": {}, "by_color": {}}
    probabilities = namer.compute_probabilities(compute_features(views.pixels), views.colored_category)
    right = probabilities.argmax(axis=1) == views.color
    names = np.array(CATEGORIES)[views.colored_category]
    colors = np.array(COLORS)[views.color]
    structure = np.isin(names, STRUCTURE)
    return {
        "things": int((~structure).sum()),
        "accuracy": _mean(right[~structure]),
        "structure": _mean(right[structure]),
        "by_category": {str(name): _mean(right[names == name]) for name in np.unique(names)},
        "by_color": {str(name): _mean(right[(colors == name) & ~structure]) for name in np.unique(colors[~structure])},
    }


def _mean(flags: NDArray[np.bool_]) -> float | None:
    return round(float(flags.mean()), 4) if len(flags) else None
