# SPDX-License-Identifier: Apache-2.0
"""`wiw collect navigation` and `wiw data`: what they print and draw, and that every kind of damage is found."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from wiw.cli import main
from wiw.datasets.navigation import NavigationData
from wiw.datasets.navigation_check import verify_datasets
from wiw.datasets.navigation_files import (
    SEGMENTS,
    build_table,
    describe_file,
    navigation_schema,
    write_frames,
    write_segment_list,
)
from wiw.datasets.navigation_segment import NavigationSegment, encode_color
from wiw.datasets.navigation_statistics import compute_statistics
from wiw.datasets.worlds import world
from wiw.errors import FileError, InfrastructureError
from wiw.scenes import Scene, apartment
from wiw.training import collect_navigation as collecting
from wiw.training import navigation_estimate
from wiw.training.collect_navigation import collect_navigation, describe_data
from wiw.training.navigation_estimate import estimate_collection
from wiw.training.navigation_recording import NavigationCollection, record_segment
from wiw.training.traversal import plan_scene
from wiw.viz.navigation_maps import BARE, COVERED, PAPER, PIXELS_PER_METRE, draw_traversal, fill_floor, grow, join_loops

pytest.importorskip("pyarrow", reason="needs wiw[export]")

RULES = {"min_samples": 60, "spacing": 1.5, "leaf_ratio": 0.5}
SMALL: dict[str, Any] = {"rules": RULES, "size": (36, 64), "backend": "cpu"}


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory, two_rooms: str) -> Path:
    folder = tmp_path_factory.mktemp("navigation")
    collect_navigation(folder, two_rooms, **SMALL)
    return folder


@pytest.fixture
def copied(collected: Path, tmp_path: Path) -> Path:
    shutil.copytree(collected, tmp_path / "data")
    return tmp_path / "data"


# -- verify ------------------------------------------------------------------------------------------------------------


def test_a_sound_dataset_is_sound(collected: Path) -> None:
    data, news = NavigationData(collected), []
    found = verify_datasets([collected], progress=lambda *each: news.append(each))
    assert found.sound and "sound" in str(found)
    assert (found.files, found.segments, found.frames) == (1, len(data), data.frames)
    assert found.pictures == data.meta["totals"]["pictures"] and news == [("data/train-00000-00.parquet", 1, 1)]
    assert verify_datasets([collected], pictures=False).pictures == 0


def rewrite(folder: Path, change: Callable[[list[NavigationSegment], list[dict[str, Any]]], None]) -> None:
    """Write a dataset's only file of frames and its list of segments anew, with right checksums."""
    data = NavigationData(folder)
    segments, rows = list(data), [dict(row) for row in data.segments]
    change(segments, rows)
    schema = navigation_schema(True, describe_data(NavigationCollection(size=(36, 64))))
    path = folder / "data/train-00000-00.parquet"
    write_frames(path, schema, (build_table(segment, schema) for segment in segments))
    write_segment_list(folder / SEGMENTS, rows)
    meta = json.loads((folder / "meta.json").read_text())
    for name in ("data/train-00000-00.parquet", SEGMENTS):
        meta["files"][name]["sha256"] = sha256((folder / name).read_bytes()).hexdigest()
    (folder / "meta.json").write_text(json.dumps(meta))


def change_first(**fields: Callable[[NavigationSegment], Any]) -> Callable[[Any, Any], None]:
    def change(segments: list[NavigationSegment], rows: list[dict[str, Any]]) -> None:
        segments[0] = replace(segments[0], **{name: make(segments[0]) for name, make in fields.items()})

    return change


def exchange(actions: Any) -> Any:
    """Turn the first turn the other way."""
    other = actions.copy()
    frame = int(np.flatnonzero(actions > 1)[0])
    other[frame] = 5 - actions[frame]
    return other


def shift(poses: Any) -> Any:
    other = poses.copy()
    other[3:, 0, 3] += 0.1
    return other


def recount(segments: Any, rows: list[dict[str, Any]]) -> None:
    rows[0]["forward"] += 1


def rename_scene(segments: list[NavigationSegment], rows: list[dict[str, Any]]) -> None:
    for index, row in enumerate(rows):
        row["scene"] = "apartments:val/3"
        segments[index] = replace(segments[index], scene="apartments:val/3")


def split_scene(segments: list[NavigationSegment], rows: list[dict[str, Any]]) -> None:
    """The same pictures under two names: one scene that would be on both sides of a split."""
    twin = replace(segments[0], scene="twin", segment=99)
    segments.append(twin)
    rows.append({**rows[0], "scene": "twin", "segment": 99, "row_group": len(rows)})


def other_pictures(segment: NavigationSegment) -> Any:
    small = encode_color(np.zeros((8, 16, 3), np.uint8), False)
    return (small, *segment.encoded_images[1:])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda segments, rows: None, None),
        (change_first(actions=lambda each: exchange(each.actions)), "frame: .*is not where action"),
        (change_first(actions=lambda each: np.where(each.actions == 1, 0, each.actions)), "frame: .*expected action 0"),
        (change_first(poses=lambda each: shift(each.poses)), "frame: .*frame 3 is not where action"),
        (change_first(rolls=lambda each: each.rolls + 1), "frame: .*expected a roll by"),
        (change_first(sources=lambda each: each.sources[::-1].copy()), "frame: .*expected each source"),
        (change_first(encoded_images=lambda each: (None,) * len(each)), "frame: .*expected an image in each frame"),
        (change_first(encoded_images=lambda each: (b"none", *each.encoded_images[1:])), "picture: .*frame 0"),
        (change_first(encoded_images=other_pictures), r"picture: .*expected images of \(36, 64\)"),
        (lambda segments, rows: segments.pop(), "file: .*expected .* row groups"),
        (recount, "frame: .*expected forward .* as in segments.parquet"),
        (rename_scene, "split: .*apartments:val/3 is of split val"),
        (split_scene, "leak: .*images are in two_rooms .* and in twin"),
    ],
)
def test_what_is_wrong_is_found(copied: Path, change: Any, words: str | None) -> None:
    rewrite(copied, change)
    found = verify_datasets([copied])
    assert found.sound == (words is None), found
    if words is not None:
        assert any(re.search(words, line) for line in str(found).splitlines()), found


def test_damaged_missing_and_foreign_files_are_found(copied: Path) -> None:
    path = copied / "data/train-00000-00.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:])
    (copied / "data/other.parquet").write_bytes(b"")
    messages = verify_datasets([copied]).problems["file"]
    assert any("SHA-256" in each for each in messages) and any("is not listed" in each for each in messages)
    path.unlink()
    assert any("No such file" in each for each in verify_datasets([copied]).problems["file"])


def test_demonstrations_are_named_where_navigation_is_expected(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text(json.dumps({"tasks": ["push_buttons"], "episodes": 2}))
    with pytest.raises(FileError, match="of `wiw collect navigation`, got one of `wiw collect manipulation`"):
        NavigationData(tmp_path)


def test_datasets_that_share_a_scene_leak(collected: Path, copied: Path, tmp_path: Path, two_rooms: str) -> None:
    found = verify_datasets([collected, copied])
    assert any(f"two_rooms is in {collected} and in {copied}" in each for each in found.problems["leak"])
    assert any("images are in two_rooms" in each for each in found.problems["leak"])
    few = {**SMALL, "rules": {**RULES, "max_scene_frames": 30}}
    other = tmp_path / "renamed.obj"
    shutil.copy(two_rooms, other)
    collect_navigation(tmp_path / "other", other, **few)
    assert "leak" not in verify_datasets([collected, tmp_path / "other"]).problems, "another name, another path"


# -- figures and pictures ----------------------------------------------------------------------------------------------


def test_statistics_are_those_of_the_segments(collected: Path) -> None:
    data = NavigationData(collected)
    figures = compute_statistics(data)
    assert figures.lengths.tolist() == [len(segment) for segment in data]
    assert figures.count_windows(14) == len(data.clips(14)) and figures.count_windows(10**6) == 0
    actions = np.concatenate([segment.actions for segment in data])
    assert [figures.totals[name] for name in ("forward", "turn_left", "turn_right")] == [
        int((actions == number).sum()) for number in (1, 2, 3)
    ]
    (scene,) = figures.scenes
    assert scene.frames == data.frames and figures.coverage == scene.coverage == pytest.approx(
        data.meta["passes"][0]["traversals"][0]["coverage"]
    )
    assert sum(figures.endings.values()) == len(data)


def test_an_estimate_is_what_is_recorded(collected: Path, two_rooms: str) -> None:
    totals, news = NavigationData(collected).meta["totals"], []
    found = estimate_collection(two_rooms, progress=lambda *each: news.append(each), **SMALL)
    assert (found.frames, found.pictures, found.segments) == tuple(
        totals[name] for name in ("frames", "pictures", "segments")
    )
    assert found.scenes == found.planned_scenes == 1 and news == [("two_rooms", 1, 1)] and found.core_hours > 0
    pictures = sum(
        len(data) for s in NavigationData(collected) for data in (*s.encoded_images, *s.encoded_depths) if data
    )
    assert found.gigabytes == pytest.approx(pictures / 1e9, rel=0.2)
    assert estimate_collection(two_rooms, passes=3, **SMALL).frames == 3 * found.frames
    assert f"{found.frames:,} frames" in str(found) and "core hours" in str(found)


def test_an_estimate_counts_scenes_passes_and_pictures_apart(
    tmp_path: Path, two_rooms: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock that only opening, planning and recording move: an hour a scene, a tenth a pass, a hundredth each."""
    hours, files = [0.0], [tmp_path / f"{number}" / "mesh.obj" for number in range(6)]
    for file in files:
        file.parent.mkdir()
        shutil.copy(two_rooms, file)

    def spend(time: float, function: Callable[..., Any]) -> Callable[..., Any]:
        def spending(*given: Any) -> Any:
            hours[0] += time
            return function(*given)

        return spending

    monkeypatch.setattr(navigation_estimate, "_read_clock", lambda: 3600 * hours[0])
    monkeypatch.setattr(navigation_estimate, "PLANNED_SCENES", 3)
    monkeypatch.setattr(navigation_estimate, "RECORDED_SCENES", 2)
    monkeypatch.setattr(navigation_estimate, "world", spend(1, world))
    monkeypatch.setattr(navigation_estimate, "plan_scene", spend(0.1, plan_scene))
    monkeypatch.setattr(collecting, "record_segment", spend(0.01, record_segment))
    monkeypatch.setattr(collecting, "describe_file", spend(0.02, describe_file))
    found = estimate_collection([str(file) for file in files], passes=4, **SMALL)
    assert (found.scenes, found.planned_scenes) == (6, 3)
    assert found.opening_hours == pytest.approx(6 * 1) and found.planning_hours == pytest.approx(6 * 4 * 0.1)
    a_segment = found.pictures / found.recording_hours * 0.03
    assert 1 < a_segment < found.pictures / found.segments * 3, "pictures in a sample that took 0.03 hours"
    assert found.core_hours == found.opening_hours + found.planning_hours + found.recording_hours
    assert "core hours on this machine: 6.0 to open scenes, 2.4 to plan, " in str(found)


def test_an_estimate_counts_the_making_of_apartments_whatever_the_cache_has(monkeypatch: pytest.MonkeyPatch) -> None:
    world("apartments:train/0", "cpu")
    asked: list[bool] = []

    def make(seed: int, split: str, cache: bool, edits: Sequence[str]) -> Scene:
        asked.append(cache)
        return apartment(seed, split, edits=edits)

    monkeypatch.setattr(navigation_estimate, "_read_clock", lambda: 3600.0 * len(asked))
    monkeypatch.setattr(navigation_estimate, "RECORDED_SCENES", 1)
    monkeypatch.setattr(navigation_estimate, "apartment", make)
    found = estimate_collection("apartments:train:2", **SMALL)
    assert (found.opening_hours, found.planning_hours, found.recording_hours) == (2, 0, 0) and asked == [False]


def test_a_scene_without_floor_is_estimated(two_rooms: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(navigation_estimate, "plan_scene", lambda *_: [])
    found = estimate_collection(two_rooms, **SMALL)
    assert (found.frames, found.pictures, found.coverage, found.gigabytes, found.recording_hours) == (0, 0, 0, 0, 0)


def test_an_estimate_names_the_scenes_that_cannot_be_opened(
    two_rooms: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.obj"
    bad.write_text("v 0 0 0\n")
    with pytest.raises(InfrastructureError, match=r"1 of 2 scenes that were planned .*: bad: .*--skip-errors"):
        estimate_collection([str(bad), two_rooms], **SMALL)
    with pytest.raises(InfrastructureError, match=r"1 of 1 scenes that were planned .*: bad: .*choose others"):
        estimate_collection(str(bad), skip_errors=True, **SMALL)
    found = estimate_collection([str(bad), two_rooms], skip_errors=True, **SMALL)
    alone = estimate_collection(two_rooms, **SMALL)
    assert list(found.left_out) == ["bad"] and not alone.left_out
    assert (found.scenes, found.planned_scenes, found.frames) == (1, 1, alone.frames)
    rules = [word for name, value in RULES.items() for word in ("--rule", f"{name}={value}")]
    asked = ["collect", "navigation", "--scenes", str(bad), two_rooms, "--size", "36", "64", "--dry-run", *rules]
    assert main([*asked, "--backend", "cpu", "--skip-errors"]) == 0
    assert "skipped   bad: " in capsys.readouterr().out


SQUARE = [[0, 0, 4, 0], [4, 0, 4, 4], [4, 4, 0, 4], [0, 4, 0, 0]]
HOLE = [[1.5, 1, 2.5, 1], [2.5, 1, 2.5, 3], [2.5, 3, 1.5, 3], [1.5, 3, 1.5, 1]]


def test_a_map_shows_what_is_near_the_path() -> None:
    """A room of 4 x 4 m with a block in it; the path is at its left, one metre from the block's other side."""
    traversal = {"walls": [*SQUARE, *HOLE], "waypoints": [[3.5, 0.5]]}
    image = draw_traversal(traversal, [np.array([[0.7, 0.7], [0.7, 3.3]])])

    def color(x: float, z: float) -> tuple[int, ...]:
        return tuple(image[round((z + 0.4) * PIXELS_PER_METRE), round((x + 0.4) * PIXELS_PER_METRE)].tolist())

    assert color(1.2, 0.7) == COVERED and color(3.6, 2) == BARE and color(2, 2) == PAPER and color(-0.3, 2) == PAPER
    assert color(1.9, 0.5) == BARE, "1.2 m away"


def test_floor_is_covered_along_the_floor() -> None:
    floor = np.zeros((40, 100), np.uint8)
    floor[:, :48] = floor[:, 52:] = 255  # a wall of four pixels
    seeds = np.zeros_like(floor)
    seeds[20, 40] = 255
    reached = grow(seeds, floor, 20) > 0
    assert reached[20, 47] and not reached[:, 52:].any()
    distance = np.hypot(*(np.indices(floor.shape) - np.array([20, 40])[:, None, None]))
    assert reached[(distance < 18) & (floor > 0) & (np.arange(100) < 48)].all() and not reached[distance > 23].any()


def test_walls_join_to_loops_and_holes_are_no_floor() -> None:
    shuffled = np.random.default_rng(0).permutation(np.array([*SQUARE, *HOLE], float)).reshape(-1, 2, 2)
    loops = join_loops(shuffled)
    assert sorted(map(len, loops)) == [5, 5] and all((loop[0] == loop[-1]).all() for loop in loops)
    floor = fill_floor([(10 * loop).astype(np.int32) for loop in loops], (41, 41))
    assert floor[20, 5] == 255 and floor[20, 20] == 0


# -- the command line --------------------------------------------------------------------------------------------------


def test_the_command_line(tmp_path: Path, two_rooms: str, capsys: pytest.CaptureFixture[str]) -> None:
    out, sheet = tmp_path / "data", tmp_path / "sheet.png"
    rules = [word for name, value in RULES.items() for word in ("--rule", f"{name}={value}")]
    asked = ["collect", "navigation", "--scenes", two_rooms, "--size", "36", "64", "--backend", "cpu", *rules]
    assert main([*asked, "--dry-run"]) == 0
    assert "1 scenes: " in capsys.readouterr().out and not out.exists()
    assert main([*asked, "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert "segments of 1 scenes" in printed.out and "scenes: 1/1, " in printed.err
    assert main([*asked, "--out", str(out), "--preset", "paper"]) == 2
    assert "holds a different collection" in capsys.readouterr().err
    assert main(["data", "stats", str(out)]) == 0
    printed = capsys.readouterr()
    assert "windows of 14 frames" in printed.out and "two_rooms" in printed.out and "forward" in printed.out
    assert main(["data", "show", str(out), "--out", str(sheet), "--frames", "2"]) == 0
    assert min(Image.open(sheet).size) > 300
    assert main(["data", "verify", str(out)]) == 0
    assert capsys.readouterr().out.endswith("sound\n")
    (out / "segments.parquet").write_bytes((out / "segments.parquet").read_bytes() + b"x")
    assert main(["data", "verify", str(out), "--quick"]) == 2
    assert "segments.parquet" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["collect", "navigation", "--scenes", "apartments:val:2"], "expected scenes of a train split"),
        (["collect", "navigation", "--rule", "spacin=2"], "spacin"),
        (["collect", "navigation", "--rule", "spacing=-2"], "spacing above 0"),
        (["collect", "navigation", "--rule", "spacing=2m"], "spacing: expected a number, got '2m'"),
        (["data", "stats", "nowhere"], "meta.json does not exist"),
        (["data", "verify", "nowhere"], "meta.json does not exist"),
        (["data", "show", "nowhere"], "meta.json does not exist"),
    ],
)
def test_what_cannot_be_is_told(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "example"),
    [
        (["collect"], "wiw collect navigation --scenes apartments:train:80"),
        (["collect", "navigation"], "--preset paper --out data --dry-run"),
        (["collect", "manipulation"], "--out demos --workers 4"),
        (["data"], "wiw data verify data"),
        (["data", "verify"], "wiw data verify train held-out"),
        (["data", "stats"], "wiw data stats data --clip 25"),
        (["data", "show"], "--scenes 12"),
    ],
)
def test_help_teaches_by_examples(arguments: list[str], example: str, capsys: pytest.CaptureFixture[str]) -> None:
    for asked in ([*arguments, "--help"], arguments if len(arguments) == 1 else [*arguments, "-h"]):
        with pytest.raises(SystemExit) as stop:
            main(asked)
        assert stop.value.code == 0
        assert example in " ".join(capsys.readouterr().out.split())


def test_the_first_collection_is_the_default(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`wiw collect --tasks ...` is `wiw collect manipulation --tasks ...`; a word that is none is refused."""
    assert main(["collect", "--tasks", "juggle", "--out", str(tmp_path / "demos")]) == 2
    assert "got juggle" in capsys.readouterr().err
    assert main(["collect", "juggling"]) == 2
    assert "no command 'wiw collect juggling'; expected one of navigation, manipulation" in capsys.readouterr().err
