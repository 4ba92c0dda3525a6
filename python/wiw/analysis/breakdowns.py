# SPDX-License-Identifier: Apache-2.0
"""Tables of a run beyond one line per arm: by kind of episode, by budget (the anytime curve), over twins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from wiw.analysis.statistics import Difference, Estimate, Units, adjust_p_values, compare, estimate_mean
from wiw.metrics.metric import SUCCESS, Metric
from wiw.types import Episode

Done = Mapping[str, Mapping[int, Mapping[str, Any]]]
"""By arm, scored episodes by index with "scene", "metrics", and "task" where there are kinds."""
PRIMITIVES, DECISIONS = "primitives", "decisions"
"""Units in which an anytime curve is cut."""
MOST_CUTS = 10
"""Maximum number of cuts of an anytime curve over decisions."""
BOTH, ONE, NEITHER = "both right", "one right", "neither right"
PAIRS = Metric("twins", "Twins", "rate", True, about="Percent of pairs of twins of which both are answered rightly.")


@dataclass(frozen=True)
class Breakdown:
    """A table of estimates: arms one way, something else the other way."""

    name: str
    """Name of the table in exports."""
    title: str
    heading: str
    """The same for a page, which explains its metrics elsewhere."""
    about: str
    """Notes that a reader of the table needs; may be empty."""
    key_name: str
    """Meaning of a key, such as "cut"."""
    metric: Metric
    estimates: Mapping[str, Mapping[str, Estimate]]
    """By arm, then by key."""
    base: str = ""
    """Arm that estimates are paired differences from; empty if they are means."""
    arms_across: bool = False
    """Whether arms are columns, as suits few arms and many keys."""
    unit: str = "episodes"
    """Unit that estimates are means over."""
    shown: frozenset[tuple[str, str]] = frozenset()
    """Row and column of the differences that the test, adjusted for all of the table, finds."""
    cut_unit: str = ""
    """Unit of the cuts, "primitives" or "decisions"; empty if keys are not cuts."""

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys, in order."""
        return tuple(dict.fromkeys(key for found in self.estimates.values() for key in found))

    @property
    def stands_in_terminal(self) -> bool:
        """Whether it belongs to the tables in a terminal; that of decisions is wide, and for pages and exports."""
        return self.cut_unit != DECISIONS

    @property
    def columns(self) -> tuple[str, ...]:
        """Titles of the columns."""
        return tuple(self.estimates) if self.arms_across else self.keys

    @property
    def rows(self) -> dict[str, dict[str, Estimate]]:
        """By row, then by column."""
        if not self.arms_across:
            return {arm: dict(found) for arm, found in self.estimates.items()}
        return {key: {arm: found[key] for arm, found in self.estimates.items() if key in found} for key in self.keys}

    @property
    def counts(self) -> dict[str, str]:
        """By row, the number of episodes (`unit`) that its estimates are over, e.g. "12"; "9-12" where they differ."""
        counts = {name: {one.n for one in row.values()} for name, row in self.rows.items()}
        return {
            name: f"{min(own)}" if len(own) == 1 else f"{min(own)}-{max(own)}" for name, own in counts.items() if own
        }

    @property
    def corner(self) -> str:
        """Heading of the rows."""
        return self.key_name if self.arms_across else f"arm minus {self.base}" if self.base else "arm"

    @property
    def reach(self) -> float:
        """Largest distance from 0 of an interval's end."""
        ends = [end for found in self.estimates.values() for one in found.values() for end in (one.low, one.high)]
        return max([1e-6, *(abs(end) for end in ends if not math.isnan(end))])

    def list_cells(self) -> list[dict[str, Any]]:
        """Return the table as plain values, a dict per estimate."""
        return [
            {
                "arm": arm,
                **({"base": self.base} if self.base else {}),
                self.key_name: key,
                **({"unit": self.cut_unit} if self.cut_unit else {}),
                "metric": self.metric.name,
                "value": one.value,
                "low": one.low,
                "high": one.high,
                "n": one.n,
            }
            for arm, found in self.estimates.items()
            for key, one in found.items()
        ]


def split_by_kind(done: Done, metrics: Sequence[Metric], kind: str, seed: int) -> list[Breakdown]:
    """Return a table per metric, by kind of episode; none if there is one kind.

    Args:
        done: see `Done`.
        metrics: to show.
        kind: what a kind is called, such as "category".
        seed: of the bootstrap.
    """
    kinds = dict.fromkeys(o["task"] for ended in done.values() for o in ended.values() if "task" in o)
    found = []
    for metric in metrics if len(kinds) > 1 else ():
        estimates: dict[str, dict[str, Estimate]] = {}
        for arm, ended in done.items():
            for each in kinds:
                own = [o for o in ended.values() if o.get("task") == each and metric.name in o["metrics"]]
                if own:
                    estimates.setdefault(arm, {})[each] = _estimate(own, metric, seed)
        if estimates:
            heading = "Success rate" if metric.name == SUCCESS.name else metric.label
            title = f"{_make_title(metric)} by {kind}"
            found.append(
                Breakdown("kinds", title, f"{heading} by {kind}", "", kind, metric, estimates, arms_across=True)
            )
    return found


@dataclass(frozen=True)
class Cuts:
    """Where the anytime curve of a run is read."""

    at: tuple[int, ...]
    unit: str
    """`PRIMITIVES` or `DECISIONS`."""
    metric: Metric
    """The score that is cut."""
    about: str

    def name_metric(self, cut: int) -> str:
        """Return the name that the score at a cut has among an episode's metrics."""
        return f"{'score' if self.unit == PRIMITIVES else self.metric.name}_at_{cut}"

    def make_metric(self, cut: int) -> Metric:
        """Return the score at a cut as a metric."""
        return replace(self.metric, name=self.name_metric(cut), of=None)


def cut_by_primitives(at: Sequence[int], metric: Metric) -> Cuts:
    """Return cuts after so many primitives, at which the task has measured the score."""
    about = "What is not answered by then counts as the best guess from the question's text alone."
    return Cuts(tuple(at), PRIMITIVES, metric, about)


def cut_by_decisions(done: Done) -> tuple[Done, Cuts | None]:
    """Return episodes that have their success after so many decisions among the metrics, and these cuts.

    Where an episode's details say whether what was answered at each decision is right ("right_after"), that is its
    success; else it has succeeded from its last decision on, if at all. Runs of a single decision have no cuts.
    """
    counts = [o["metrics"].get("decisions", 0) for ended in done.values() for o in ended.values()]
    budget = int(max(counts, default=0))
    if budget < 2:
        return done, None
    spacing = -(-budget // MOST_CUTS)
    cuts = Cuts(
        tuple(sorted({1, *range(spacing, budget, spacing), budget})),
        DECISIONS,
        SUCCESS,
        "An episode that ended before keeps its outcome.",
    )
    return {arm: {i: _add_cuts(o, cuts) for i, o in ended.items()} for arm, ended in done.items()}, cuts


def _add_cuts(outcome: Mapping[str, Any], cuts: Cuts) -> Mapping[str, Any]:
    metrics = outcome["metrics"]
    if not {"success", "decisions"} <= metrics.keys():
        return outcome
    right = outcome.get("details", {}).get("right_after")
    found = {
        cuts.name_metric(cut): float(right[min(cut, len(right)) - 1])
        if right
        else float(metrics["success"]) * (metrics["decisions"] <= cut)
        for cut in cuts.at
    }
    return {**outcome, "metrics": {**metrics, **found}}


def read_anytime_curve(done: Done, cuts: Cuts, seed: int) -> list[Breakdown]:
    """Return the score of each arm if every episode had been cut there; none where arms lack it.

    Args:
        done: see `Done`, with the scores at the cuts among the metrics.
        cuts: where, and which score.
        seed: of the bootstrap.
    """
    estimates: dict[str, dict[str, Estimate]] = {}
    for arm, ended in done.items():
        for cut in cuts.at:
            at = cuts.make_metric(cut)
            if ended and all(at.name in o["metrics"] for o in ended.values()):
                estimates.setdefault(arm, {})[str(cut)] = _estimate(list(ended.values()), at, seed)
    title = f"{_make_title(cuts.metric)} within N {cuts.unit}"
    heading = f"{cuts.metric.label} within N {cuts.unit}"
    found = Breakdown("anytime", title, heading, cuts.about, "cut", cuts.metric, estimates, cut_unit=cuts.unit)
    return [found] if estimates else []


def compare_anytime_curves(
    done: Done, pairs: Iterable[tuple[str, str]], cuts: Cuts, seed: int, units: Units | None = None
) -> list[Breakdown]:
    """Return paired differences of the anytime curve, a table per base.

    Args:
        done: see `Done`, with the scores at the cuts among the metrics.
        pairs: arms and what each is compared with.
        cuts: where, and which score.
        seed: of the bootstrap.
        units: of a run that was looked at before it was stopped, see `wiw.analysis.statistics.compare`.
    """
    found: dict[str, dict[tuple[str, str], Difference]] = {}
    for arm, base in pairs:
        for cut in cuts.at:
            at = cuts.make_metric(cut)
            both = [o["metrics"] for name in (arm, base) for o in done[name].values()]
            known = all(at.name in each for each in both)
            difference = compare(arm, base, done, at, seed, units) if known else None
            if difference is not None:
                found.setdefault(base, {})[arm, str(cut)] = difference
    return [_tabulate_anytime_differences(base, cells, cuts) for base, cells in found.items()]


def _tabulate_anytime_differences(base: str, cells: Mapping[tuple[str, str], Difference], cuts: Cuts) -> Breakdown:
    """Return the table of differences from one base, by arm and cut."""
    estimates: dict[str, dict[str, Estimate]] = {}
    for (arm, cut), difference in cells.items():
        estimates.setdefault(arm, {})[cut] = difference.estimate
    adjusted = zip(cells, adjust_p_values(list(cells.values())), strict=True)
    heading = f"{cuts.metric.label} within N {cuts.unit}, difference from {base}"
    return Breakdown(
        "anytime_differences",
        f"{heading}, points",
        heading,
        "Paired by episode.",
        "cut",
        cuts.metric,
        estimates,
        base,
        shown=frozenset(cell for cell, difference in adjusted if difference.is_shown),
        cut_unit=cuts.unit,
    )


def score_twins(done: Done, twins: Sequence[tuple[int, int]], seed: int) -> list[Breakdown]:
    """Return how often both, one or neither of two twins are answered rightly; nothing without twins.

    Args:
        done: see `Done`.
        twins: indices of episodes that ask the same where something else is true.
        seed: of the bootstrap.
    """
    estimates: dict[str, dict[str, Estimate]] = {}
    for arm, ended in done.items():
        pairs = [(ended[i], ended[j]) for i, j in twins if i in ended and j in ended]
        pairs = [pair for pair in pairs if all("success" in o["metrics"] for o in pair)]
        if not pairs:
            continue
        right = [sum(o["metrics"]["success"] for o in pair) for pair in pairs]
        scenes = [first["scene"] for first, _ in pairs]
        estimates[arm] = {
            key: estimate_mean([float(count == wanted) for count in right], scenes, PAIRS, seed=seed)
            for key, wanted in ((BOTH, 2), (ONE, 1), (NEITHER, 0))
        }
    about = (
        "Twins ask the same, from the same start, in two copies of a home that differ in one thing. "
        "Only who looks answers both rightly."
    )
    title = "Counterfactual twins, % of pairs"
    return [Breakdown("twins", title, title, about, "outcome", PAIRS, estimates, unit="pairs")] if estimates else []


def find_twins(episodes: Sequence[Episode]) -> list[tuple[int, int]]:
    """Return the pairs of episodes that name each other as twins, by index, each pair once."""
    places = {episode.episode_id: index for index, episode in enumerate(episodes)}
    named = {index: places.get(_read_twin(episode)) for index, episode in enumerate(episodes)}
    return [(i, j) for i, j in named.items() if j is not None and i < j and named[j] == i]


def _read_twin(episode: Episode) -> str:
    question = episode.info.get("question")
    return str(question.get("twin") or "") if isinstance(question, Mapping) else ""


def _estimate(outcomes: Sequence[Mapping[str, Any]], metric: Metric, seed: int) -> Estimate:
    values, scenes = [o["metrics"][metric.name] for o in outcomes], [o["scene"] for o in outcomes]
    return estimate_mean(values, scenes, metric, seed=seed)


def _make_title(metric: Metric) -> str:
    return " ".join(part for part in (metric.label, metric.unit, "↑" if metric.higher_is_better else "↓") if part)
