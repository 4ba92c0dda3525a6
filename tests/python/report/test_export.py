# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import csv
import importlib.util
import json
import re
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from fakes import LineAgent, LineTask

from wiw.analysis import summary
from wiw.analysis.summary import summarise_run
from wiw.cli import main
from wiw.errors import ArgumentError, FileError
from wiw.metrics.metric import Metric
from wiw.registry import METRICS
from wiw.report import export
from wiw.report.export import tables
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import run_arms
from wiw.studies.run_log import load_run

EVIL = 'a,"b"\n/../c'
TABLES = ("arms", "episodes", "outcomes", "decisions", "candidates", "anytime", "anytime_differences")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Four episodes of two arms, one failed in each; the second arm's name has all that CSV and paths stumble over."""
    arms = {"none": LineAgent(0.5), EVIL: LineAgent(0.8)}
    out = tmp_path_factory.mktemp("export") / "run"
    return run_arms(LineTask(broken=("0002",)), arms, 4, out=out, progress=False, keep_images="all")


def check(log, read):
    """Tables, read by another program, against the run's own records."""
    outcomes, decisions, candidates = read("outcomes"), read("decisions"), read("candidates")
    assert [(r["arm"], int(r["episode"]), r["status"]) for r in outcomes] == [
        (r["arm"], r["episode"], r["status"]) for r in log.episodes
    ]
    assert [float(r["spl"]) for r in outcomes if r["status"] == "done"] == [
        r["metrics"]["spl"] for r in log.episodes if r["status"] == "done"
    ]
    assert [(r["arm"], int(r["decision"]), float(r["after_x"])) for r in decisions] == [
        (r["arm"], r["decision"], r["after_x"]) for r in log.decisions
    ]
    assert [float(r["seconds_propose"]) for r in decisions] == [0.001] * len(decisions)
    assert [int(r["calls_frames"]) for r in decisions] == [10] * len(decisions)
    assert len(candidates) == 2 * len(decisions)
    assert [float(r["score"]) for r in candidates] == [score for r in log.decisions for score in r["scores"]]
    assert [len(read(name)) for name in ("arms", "episodes")] == [2, 4]
    return decisions


def test_csv_says_what_the_run_says(log, tmp_path, capsys):
    assert main(["export", str(log.path), "--csv", str(tmp_path / "csv")]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "csv" / f"{name}.csv") for name in TABLES]

    def read(name):
        with (tmp_path / "csv" / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    decisions = check(log, read)
    assert [json.loads(r["executed"]) for r in decisions] == [r["executed"] for r in log.decisions]


def test_parquet_says_what_the_run_says(log, tmp_path):
    pytest.importorskip("pyarrow")
    pandas = pytest.importorskip("pandas")
    log.export(parquet=tmp_path / "parquet")
    decisions = check(
        log, lambda name: pandas.read_parquet(tmp_path / "parquet" / f"{name}.parquet").to_dict("records")
    )
    assert [r["executed"].tolist() for r in decisions] == [r["executed"] for r in log.decisions]


class TieredTask(LineTask):
    """Episodes of two tiers."""

    def episodes(self, count):
        tiers = ("near", "far")
        return [replace(each, info={"tier": tiers[i % 2]}) for i, each in enumerate(super().episodes(count))]


def test_outcomes_have_their_tier_and_keep_their_columns(tmp_path):
    log = run_arms(TieredTask(), {"none": LineAgent()}, 2, out=tmp_path / "run", progress=False)
    with sqlite3.connect(store_path(log.path)) as store:
        store.execute("""UPDATE outcome SET metrics = json_set(metrics, '$.seconds', 7.0, '$.kind', 1.0)""")
    rows = tables(load_run(log.path))["outcomes"]
    assert [row["tier"] for row in rows] == ["near", "far"]
    assert all((row["kind"], row["metric_kind"], row["metric_seconds"]) == ("", 1, 7) for row in rows)


def test_arms_and_tiers_keep_their_columns_too(tmp_path, monkeypatch):
    names = ("n", "errors", "role", "tier", "utility")
    for name in names:
        monkeypatch.setitem(METRICS.registered, name, Metric(name, name, "length", True))
    log = run_arms(TieredTask(), {"none": LineAgent()}, 4, out=tmp_path / "run", progress=False)
    with sqlite3.connect(store_path(log.path)) as store:
        for name in names:
            store.execute(f"UPDATE outcome SET metrics = json_set(metrics, '$.{name}', 7.0)")
    made = tables(load_run(log.path))
    assert [row["tier"] for row in made["tiers"]] == ["near", "far"] and "utility" not in made["arms"][0]
    for row in (*made["arms"], *made["tiers"]):
        assert row["n"] > 1 and row["errors"] == 0 and row["role"].startswith("policy")
        assert [row[f"metric_{name}"] for name in names] == [7] * len(names) and "metric_n_low" in row


def test_a_run_is_summarised_once(log, monkeypatch):
    calls = []
    for module in (export, summary):
        monkeypatch.setattr(module, "summarise_run", lambda run: calls.append(run) or summarise_run(run))
    made = tables(log)
    assert calls == [log] and made["arms"] == log.table()


def test_every_column_is_described(log):
    """In docs/exported-tables.md; METRIC, STAGE and NAME stand for any."""
    described = read_described_columns()
    metrics = sorted({metric for row in log.episodes for metric in row["metrics"]})
    made = tables(log)
    assert {"arms", "episodes", "outcomes", "decisions", "candidates"} == set(described) & set(made)
    for name in set(described) & set(made):
        named = [re.sub("METRIC|STAGE|NAME", r"\\w+", column) for column in described[name] if column != "METRIC"]
        for column in {column for row in made[name] for column in row}:
            assert any(re.fullmatch(pattern, column) for pattern in [*named, *metrics]), f"{name}: {column}"


def read_described_columns():
    """The columns that the page names, by table."""
    page = (Path(__file__).parents[3] / "docs" / "exported-tables.md").read_text(encoding="utf-8")
    found = {}
    for part in page.split("\n## ")[1:]:
        cells = [line.split("|")[1] for line in part.splitlines() if line.startswith("| `")]
        found[part.partition("\n")[0]] = [column for cell in cells for column in re.findall("`(.+?)`", cell)]
    return found


def test_rerun_reads_its_recording(log, tmp_path):
    pytest.importorskip("rerun")
    file = tmp_path / "run.rrd"
    assert log.export(rerun=file) == [file]
    pictures = sum(len(log.store.images(r["arm"], r["episode"], r["decision"])) for r in log.decisions)
    entities, images = contents_of(file)
    assert {"/episode_0000/none/panorama", "/episode_0003/none/imagined/1", "/episode_0001/world"} <= entities
    assert not any(entity.startswith("/episode_0002/none/panorama") for entity in entities)
    assert images == pictures


def contents_of(file):
    """Entity paths, and how many pictures are logged, as Rerun's own program finds them."""
    rerun = [sys.executable, "-m", "rerun", "rrd"]
    assert subprocess.run([*rerun, "verify", file], check=False, capture_output=True).returncode == 0
    shown = subprocess.run([*rerun, "print", file], check=True, capture_output=True, text=True).stdout
    chunks = re.findall(r"^Chunk\(.*?\) with (\d+) rows .*? - (/\S*) - (.*)$", shown, re.M)
    return {path for _, path, _ in chunks}, sum(int(rows) for rows, _, data in chunks if "EncodedImage" in data)


def test_what_is_there_already_is_kept(log, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    with pytest.raises(FileError, match="mine is not empty"):
        log.export(csv=tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]


def test_missing_packages_are_named_with_the_command(log, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ArgumentError, match=r"pyarrow, which is not installed: pip install pyarrow"):
        log.export(parquet=tmp_path / "parquet")
    assert main(["export", str(log.path), "--rerun", str(tmp_path / "run.rrd")]) == 2
    assert "pip install rerun-sdk" in capsys.readouterr().err and list(tmp_path.iterdir()) == []


def test_a_recording_has_the_ending_that_the_viewer_opens(log, tmp_path):
    with pytest.raises(ArgumentError, match=r"name to end in \.rrd, got .*run\.txt"):
        log.export(csv=tmp_path / "tables", rerun=tmp_path / "run.txt")
    assert list(tmp_path.iterdir()) == []


def test_something_must_be_asked_for(log, capsys):
    assert main(["export", str(log.path)]) == 2
    assert "--csv DIR" in capsys.readouterr().err
