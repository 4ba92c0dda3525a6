# SPDX-License-Identifier: Apache-2.0
"""One decision as a picture: what was seen, what was imagined for each plan, what was chosen."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.report.cuts import BAND, FRONT, cut_part
from wiw.report.plans import format_glyphs, is_primitive_plan, numbers
from wiw.report.stage import format_signs
from wiw.runs.rows import select_frames
from wiw.tabletop.workbench import SHUT
from wiw.types import ArmObservation, Decision, Observation, Rollout

CHOSEN, OTHER = "#2e9e6b", "#9a9ea8"
WIDTH, TOP, ROW = 11.0, 2.7, 1.15
"""Inches: of the figure, of the row of what was seen, of a candidate's row."""


class DecisionFigure(Figure):
    """A matplotlib figure that shows itself in Jupyter, also without `%matplotlib inline`."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=90)
        return buffer.getvalue()


def show(decision: Decision) -> DecisionFigure:
    """Draw a decision; return a matplotlib figure, which Jupyter displays and `.savefig(path)` writes.

    Raises:
        ArgumentError: the decision carries no observation (one that was read back from a run store does not).
    """
    if decision.observation is None:
        raise ArgumentError(
            "show: the decision contains no observation; show one returned by agent.decide, or open the run's report"
        )
    rows = len(decision.proposals)
    figure = DecisionFigure(figsize=(WIDTH, TOP + ROW * rows), layout="constrained")
    grid = figure.add_gridspec(1 + rows, 1, height_ratios=[TOP, *[ROW] * rows])
    _top(figure, grid[0], decision)
    scores = _scores(decision)
    for index in range(rows):
        _candidate(figure, grid[1 + index], decision, index, scores)
    return figure


def _top(figure: Figure, place: Any, decision: Decision) -> None:
    assert decision.observation is not None
    goal = decision.goal
    has_image = goal is not None and goal.image is not None
    columns = place.subgridspec(1, 2, width_ratios=[4, 1]) if has_image else place.subgridspec(1, 1)
    _picture(figure.add_subplot(columns[0, 0]), *_choose_picture(decision.observation))
    if goal is not None and goal.image is not None:
        _picture(figure.add_subplot(columns[0, 1]), goal.image, "goal")
    if goal is not None and goal.text:
        figure.suptitle(goal.text, parse_math=False)


def _choose_picture(observation: Observation | ArmObservation) -> tuple[NDArray[np.uint8], str]:
    """Return a picture of where the agent is, and what it is."""
    if isinstance(observation, ArmObservation):
        return observation.front, "seen from the front"
    panorama = observation.mark_target("panorama")
    return cut_part(panorama, BAND, (0, 1)), "seen, all around"


def _describe_plan(decision: Decision, index: int) -> str:
    """Return a plan in signs."""
    actions, here = decision.proposals[index].actions.tolist(), decision.observation
    if isinstance(here, ArmObservation):
        return format_signs(actions, here.pose[:3].tolist(), bool(here.pose[6] < SHUT))
    return " ".join(format_glyphs(actions)) if is_primitive_plan(actions) else numbers(actions)


def _candidate(figure: Figure, place: Any, decision: Decision, index: int, scores: NDArray[np.float64]) -> None:
    chosen = index == decision.chosen
    color = CHOSEN if chosen else OTHER
    rollout = None if decision.rollouts is None else decision.rollouts[index]
    columns = place.subgridspec(1, 2, width_ratios=[1, 5])
    label = figure.add_subplot(columns[0, 0])
    label.axis("off")
    label.set(xlim=(0, 1), ylim=(0, 1))
    label.text(0, 0.68, _describe_plan(decision, index), fontsize=12, weight="bold")
    low, high = np.nanmin(scores), np.nanmax(scores)
    share = 1.0 if high <= low else (scores[index] - low) / (high - low)
    label.barh([0.42, 0.42], [1, share], height=0.08, color=["#e4e2db", color])
    label.text(0, 0.08, f"{scores[index]:.3f}" + ("   chosen" if chosen else ""), color=color, fontsize=10)
    if rollout is not None:
        unread = len(decision.proposals[index].actions) - len(rollout.frames)
        _frames(figure, columns[0, 1], rollout, unread, color if chosen else None)


def _frames(figure: Figure, place: Any, rollout: Rollout, unread: int, border: str | None) -> None:
    """Draw a rollout, of which the first `unread` actions have no frames."""
    kept = select_frames(len(rollout.frames))
    cells = place.subgridspec(1, len(kept), wspace=0.02)
    for column, k in enumerate(kept):
        axes = figure.add_subplot(cells[0, column])
        title = "real, turned" if rollout.real[k] else f"imagined {unread + k + 1}"
        _picture(axes, _front(rollout.frames[k]), title, size=7)
        if border is not None:
            axes.spines[:].set(visible=True, color=border, linewidth=2.5)


def _front(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the first of several views; of a panorama the part towards which the agent looks."""
    view = frame[0] if frame.ndim == 4 else frame
    height, width = view.shape[:2]
    return view if width <= 1.6 * height else cut_part(view, BAND, FRONT)


def _picture(axes: Axes, image: NDArray[np.uint8], title: str, size: int = 9) -> None:
    axes.imshow(image)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(title, fontsize=size, color="#6a6e78", loc="left", pad=3)


def _scores(decision: Decision) -> NDArray[np.float64]:
    """Return the reviser's scores, or the proposing policy's own preferences."""
    if decision.scores is not None:
        return np.asarray(decision.scores, np.float64)
    return np.array([proposal.prior for proposal in decision.proposals])
