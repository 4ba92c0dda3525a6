# SPDX-License-Identifier: Apache-2.0
"""Collection, encoding of clips and scoring of frames on a Ray cluster give what one process gives."""

from __future__ import annotations

import functools
import json
import os
import signal
import sqlite3
import sys
from pathlib import Path
from typing import Any

import pytest

import wiw
from wiw.cli import main
from wiw.errors import ArgumentError, InfrastructureError, ScorerError
from wiw.ray_cluster import HERE, Engine, connect_cluster, map_batches, run_tasks
from wiw.runs.config import RunConfig
from wiw.studies.evaluate import run_arms
from wiw.training.collect_navigation import collect_navigation

RAY = Engine(engine="ray")
RULES = {"min_samples": 60, "spacing": 1.5, "leaf_ratio": 0.5}
SMALL: dict[str, Any] = {"rules": RULES, "size": (36, 64), "seed": 3, "backend": "cpu", "passes": 2, "lossless": True}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# -- clusters ----------------------------------------------------------------------------------------------------------


class PlayedRay:
    """Stands in for ray, and takes no cluster."""

    def __init__(self) -> None:
        self.given: dict[str, Any] = {}

    def is_initialized(self) -> bool:
        return False

    def init(self, **given: Any) -> None:
        self.given = given
        raise ConnectionError("nobody is there")


def test_a_cluster_that_others_have_started_is_joined_only_where_it_is_named(monkeypatch) -> None:
    """With address None, Ray joins the one of RAY_ADDRESS, or the last that was started on this machine."""
    played = PlayedRay()
    monkeypatch.setitem(sys.modules, "ray", played)
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    with pytest.raises(InfrastructureError, match="cannot be started on this machine: nobody"), connect_cluster(None):
        pass
    assert played.given["address"] == "local" and played.given["num_cpus"] == len(os.sched_getaffinity(0))
    with pytest.raises(InfrastructureError, match="no Ray cluster at auto: nobody"), connect_cluster("auto"):
        pass
    assert played.given["address"] == "auto" and "num_cpus" not in played.given


# -- tasks -------------------------------------------------------------------------------------------------------------


def square(number: int) -> int:
    return number * number


def die_once(folder: Path, number: int) -> int:
    if not (folder / str(number)).exists():
        (folder / str(number)).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def die(number: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def refuse(number: int) -> None:
    raise ArgumentError(f"not {number}")


def test_tasks_return_what_calls_do_in_any_order(ray) -> None:
    assert dict(run_tasks(RAY, square, range(5), 2)) == {number: number * number for number in range(5)}


def test_a_lost_task_is_repeated_and_one_that_is_lost_every_time_is_said(ray, tmp_path: Path) -> None:
    assert dict(run_tasks(RAY, functools.partial(die_once, tmp_path), [2, 3], 2)) == {2: 4, 3: 9}
    with pytest.raises(InfrastructureError, match="was lost"):
        list(run_tasks(RAY, die, [1], 1))


def test_errors_of_tasks_are_those_of_calls(ray) -> None:
    with pytest.raises(ArgumentError, match="not 7"):
        list(run_tasks(RAY, refuse, [7], 1))


def test_what_ray_alone_has_is_asked_of_ray_alone(tmp_path: Path) -> None:
    for place in (Engine(address="auto"), Engine(worker_gpus=1)):
        with pytest.raises(ArgumentError, match="give --engine ray"):
            wiw.collect(tmp_path / "demos", "slide_block", place=place)
    with pytest.raises(ArgumentError, match="at least 0"):
        wiw.collect(tmp_path / "demos", "slide_block", place=Engine(engine="ray", worker_gpus=-1))
    assert not (tmp_path / "demos").exists()


# -- collection --------------------------------------------------------------------------------------------------------


def test_collection_on_ray_writes_the_same_bytes_and_resumes(ray, tmp_path: Path, two_rooms: str) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    collect_navigation(here, two_rooms, **SMALL)
    collect_navigation(there, two_rooms, workers=2, place=RAY, **SMALL)
    assert contents(there) == contents(here)
    (lost,) = there.glob("data/train-00001-00.parquet")
    lost.unlink()
    kept = {path: path.stat().st_mtime_ns for path in there.glob("data/*.parquet")}
    (there / "wiw.json").unlink(missing_ok=True)
    collect_navigation(there, two_rooms, workers=2, place=RAY, **SMALL)
    assert contents(there) == contents(here)
    assert all(path.stat().st_mtime_ns == time for path, time in kept.items())


@pytest.mark.nightly
def test_demonstrations_on_ray_are_the_same_by_the_command(ray, tmp_path: Path) -> None:
    asked = ["collect", "manipulation", "--tasks", "slide_block,push_buttons", "--episodes", "1", "--size", "64"]
    asked += ["--frames", "16", "--seed", "5", "--backend", "cpu"]
    assert main([*asked, "--out", str(tmp_path / "here")]) == 0
    assert main([*asked, "--out", str(tmp_path / "there"), "--engine", "ray", "--workers", "2"]) == 0
    assert contents(tmp_path / "there") == contents(tmp_path / "here")


# -- Ray Data ----------------------------------------------------------------------------------------------------------


class Adder:
    def __init__(self, much: int) -> None:
        self.much = much

    def __call__(self, batch: Any) -> dict[str, Any]:
        if (batch["number"] < 0).any():
            raise ScorerError("negative")
        return {"number": batch["number"] + self.much}


def test_batches_are_mapped_by_a_pool_and_errors_keep_their_type(ray) -> None:
    rows = [{"number": number} for number in range(10)]
    found = [row["number"] for row in map_batches(RAY, Adder, {"much": 5}, rows, 2, 3)]
    assert sorted(found) == list(range(5, 15))
    with pytest.raises(ScorerError, match="negative"):
        list(map_batches(RAY, Adder, {"much": 5}, [{"number": -1}], 1, 3))


SCORER = """
import json, os, sys
print(json.dumps({"scorer": "size", "version": "1", "licence": "MIT", "scores": {"size": None}}), flush=True)
for line in sys.stdin:
    path = line.rstrip()
    print(json.dumps({"path": path, "scores": {"size": os.path.getsize(path) / 7}}), flush=True)
"""


def read_scores(run: Path) -> set[tuple[str, str, str]]:
    with sqlite3.connect(run / "quality.sqlite") as connection:
        return set(connection.execute("SELECT scorer, frame, scores FROM score"))


def test_frames_are_scored_on_ray_as_here(ray, tmp_path: Path, two_rooms: str) -> None:
    arms = {"copy": wiw.Agent("matcher", "copy", candidates=2), "warp": wiw.Agent("matcher", "warp", candidates=2)}
    config = RunConfig(episodes=1, seed=0, out=tmp_path / "run", progress=False, keep_images="all")
    run_arms("imagenav", arms, config=config, scenes=two_rooms, decisions=1).close()
    (tmp_path / "scorer.py").write_text(SCORER)
    scorer = f"{sys.executable} {tmp_path}/scorer.py"
    moves: list[tuple[Any, ...]] = []
    watch = lambda *each: moves.append(each)  # noqa: E731
    here = wiw.quality(tmp_path / "run", [scorer], frames=8, out=tmp_path / "out")
    scored = read_scores(tmp_path / "run")
    (tmp_path / "run/quality.sqlite").unlink()
    there = wiw.quality(tmp_path / "run", [scorer], frames=8, out=tmp_path / "out", workers=2, place=RAY, watch=watch)
    assert read_scores(tmp_path / "run") == scored
    assert json.loads(there.to_json()) == json.loads(here.to_json())
    assert [each[1] for each in moves if each[0] == "size"] == list(range(1, 1 + sum(e[0] == "size" for e in moves)))
    with pytest.raises(ArgumentError, match="several with engine ray"):
        wiw.quality(tmp_path / "run", workers=2)


def test_clips_are_encoded_ahead_and_training_then_encodes_none(
    ray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By Ray and by this process the same files; the training reads them all."""
    pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")
    from post_training_parts import save_dataset, save_stock, tiny_recipe

    from wiw.training.post_training.encode_clips import encode_clips
    from wiw.training.post_training.latent_cache import LatentCache
    from wiw.training.post_training.train import post_train

    name, data = "nwm-action", save_dataset(tmp_path / "data")
    recipe = tiny_recipe(name, mirror=0.5)
    given: dict[str, Any] = {"weights": str(save_stock(tmp_path, name)), "device": "cpu"}
    seen: list[tuple[int, int]] = []
    for place, workers, cache in ((HERE, 1, "here"), (RAY, 2, "there")):
        progress = lambda *each: seen.append(each)  # noqa: E731
        count = encode_clips(
            name, data, tmp_path / cache, recipe=recipe, part="all", workers=workers, place=place, progress=progress,
            **given,
        )  # fmt: skip
        assert count == 2 * recipe.clips and seen[-1] == (count, count)
    assert contents(tmp_path / "there") == contents(tmp_path / "here") and len(contents(tmp_path / "here")) == count
    made: list[int] = []
    encode = LatentCache.encode

    def watch(cache: Any, index: int, mirrored: bool, make: Any, device: Any) -> Any:
        return encode(cache, index, mirrored, lambda: (made.append(index), make())[1], device)

    monkeypatch.setattr(LatentCache, "encode", watch)
    post_train(name, data, tmp_path / "out", recipe=recipe, part="all", cache=tmp_path / "there", **given)
    assert made == []
    with pytest.raises(ArgumentError, match="several with engine ray"):
        encode_clips(name, data, tmp_path / "other", recipe=recipe, part="all", workers=2, **given)
