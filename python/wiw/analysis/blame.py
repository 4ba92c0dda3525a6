# SPDX-License-Identifier: Apache-2.0
"""Which stage causes an agent's failures, from reruns with ground truth in one stage at a time.

`wiw.blame` reruns failures; this module reads the reruns. Stages and verdicts are in `wiw.analysis.blame_schemes`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wiw.analysis.blame_schemes import LOOP, Scheme, choose_scheme
from wiw.analysis.statistics import Estimate, estimate_mean
from wiw.analysis.summary import show_estimate
from wiw.errors import ArgumentError
from wiw.files import atomic_file
from wiw.metrics.metric import SUCCESS, is_success
from wiw.runs.rows import to_json
from wiw.runs.store import RunStore
from wiw.scenes import strip_edits

FOLDER = "blame"
"""Folder inside the run's that holds the reruns: a run store with one arm per arm and rerun."""


@dataclass(frozen=True)
class EpisodeBlame:
    """One failure that was rerun."""

    arm: str
    episode: int
    scene: str
    success: Mapping[str, bool]
    """By rerun, whether the episode succeeds; a rerun that changes nothing is left out."""
    scheme: Scheme = LOOP

    @property
    def verdict(self) -> str:
        """One of the scheme's verdicts."""
        return self.scheme.find_verdict(self.success)


@dataclass(frozen=True)
class ArmBlame:
    """One arm's failures."""

    arm: str
    judged: int
    """Episodes of the run that ended without an error."""
    failures: int
    """Episodes of these without success."""
    errors: tuple[int, ...]
    """Episodes of the run that ended with an error; nothing is blamed for them."""
    episodes: tuple[EpisodeBlame, ...]
    """Failures that were rerun with ground truth in each stage."""
    rerun_errors: Mapping[int, str]
    """Failures whose rerun ended with an error, by episode: which rerun, and why."""
    recovery: Mapping[str, Estimate]
    """By rerun, percent of `episodes` that succeed; empty if there are none."""
    scheme: Scheme = LOOP

    @property
    def remaining(self) -> int:
        """Failures that have not been rerun yet."""
        return self.failures - len(self.episodes) - len(self.rerun_errors)

    @property
    def verdicts(self) -> dict[str, int]:
        """Number of failures by verdict."""
        found = Counter(episode.verdict for episode in self.episodes)
        return {verdict: found[verdict] for verdict in self.scheme.verdicts}

    def as_dict(self) -> dict[str, Any]:
        """Return plain values: `mended_<rerun>` with `_low` and `_high` in percent, `blame_<verdict>` in episodes."""
        line: dict[str, Any] = {"arm": self.arm, "judged": self.judged, "failures": self.failures}
        line |= {"examined": len(self.episodes), "remaining": self.remaining}
        line |= {"errors": list(self.errors), "rerun_errors": dict(self.rerun_errors)}
        for rerun, found in self.recovery.items():
            name = f"mended_{rerun}"
            line |= {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}
        return line | {f"blame_{verdict}": count for verdict, count in self.verdicts.items()}


@dataclass(frozen=True)
class Blame:
    """The result of `wiw.blame`."""

    run: Path
    arms: tuple[ArmBlame, ...]
    scheme: Scheme = LOOP

    def __getitem__(self, arm: str) -> ArmBlame:
        """Return one arm's failures."""
        for line in self.arms:
            if line.arm == arm:
                return line
        raise KeyError(f"no failures of '{arm}' were examined; those of {', '.join(a.arm for a in self.arms)} were")

    def verdicts(self) -> dict[tuple[str, int], str]:
        """Return the verdicts by arm and episode."""
        return {(one.arm, one.episode): one.verdict for line in self.arms for one in line.episodes}

    def notes(self) -> list[str]:
        """Return sentences that a reader of the tables needs."""
        found = []
        for line in self.arms:
            if line.errors:
                text = "ended with an infrastructure error in the run, so no stage is blamed for them"
                found.append(_name_episodes(line.arm, text, line.errors))
            if line.rerun_errors:
                episode, cause = next(iter(line.rerun_errors.items()))
                text = "could not be rerun because of an infrastructure error"
                found.append(f"{_name_episodes(line.arm, text, line.rerun_errors)} The first, {episode}, {cause}")
            if line.remaining:
                found.append(f"{line.arm}: {line.remaining} of {line.failures} failures have not been rerun.")
        if any(line.recovery for line in self.arms):
            found.append("Recovery: percent of the rerun failures that succeed with that ground truth, 95 % interval.")
        return found

    def to_json(self) -> str:
        """Return arms and episodes as JSON."""
        arms = [line.as_dict() for line in self.arms]
        episodes = [
            {"arm": one.arm, "episode": one.episode, "scene": one.scene, "verdict": one.verdict, "mended": one.success}
            for line in self.arms
            for one in line.episodes
        ]
        return json.dumps(json.loads(to_json({"arms": arms, "episodes": episodes})), indent=2)

    def save(self) -> Path:
        """Write blame.json into the run's folder and return its path."""
        path = self.run / "blame.json"
        with atomic_file(path) as draft:
            draft.write_text(self.to_json(), encoding="utf-8")
        return path

    def __str__(self) -> str:
        lines = [
            f"{line.arm}: {', '.join(f'{count} {verdict}' for verdict, count in line.verdicts.items() if count)}"
            for line in self.arms
        ]
        return "\n".join(lines)

    def summary(self) -> None:
        """Print both tables."""
        from rich import box
        from rich.console import Console
        from rich.table import Table

        console = Console()
        gap = " " if console.width >= ROOMY or not console.is_terminal else "\n"
        console = Console(width=None if console.is_terminal else max(console.width, ROOMY))
        for title, columns, cells in (
            ("Failures that succeed with ground truth in one stage, %", (*self.scheme.reruns,), _recovery_cells),
            ("Stage to blame, episodes", (*self.scheme.verdicts,), _verdict_cells),
        ):
            table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
            table.add_column("arm", style="bold", overflow="fold")
            for column in ("failures", "rerun", *columns):
                table.add_column(column, justify="right", no_wrap=True)
            for line in self.arms:
                shown = [cell.replace(" ", gap, 1) for cell in cells(line)]
                table.add_row(line.arm, str(line.failures), str(len(line.episodes)), *shown)
            console.print(table)
        for note in self.notes():
            console.print(note, style="dim", highlight=False)


ROOMY = 120
"""Terminal columns from which on an estimate and its interval stand on one line."""


def _recovery_cells(line: ArmBlame) -> list[str]:
    """Return a cell per rerun, e.g. "46.3 [38.9, 54.0]"; a dash where it changes nothing or nothing was rerun."""
    return [show_estimate(line.recovery[rerun]) if rerun in line.recovery else "–" for rerun in line.scheme.reruns]


def _verdict_cells(line: ArmBlame) -> list[str]:
    """Return the number of failures per verdict."""
    return [str(count) for count in line.verdicts.values()]


def read_blame(run: RunStore) -> Blame | None:
    """Return the verdicts on a run's failures so far; None if none was rerun.

    None too where another judge's marks are read than the run's own, by which reruns are failures.
    """
    folder = run.path.parent / FOLDER
    if not RunStore.exists(folder) or (run.judge is not None and not run.judge.own):
        return None
    with RunStore.read(folder) as store:
        if store.config["attributes"] != run.created:  # of an older run in the same folder
            return None
        reruns = {(row["arm"], row["episode"]): row for row in store.outcomes()}
    lines = [_read_arm(run, one["name"], reruns) for one in run.config["arms"]]
    return Blame(
        run.path.parent,
        tuple(line for line in lines if line.episodes or line.rerun_errors),
        choose_scheme(run.config["task"]),
    )


def list_failures(run: RunStore, arm: str) -> list[int]:
    """Return the episodes of an arm that ended without success and without an error.

    Raises:
        ArgumentError: the task does not say what success is.
    """
    judged = [row for row in run.outcomes() if row["arm"] == arm and row["status"] == "done"]
    if any("success" not in row["metrics"] for row in judged):
        raise ArgumentError(f"{run.path}: its task has no metric 'success', so none of its episodes counts as failed")
    return [row["episode"] for row in judged if not is_success(row["metrics"])]


def list_reruns(run: RunStore, arm: str) -> list[str]:
    """Return the reruns that make a difference for an arm: the oracle's rollouts are the ground truth already."""
    agent = next(one["agent"] for one in run.config["arms"] if one["name"] == arm)
    exact = agent.get("model") == "oracle" and not {"placebo", "error"} & agent.keys()
    return [rerun for rerun in choose_scheme(run.config["task"]).reruns if not (exact and rerun == "imagination")]


def name_rerun(arm: str, rerun: str) -> str:
    """Return the name of an arm in the store of reruns."""
    return f"{arm}/{rerun}"


def _read_arm(run: RunStore, arm: str, reruns: Mapping[tuple[str, int], Mapping[str, Any]]) -> ArmBlame:
    ended = [row for row in run.outcomes() if row["arm"] == arm]
    scenes = {row["episode"]: row["scene"] for row in ended}
    failures, names, scheme = list_failures(run, arm), list_reruns(run, arm), choose_scheme(run.config["task"])
    examined, errors = [], dict[int, str]()
    for episode in failures:
        rows = {name: reruns.get((name_rerun(arm, name), episode)) for name in names}
        if cause := _find_error(rows):
            errors[episode] = cause
        elif all(row is not None for row in rows.values()):
            success = {name: is_success(row["metrics"]) for name, row in rows.items() if row is not None}
            examined.append(EpisodeBlame(arm, episode, scenes[episode], success, scheme))
    return ArmBlame(
        arm,
        sum(row["status"] == "done" for row in ended),
        len(failures),
        tuple(row["episode"] for row in ended if row["status"] == "error"),
        tuple(examined),
        errors,
        {name: _estimate_recovery(examined, name, run.config["seed"]) for name in names} if examined else {},
        scheme,
    )


def _find_error(rows: Mapping[str, Mapping[str, Any] | None]) -> str:
    """Return the error that kept an episode from being rerun; empty if there was none."""
    for rerun, row in rows.items():
        if row is not None and row["status"] == "error":
            return f"{rerun}: {(row['error'].strip().splitlines() or ['unknown'])[-1]}"
    return ""


def _estimate_recovery(examined: list[EpisodeBlame], rerun: str, seed: int) -> Estimate:
    values = [float(one.success[rerun]) for one in examined]
    scenes = [strip_edits(one.scene) for one in examined]  # intervals are over apartments, as in all tables
    return estimate_mean(values, scenes, SUCCESS, seed=seed)


def _name_episodes(arm: str, text: str, episodes: Iterable[int]) -> str:
    """Return e.g. "warp: 2 episodes could not be rerun because of an infrastructure error: 3, 8."."""
    numbers = list(episodes)
    count = "1 episode" if len(numbers) == 1 else f"{len(numbers)} episodes"
    return f"{arm}: {count} {text}: {', '.join(map(str, numbers))}."
