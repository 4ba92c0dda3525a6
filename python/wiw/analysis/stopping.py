# SPDX-License-Identifier: Apache-2.0
"""Rules by which a run stops early: "oracle-none excludes 0", "width<8"."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wiw.analysis.anytime import find_anytime_interval
from wiw.analysis.intervals import Array, Interval
from wiw.errors import ArgumentError
from wiw.metrics.metric import SUCCESS
from wiw.scenes import strip_edits
from wiw.types import Episode

UNDERSTOOD = (
    "'A-B excludes 0' (the difference of SR between two arms is shown), 'width<N' (the interval of every arm's SR is "
    "narrower than N points), 'width(A)<N' and 'width(A-B)<N'"
)


@dataclass(frozen=True)
class Look:
    """Findings of one look at a run in progress."""

    episodes: int
    """Per arm, so far."""
    of: int
    """Maximum number of episodes per arm."""
    text: str
    """E.g. "oracle-none +31.2 [3.0, 60.1] over 12 scenes"."""
    is_enough: bool
    """Whether the run stops."""

    def __str__(self) -> str:
        return f"{self.episodes} of {self.of} episodes: {self.text}"


@dataclass(frozen=True)
class StopRule:
    """A rule for when a run has shown enough, by intervals that allow for looking at any time."""

    text: str
    targets: tuple[tuple[str, ...], ...]
    """Each an arm, or an arm and the one that it is compared with."""
    width: float | None
    """Points below which every target's interval must be; None if it must exclude 0."""
    every: int
    """Episodes per arm between two looks."""

    def list_bounds(self, episodes: int) -> Iterator[int]:
        """Yield the numbers of episodes at which to look, the last being all."""
        yield from range(self.every, episodes, self.every)
        yield episodes

    def look(self, bound: int, episodes: Sequence[Episode], outcomes: Sequence[Mapping[str, Any]]) -> Look:
        """Return what the first `bound` episodes show.

        Scenes are the units: each counts by its mean, once all of its episodes have ended. In a single scene they are
        its episodes.

        Args:
            bound: episodes of each arm that have ended.
            episodes: all that the run may have.
            outcomes: rows of the run store.
        """
        order = list_units(episodes, bound)
        scores = {
            (row["arm"], row["episode"]): float(row["metrics"][SUCCESS.name])
            for row in outcomes
            if row["status"] == "done" and SUCCESS.name in row["metrics"]
        }
        unit = _name_unit(episodes)
        found = [self._look_at(target, order, scores, unit) for target in self.targets]
        return Look(bound, len(episodes), "; ".join(text for text, _ in found), all(reached for _, reached in found))

    def _look_at(
        self,
        target: tuple[str, ...],
        units: Sequence[Sequence[int]],
        scores: Mapping[tuple[str, int], float],
        unit: str,
    ) -> tuple[str, bool]:
        values = list_unit_means(target, units, scores)
        name = "-".join(target)
        if not len(values):  # a rule of any width must not hold of nothing
            return f"{name} unknown: no {unit} is complete so far", False
        low, high = find_percent_interval(target, values)
        middle = 100 * float(values.mean())
        sign = "+" if len(target) == 2 else ""
        count = f"1 {unit}" if len(values) == 1 else f"{len(values)} {unit}s"
        text = f"{name} {middle:{sign}.1f} [{low:.1f}, {high:.1f}] over {count}"
        if self.width is None:
            return text, low > 0 or high < 0
        return f"{text}, width {high - low:.1f}", high - low < self.width


def find_percent_interval(target: Sequence[str], values: Array) -> Interval:
    """Return the anytime-valid 95 % interval of a rate, or of a difference of two, in percent."""
    low, high = find_anytime_interval(values, bounds=(0.0, 1.0) if len(target) == 1 else (-1.0, 1.0))
    return 100 * low, 100 * high


def list_units(episodes: Sequence[Episode], bound: int) -> list[list[int]]:
    """Return the episodes of each scene with all of them among the first `bound`, in order; of one scene, each alone.

    Which scenes are complete at a look depends on the order of episodes alone, not on how they ended.
    """
    scenes: dict[str, list[int]] = {}
    for index, episode in enumerate(episodes):
        scenes.setdefault(strip_edits(episode.scene), []).append(index)
    if len(scenes) == 1:
        return [[index] for index in range(bound)]
    complete = [indices for indices in scenes.values() if indices[-1] < bound]
    return sorted(complete, key=lambda indices: indices[-1])


def find_units(
    episodes: Sequence[Episode], outcomes: Sequence[Mapping[str, Any]], arms: Sequence[str]
) -> list[list[int]]:
    """Return the units that a run can be judged by so far: those of the first episodes that have ended in all arms.

    A scene in which episodes are still to run is no unit, as in the looks of the run itself.

    Args:
        episodes: all that the run may have.
        outcomes: with "arm" and "episode", however they ended.
        arms: which must have ended.
    """
    ended: dict[str, set[int]] = {arm: set() for arm in arms}
    for row in outcomes:
        if row["arm"] in ended:
            ended[row["arm"]].add(row["episode"])
    bound = next((i for i in range(len(episodes)) if any(i not in own for own in ended.values())), len(episodes))
    return list_units(episodes, bound)


def describe_bets(episodes: Sequence[Episode], units: Sequence[Sequence[int]]) -> str:
    """Return the test over these units in words."""
    if _name_unit(episodes) == "episode":
        return "a betting test over episodes of one scene, which says nothing about other scenes"
    done = "1 is" if len(units) == 1 else f"{len(units)} are"
    return f"a betting test over scenes ({done} complete)"


def _name_unit(episodes: Sequence[Episode]) -> str:
    return "scene" if len({strip_edits(episode.scene) for episode in episodes}) > 1 else "episode"


def list_unit_means(
    target: Sequence[str], units: Sequence[Sequence[int]], scores: Mapping[tuple[str, int], float]
) -> Array:
    """Return the mean of an arm, or of the difference of two, in each unit with episodes that are scored in all."""
    means = []
    for indices in units:
        both = [[scores[arm, i] for arm in target] for i in indices if all((arm, i) in scores for arm in target)]
        if both:
            means.append(np.mean([row[0] - sum(row[1:]) for row in both]))
    return np.array(means, np.float64)


def parse_stop_rule(text: str, arms: Sequence[str], every: int) -> StopRule:
    """Return the rule that a text describes.

    Args:
        text: see `UNDERSTOOD`.
        arms: of the run.
        every: episodes per arm between two looks.

    Raises:
        ArgumentError: a text that is not understood, or an arm that the run does not have.
    """
    compact = " ".join(text.split())
    if match := re.fullmatch(r"(.+?) excludes 0", compact):
        target = _read_target(match[1], arms, text)
        if len(target) == 1:
            raise _refuse(text, arms, f"'{match[1]}' is a single arm, not a difference")
        return StopRule(compact, (target,), None, every)
    if match := re.fullmatch(r"width ?(?:\((.+)\))? ?< ?(\d+(?:\.\d+)?)", compact):
        targets = (_read_target(match[1], arms, text),) if match[1] else tuple((arm,) for arm in arms)
        if float(match[2]) <= 0:
            raise _refuse(text, arms, "no interval is narrower than 0 points")
        return StopRule(compact, targets, float(match[2]), every)
    raise _refuse(text, arms, "no such rule")


def _read_target(text: str, arms: Sequence[str], rule: str) -> tuple[str, ...]:
    """Return the arm, or the two with a minus between them, that a text names; names of arms may have minus signs."""
    name = text.strip()
    if name in arms:
        return (name,)
    for match in re.finditer("-", name):
        pair = name[: match.start()].strip(), name[match.end() :].strip()
        if all(arm in arms for arm in pair) and pair[0] != pair[1]:
            return pair
    raise _refuse(rule, arms, f"'{name}' is neither an arm nor a difference of two")


def _refuse(text: str, arms: Sequence[str], reason: str) -> ArgumentError:
    return ArgumentError(f"until: got '{text}': {reason}; expected {UNDERSTOOD}, with arms among {', '.join(arms)}")
