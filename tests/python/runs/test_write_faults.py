# SPDX-License-Identifier: Apache-2.0
"""Each call that writes fails once, in four ways in turn: a typed error or no harm, nothing lost, and the second try
ends as if nothing had happened.

Every write of every job fails nightly; otherwise a few, evenly spread.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import shutil
import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from crash_victims import FAULTS, Victims, build_faults, evaluate
from folders import contents
from test_crash import facts, whole

import wiw.errors
from wiw.runs.store import RunStore
from wiw.runs.store_file import store_path

SMALL = {"episodes": 2, "keep_images": 1}
SAMPLE = 4
"""Faults of each job that are tried for every change; of `FILES`, which share how they write, half as many."""


@dataclass
class Work:
    """A job that writes below a folder, and what is equal however it went."""

    job: str
    read: Callable[[Path], Any]
    options: Mapping[str, Any] = field(default_factory=dict)
    prepare: Callable[[Path], None] = lambda target: None
    """Make what the job goes on with."""
    target: str = "made"


@pytest.fixture(scope="module")
def victims(tmp_path_factory: pytest.TempPathFactory) -> Any:
    pytest.importorskip("pyarrow", reason="needs wiw[export]")
    pytest.importorskip("torch", reason="needs wiw[torch]")
    library = build_faults(tmp_path_factory.mktemp("library"))
    jobs = ("wiw.runs.merge", "wiw.training.collect_navigation", "test_train_navigator", "post_training_parts")
    imports = (*jobs, "wiw.policies.navigator.weights", "torch._dynamo")
    server = Victims(library, imports, WIW_NUM_THREADS="1")
    yield server
    server.close()


@pytest.fixture(scope="module")
def works(tmp_path_factory: pytest.TempPathFactory, two_rooms: str) -> dict[str, Work]:
    folder = tmp_path_factory.mktemp("begun")
    run, half, parts = folder / "run", folder / "half", [folder / "1", folder / "2"]
    evaluate(run, **SMALL)
    shutil.copytree(run, half)
    with sqlite3.connect(store_path(half)) as store:
        store.execute("DELETE FROM outcome WHERE episode = 1 OR arm = 'warp'")
    for number, part in enumerate(parts, 1):
        evaluate(part, shard=f"{number}/2", **SMALL)
    exports = {kind: Work("export", read_files, {"out": str(run), "kind": kind}) for kind in ("csv", "parquet", "view")}
    return {
        "run": Work("evaluate", facts, SMALL),
        "run on a local disk": Work("evaluate", facts, {**SMALL, "scratch": "disk"}),
        "resume": Work("evaluate", facts, SMALL, lambda target: shutil.copytree(half, target)),
        "merge": Work("merge", facts, {"parts": [str(part) for part in parts], "scratch": "disk"}),
        **exports,
        "report": Work("report", read_files, {"out": str(run)}, target="report.html"),
        "collect": Work("collect", read_files, {"scene": two_rooms}),
        "train": Work("train", read_files),
        "post-train": Work("post_train", read_training, prepare_training(folder)),
    }


def prepare_training(folder: Path) -> dict[str, str]:
    """What a video generator is post-trained on and from, written below a folder; nothing without diffusers."""
    if not all(importlib.util.find_spec(name) for name in ("diffusers", "peft")):
        return {}
    from post_training_parts import save_dataset, save_stock

    data = save_dataset(folder / "clips"), save_dataset(folder / "others", scenes=["cellar"])
    places = {"data": data[0], "validation": data[1], "weights": save_stock(folder / "stock", "ltx-action")}
    return {name: str(path) for name, path in places.items()}


def read_training(target: Path) -> dict[str, Any]:
    """The files of a training, with its log in place of when each of its lines was written."""
    found = read_files(target)
    log = found.pop("ltx.log/metrics.jsonl").decode().splitlines()
    return {**found, "log": [{**json.loads(line), "seconds": 0} for line in log]}


def read_files(target: Path) -> dict[str, bytes]:
    return {"": target.read_bytes()} if target.is_file() else contents(target)


def carry_out(victims: Victims, work: Work, folder: Path, number: int, way: str) -> int:
    """Let a victim do the work below a folder; return its exit code."""
    target, options = folder / work.target, dict(work.options)
    if "scratch" in options:
        options["scratch"] = str(folder / options["scratch"])
    if work.job == "evaluate":
        options["reported"] = str(folder.with_suffix(".reported"))
    place = {"target": str(target)} if work.job in ("export", "report") else {"out": str(target)}
    return victims.run(work.job, **{**place, **options}, below=str(folder), fault=[number, way])


FILES = ("csv", "parquet", "view", "report", "train", "post-train")
"""Jobs that write files or folders at once."""
WORKS = ("run", "run on a local disk", "resume", "merge", "collect", *FILES)


@pytest.mark.parametrize("name", WORKS)
def test_some_writes_that_fail_harm_nothing(name: str, victims: Victims, works: Any, tmp_path: Path) -> None:
    count, first = (SAMPLE // 2, WORKS.index(name)) if name in FILES else (SAMPLE, 0)

    def choose(writes: int) -> Any:
        return np.linspace(1, writes, count).astype(int).tolist()

    check_faults(victims, works[name], tmp_path, choose, first)


@pytest.mark.nightly
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", WORKS)
def test_each_write_that_fails_harms_nothing(name: str, victims: Victims, works: Any, tmp_path: Path) -> None:
    check_faults(victims, works[name], tmp_path, lambda writes: range(1, writes + 1))


def check_faults(victims: Victims, work: Work, tmp_path: Path, choose: Callable[[int], Any], first: int = 0) -> None:
    if work.job == "post_train" and not work.options:
        pytest.skip("needs wiw[diffusers]")
    quiet = begin(work, tmp_path / "quiet")
    assert carry_out(victims, work, quiet, 0, FAULTS[0]) == 0, victims.said
    expected, writes = work.read(quiet / work.target), int(victims.said)
    assert writes > 3
    stopped = 0
    for number, way in zip(choose(writes), itertools.islice(itertools.cycle(FAULTS), first, None), strict=False):
        folder = begin(work, tmp_path / "work")
        code = carry_out(victims, work, folder, number, way)
        stopped += code != 0
        check_end(code, way, victims.said, folder)
        check_kept(work, folder)
        if code != 0 and not (work.job == "merge" and RunStore.exists(folder / work.target)):  # is there whole or not
            assert carry_out(victims, work, folder, 0, way) == 0, (way, number, victims.said)
        assert work.read(folder / work.target) == expected, (way, number)
        assert not list(folder.rglob("*.part")), (way, number)
        shutil.rmtree(folder)
        folder.with_suffix(".reported").unlink(missing_ok=True)
    assert stopped > 0


def begin(work: Work, folder: Path) -> Path:
    folder.mkdir()
    work.prepare(folder / work.target)
    return folder


def check_end(code: int, way: str, said: str, folder: Path) -> None:
    """It is well, killed where the fault kills, or ends with a typed error that says where and what to do."""
    if code == -9:
        assert way == FAULTS[-1]
    elif code != 0:
        kind, _, text = said.partition(": ")
        assert issubclass(getattr(wiw.errors, kind, int), wiw.errors.Error), said
        assert str(folder) in text and "expected" in text, said


def check_kept(work: Work, folder: Path) -> None:
    """The store is whole, and has each episode that it said it has."""
    run, reported = folder / work.target, folder.with_suffix(".reported")
    if work.job == "evaluate" and RunStore.exists(run):
        told = {(arm, int(each)) for arm, each in map(str.split, reported.read_text().splitlines())}
        assert "scratch" in work.options or told <= whole(run)
