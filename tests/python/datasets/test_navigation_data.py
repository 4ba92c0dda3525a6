# SPDX-License-Identifier: Apache-2.0
"""Navigation datasets: what was seen is what is read, whoever records it and however often it is killed."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folders import contents
from hypothesis import given, settings
from hypothesis import strategies as st

import wiw
from wiw.action import FORWARD, NULL, STOP, TURN_LEFT, TURN_RIGHT, to_trajectory
from wiw.datasets.navigation import NavigationData, part_of
from wiw.datasets.navigation_files import COLUMNS, FrameFile, build_table, navigation_schema, write_frames
from wiw.datasets.navigation_segment import DEPTH_UNITS, NavigationSegment, encode_color, encode_millimetres
from wiw.datasets.scene_splits import (
    find_evaluation_split,
    find_shared_scene,
    list_evaluation_scenes,
    match_names,
)
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, DependencyError, FileError, InfrastructureError
from wiw.training import collect_navigation as collecting
from wiw.training.collect_navigation import collect_navigation, resolve_train_scenes

parquet = pytest.importorskip("pyarrow.parquet", reason="needs wiw[export]")

RULES = {"min_samples": 60, "spacing": 1.5, "leaf_ratio": 0.5}
SMALL: dict[str, Any] = {"rules": RULES, "size": (36, 64), "seed": 3, "backend": "cpu"}


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory, two_rooms: str) -> Path:
    """Two passes over one scene that nothing disturbed."""
    folder = tmp_path_factory.mktemp("navigation")
    collect_navigation(folder, two_rooms, passes=2, lossless=True, **SMALL)
    return folder


# -- what is written ---------------------------------------------------------------------------------------------------


def test_frames_show_what_is_seen_from_their_poses(collected: Path, two_rooms: str) -> None:
    """Colour to a grey level on average (edges fall to one side or the other), depth to the millimetre."""
    renderer = world(two_rooms, "cpu").renderer
    for segment in NavigationData(collected)[:3]:
        seen = renderer.panorama(segment.poses, (36, 64), outputs=("color", "depth"))
        assert np.abs(segment.images.astype(float) - seen["color"]).mean() < 0.5
        assert segment.depths is not None
        near = np.abs(segment.depths - seen["depth"]) < 0.6 / DEPTH_UNITS + 1e-4 * seen["depth"]
        assert near.mean() > 0.98


def test_frames_after_turns_are_exact_rolls(collected: Path) -> None:
    turned = 0
    for segment in NavigationData(collected):
        for frame in range(1, len(segment)):
            sign = {int(TURN_LEFT): 1, int(TURN_RIGHT): -1}.get(int(segment.actions[frame]))
            if sign is None:
                assert segment.encoded_images[frame] is not None
                continue
            turned += 1
            assert segment.encoded_images[frame] is None and segment.sources[frame] == segment.sources[frame - 1]
            rolled = np.roll(segment.images[frame - 1], sign * 64 // 16, axis=1)
            np.testing.assert_array_equal(segment.images[frame], rolled)
    assert turned > 20


def test_one_position_looks_the_same_in_two_segments(collected: Path) -> None:
    """A segment begins where another has ended; its first frame is recorded anew, whichever way the agent faces."""
    first, second = NavigationData(collected)[:2]
    np.testing.assert_array_equal(first.poses[-1], second.poses[0])
    np.testing.assert_array_equal(first.images[-1], second.images[0])


def test_actions_say_how_poses_change(collected: Path) -> None:
    for segment in NavigationData(collected):
        assert segment.actions[0] == NULL and not np.isin(segment.actions[1:], (int(NULL), int(STOP))).any()
        relative = np.linalg.inv(segment.poses[0]) @ segment.poses
        moved = np.stack([-relative[1:, 2, 3], -relative[1:, 0, 3]], axis=1)
        expected = to_trajectory(segment.actions[1:].tolist())
        np.testing.assert_allclose(moved, expected[:, :2], atol=0.02 * np.sqrt(len(segment)))
        np.testing.assert_allclose(relative[1:, 0, 0], np.cos(expected[:, 2]), atol=1e-9)
        np.testing.assert_allclose(segment.poses[:, 1, 3], 1.0, atol=0.01)


def test_the_list_of_segments_says_what_is_in_the_files(collected: Path) -> None:
    data = NavigationData(collected)
    assert data.frames == sum(map(len, data)) == data.meta["totals"]["frames"]
    for row, segment in zip(data.segments, data, strict=True):
        assert (row["scene"], row["pass"], row["segment"]) == (segment.scene, segment.pass_index, segment.segment)
        assert row["frames"] == len(segment) and row["forward"] == (segment.actions == FORWARD).sum()
        assert row["pictures"] == sum(each is not None for each in segment.encoded_images)
    assert {row["pass"] for row in data.segments} == {0, 1}
    for record in data.meta["passes"]:
        (traversal,) = record["traversals"]
        assert traversal["area"] > 15 and 0.5 < traversal["coverage"] <= 1 and traversal["dropped"] == 0
        rows = [row for row in data.segments if row["pass"] == record["pass"]]
        assert traversal["frames"] == sum(row["frames"] for row in rows)


def test_a_row_group_is_a_segment_and_pictures_are_stored_as_they_are(collected: Path) -> None:
    data = NavigationData(collected)
    (path, *_) = sorted((collected / "data").iterdir())
    with parquet.ParquetFile(path) as file:
        metadata, schema = file.metadata, file.schema_arrow
    groups = [row for row in data.segments if row["file"] == f"data/{path.name}"]
    assert [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)] == [r["frames"] for r in groups]
    for index in range(metadata.row_group(0).num_columns):
        column = metadata.row_group(0).column(index)
        if column.path_in_schema.startswith(("rgb", "depth")):
            assert column.compression == "UNCOMPRESSED" and "PLAIN_DICTIONARY" not in column.encodings
            assert not column.has_dictionary_page and column.has_offset_index
    features = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
    assert list(features) == list(COLUMNS) and features["rgb"] == features["depth"] == {"_type": "Image"}
    about = json.loads(schema.metadata[b"wiw"])
    assert about["camera"]["size"] == [36, 64] and about["depth"]["unit"] == "millimetre" and about["split"] == "train"


def test_perspective_views_are_recorded_where_asked(tmp_path: Path, two_rooms: str) -> None:
    few = {**SMALL, "rules": {**RULES, "max_scene_frames": 30}}
    data = collect_navigation(tmp_path, two_rooms, perspective=True, lossless=True, **{**few, "size": (32, 40)})
    renderer = world(two_rooms, "cpu").renderer
    for segment in data:
        seen = renderer.perspective(segment.poses, (32, 40), 90.0, ("color", "depth"))
        np.testing.assert_array_equal(segment.images, seen["color"])
        assert segment.depths is not None
        np.testing.assert_allclose(segment.depths, seen["depth"], atol=0.51 / DEPTH_UNITS)
        np.testing.assert_array_equal(segment.sources, np.arange(len(segment)))
    assert data.meta["camera"]["hfov_deg"] == 90 and data.meta["depth"]["measure"] == "planar"


def test_colour_is_jpeg_and_depth_is_optional(tmp_path: Path, two_rooms: str, collected: Path) -> None:
    few = {**SMALL, "rules": {**RULES, "max_scene_frames": 30}}
    (segment, *_) = collect_navigation(tmp_path, two_rooms, depth=False, **few)
    exact = NavigationData(collected)[0]
    assert segment.encoded_images[0].startswith(b"\xff\xd8") and exact.encoded_images[0].startswith(b"RIFF")
    assert segment.depths is None and exact.depths is not None
    np.testing.assert_array_equal(segment.poses, exact.poses[: len(segment)])
    assert np.abs(segment.images.astype(float) - exact.images[: len(segment)]).mean() < 3


# -- reading -----------------------------------------------------------------------------------------------------------


def made_up(rng: np.random.Generator, frames: int, number: int, depth: bool, lossless: bool) -> NavigationSegment:
    moved = np.concatenate([[True], rng.random(frames - 1) < 0.5])
    sources = np.maximum.accumulate(np.where(moved, np.arange(frames), 0)).astype(np.int32)
    images = [encode_color(rng.integers(0, 256, (8, 32, 3)).astype(np.uint8), lossless) for _ in range(frames)]
    depths = [encode_millimetres(rng.random((8, 32)).astype(np.float32)) for _ in range(frames)]
    return NavigationSegment(
        scene='a "scene"',
        pass_index=int(rng.integers(9)),
        island=int(rng.integers(9)),
        segment=number,
        seed=int(rng.integers(2**62)),
        height=1.5,
        actions=np.array([0, *rng.integers(1, 4, frames - 1)], np.int8),
        poses=rng.normal(size=(frames, 4, 4)),
        sources=sources,
        rolls=np.where(moved, 0, rng.integers(-8, 8, frames)).astype(np.int32),
        encoded_images=tuple(data if new else None for data, new in zip(images, moved, strict=True)),
        encoded_depths=tuple(data if new else None for data, new in zip(depths, moved, strict=True)) if depth else None,
    )


@settings(max_examples=25)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=3), st.booleans(), st.booleans(), st.integers(0, 2**32))
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, lengths: list[int], depth: bool, lossless: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    written = [made_up(rng, frames, number, depth, lossless) for number, frames in enumerate(lengths)]
    path = tmp_path_factory.mktemp("made") / "train-00000-00.parquet"
    schema = navigation_schema(depth, {"name": "ü"})
    write_frames(path, schema, (build_table(each, schema) for each in written))
    file = FrameFile(path)
    assert len(file) == len(lengths) and file.facts["name"] == "ü"
    for index, each in enumerate(written):
        for name, value in vars(each).items():
            np.testing.assert_equal(getattr(file.read_segment(index), name), value)
        bare = file.read_segment(index, pictures=False)
        assert bare.encoded_images == (None,) * len(each) and bare.encoded_depths is None


def test_facts_without_columns_are_damage(tmp_path: Path) -> None:
    path, schema = tmp_path / "train-00000-00.parquet", navigation_schema(False, {})
    write_frames(path, schema, [build_table(made_up(np.random.default_rng(0), 2, 0, False, True), schema)])
    file = FrameFile(path)
    del file.facts["columns"]
    with pytest.raises(FileError, match="damaged"):
        file.read_segment(0)


@settings(max_examples=40)
@given(st.integers(1, 9), st.integers(0, 2**32), st.data())
def test_a_clip_is_a_part_of_its_segment(frames: int, seed: int, data: Any) -> None:
    segment = made_up(np.random.default_rng(seed), frames, 0, True, True)
    start = data.draw(st.integers(0, frames - 1))
    length = data.draw(st.integers(1, frames - start))
    clip = segment.clip(start, length)
    np.testing.assert_array_equal(clip.images, segment.images[start : start + length])
    assert clip.depths is not None and segment.depths is not None
    np.testing.assert_array_equal(clip.depths, segment.depths[start : start + length])
    np.testing.assert_array_equal(clip.poses, segment.poses[start : start + length])
    np.testing.assert_array_equal(clip.actions, [0, *segment.actions[start + 1 : start + length]])
    for wrong in ((start, frames - start + 1), (-1, 1), (0, 0)):
        with pytest.raises(ArgumentError, match=f"within its {frames} frames"):
            segment.clip(*wrong)


def test_clips_are_all_windows_of_their_length(collected: Path) -> None:
    data = NavigationData(collected)
    for length, stride in ((14, 1), (5, 3)):
        clips = data.clips(length, stride)
        expected = [
            (index, start)
            for index, row in enumerate(data.segments)
            for start in range(0, row["frames"] - length + 1, stride)
        ]
        assert [clips.locate(at) for at in range(len(clips))] == expected
        at = len(clips) // 2
        np.testing.assert_array_equal(clips[at].poses, data[expected[at][0]].poses[expected[at][1] :][:length])
    with pytest.raises(IndexError, match="clips, got"):
        clips[len(clips)]
    with pytest.raises(ArgumentError, match="no segment has 9999 frames"):
        data.clips(9999)
    with pytest.raises(ArgumentError, match="1 frame or more"):
        data.clips(0)


def test_a_clip_reads_nothing_but_its_row_group(collected: Path, tmp_path: Path) -> None:
    """All other row groups are overwritten: checksums would tell if a byte of them was read."""
    shutil.copytree(collected, tmp_path, dirs_exist_ok=True)
    data = NavigationData(tmp_path)
    path = tmp_path / data.segments[2]["file"]
    metadata = parquet.read_metadata(path)
    whole = bytearray(path.read_bytes())
    for group in range(metadata.num_row_groups):
        columns = [metadata.row_group(group).column(i) for i in range(metadata.num_columns)]
        starts = [column.dictionary_page_offset or column.data_page_offset for column in columns]
        end = max(start + column.total_compressed_size for start, column in zip(starts, columns, strict=True))
        if group != 2:
            whole[min(starts) : end] = b"\xff" * (end - min(starts))
    path.write_bytes(whole)
    clip = data.clips(5)[sum(row["frames"] - 4 for row in data.segments[:2])]
    np.testing.assert_array_equal(clip.images, NavigationData(collected)[2].images[:5])
    with pytest.raises(FileError, match="damaged"):
        data[1]


def test_parts_share_no_scene_and_scenes_stay_where_they_are(collected: Path) -> None:
    names = [f"apartments:train/{number}" for number in range(1000)]
    held_out = [name for name in names if part_of(name, 0.05) == "held-out"]
    assert 25 < len(held_out) < 80
    assert set(held_out) <= {name for name in names if part_of(name, 0.1) == "held-out"}
    parts = [NavigationData(collected, part, held_out=0.5) for part in ("train", "held-out")]  # type: ignore[arg-type]
    assert sorted(map(len, parts)) == [0, len(NavigationData(collected))], "one scene is in one part"
    with pytest.raises(ArgumentError, match="all, train, held-out"):
        NavigationData(collected, "val")  # type: ignore[arg-type]


def test_other_scenes_of_its_file_name_leave_a_scene_in_its_part(
    collected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def list_held_out(*names: str) -> list[str]:
        rows = [{"scene": name} for name in names]
        monkeypatch.setattr("wiw.datasets.navigation.read_segment_list", lambda path: rows)
        return [row["scene"] for row in NavigationData(collected, "held-out", held_out=0.5).segments]

    names = [f"house{number}" for number in range(20)]
    held_out = list_held_out(*names)
    assert 0 < len(held_out) < len(names)
    renamed = list_held_out(*(f"{folder}/{name}" for name in names for folder in "ab"))
    assert renamed == [f"{folder}/{name}" for name in held_out for folder in "ab"]
    assert list_held_out(*(f"{name}.v1" for name in names)) == [f"{name}.v1" for name in held_out]


def test_an_edited_apartment_is_in_the_part_of_the_one_that_it_is_a_copy_of(
    collected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"apartments:train/{number}" for number in range(20)]
    rows = [{"scene": name + edit} for name in names for edit in ("", "?remove:tv_1")]
    monkeypatch.setattr("wiw.datasets.navigation.read_segment_list", lambda path: rows)
    held_out = [row["scene"] for row in NavigationData(collected, "held-out", held_out=0.5).segments]
    assert 0 < len(held_out) < len(rows)
    assert held_out[1::2] == [f"{name}?remove:tv_1" for name in held_out[::2]]


@pytest.mark.extra
def test_datasets_loads_and_streams_it(collected: Path, tmp_path: Path) -> None:
    pytest.importorskip("datasets.arrow_dataset", reason="no datasets: pip install datasets")
    import datasets

    expected = NavigationData(collected)
    frames = datasets.load_dataset(str(collected), split="train", cache_dir=str(tmp_path))
    assert len(frames) == expected.frames and frames.column_names == list(COLUMNS)
    for index, row in enumerate(frames.select(range(len(expected[0])))):
        np.testing.assert_array_equal(np.array(row["T_world_camera"]), expected[0].poses[index])
        source = frames[row["source"]]
        np.testing.assert_array_equal(
            np.roll(np.array(source["rgb"]), row["roll"], axis=1), expected[0].images[index], err_msg=str(index)
        )
        assert expected[0].depths is not None
        millimetres = np.roll(np.array(source["depth"]), row["roll"], axis=1)
        np.testing.assert_allclose(millimetres / 1000, expected[0].depths[index], atol=1e-6)
    streamed = datasets.load_dataset(str(collected), split="train", streaming=True)
    actions = [row["action"] for row, _ in zip(streamed, range(20), strict=False)]
    assert actions == frames["action"][:20]
    segments = datasets.load_dataset(str(collected), "segments", split="train", cache_dir=str(tmp_path))
    assert segments["frames"][:] == [row["frames"] for row in expected.segments]


# -- killed, resumed, shared out ---------------------------------------------------------------------------------------


def test_any_number_of_workers_writes_the_same(collected: Path, tmp_path: Path, two_rooms: str) -> None:
    news: list[tuple[Any, ...]] = []
    progress = lambda *each: news.append(each)  # noqa: E731
    made = collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, workers=2, progress=progress, **SMALL)
    assert contents(tmp_path) == contents(collected)
    assert [each[:3] for each in news] == [("two_rooms", 1, 2), ("two_rooms", 2, 2)] and news[-1][3] == made.frames


@pytest.mark.parametrize("segments", [1, 6])
def test_a_killed_collection_loses_one_segment_at_most(
    collected: Path, tmp_path: Path, two_rooms: str, segments: int
) -> None:
    """It is killed while it records; all segments that were complete stay as they are, and the end is the same."""
    out, script = tmp_path / "out", tmp_path / "collect.py"
    asked = f"{str(out)!r}, {two_rooms!r}, passes=2, lossless=True, **{SMALL!r}"
    script.write_text(
        "import wiw.training.collect_navigation as c, time\n"
        "record = c.record_segment\n"
        "c.record_segment = lambda *given: (time.sleep(0.02), record(*given))[1]\n"  # so that the kill finds it at work
        f"if __name__ == '__main__':\n    c.collect_navigation({asked})\n"
    )
    process = subprocess.Popen([sys.executable, str(script)])
    while process.poll() is None and len(list(out.glob("parts/*/*.parquet"))) < segments:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    parts = sorted(out.glob("parts/*/*.parquet"))
    assert len(parts) >= segments
    recorded: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        record = collecting.record_segment
        patch.setattr(collecting, "record_segment", lambda *given: (recorded.append(given[3]), record(*given))[1])
        collect_navigation(out, two_rooms, passes=2, lossless=True, **SMALL)
    assert len(recorded) == len(NavigationData(collected)) - len(parts), "no complete segment is recorded again"
    assert contents(out) == contents(collected)


def test_half_a_segment_is_recorded_again(collected: Path, tmp_path: Path, two_rooms: str) -> None:
    rows = NavigationData(collected).segments
    schema = navigation_schema(True, {})
    other = made_up(np.random.default_rng(0), rows[1]["frames"], 1, True, True)
    write_frames(tmp_path / "parts/00000/00001.parquet", schema, [build_table(other, schema)])
    (tmp_path / "parts/00000/00000.parquet").write_bytes(b"PAR1 half")
    (tmp_path / "manifest.json").write_bytes((collected / "manifest.json").read_bytes())
    collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    assert contents(tmp_path) == contents(collected)


def test_a_finished_dataset_is_left_alone_and_a_lost_file_is_made_anew(
    collected: Path, tmp_path: Path, two_rooms: str
) -> None:
    shutil.copytree(collected, tmp_path, dirs_exist_ok=True)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())
    (tmp_path / "data/train-00001-00.parquet").unlink()
    with pytest.raises(FileError, match="is missing"):
        NavigationData(tmp_path)[-1]
    collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    assert contents(tmp_path) == contents(collected)
    kept = tmp_path / "data/train-00000-00.parquet"
    assert kept.stat().st_mtime_ns == times[kept]


def test_a_lost_card_is_made_anew(collected: Path, tmp_path: Path, two_rooms: str) -> None:
    shutil.copytree(collected, tmp_path, dirs_exist_ok=True)
    (tmp_path / "README.md").unlink()
    collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    assert contents(tmp_path) == contents(collected)


@pytest.mark.parametrize("damage", ["missing", "cut", "flipped"])
def test_a_lost_list_of_segments_is_made_anew(damage: str, collected: Path, tmp_path: Path, two_rooms: str) -> None:
    shutil.copytree(collected, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "segments.parquet"
    whole = bytearray(path.read_bytes())
    if damage == "missing":
        path.unlink()
    else:
        whole[40] ^= 0xFF
        path.write_bytes(whole[:-9] if damage == "cut" else whole)
    collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    assert contents(tmp_path) == contents(collected)


def test_files_are_cut_where_they_are_full(
    collected: Path, tmp_path: Path, two_rooms: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collecting, "MAX_FILE_BYTES", 60_000)
    data = collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    assert len(list((tmp_path / "data").iterdir())) > 4
    for one, other in zip(data, NavigationData(collected), strict=True):
        np.testing.assert_array_equal(one.images, other.images)


# -- what cannot be ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spec", "split"),
    [
        ("apartments:val:3", "val"),
        ("apartments:test/7", "test"),
        ("apartments:val/1?remove:tv_1", "val"),
    ],
)
def test_scenes_of_evaluation_are_refused(spec: str, split: str, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=f"train split, got apartments:{split}/.*which is of {split}"):
        collect_navigation(tmp_path / "new", ["apartments:train:1", spec])
    assert not (tmp_path / "new").exists()


def test_files_below_a_folder_of_evaluation_are_refused(tmp_path: Path, two_rooms: str) -> None:
    for split in ("val", "minival", "Test"):
        file = tmp_path / split / "00800" / "house.obj"
        file.parent.mkdir(parents=True)
        file.write_text(Path(two_rooms).read_text())
        with pytest.raises(ArgumentError, match=f"which is of {split.lower()}"):
            resolve_train_scenes(file)
    for scene, split in (("2azQ1b91cZZ", "val"), ("YVUC4YcDtcY", "test")):
        file = tmp_path / "mp3d" / scene / f"{scene}.glb"
        file.parent.mkdir(parents=True)
        file.write_bytes(b"")
        with pytest.raises(ArgumentError, match=f"which is of {split}"):
            resolve_train_scenes(file)
    with pytest.raises(ArgumentError, match="got none"):
        resolve_train_scenes([])
    assert list(resolve_train_scenes([two_rooms, "apartments:train:2"])) == [
        "two_rooms",
        "apartments:train/0",
        "apartments:train/1",
    ]


@pytest.mark.parametrize(
    ("file", "split"),
    [
        ("hm3d-val-habitat-v0.2/a/b.glb", "val"),
        ("hm3d-minival-habitat/a/b.glb", "minival"),
        ("HM3D-test-glb-v0.2/a/b.glb", "test"),
        ("hm3d_val/a/b.glb", "val"),
        ("hm3d/00800-TEEsavR23oF/TEEsavR23oF.basis.glb", "val"),
        ("hm3d/00877-4ok3usBNeis/4ok3usBNeis.glb", "val"),
        ("hm3d/00900-4ok3usBNeis/4ok3usBNeis.basis.glb", "test"),
        ("hm3d-train-habitat-v0.2/00999-4ok3usBNeis/4ok3usBNeis.basis.glb", "test"),
        ("hm3d-train-habitat-v0.2/00799-4ok3usBNeis/4ok3usBNeis.basis.glb", None),
        ("hm3d/01000-4ok3usBNeis/4ok3usBNeis.basis.glb", None),
        ("hm3d/00877-4ok3usBNeis/kitchen.glb", None),
        ("mine/00877-kitchen/kitchen.glb", None),
        ("mine/877-4ok3usBNeis/4ok3usBNeis.glb", None),
        ("00877-4ok3usBNeis/more/4ok3usBNeis.glb", None),
        ("hm3d-valley/a.glb", None),
        ("hm3d-test-run-7/a.glb", None),
        ("evaluate/latest/testing.glb", None),
    ],
)
def test_scans_of_evaluation_are_known_by_their_archives_and_numbers(file: str, split: str | None) -> None:
    assert find_evaluation_split(f"/data/{file}") == split


def test_scans_of_evaluation_are_known_through_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (scan,) = write_scenes(tmp_path, "hm3d/00800-TEEsavR23oF/TEEsavR23oF.basis.glb")
    (house,) = write_scenes(tmp_path, "val/homes/house.glb")
    for link, target in {"a.glb": scan, "b.glb": house, "folder": f"{tmp_path}/val/homes", "val/out.glb": "/x"}.items():
        (tmp_path / link).symlink_to(target)
    monkeypatch.chdir(tmp_path)
    given = ["a.glb", "b.glb", "folder/house.glb", "hm3d/00800-TEEsavR23oF/x/../TEEsavR23oF.basis.glb", "val/out.glb"]
    assert [find_evaluation_split(each) for each in given] == ["val"] * len(given)
    assert find_evaluation_split("val/../train/house.glb") is None
    assert find_shared_scene(["a.glb"], ["TEEsavR23oF"]) == "a.glb" and find_shared_scene(["a.glb"], ["house"]) is None


def write_scenes(folder: Path, *names: str) -> list[str]:
    """Write empty files; return their paths."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return [str(folder / name) for name in names]


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["a/mesh.obj", "b/mesh.obj", "c/other.v1.obj"], ["a/mesh", "b/mesh", "other"]),
        (["house.v1.glb", "house.v2.glb"], ["house.v1", "house.v2"]),
        (["house.glb", "house.v2.glb"], ["house", "house.v2"]),
        (["a/x.v1.glb", "a/x.v2.glb", "b/x.v1.glb"], ["a/x.v1", "a/x.v2", "b/x.v1"]),
        (["p/a/mesh.obj", "q/a/mesh.obj"], ["p/a/mesh", "q/a/mesh"]),
        (["a/scan.basis.glb", "b/scan.basis.glb"], ["a/scan", "b/scan"]),
        (["a/home.scene_instance.json", "b/home.scene_instance.json"], ["a/home", "b/home"]),
        (["p/r/habitat/mesh_semantic.ply", "q/r/habitat/mesh_semantic.ply"], ["p/r", "q/r"]),
        (["scan.basis.glb", "house.v1.glb", "r/habitat/mesh_semantic.ply"], ["scan", "house", "r"]),
    ],
)
def test_scenes_of_one_name_are_told_apart_by_their_paths(
    files: list[str], names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    specs = write_scenes(tmp_path, *files)
    assert list(resolve_train_scenes(specs).items()) == list(zip(names, specs, strict=True))
    assert list(resolve_train_scenes(specs[::-1])) == names[::-1]
    monkeypatch.chdir(tmp_path)
    assert list(resolve_train_scenes(files)) == names
    for spec in specs:
        assert find_shared_scene([spec], names) == spec, "a scene is known by the name that it has among others"
    assert find_shared_scene(write_scenes(tmp_path, "elsewhere/new.glb"), names) is None
    if names[0] in ("a/mesh", "a/scan", "a/home"):
        assert find_shared_scene([specs[0].replace("/a/", "/c/")], names) is None


def test_a_scene_is_not_collected_twice(tmp_path: Path) -> None:
    one, other, twin = write_scenes(tmp_path, "a/house.glb", "a/house.obj", "r.v1/habitat/mesh_semantic.ply")
    (tmp_path / "linked").symlink_to("a")
    again = [one, f"{tmp_path}/b/../a/house.glb", f"{tmp_path}/linked/house.glb", other]
    (third,) = write_scenes(tmp_path, "b/house.glb")
    for second in again:
        with pytest.raises(ArgumentError, match=rf"got house twice \({one}, {re.escape(second)}\): .*rename one"):
            resolve_train_scenes([third, one, second])
    with pytest.raises(ArgumentError, match="apartments:train/0 twice"):
        resolve_train_scenes(["apartments:train:1", "apartments:train/0"])
    with pytest.raises(ArgumentError, match=r"r\.v1 twice"):
        resolve_train_scenes([*write_scenes(tmp_path, "r.v1.glb", "r.v2.glb"), twin])


def test_names_of_two_datasets_match_if_they_may_be_of_one_scene() -> None:
    first, second = (
        ["mesh", "p/a/house.v1", "apartments:train/0"],
        ["b/mesh", "a/house.v1", "0", "c/house.v1", "train/0"],
    )
    assert match_names(first, second) == [("mesh", "b/mesh"), ("p/a/house.v1", "a/house.v1")]
    assert match_names(second, first) == sorted((b, a) for a, b in match_names(first, second))
    assert match_names(["house"], ["house.v2", "a/b"]) == [("house", "house.v2")]
    assert list_evaluation_scenes(["x/2azQ1b91cZZ", "x/mesh"]) == [("x/2azQ1b91cZZ", "val")]


def test_scenes_of_one_file_name_are_recorded(two_rooms: str, tmp_path: Path) -> None:
    files = [tmp_path / folder / "mesh.obj" for folder in "ab"]
    for file in files:
        file.parent.mkdir()
        shutil.copy(two_rooms, file)
    few = {**SMALL, "rules": {**RULES, "max_scene_frames": 10}}
    data = collect_navigation(tmp_path / "out", files, **few)
    assert data.scenes == {"a/mesh", "b/mesh"} and data.find_shared([str(files[1])]) == str(files[1])
    before = contents(tmp_path / "out")
    collect_navigation(tmp_path / "out", files, **few)
    assert contents(tmp_path / "out") == before
    with pytest.raises(ArgumentError, match="holds a different collection"):
        collect_navigation(tmp_path / "out", files[:1], **few)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"passes": 0}, "1 pass or more"),
        ({"seed": -1}, "seed from 0"),
        ({"height": 9.0}, "camera height from 0.1 to 3"),
        ({"size": (36, 60)}, "multiple of 16"),
        ({"size": (8, 64)}, "16 to 8192"),
        ({"backend": "metal"}, "backend: expected one of auto, cpu, gpu, got 'metal'"),
        ({"workers": 0}, "1 worker or more"),
        ({"preset": "huge"}, "default, paper, got huge"),
        ({"rules": {"spacing": -1.0}}, "spacing above 0"),
        ({"pass": 2}, r"unknown option 'pass'; .*Did you mean passes"),
        ({"passes": "2"}, "passes: expected a whole number, got '2'"),
    ],
)
def test_what_cannot_be_collected_is_refused(tmp_path: Path, two_rooms: str, asked: dict[str, Any], words: str) -> None:
    with pytest.raises(ArgumentError, match=words):
        collect_navigation(tmp_path / "new", two_rooms, **asked)
    assert not (tmp_path / "new").exists()


def test_another_collection_is_not_mixed_in(collected: Path, tmp_path: Path, two_rooms: str) -> None:
    shutil.copytree(collected, tmp_path, dirs_exist_ok=True)
    with pytest.raises(ArgumentError, match=r"holds a different collection: .*seed was 3, now 4"):
        collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **{**SMALL, "seed": 4})
    (tmp_path / "manifest.json").write_text('{"tasks": [], "episodes": 3}')
    with pytest.raises(FileError, match="manifest of `wiw collect navigation`"):
        collect_navigation(tmp_path, two_rooms, **SMALL)
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(FileError, match="expected a new folder"):
        collect_navigation(tmp_path, two_rooms, **SMALL)


@pytest.fixture
def own_scene(tmp_path: Path, two_rooms: str) -> Path:
    """A copy of the scene, with its materials."""
    for ending in (".obj", ".mtl"):
        shutil.copy(Path(two_rooms).with_suffix(ending), tmp_path)
    return tmp_path / Path(two_rooms).name


@pytest.mark.parametrize("edited", [".obj", ".mtl"])
@pytest.mark.parametrize("kept", ["all", "parts"])
def test_a_scene_that_has_changed_is_not_mixed_in(
    edited: str, kept: str, collected: Path, tmp_path: Path, own_scene: Path
) -> None:
    """Whether the dataset is finished or a first segment is recorded; the scene's own path does not matter."""
    out = tmp_path / "out"
    shutil.copytree(collected, out)
    before = contents(out)
    collect_navigation(out, own_scene, passes=2, lossless=True, **SMALL)
    assert contents(out) == before
    if kept == "parts":
        shutil.rmtree(out / "scenes")
        (out / "parts/00001").mkdir(parents=True)
    with own_scene.with_suffix(edited).open("a") as file:
        file.write("# another\n")
    before = contents(out)
    with pytest.raises(
        ArgumentError, match=r"different collection: the files of two_rooms have changed since; repeat .*--out"
    ):
        collect_navigation(out, own_scene, passes=2, lossless=True, **SMALL)
    assert contents(out) == before


def test_a_folder_without_digests_of_its_scenes_is_read_but_not_continued(
    collected: Path, tmp_path: Path, two_rooms: str
) -> None:
    shutil.copytree(collected, tmp_path, dirs_exist_ok=True)
    for name, path in (("manifest.json", []), ("meta.json", ["config"])):
        content = part = json.loads((tmp_path / name).read_text())
        for key in path:
            part = part[key]
        del part["sources"]
        (tmp_path / name).write_text(json.dumps(content))
    assert len(NavigationData(tmp_path)[:]) == len(NavigationData(collected))
    with pytest.raises(ArgumentError, match="two_rooms may have changed since, as it has no digests of them"):
        collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    shutil.rmtree(tmp_path / "scenes")
    collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    assert contents(tmp_path) == contents(collected)


def test_a_scene_that_could_not_be_opened_may_be_mended(tmp_path: Path, own_scene: Path) -> None:
    bad, out, few = tmp_path / "bad.obj", tmp_path / "out", {**SMALL, "rules": {**RULES, "max_scene_frames": 10}}
    bad.write_text("v 0 0 0\n")
    with pytest.raises(InfrastructureError, match="1 of 2 scenes"):
        collect_navigation(out, [bad, own_scene], **few)
    shutil.copy(own_scene, bad)
    assert collect_navigation(out, [bad, own_scene], **few).scenes == {"bad", "two_rooms"}
    before = contents(out)
    assert collect_navigation(out, [bad, own_scene], **few).meta["left_out"] == {} and contents(out) == before


@pytest.mark.parametrize("skip_errors", [False, True])
def test_no_dataset_is_made_of_nothing(skip_errors: bool, tmp_path: Path, two_rooms: str) -> None:
    bad = [tmp_path / f"bad{number}.obj" for number in range(2)]
    for file in bad:
        file.write_text("v 0 0 0\n")
    with pytest.raises(InfrastructureError, match=r"2 of 2 scenes cannot be recorded: bad0: .*; bad1: .*choose others"):
        collect_navigation(tmp_path / "out", bad, skip_errors=skip_errors, **SMALL)
    far = {**SMALL, "rules": {**RULES, "spacing": 1000.0}}
    with pytest.raises(InfrastructureError, match=r"a frame of one scene at least, got none of two_rooms"):
        collect_navigation(tmp_path / "far", two_rooms, skip_errors=skip_errors, **far)
    for out in ("out", "far"):
        assert not {"meta.json", "README.md", "segments.parquet"} & {path.name for path in (tmp_path / out).iterdir()}


def test_a_scene_that_cannot_be_opened_stops_no_other(tmp_path: Path, two_rooms: str) -> None:
    bad = tmp_path / "bad.obj"
    bad.write_text("v 0 0 0\n")
    out = tmp_path / "out"
    few = {**SMALL, "rules": {**RULES, "max_scene_frames": 30}}
    with pytest.raises(InfrastructureError, match=r"1 of 2 scenes cannot be recorded.*bad: "):
        collect_navigation(out, [bad, two_rooms], **few)
    with pytest.raises(FileError, match=r"meta.json is missing.*until it finishes"):
        NavigationData(out)
    data = collect_navigation(out, [bad, two_rooms], skip_errors=True, **few)
    assert {row["scene"] for row in data.segments} == {"two_rooms"} and list(data.meta["left_out"]) == ["bad"]


def test_a_full_disk_is_told_and_loses_nothing(
    collected: Path, tmp_path: Path, two_rooms: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full at the fourth segment; with room again, the same call goes on."""
    write, written = collecting.write_frames, []

    def run_out(path: Path, *given: Any) -> None:
        written.append(path)
        if len(written) == 4:
            monkeypatch.setattr("wiw.files.os.fsync", fail)
        write(path, *given)

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(collecting, "write_frames", run_out)
    with pytest.raises(FileError, match=r"cannot be written.*No space left"):
        collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    monkeypatch.undo()
    assert len(list(tmp_path.rglob("parts/*/*.parquet"))) == 3 and not list(tmp_path.rglob("*.part"))
    collect_navigation(tmp_path, two_rooms, passes=2, lossless=True, **SMALL)
    assert contents(tmp_path) == contents(collected)


def test_a_damaged_dataset_is_told(collected: Path, tmp_path: Path) -> None:
    shutil.copytree(collected, tmp_path, dirs_exist_ok=True)
    (tmp_path / "segments.parquet").write_bytes(b"PAR1")
    with pytest.raises(FileError, match=r"segments\.parquet.*damaged"):
        NavigationData(tmp_path)
    for text, words in (("{}", "no list of files"), ("[", "description"), ('{"files": {}, "format": 9}', "got 9")):
        (tmp_path / "meta.json").write_text(text)
        with pytest.raises(FileError, match=words):
            NavigationData(tmp_path)
    with pytest.raises(FileError, match="expected the description of a navigation dataset"):
        NavigationData(tmp_path / "nowhere")


def test_a_damaged_picture_is_told() -> None:
    segment = made_up(np.random.default_rng(0), 2, 0, True, False)
    for data in (b"no picture", b"", None):
        broken = replace(segment, encoded_images=(data, segment.encoded_images[1]))
        with pytest.raises(FileError, match=r"expected an image in frame 0.*wiw data verify"):
            _ = broken.images


def test_pyarrow_is_asked_for_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for call in (lambda: wiw.collect_navigation(tmp_path / "new"), lambda: NavigationData(tmp_path)):
        with pytest.raises(DependencyError, match=r"pip install 'wiw\[export\]'"):
            call()
