# SPDX-License-Identifier: Apache-2.0
"""Demonstrations: what experts do is what is written, whoever collects it and however often it is stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import wiw
from wiw import files
from wiw.cli import main
from wiw.datasets import shards
from wiw.datasets.demonstration import decode_colors, decode_depths
from wiw.datasets.demonstrations import (
    DEPTH_UNITS,
    Demonstration,
    Demonstrations,
    encode_depth,
    encode_image,
    shard_range,
)
from wiw.errors import ArgumentError, DependencyError, FileError, InfrastructureError
from wiw.tabletop.base import make_action
from wiw.tabletop.slide_block import SlideBlock
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import TABLE
from wiw.tasks.manipulation import Manipulation
from wiw.training import recording
from wiw.training.recording import FIRST_SEED, choose_end_frames, table_seed

parquet = pytest.importorskip("pyarrow.parquet", reason="needs wiw[export]")

SMALL: dict[str, Any] = {"episodes": 1, "size": 64, "frames": 16, "seed": 5, "backend": "cpu"}
WHOLE = {**SMALL, "format": "png", "depth": True, "wrist": True}
"""With all that can be recorded."""
TASKS = ("slide_block", "push_buttons", "insert_peg")


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files that nothing disturbed."""
    folder = tmp_path_factory.mktemp("demos")
    wiw.collect(folder, TASKS, **WHOLE)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# -- what is written ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_a_demonstration_is_what_happens_at_its_table(collected: Path, task: str) -> None:
    """Going to its actions again, one after another, leads through its key frames to the last bit."""
    (each,) = Demonstrations(collected, task)
    kind = TABLETOP_TASKS[task]
    setup = kind.create_setup(each.seed, each.variation)
    bench = setup.build_workbench("cpu")
    assert each.task == task and each.instruction == setup.instruction and each.success
    for name, pose in bench.get_poses(setup.objects).items():
        np.testing.assert_array_equal(each.places[name], pose)
    frames = [0, *np.flatnonzero(each.ended)]
    assert frames[-1] == len(each) - 1 == 15
    for number, frame in enumerate(frames):
        if number:
            bench.move_to(each.actions[frame])
        assert each.keys[frame] == number
        np.testing.assert_array_equal(each.poses[frame], bench.pose)
        seen = bench.render_view("front", (64, 64), ("color", "depth"))
        np.testing.assert_array_equal(each.images[frame], seen["color"])
        assert each.depths is not None
        np.testing.assert_allclose(each.depths[frame], seen["depth"], atol=0.51 / DEPTH_UNITS)
        by_hand = bench.render_view("wrist", (64, 64), ("color", "depth"))
        assert each.encoded_wrist_images is not None and each.encoded_wrist_depths is not None
        np.testing.assert_array_equal(decode_colors(each.encoded_wrist_images[frame : frame + 1])[0], by_hand["color"])
        near = decode_depths(each.encoded_wrist_depths[frame : frame + 1])[0]
        np.testing.assert_allclose(near, by_hand["depth"], atol=0.51 / DEPTH_UNITS)
        assert each.wrist_poses is not None
        np.testing.assert_array_equal(each.wrist_poses[frame], bench.get_camera_pose("wrist"))
    assert kind.is_success(bench, setup)


def test_frames_are_spread_over_its_time(collected: Path) -> None:
    for each in Demonstrations(collected):
        apart = np.diff(each.seconds)
        assert each.seconds[0] == 0 and (apart > 0).all() and apart.max() < 2.5 * apart.mean()
        moved = np.linalg.norm(np.diff(each.poses[:, :3], axis=0), axis=1)
        assert (moved > 1e-4).mean() > 0.5, "the arm is seen on its way, not at its ends alone"
        np.testing.assert_array_equal(np.diff(each.keys) >= 0, True)
        np.testing.assert_array_equal(each.actions[0], each.actions[1])


def test_files_are_plain_parquet_that_others_read(collected: Path) -> None:
    pandas = pytest.importorskip("pandas")
    path = collected / "push_buttons-00000.parquet"
    table = pandas.read_parquet(path)
    (each,) = Demonstrations(collected, ["push_buttons"])
    assert list(table.columns) == list(shards.COLUMNS) and len(table) == 16
    np.testing.assert_array_equal(np.stack(table["pose"]), each.poses)
    assert table["image"][3]["bytes"] == each.encoded_images[3] and table["image"][3]["path"] is None
    metadata = parquet.read_schema(path).metadata
    about = json.loads(metadata[b"wiw"])
    assert about["columns"] == shards.COLUMNS and about["wiw"] == wiw.__version__
    features = json.loads(metadata[b"huggingface"])["info"]["features"]
    assert list(features) == list(shards.COLUMNS)
    assert features["image"] == {"_type": "Image"} and features["pose"]["length"] == 7


def test_the_wrist_camera_is_described_where_there_is_one(collected: Path, tmp_path: Path) -> None:
    facts = Demonstrations(collected).files[0].facts["wrist_camera"]
    assert facts["hfov_deg"] == 80 and "T_world_camera" not in facts
    intrinsics = Demonstrations(collected).wrist_intrinsics
    assert intrinsics is not None and intrinsics[0, 0] == pytest.approx(32 / np.tan(np.radians(40)))
    wiw.collect(tmp_path, ["slide_block"], **SMALL)
    plain = Demonstrations(tmp_path)
    assert plain.wrist_intrinsics is None and plain[0].wrist_poses is None and "wrist" not in plain.config


def test_its_camera_sees_things_where_they_are(collected: Path) -> None:
    demonstrations = Demonstrations(collected)
    camera = demonstrations.camera
    for each in demonstrations:
        for pose in each.places.values():
            x, y, z, _ = np.linalg.inv(camera.T_world_camera) @ pose[:, 3]
            column, row, _ = camera.intrinsics @ np.array([x, -y, -z]) / -z
            assert 0 < column < 64 and 0 < row < 64
            assert each.depths is not None
            assert abs(each.depths[0, int(row), int(column)] + z) < 0.08


@settings(max_examples=25, deadline=None)
@given(
    st.integers(1, 4),
    st.integers(1, 3),
    st.booleans(),
    st.booleans(),
    st.sampled_from(["jpeg", "png"]),
    st.integers(0, 2**32),
)
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, frames: int, count: int, depth: bool, wrist: bool, kind: Any, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    written = [made_up(rng, frames, episode, depth, wrist, kind) for episode in range(count)]
    path = tmp_path_factory.mktemp("shard") / "made-00000.parquet"
    shards.write(path, written, {"failed": 3})
    shard = shards.Shard(path)
    assert len(shard) == count and shard.facts["failed"] == 3
    for index, each in enumerate(written):
        read = shard[index]
        for name, value in vars(each).items():
            np.testing.assert_equal(getattr(read, name), value)
        assert read.images.shape == (frames, 8, 8, 3) and (read.depths is not None) == depth


def make_pictures(rng: np.random.Generator, frames: int, kind: Any) -> tuple[bytes, ...]:
    return tuple(encode_image(rng.integers(0, 256, (8, 8, 3)).astype(np.uint8), kind) for _ in range(frames))


def make_depths(rng: np.random.Generator, frames: int) -> tuple[bytes, ...]:
    return tuple(encode_depth(rng.random((8, 8)).astype(np.float32)) for _ in range(frames))


def made_up(rng: np.random.Generator, frames: int, episode: int, depth: bool, wrist: bool, kind: Any) -> Demonstration:
    return Demonstration(
        task="made up",
        variation=int(rng.integers(50)),
        seed=int(rng.integers(2**31, 2**32)),
        episode=episode,
        instruction='say "ü"',
        success=bool(rng.integers(2)),
        places={"a cup": rng.normal(size=(4, 4)), "b": np.eye(4)},
        seconds=rng.random(frames),
        poses=rng.normal(size=(frames, 7)),
        actions=rng.normal(size=(frames, 7)),
        keys=rng.integers(0, 9, frames).astype(np.int32),
        ended=rng.integers(0, 2, frames).astype(bool),
        encoded_images=make_pictures(rng, frames, kind),
        encoded_depths=make_depths(rng, frames) if depth else None,
        encoded_wrist_images=make_pictures(rng, frames, kind) if wrist else None,
        encoded_wrist_depths=make_depths(rng, frames) if depth and wrist else None,
        wrist_poses=rng.normal(size=(frames, 4, 4)) if wrist else None,
    )


@given(st.lists(st.integers(0, 900), min_size=1, max_size=15), st.integers(16, 200))
def test_each_action_ends_in_a_frame_of_its_own(lengths: list[int], frames: int) -> None:
    ends = np.cumsum([0, *lengths])
    at = choose_end_frames(ends, frames)
    assert at[0] == 0 and at[-1] == frames - 1 and (np.diff(at) >= 1).all()
    if ends[-1] and min(lengths) > 3 * ends[-1] / frames:
        assert np.abs(at - ends / ends[-1] * (frames - 1)).max() <= 0.5


@given(st.integers(0, 2**62), st.integers(0, 10**6), st.integers(0, 19))
def test_no_table_is_both_learnt_from_and_evaluated(seed: int, episode: int, attempt: int) -> None:
    evaluated = Manipulation(seed=seed).episode(episode).info["seed"]
    assert evaluated < FIRST_SEED <= table_seed(seed, episode, attempt) < 2 * FIRST_SEED


@given(st.integers(1, 500))
def test_every_demonstration_is_in_one_file(episodes: int) -> None:
    files = [shard_range(number, episodes) for number in range(-(-episodes // 10))]
    assert [episode for file in files for episode in file] == list(range(episodes))


class _Clumsy(SlideBlock):
    """Has only to move; at tables whose seeds are even, its expert stays where it is."""

    clumsy = False

    def create_setup(self, seed: int, variation: int) -> Any:
        self.clumsy = seed % 2 == 0
        return super().create_setup(seed, variation)

    def plan_expert(self, places: Any, target: Any) -> Any:
        return np.array([make_action(0.15, 0.0, 0.45 if self.clumsy else 0.3, 1.0)])

    def is_success(self, bench: Any, setup: Any) -> bool:
        return bool(bench.pose[2] < TABLE + 0.35)


def test_failures_are_counted_and_kept_where_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TABLETOP_TASKS, "slide_block", _Clumsy())
    monkeypatch.setattr(recording, "POSES", 2)
    asked = {**SMALL, "episodes": 4}
    kept = wiw.collect(tmp_path / "kept", "slide_block", **asked)
    assert len(kept) == 4 and all(each.success and each.seed % 2 for each in kept)
    attempts = [next(n for n in range(99) if table_seed(5, each.episode, n) == each.seed) for each in kept]
    assert kept.failed == {"slide_block": sum(attempts)} and sum(attempts) > 0
    every = wiw.collect(tmp_path / "every", "slide_block", keep_failed=True, **asked)
    assert [each.seed for each in every] == [table_seed(5, episode, 0) for episode in range(4)]
    assert [each.success for each in every] == [attempt == 0 for attempt in attempts]
    assert every.failed == {"slide_block": sum(not each.success for each in every)}
    monkeypatch.setattr(recording, "ATTEMPTS", 1)
    with pytest.raises(InfrastructureError, match="slide_block failed at 1 tables in a row"):
        wiw.collect(tmp_path / "none", "slide_block", **asked)


# -- stopped, gone on with, shared out ---------------------------------------------------------------------------------


def test_any_number_of_workers_writes_the_same(collected: Path, tmp_path: Path) -> None:
    told: list[tuple[Any, ...]] = []
    made = wiw.collect(tmp_path, TASKS, workers=2, progress=lambda *news: told.append(news), **WHOLE)
    assert contents(tmp_path) == contents(collected)
    assert sorted(told) == sorted((task, 1, 1, 0) for task in TASKS) and len(made) == 3


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_collection_goes_on_and_ends_as_any_other(collected: Path, tmp_path: Path, workers: int) -> None:
    asked = f"{str(tmp_path)!r}, {TASKS!r}, workers={workers}, **{WHOLE!r}"
    script = tmp_path.with_suffix(".py")
    script.write_text(f"import wiw\nif __name__ == '__main__':\n    wiw.collect({asked})\n")
    process = subprocess.Popen([sys.executable, str(script)], start_new_session=True)
    while process.poll() is None and not list(tmp_path.glob("*.parquet")):
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    _gone(process.pid)
    draft = tmp_path / f".slide_block-00000.parquet.{files._place()}-{process.pid}.part"
    draft.write_bytes(b"half")
    assert len(Demonstrations(tmp_path, partial=True)) == len(list(tmp_path.glob("*.parquet")))
    wiw.collect(tmp_path, TASKS, **WHOLE)
    assert contents(tmp_path) == contents(collected) and not draft.exists()


def _gone(session: int) -> None:
    """Waits until no process of a session is left, as workers of a killed parent must not be."""
    for _ in range(2000):
        if not any(_session(int(each.name)) == session for each in Path("/proc").iterdir() if each.name.isdigit()):
            return
        time.sleep(0.01)
    raise AssertionError("a worker outlived its parent")


def _session(pid: int) -> int:
    try:
        state, _, _, session = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:4]
    except (OSError, ValueError):
        return -1
    return -1 if state == "Z" else int(session)


def test_a_finished_collection_is_left_alone_and_a_damaged_file_is_made_anew(collected: Path, tmp_path: Path) -> None:
    for name, data in contents(collected).items():
        (tmp_path / name).write_bytes(data)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    damaged = tmp_path / "insert_peg-00000.parquet"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    wiw.collect(tmp_path, TASKS, **WHOLE)
    assert contents(tmp_path) == contents(collected)
    assert [path for path in times if path.stat().st_mtime_ns != times[path]] == [damaged]


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demos"
    arguments = ["collect", "manipulation", "--tasks", "slide_block", "--episodes", "1", "--frames", "16"]
    assert main([*arguments, "--size", "64", "--out", str(out)]) == 0
    assert json.loads((out / "manifest.json").read_text())["backend"] in ("cpu", "gpu")
    printed = capsys.readouterr()
    assert "1 demonstrations of 16 frames" in printed.out and "failed at 0 tables" in printed.out
    assert "slide_block: 1/1 demonstrations" in printed.err
    assert main([*arguments, "--size", "96", "--out", str(out)]) == 2
    assert "size was 64, now 96" in capsys.readouterr().err


# -- what cannot be ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"episodes": 0}, "expected episodes of 1 or more, got 0"),
        ({"seed": -1}, "seed of 0 or more"),
        ({"seed": 2**64}, r"seed: expected a whole number from 0 to 2\*\*64 - 1"),
        ({"size": 8}, "16 to 4096"),
        ({"frames": 15}, "over 15 frames"),
        ({"format": "webp"}, "format: expected one of jpeg, png, got 'webp'"),
        ({"backend": "metal"}, "backend: expected one of auto, cpu, gpu, got 'metal'"),
        ({"workers": 0}, "1 worker or more"),
        ({"tasks": "juggle"}, "push_buttons, slide_block, insert_peg, stack_cups, got juggle"),
        ({"tasks": ["slide_block"] * 2}, "different ones"),
        ({"tasks": []}, "tasks as all"),
        ({"episode": 1}, r"unknown option 'episode'; .*Did you mean episodes\?"),
        ({"episodes": "1"}, "episodes: expected a whole number, got '1'"),
    ],
)
def test_what_cannot_be_collected_is_refused(tmp_path: Path, asked: dict[str, Any], words: str) -> None:
    with pytest.raises(ArgumentError, match=words):
        wiw.collect(tmp_path / "new", **asked)
    assert not (tmp_path / "new").exists()


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("%")
    with pytest.raises(FileError, match="does not exist; expected a manifest of `wiw collect`"):
        wiw.collect(tmp_path, **SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    (tmp_path / "thesis.tex").rename(tmp_path / "manifest.json")
    with pytest.raises(FileError, match="manifest of `wiw collect`"):
        Demonstrations(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="cannot be written"):
        wiw.collect(tmp_path / "file", **SMALL)


OTHERS = (
    *("{}", "[]", "null", "3", '{"tasks": ["push_buttons"]}', '{"tasks": 3, "episodes": 1}'),
    *('{"tasks": [], "episodes": "1"}', '{"tasks": [], "episodes": true}'),
)


@pytest.mark.parametrize("text", OTHERS)
def test_a_manifest_of_something_else_is_told(tmp_path: Path, text: str) -> None:
    (tmp_path / "manifest.json").write_text(text)
    for call in (lambda: Demonstrations(tmp_path), lambda: wiw.collect(tmp_path, **SMALL)):
        with pytest.raises(FileError, match="expected a manifest of `wiw collect`"):
            call()


def test_files_that_are_missing_or_damaged_are_named(collected: Path, tmp_path: Path) -> None:
    for name, data in contents(collected).items():
        (tmp_path / name).write_bytes(data)
    path = tmp_path / "push_buttons-00000.parquet"
    whole = path.read_bytes()
    demonstrations = Demonstrations(tmp_path)
    assert demonstrations[-1].task == "insert_peg" and [each.task for each in demonstrations[:2]] == list(TASKS[:2])
    with pytest.raises(IndexError, match="one of 3 demonstrations, got 3"):
        demonstrations[3]
    with pytest.raises(ArgumentError, match="slide_block, push_buttons, insert_peg, got stack_cups"):
        Demonstrations(tmp_path, "stack_cups")
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileError, match=r"push_buttons-00000\.parquet.*damaged"):
        Demonstrations(tmp_path)
    table = parquet.read_table(collected / path.name)
    parquet.write_table(table.replace_schema_metadata({}), path)
    with pytest.raises(FileError, match=r"push_buttons-00000\.parquet.*damaged"):
        Demonstrations(tmp_path)
    path.unlink()
    with pytest.raises(FileError, match="is missing"):
        Demonstrations(tmp_path)
    assert [each.task for each in Demonstrations(tmp_path, partial=True)] == ["slide_block", "insert_peg"]
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(FileError, match="does not exist; expected a manifest of `wiw collect`"):
        Demonstrations(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("camera", {}), ("camera", {"intrinsics": "wide", "T_world_camera": []}), ("failed", None), ("task", "juggling")],
)
def test_damaged_facts_are_told(collected: Path, name: str, value: Any) -> None:
    found = Demonstrations(collected)
    found.files[0].facts[name] = value
    with pytest.raises(FileError, match="damaged"):
        getattr(found, "camera" if name == "camera" else "failed")


def test_a_damaged_picture_is_told(collected: Path) -> None:
    broken = replace(Demonstrations(collected)[0], encoded_images=(b"no picture",))
    with pytest.raises(FileError, match="picture of a demonstration is damaged"):
        _ = broken.images
    rng = np.random.default_rng(0)
    small, large = (encode_image(rng.integers(0, 256, (n, n, 3)).astype(np.uint8), "png") for n in (8, 9))
    depths = tuple(encode_depth(np.ones((n, n), np.float32)) for n in (8, 9))
    broken = replace(broken, encoded_images=(small, large), encoded_depths=depths)
    for name in ("images", "depths"):
        with pytest.raises(FileError, match="picture of a demonstration is damaged"):
            getattr(broken, name)


def test_a_flipped_bit_is_told(tmp_path: Path) -> None:
    each = made_up(np.random.default_rng(0), 3, 0, True, True, "jpeg")
    path = tmp_path / "made-00000.parquet"
    shards.write(path, [each], {})
    whole = path.read_bytes()
    for at in (whole.index(each.encoded_images[1]) + 300, whole.index(each.poses[0, :1].tobytes()[:4]) + 1):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(FileError, match=r"made-00000\.parquet.*damaged"):
            shards.Shard(path)[0]


def test_pyarrow_is_asked_for_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for call in (lambda: wiw.collect(tmp_path / "new", **SMALL), lambda: Demonstrations(tmp_path)):
        with pytest.raises(DependencyError, match=r"pip install 'wiw\[export\]'"):
            call()
    assert not list(tmp_path.iterdir())
