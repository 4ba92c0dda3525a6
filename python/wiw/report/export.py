# SPDX-License-Identifier: Apache-2.0
"""A run as plain tables (CSV, Parquet) for other programs, and as a recording for the Rerun viewer.

Everything is written beside its place and renamed once it is whole, so that a killed export leaves no half file.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from wiw.analysis.summary import list_arm_lines, list_tier_lines, summarise_run
from wiw.errors import ArgumentError
from wiw.files import atomic_file, atomic_folder
from wiw.metrics.metric import name_column
from wiw.runs.rows import to_json
from wiw.runs.run import Run

Table = list[dict[str, Any]]

NUMBERED = ("seconds", "calls", "spent")
"""Columns of decisions with named numbers, each of which becomes a column such as seconds_propose."""
NESTED = ("actions", "executed", "answer", "real_frames", "path", "refused")
"""Columns of decisions that stay lists in Parquet and become JSON in CSV."""


def export(run: Run, csv: Path | None = None, parquet: Path | None = None, rerun: Path | None = None) -> list[Path]:
    """Write tables or a recording and return the files.

    Args:
        run: to be exported.
        csv: new folder for one CSV file a table.
        parquet: new folder for one Parquet file a table.
        rerun: recording for the Rerun viewer.

    Raises:
        ArgumentError: nothing is requested, the recording does not end in .rrd, or a package is not installed.
        FileError: a folder holds something already, or cannot be written.
    """
    if rerun is not None and rerun.suffix != ".rrd":
        raise ArgumentError(f"export: expected a recording's name to end in .rrd, got {rerun}")
    if csv is None and parquet is None and rerun is None:
        raise ArgumentError("export: expected at least one of csv (--csv DIR), parquet and rerun (--rerun FILE.rrd)")
    written = [] if csv is None else export_csv(run, csv)
    written += [] if parquet is None else export_parquet(run, parquet)
    return written if rerun is None else [*written, export_rerun(run, rerun)]


def tables(run: Run) -> dict[str, Table]:
    """Return the run as tables of plain values, by name: arms, episodes, outcomes, decisions, candidates.

    Ended episodes only; a metric is a column of outcomes, seconds and counts are columns of decisions. Where the task
    has them: tiers, kinds, anytime, anytime_differences, twins, and judgements, by all judges.
    """
    decisions, summary = run.store.decisions(), summarise_run(run)
    further: dict[str, Table] = {}
    for breakdown in summary.breakdowns:
        further.setdefault(breakdown.name, []).extend(breakdown.list_cells())
    if tiers := list_tier_lines(summary):
        further["tiers"] = tiers
    if judgements := list_judgements(run):
        further["judgements"] = judgements
    return {
        "arms": list_arm_lines(summary),
        "episodes": _tabulate_episodes(run),
        "outcomes": [
            _drop_nested({**row, **_name_metrics(row), "details": to_json(row["details"])}, "metrics")
            for row in run.store.outcomes()
        ],
        "decisions": [_flatten_decision(row) for row in decisions],
        "candidates": [candidate for row in decisions for candidate in _list_candidates(row)],
        **further,
    }


def _name_metrics(outcome: Mapping[str, Any]) -> dict[str, float]:
    """Return an outcome's metrics by the names of their columns."""
    return {name_column(name, outcome): value for name, value in outcome["metrics"].items()}


def list_judgements(run: Run) -> Table:
    """Return every judgement of the run by every judge, a dict each; none where its task has no answers in words."""
    recorded = {(row["arm"], row["episode"]): row for row in run.store.recorded_outcomes()}
    found: Table = []
    for judge in run.store.judges:
        judged = run.store.judged_outcomes(judge.digest)
        for (arm, episode), row in ({**recorded, **judged} if judge.own else judged).items():
            key = {"judge": judge.digest, "judge_name": judge.label, "own": judge.own, "arm": arm, "episode": episode}
            found += [
                {**key, **each, "kind": row["kind"], "error": row["error"]} for each in _list_judgements(row["details"])
            ]
    return found


def _list_judgements(details: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the answers of an outcome, the agent's and the one from the text alone, with their judgements."""
    blind = details.get("blind") or {}
    pairs = (
        ("agent", details.get("answer"), details.get("judgement")),
        ("blind", *map(blind.get, ("answer", "judgement"))),
    )
    for answered_by, answer, judgement in pairs:
        if answer:
            marked = dict(judgement or {})
            yield {"answered_by": answered_by, "answer": answer, "marked_by": marked.pop("judge", ""), **marked}


def export_csv(run: Run, folder: Path) -> list[Path]:
    """Write one CSV file per table into a new folder; lists are JSON.

    Raises:
        FileError: the folder holds something already, or cannot be written.
    """
    return _export(run, folder, "csv", _write_csv)


def export_parquet(run: Run, folder: Path) -> list[Path]:
    """Write one Parquet file per table into a new folder; lists stay lists.

    Raises:
        ArgumentError: pyarrow is not installed.
        FileError: the folder holds something already, or cannot be written.
    """
    _require("pyarrow", "Parquet")
    return _export(run, folder, "parquet", _write_parquet)


def export_rerun(run: Run, file: Path) -> Path:
    """Write a recording for `rerun FILE`: paths, distances and scores over decisions, and the stored pictures.

    Raises:
        ArgumentError: rerun-sdk is not installed.
        FileError: the file cannot be written.
    """
    _require("rerun", "Rerun recordings")
    from wiw.report.recording import record

    with atomic_file(file) as draft:
        record(run, draft)
    return file


def _require(module: str, what: str) -> None:
    from importlib.util import find_spec

    if find_spec(module) is None:
        package = {"rerun": "rerun-sdk"}.get(module, module)
        raise ArgumentError(f"{what} need {package}, which is not installed: pip install {package} (or wiw[export])")


def _export(run: Run, folder: Path, suffix: str, write: Callable[[Path, Table], None]) -> list[Path]:
    made = tables(run)
    with atomic_folder(folder) as draft:
        for name, table in made.items():
            write(draft / f"{name}.{suffix}", table)
    return [folder / f"{name}.{suffix}" for name in made]


def _list_columns(table: Table) -> list[str]:
    return list(dict.fromkeys(name for row in table for name in row))


def _write_csv(path: Path, table: Table) -> None:
    from csv import DictWriter

    with path.open("w", newline="", encoding="utf-8") as file:
        writer = DictWriter(file, _list_columns(table))
        writer.writeheader()
        writer.writerows({name: _convert_cell(value) for name, value in row.items()} for row in table)


def _convert_cell(value: Any) -> Any:
    return to_json(value) if isinstance(value, list | dict) else value


def _write_parquet(path: Path, table: Table) -> None:
    import pyarrow
    from pyarrow import parquet

    columns = {name: [row.get(name) for row in table] for name in _list_columns(table)}
    parquet.write_table(pyarrow.table(columns), path, compression="zstd")


def _tabulate_episodes(run: Run) -> Table:
    rows = []
    for index, episode in enumerate(run.store.episodes()):
        row: dict[str, Any] = {"episode": index, "episode_id": episode.episode_id, "scene": episode.scene}
        for when, place, yaw in (
            ("start", episode.start_position, episode.start_yaw),
            ("goal", episode.goal_position, episode.goal_yaw),
        ):
            row |= {f"{when}_{axis}": value for axis, value in zip("xyz", place, strict=True)} | {f"{when}_yaw": yaw}
        rows.append({**row, "geodesic": episode.geodesic, "info": json.dumps(dict(episode.info))})
    return rows


def _flatten_decision(row: dict[str, Any]) -> dict[str, Any]:
    numbers = {f"{column}_{name}": value for column in NUMBERED for name, value in row[column].items()}
    lists = {name: row[name] if isinstance(row[name], list) else to_json(row[name]) for name in NESTED if row[name]}
    return {**_drop_nested(row, "proposals", "scores", *NUMBERED, *NESTED), **lists, **numbers}


def _list_candidates(row: dict[str, Any]) -> Iterator[dict[str, Any]]:
    scores = row["scores"] or [None] * len(row["proposals"])
    for number, (proposal, score) in enumerate(zip(row["proposals"], scores, strict=True)):
        name = {key: row[key] for key in ("arm", "episode", "decision")}
        yield {**name, "candidate": number, "score": score, "chosen": number == row["chosen"], **proposal}


def _drop_nested(row: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in names}
