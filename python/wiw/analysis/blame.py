# SPDX-License-Identifier: Apache-2.0
"""Which stage failures are due to, from the failed episodes run again with stages told the truth (`wiw.attribute`).

A stage is acquitted where a failure is mended while it stays as it is. So the verdict is the first of these swaps that
mends, in the order of how much it gives away:
imagination: with the true futures, the agent's own scores of its own plans suffice.
scoring: with the true worth of each plan, its own plans suffice.
proposals: it would have recognised a good plan, had it had one.
joint: all three together mend it, none alone.
beyond: not even all three do: the budget, the actions, or an answer that is wrong from the best view.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wiw.analysis.statistics import Estimate, estimate_mean
from wiw.analysis.summary import show_estimate
from wiw.errors import ArgumentError
from wiw.files import whole_file
from wiw.loop.swaps import STAGES
from wiw.metrics.headlines import SUCCESS
from wiw.runs.rows import to_json
from wiw.runs.store import RunStore

FOLDER = "blame"
"""In the run's folder, where the episodes that were run again are kept: a run store with an arm for each swap."""
SWAPS: Mapping[str, tuple[str, ...]] = {**{stage: (stage,) for stage in STAGES}, "all": STAGES}
"""What is told the truth, by the swap's name."""
VERDICTS = {
    "imagination": "the true futures would have sufficed",
    "scoring": "a good plan was proposed and not chosen",
    "proposals": "no good plan was proposed",
    "joint": "only all three together mend it",
    "beyond": "not even all three do",
}


@dataclass(frozen=True)
class EpisodeBlame:
    """One failed episode that was run again."""

    arm: str
    episode: int
    scene: str
    mended: Mapping[str, bool]
    """By swap, whether the episode succeeds with it; a swap that changes nothing is left out."""

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`."""
        single = next((stage for stage in STAGES if self.mended.get(stage)), None)
        return single or ("joint" if self.mended["all"] else "beyond")


@dataclass(frozen=True)
class ArmBlame:
    """One arm's failures."""

    arm: str
    judged: int
    """Episodes of the run that count."""
    failed: int
    """Of those, the ones without success."""
    infrastructure: tuple[int, ...]
    """Episodes of the run whose infrastructure failed: nobody knows what the agent would have done."""
    episodes: tuple[EpisodeBlame, ...]
    """Those of the failed ones that were run again with every swap."""
    broken: Mapping[int, str]
    """Those where the infrastructure of a swapped run failed, by episode: which swap, and why."""
    mended: Mapping[str, Estimate]
    """By swap, percent of `episodes` that succeed with it; empty where there are none."""

    @property
    def open(self) -> int:
        """Failed episodes that have not been run again with every swap yet."""
        return self.failed - len(self.episodes) - len(self.broken)

    @property
    def verdicts(self) -> dict[str, int]:
        """How many failures each of `VERDICTS` explains."""
        found = Counter(episode.verdict for episode in self.episodes)
        return {verdict: found[verdict] for verdict in VERDICTS}

    def as_dict(self) -> dict[str, Any]:
        """Plain values: `mended_<swap>` with `_low` and `_high` in percent, `blame_<verdict>` in episodes."""
        line: dict[str, Any] = {"arm": self.arm, "judged": self.judged, "failed": self.failed}
        line |= {"examined": len(self.episodes), "open": self.open}
        line |= {"infrastructure": list(self.infrastructure), "broken": dict(self.broken)}
        for swap, found in self.mended.items():
            name = f"mended_{swap}"
            line |= {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}
        return line | {f"blame_{verdict}": count for verdict, count in self.verdicts.items()}


@dataclass(frozen=True)
class Blame:
    """What `wiw.attribute` found."""

    run: Path
    arms: tuple[ArmBlame, ...]

    def __getitem__(self, arm: str) -> ArmBlame:
        """One arm's failures."""
        for line in self.arms:
            if line.arm == arm:
                return line
        raise KeyError(f"no failures of '{arm}' were examined; those of {', '.join(a.arm for a in self.arms)} were")

    def verdicts(self) -> dict[tuple[str, int], str]:
        """By arm and episode."""
        return {(one.arm, one.episode): one.verdict for line in self.arms for one in line.episodes}

    def notes(self) -> list[str]:
        """What a reader must know, a sentence each."""
        found = []
        for line in self.arms:
            if line.infrastructure:
                text = "failed for infrastructure, so nothing is blamed for them"
                found.append(_named(line.arm, text, line.infrastructure))
            if line.broken:
                episode, cause = next(iter(line.broken.items()))
                text = "could not be run again, as infrastructure failed"
                found.append(f"{_named(line.arm, text, line.broken)} The first, {episode}, {cause}")
            if line.open:
                found.append(f"{line.arm}: {line.open} of {line.failed} failed episodes were not examined.")
        if any(line.mended for line in self.arms):
            found.append("Mended: percent of the examined failures that succeed with the swap, 95 % interval.")
        return found

    def to_json(self) -> str:
        """Arms and episodes as JSON."""
        arms = [line.as_dict() for line in self.arms]
        episodes = [
            {"arm": one.arm, "episode": one.episode, "scene": one.scene, "verdict": one.verdict, "mended": one.mended}
            for line in self.arms
            for one in line.episodes
        ]
        return json.dumps(json.loads(to_json({"arms": arms, "episodes": episodes})), indent=2)

    def save(self) -> Path:
        """Writes blame.json into the run's folder."""
        path = self.run / "blame.json"
        with whole_file(path) as draft:
            draft.write_text(self.to_json(), encoding="utf-8")
        return path

    def summary(self) -> None:
        """Prints both tables."""
        from rich import box
        from rich.console import Console
        from rich.table import Table

        console = Console()
        console = Console(width=None if console.is_terminal else max(console.width, 120))
        for title, columns, cells in (
            ("Failures that a swap turns into successes, %", (*SWAPS,), _mended_cells),
            ("Which stage is to blame, episodes", (*VERDICTS,), _verdict_cells),
        ):
            table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
            table.add_column("arm", style="bold")
            for column in ("failed", "examined", *columns):
                table.add_column(column, justify="right")
            for line in self.arms:
                table.add_row(line.arm, str(line.failed), str(len(line.episodes)), *cells(line))
            console.print(table)
        for note in self.notes():
            console.print(note, style="dim", highlight=False)

    def __str__(self) -> str:
        lines = [
            f"{line.arm}: {', '.join(f'{count} {verdict}' for verdict, count in line.verdicts.items() if count)}"
            for line in self.arms
        ]
        return "\n".join(lines)


def _mended_cells(line: ArmBlame) -> list[str]:
    """For each swap, e.g. "46.3 [38.9, 54.0]"; a dash where it changes nothing or nothing was examined."""
    return [show_estimate(line.mended[swap]) if swap in line.mended else "–" for swap in SWAPS]


def _verdict_cells(line: ArmBlame) -> list[str]:
    """For each verdict how many failures it explains."""
    return [str(count) for count in line.verdicts.values()]


def blame(run: RunStore) -> Blame | None:
    """What the failed episodes that were run again say, of the arms that have any; None where none was."""
    folder = run.path.parent / FOLDER
    if not RunStore.begun(folder):
        return None
    with RunStore.read(folder) as store:
        if store.config["attributes"] != run.created:  # of a run that lay here before
            return None
        again = {(row["arm"], row["episode"]): row for row in store.outcomes()}
    lines = [_arm(run, one["name"], again) for one in run.config["arms"]]
    return Blame(run.path.parent, tuple(line for line in lines if line.episodes or line.broken))


def failed_episodes(run: RunStore, arm: str) -> list[int]:
    """Episodes of an arm that were judged and did not succeed.

    Raises:
        ArgumentError: the task does not say what success is.
    """
    judged = [row for row in run.outcomes() if row["arm"] == arm and row["status"] == "done"]
    if any("success" not in row["metrics"] for row in judged):
        raise ArgumentError(f"{run.path}: its task has no metric 'success', so none of its episodes counts as failed")
    return [row["episode"] for row in judged if row["metrics"]["success"] < 1]


def swaps_of(run: RunStore, arm: str) -> list[str]:
    """The swaps that change something of an arm: where the oracle imagines already, its stage is told the truth."""
    agent = next(one["agent"] for one in run.config["arms"] if one["name"] == arm)
    told = agent.get("model") == "oracle" and "placebo" not in agent
    return [swap for swap in SWAPS if not (told and swap == "imagination")]


def swapped(arm: str, swap: str) -> str:
    """Name of the arm in the store of swapped episodes."""
    return f"{arm}/{swap}"


def _arm(run: RunStore, arm: str, again: Mapping[tuple[str, int], Mapping[str, Any]]) -> ArmBlame:
    ended = [row for row in run.outcomes() if row["arm"] == arm]
    scenes = {row["episode"]: row["scene"] for row in ended}
    failed, swaps = failed_episodes(run, arm), swaps_of(run, arm)
    examined, broken = [], dict[int, str]()
    for episode in failed:
        rows = {swap: again.get((swapped(arm, swap), episode)) for swap in swaps}
        if cause := _cause(rows):
            broken[episode] = cause
        elif all(row is not None for row in rows.values()):
            mended = {swap: bool(row["metrics"]["success"]) for swap, row in rows.items() if row is not None}
            examined.append(EpisodeBlame(arm, episode, scenes[episode], mended))
    return ArmBlame(
        arm,
        sum(row["status"] == "done" for row in ended),
        len(failed),
        tuple(row["episode"] for row in ended if row["status"] == "failed"),
        tuple(examined),
        broken,
        {swap: _share(examined, swap, run.config["seed"]) for swap in swaps} if examined else {},
    )


def _cause(rows: Mapping[str, Mapping[str, Any] | None]) -> str:
    """Why an episode could not be run again with every swap; empty where it could, or has not been."""
    for swap, row in rows.items():
        if row is not None and row["status"] == "failed":
            return f"{swap}: {(row['error'].strip().splitlines() or ['unknown'])[-1]}"
    return ""


def _share(examined: list[EpisodeBlame], swap: str, seed: int) -> Estimate:
    values = [float(one.mended[swap]) for one in examined]
    return estimate_mean(values, [one.scene for one in examined], SUCCESS, seed=seed)


def _named(arm: str, what: str, episodes: Any) -> str:
    """E.g. "warp: 2 episodes failed for infrastructure, so nothing is blamed for them: 3, 8."."""
    count = "1 episode" if len(episodes) == 1 else f"{len(episodes)} episodes"
    return f"{arm}: {count} {what}: {', '.join(map(str, episodes))}."
