# SPDX-License-Identifier: Apache-2.0
"""Evaluate armnet by what becomes of each thing: lamps that light up, things carried, placed, pushed, left alone."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from wiw.tabletop.colours import MIN_SIMILARITY, compare_colour
from wiw.tabletop.push_buttons import UNLIT_COLOUR
from wiw.tabletop.workbench import LAMPS
from wiw.training.armnet import StepPrediction, build_sequences, clear_canvas, load_bare_table, predict_free_running
from wiw.training.plays import EVENTS, POSES, Plays
from wiw.world_models.armnet.network import Network, compose_static_view

LIT = tuple(number for number, event in enumerate(EVENTS) if event.startswith("lit"))
"""The events of lamps, 1 to 3 like the lamps themselves."""
MIN_PIXELS = 4
"""Fewest pixels of a thing, or of a lamp, by which it is judged."""

Figures = dict[str, dict[str, list[float]]]


def evaluate_events(network: Network, plays: Plays) -> dict[str, Any]:
    """Measure a network's views by what becomes of each thing at a pose.

    Returns:
        {"one_pose": {event: figures}, "free_running": {event: figures}}: each pose by itself, from the true view
        before it; and all poses in a row, from a play's first view. The events are `EVENTS`. The figures are "count",
        the number of things; "arm" and "armnet", the mean absolute error, in units of 1/255, where the thing is before
        or after the pose, of the view if nothing but the arm had moved, and of the network's; "sharpness", the
        differences between neighbouring pixels there as a share of the true ones; and for lamps "lit", the number that
        the true view shows, with "right", the share of them that the network's view shows in the right colour.
    """
    one_pose, free_running = (defaultdict[str, dict[str, list[float]]](lambda: defaultdict(list)) for _ in range(2))
    plate = load_bare_table()
    with torch.inference_mode():
        for rows in np.array_split(np.arange(len(plays)), max(1, len(plays) // 16)):
            batch = build_sequences(plays, rows, np.zeros(len(rows), np.int64), POSES)
            canvas = clear_canvas(batch.views[0], batch.arms[0], plate)
            for at, step in enumerate(predict_free_running(network, batch)):
                alone = compose_static_view(canvas, batch.arms[at + 1], plate)
                _add_figures(free_running, plays, rows, at, alone, step)
                (single,) = predict_free_running(network, build_sequences(plays, rows, np.full(len(rows), at), 1))
                _add_figures(one_pose, plays, rows, at, single.static_view, single)
    return {"one_pose": _summarise(one_pose), "free_running": _summarise(free_running)}


def _add_figures(
    figures: Figures, plays: Plays, rows: NDArray[np.int64], at: int, alone: Tensor, step: StepPrediction
) -> None:
    """Add the figures of each thing of the plays `rows` at the pose number `at`."""
    views = {"arm": alone, "armnet": step.prediction}
    errors = {name: 255 * (view - step.target).abs().mean(1).numpy() for name, view in views.items()}
    edges, true_edges = _measure_edges(step.prediction), _measure_edges(step.target)
    for place, row in enumerate(rows):
        before, after = plays.things[row, at], plays.things[row, at + 1]
        for thing in range(1, max(before.max(), after.max()) + 1):
            region = (before == thing) | (after == thing)
            if region.sum() < MIN_PIXELS:
                continue
            event = int(plays.events[row, at, thing - 1])
            found = figures[EVENTS[event]]
            for name, error in errors.items():
                found[name].append(float(error[place][region].mean()))
            found["sharpness"].append(float(edges[place][region].sum() / true_edges[place][region].sum()))
            if event in LIT:
                true, made = _to_bytes(step.target[place]), _to_bytes(step.prediction[place])
                shown = (after == thing) & (_rate_ring_colours(true).argmax(0) == event)
                if shown.sum() >= MIN_PIXELS:
                    found["right"].append(float(_rate_ring_colours(made[shown]).mean(axis=1).argmax() == event))


def _rate_ring_colours(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return how alike pixels uint8 [..., 3] are to a ring that is not lit, and to the lamps: float64 [1 + 3, ...].

    What is unlike all counts as not lit.
    """
    likeness = np.stack([compare_colour(pixels, colour) ** 2 for colour in (UNLIT_COLOUR, *LAMPS.values())])
    return np.where(likeness < MIN_SIMILARITY, 0.0, likeness)


def _measure_edges(view: Tensor) -> NDArray[np.float32]:
    """Return the absolute differences to the next pixels on the right and below, [B, H, W], of a view."""
    right, below = view.diff(dim=3).abs().mean(1), view.diff(dim=2).abs().mean(1)
    return (functional.pad(right, (0, 1)) + functional.pad(below, (0, 0, 0, 1))).numpy()


def _to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Return an image [3, H, W] in [0, 1] as uint8 [H, W, 3]."""
    return (image.permute(1, 2, 0) * 255).round().byte().numpy()


def _summarise(figures: Figures) -> dict[str, dict[str, float]]:
    def summarise(found: dict[str, list[float]]) -> dict[str, float]:
        lamps = {"lit": len(found["right"])} if found.get("right") else {}
        return {"count": len(found["arm"])} | lamps | {k: round(float(np.mean(v)), 3) for k, v in found.items()}

    return {event: summarise(figures[event]) for event in EVENTS if event in figures}
