# SPDX-License-Identifier: Apache-2.0
"""LeRobot datasets: what is exported says what was collected, LeRobot itself reads it, and importing gives it back."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folders import contents
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from locations import TESTS
from PIL import Image

import wiw
from wiw.action import NULL, to_trajectory
from wiw.cli import main
from wiw.datasets import shards
from wiw.datasets.demonstration import Demonstration, decode_colors, decode_depths
from wiw.datasets.demonstrations import Demonstrations, encode_depth, encode_image
from wiw.datasets.lerobot import export_lerobot, import_lerobot, writing
from wiw.datasets.lerobot.layout import color_feature
from wiw.datasets.lerobot.statistics import Distribution, FeatureTally, sample_frames, tally_episode
from wiw.datasets.navigation import NavigationData
from wiw.errors import ArgumentError, DependencyError, FileError
from wiw.training.collect_navigation import collect_navigation

pyarrow = pytest.importorskip("pyarrow", reason="needs wiw[export]")
parquet = pytest.importorskip("pyarrow.parquet", reason="needs wiw[export]")

RULES = {"min_samples": 60, "spacing": 1.5, "leaf_ratio": 0.5, "max_scene_frames": 60}
SIZE = (36, 64)
RGB, DEPTH, FRONT = "observation.images.rgb", "observation.images.depth", "observation.images.front"
FRAME_FILE, EPISODE_FILE = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def navigation(tmp_path_factory: pytest.TempPathFactory, two_rooms: str) -> Path:
    folder = tmp_path_factory.mktemp("navigation")
    collect_navigation(folder, two_rooms, lossless=True, passes=2, rules=RULES, size=SIZE, seed=3, backend="cpu")
    return folder


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory, two_rooms: str) -> Path:
    """Perspective views as JPEG, without depth."""
    folder = tmp_path_factory.mktemp("views")
    few = {"rules": {**RULES, "max_scene_frames": 20}, "size": (32, 40), "seed": 3, "backend": "cpu"}
    collect_navigation(folder, two_rooms, perspective=True, depth=False, **few)
    return folder


@pytest.fixture(scope="module")
def manipulation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demos")
    tasks = ("slide_block", "push_buttons")
    wiw.collect(folder, tasks, episodes=2, size=32, frames=16, seed=5, depth=True, wrist=True, backend="cpu")
    return folder


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, navigation: Path, manipulation: Path, views: Path) -> Path:
    """The three collections as LeRobot datasets."""
    folder = tmp_path_factory.mktemp("exported")
    export_lerobot(navigation, folder / "navigation", workers=2)
    export_lerobot(views, folder / "views")
    export_lerobot(manipulation, folder / "manipulation", fps=12)
    return folder


def read_frames(folder: Path) -> dict[str, Any]:
    """Return the columns of all frames, pictures as PIL decodes them."""
    rows = [row for path in sorted(folder.glob("data/*/*.parquet")) for row in parquet.read_table(path).to_pylist()]
    return {name: np.array([decode(row[name]) for row in rows]) for name in rows[0]}


def decode(value: Any) -> Any:
    return np.asarray(Image.open(io.BytesIO(value["bytes"]))) if isinstance(value, dict) else value


# -- what is written ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["navigation", "manipulation"])
def test_the_layout_is_that_of_lerobot_3(exported: Path, name: str) -> None:
    pandas = pytest.importorskip("pandas")
    folder = exported / name
    meta = {"meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/wiw.json", EPISODE_FILE}
    assert set(contents(folder)) == {"README.md", FRAME_FILE, *meta}
    info = json.loads((folder / "meta/info.json").read_text())
    episodes = parquet.read_table(folder / EPISODE_FILE).to_pylist()
    tasks = pandas.read_parquet(folder / "meta/tasks.parquet")
    assert info["codebase_version"] == "v3.0" and info["fps"] == {"navigation": 5, "manipulation": 12}[name]
    assert info["data_path"].format(chunk_index=0, file_index=0) == FRAME_FILE and info["video_path"] is None
    assert info["total_episodes"] == len(episodes) and info["splits"] == {"train": f"0:{len(episodes)}"}
    assert info["total_tasks"] == len(tasks) and list(tasks.columns) == ["task_index"]

    with parquet.ParquetFile(folder / FRAME_FILE) as file:
        metadata, schema = file.metadata, file.schema_arrow
    assert schema.names == list(info["features"]) and info["total_frames"] == metadata.num_rows
    lengths = [metadata.row_group(index).num_rows for index in range(metadata.num_row_groups)]
    assert lengths == [row["length"] for row in episodes], "a row group is an episode"
    frames = read_frames(folder)
    for key, feature in info["features"].items():
        shape = frames[key].shape[1:]
        assert shape == {"image": tuple(feature["shape"][: len(shape)]), None: ()}.get(
            feature["dtype"] if feature["dtype"] == "image" else None if feature["shape"] == [1] else "vector",
            tuple(feature["shape"]),
        )
        assert feature["dtype"] == "image" or frames[key].dtype.kind == np.dtype(feature["dtype"]).kind
    np.testing.assert_array_equal(frames["index"], np.arange(info["total_frames"]))
    np.testing.assert_allclose(frames["timestamp"], frames["frame_index"] / info["fps"], atol=1e-6)
    for index, row in enumerate(episodes):
        part = slice(row["dataset_from_index"], row["dataset_to_index"])
        assert (frames["episode_index"][part] == index).all()
        np.testing.assert_array_equal(frames["frame_index"][part], np.arange(row["length"]))
        assert [tasks.iloc[each].name for each in set(frames["task_index"][part])] == row["tasks"]
    assert episodes[-1]["dataset_to_index"] == info["total_frames"]


@pytest.mark.parametrize("name", ["navigation", "views"])
def test_frames_of_navigation_are_those_of_its_segments(
    exported: Path, navigation: Path, views: Path, name: str
) -> None:
    frames, start = read_frames(exported / name), 0
    turned = 0
    for segment in NavigationData(navigation if name == "navigation" else views):
        part = slice(start, start := start + len(segment))
        np.testing.assert_array_equal(frames[RGB][part], [np.asarray(each) for each in seen(segment)])
        np.testing.assert_array_equal(frames["T_world_camera"][part].reshape(-1, 4, 4), segment.poses)
        if segment.depths is not None:
            np.testing.assert_array_equal(frames[DEPTH][part], np.rint(1000 * segment.depths))
        np.testing.assert_array_equal(frames["primitive"][part], [*segment.actions[1:], NULL])
        turned += sum(each is None for each in segment.encoded_images)
    assert start == len(frames[RGB]) and (turned > 10) == (name == "navigation")


def seen(segment: Any) -> Any:
    """Pictures of a segment as PIL decodes them, which rounds JPEG otherwise than OpenCV in places."""
    stored = [data and np.asarray(Image.open(io.BytesIO(data))) for data in segment.encoded_images]
    return [np.roll(stored[source], roll, axis=1) for source, roll in zip(segment.sources, segment.rolls, strict=True)]


def test_an_action_leads_to_the_next_state(exported: Path) -> None:
    """Steps end up to a centimetre beside the plan, on the mesh; turns are exact."""
    frames = read_frames(exported / "navigation")
    state, action, first = frames["observation.state"], frames["action"], frames["frame_index"] == 0
    assert np.abs(state[first]).max() < 1e-12 and (action[np.roll(first, -1)] == 0).all() and np.abs(action).sum() > 10
    turned = state[:-1, 2] + action[:-1, 1]
    ahead = np.stack([np.cos(state[:-1, 2]), np.sin(state[:-1, 2])], axis=1) * action[:-1, :1]
    within = ~first[1:]
    assert np.abs(np.exp(1j * turned) - np.exp(1j * state[1:, 2]))[within].max() < 1e-6
    assert np.abs(state[:-1, :2] + ahead - state[1:, :2])[within].max() < 0.012
    np.testing.assert_allclose(action, to_trajectory(frames["primitive"][:, None])[:, 0, [0, 2]], atol=1e-7)


def test_frames_of_manipulation_are_those_of_its_demonstrations(exported: Path, manipulation: Path) -> None:
    frames, demonstrations = read_frames(exported / "manipulation"), Demonstrations(manipulation)
    episodes = parquet.read_table(exported / "manipulation" / EPISODE_FILE).to_pylist()
    for index, (row, each) in enumerate(zip(episodes, demonstrations, strict=True)):
        part = slice(16 * index, 16 * index + 16)
        np.testing.assert_array_equal(frames["observation.state"][part], each.poses)
        np.testing.assert_array_equal(frames["action"][part][:-1], each.actions[1:])
        np.testing.assert_array_equal(frames["action"][part][-1], each.actions[-1])
        pictures = [np.asarray(Image.open(io.BytesIO(data))) for data in each.encoded_images]
        np.testing.assert_array_equal(frames[FRONT][part], pictures)
        np.testing.assert_array_equal(frames[FRONT + "_depth"][part], each.depths)
        wrist = "observation.images.wrist"
        assert each.encoded_wrist_images is not None and each.encoded_wrist_depths is not None
        np.testing.assert_array_equal(frames[wrist][part], decode_colors(each.encoded_wrist_images))
        np.testing.assert_array_equal(frames[f"{wrist}_depth"][part], decode_depths(each.encoded_wrist_depths))
        assert each.wrist_poses is not None
        np.testing.assert_array_equal(frames["wrist_camera_pose"][part], each.wrist_poses.reshape(-1, 16))
        assert row["tasks"] == [each.instruction] and (row["kind"], row["seed"]) == (each.task, each.seed)
    rate = len(demonstrations) * 15 / sum(each.seconds[-1] for each in demonstrations)
    assert abs(wiw.datasets.lerobot.manipulation.estimate_rate(demonstrations) - rate) <= 0.5


@pytest.mark.parametrize("name", ["navigation", "manipulation"])
def test_statistics_are_those_of_the_frames(exported: Path, name: str) -> None:
    """All frames and pixels are looked at: pictures are small, episodes short."""
    frames = read_frames(exported / name)
    stored = json.loads((exported / name / "meta/stats.json").read_text())
    features = json.loads((exported / name / "meta/info.json").read_text())["features"]
    assert list(stored) == list(features)
    for key, feature in features.items():
        color = feature["dtype"] == "image" and feature["shape"][2] == 3
        values = frames[key].astype(np.float64).reshape(-1, feature["shape"][2 if feature["dtype"] == "image" else 0])
        check_statistics(stored[key], values / (255 if color else 1), feature["dtype"] == "image")
        assert stored[key]["count"] == [len(frames[key])]
    episodes = parquet.read_table(exported / name / EPISODE_FILE).to_pylist()
    for row in episodes[:2]:
        values = frames["action"][row["dataset_from_index"] : row["dataset_to_index"]]
        check_statistics({key[13:]: row[key] for key in row if key.startswith("stats/action/")}, values, False)
        assert row["stats/action/count"] == [row["length"]]


def check_statistics(stored: dict[str, Any], values: Any, image: bool) -> None:
    expected = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    levels = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
    expected |= {key: np.quantile(values, q, axis=0, method="inverted_cdf") for key, q in levels.items()}
    assert set(stored) == {*expected, "count"}
    for key, value in expected.items():
        shape = (-1, 1, 1) if image else (-1,)
        np.testing.assert_allclose(stored[key], value.reshape(shape), atol=1e-6, rtol=1e-6, err_msg=key)


@given(arrays(np.uint16, st.integers(1, 60), elements=st.integers(0, 9)), st.data())
def test_distributions_of_parts_give_that_of_the_whole(values: Any, data: st.DataObject) -> None:
    cut = data.draw(st.integers(1, len(values)))
    parts = [part for part in (values[:cut], values[cut:]) if len(part)]
    merged = Distribution.merge([Distribution.from_values(part) for part in parts])
    whole = Distribution.from_values(values.astype(float))
    np.testing.assert_array_equal(merged.values, whole.values)
    np.testing.assert_array_equal(merged.counts, whole.counts)
    quantiles = np.quantile(values, [0.01, 0.1, 0.5, 0.9, 0.99], method="inverted_cdf")
    expected = [values.min(), values.max(), values.mean(), values.std(), *quantiles]
    np.testing.assert_allclose(whole.describe(), expected, atol=1e-12)


def test_large_pictures_are_thinned_and_long_episodes_sampled() -> None:
    """As LeRobot has it: from 300 pixels on, every (longer side // 150)th; up to 464 frames 100, then n ** .75."""
    image = np.random.default_rng(0).integers(0, 256, (330, 310, 3)).astype(np.uint8)
    tally = tally_episode({"a": color_feature("", image.shape)}, {"a": [encode_image(image, "png")]})["a"]
    np.testing.assert_allclose(tally.describe()["mean"], image[::2, ::2].mean((0, 1))[:, None, None] / 255)
    assert [len(sample_frames(count)) for count in (1, 99, 100, 101, 400, 750)] == [1, 99, 100, 100, 100, 143]
    assert sample_frames(750)[:2] == [0, 5] and sample_frames(750)[-1] == 749
    many = FeatureTally.merge([tally] * 3)
    assert many.frames == 3 and many.describe()["std"] == tally.describe()["std"]


@pytest.mark.extra
def test_datasets_loads_and_streams_it(exported: Path, tmp_path: Path) -> None:
    pytest.importorskip("datasets.arrow_dataset", reason="no datasets: pip install datasets")
    import datasets

    frames = read_frames(exported / "navigation")
    loaded = datasets.load_dataset(str(exported / "navigation"), split="train", cache_dir=str(tmp_path))
    np.testing.assert_array_equal(np.array(loaded[7][DEPTH]), frames[DEPTH][7])
    streamed = datasets.load_dataset(str(exported / "navigation"), split="train", streaming=True)
    assert [row["primitive"] for row, _ in zip(streamed, range(9), strict=False)] == frames["primitive"][:9].tolist()


# -- and back ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["navigation", "views", "manipulation"])
def test_importing_gives_back_what_was_exported(
    exported: Path, tmp_path: Path, name: str, request: pytest.FixtureRequest
) -> None:
    news: list[tuple[int, int]] = []
    made = import_lerobot(exported / name, tmp_path / "back", progress=lambda *each: news.append(each))
    collected = contents(request.getfixturevalue(name))
    if name != "manipulation":  # how a collection was begun, which only resuming it needs
        collected = {file: data for file, data in collected.items() if not file.startswith(("manifest", "scenes"))}
    assert contents(tmp_path / "back") == collected
    assert news[-1] == (len(made), len(made))


def test_files_hold_as_many_episodes_as_fit(
    navigation: Path, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "FILE_MEGABYTES", 0.1)
    monkeypatch.setattr(writing, "CHUNK_FILES", 2)
    export_lerobot(navigation, tmp_path / "many")
    files = sorted((tmp_path / "many").glob("data/*/*.parquet"))
    assert len(files) > 2 and files[2].parent.name == "chunk-001" and files[2].name == "file-000.parquet"
    assert all(path.stat().st_size < 0.15 * 2**20 for path in files)
    many, one = read_frames(tmp_path / "many"), read_frames(exported / "navigation")
    for key, values in one.items():
        np.testing.assert_array_equal(many[key], values)
    import_lerobot(tmp_path / "many", tmp_path / "back")
    assert contents(tmp_path / "back")["meta.json"] == (navigation / "meta.json").read_bytes()


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 12), st.integers(1, 3), st.booleans(), st.integers(0, 2**32))
def test_any_demonstrations_come_back(
    tmp_path_factory: pytest.TempPathFactory, count: int, frames: int, depth: bool, seed: int
) -> None:
    folder, rng = tmp_path_factory.mktemp("made"), np.random.default_rng(seed)
    made = [make_up(rng, frames, episode, depth) for episode in range(count)]
    manifest = {"tasks": ["made"], "episodes": count, "size": 8, "depth": depth}
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n")
    for number in range(-(-count // 10)):
        part = made[10 * number : 10 * number + 10]
        shards.write(folder / f"made-{number:05d}.parquet", part, {"task": "made", "failed": number})
    export_lerobot(folder, folder / "export")
    back = import_lerobot(folder / "export", folder / "back")
    for one, other in zip(Demonstrations(folder), back, strict=True):
        for name, value in vars(one).items():
            np.testing.assert_equal(getattr(other, name), value, err_msg=name)
    assert back.failed == {"made": sum(range(-(-count // 10)))}


def make_up(rng: np.random.Generator, frames: int, episode: int, depth: bool) -> Demonstration:
    seconds, actions = np.arange(frames) / 3, rng.normal(size=(frames, 7))
    actions[0] = actions[min(1, frames - 1)]  # the first action is under way from frame 1 on
    return Demonstration(
        task="made",
        variation=int(rng.integers(50)),
        seed=int(rng.integers(2**31, 2**32)),
        episode=episode,
        instruction=f'say "ü" {rng.integers(3)} times',
        success=bool(rng.integers(2)),
        places={"a cup": rng.normal(size=(4, 4))},
        seconds=seconds,
        poses=rng.normal(size=(frames, 7)),
        actions=actions,
        keys=rng.integers(0, 9, frames).astype(np.int32),
        ended=rng.integers(0, 2, frames).astype(bool),
        encoded_images=tuple(encode_image(rng.integers(0, 256, (8, 8, 3), np.uint8), "jpeg") for _ in seconds),
        encoded_depths=tuple(encode_depth(13 * rng.random((8, 8), np.float32)) for _ in seconds) if depth else None,
    )


def test_the_command_line(navigation: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, back = str(tmp_path / "lerobot"), str(tmp_path / "back")
    assert main(["data", "export", str(navigation), "--format", "lerobot", "--out", out, "--fps", "10"]) == 0
    printed = capsys.readouterr()
    assert f"written   {out}" in printed.out and "episodes: " in printed.err
    assert main(["data", "export", str(navigation), "--out", out]) == 2
    assert "is not empty" in capsys.readouterr().err
    assert main(["data", "import", out, "--out", back]) == 0
    assert main(["data", "verify", back]) == 0
    assert capsys.readouterr().out.endswith("sound\n")


# -- what cannot be ----------------------------------------------------------------------------------------------------


def edit_info(**change: Any) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        path = folder / "meta/info.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | change))

    return edit


def edit_feature(name: str, **change: Any) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        path = folder / "meta/info.json"
        info = json.loads(path.read_text())
        info["features"][name] |= change
        path.write_text(json.dumps(info))

    return edit


def drop_column(file: str, name: str) -> Callable[[Path], None]:
    return lambda folder: parquet.write_table(parquet.read_table(folder / file).drop_columns([name]), folder / file)


def set_column(file: str, name: str, value: Any) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        table = parquet.read_table(folder / file)
        at = table.schema.get_field_index(name)
        values = pyarrow.array([value] * len(table), table.schema.field(at).type)
        parquet.write_table(table.set_column(at, name, values), folder / file)

    return edit


def cut_short(file: str) -> Callable[[Path], None]:
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes()[:-50])  # type: ignore[func-returns-value]


def write(file: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / file).write_text(text)  # type: ignore[func-returns-value]


@pytest.mark.parametrize("number", ["00{file_index}", "{file_index:3}", "{file_index:03}", "{file_index:03d}"])
def test_names_of_files_may_be_written_otherwise(exported: Path, tmp_path: Path, number: str) -> None:
    folder = shutil.copytree(exported / "views", tmp_path / "renamed")
    edit_info(data_path=f"frames {number}.parquet")(folder)
    (folder / FRAME_FILE).rename(folder / f"frames {number}.parquet".format(file_index=0))
    assert len(import_lerobot(folder, tmp_path / "back")) > 0


BAD_PATHS: tuple[Any, ...] = (
    "data/{episode}.parquet",
    "data/{chunk_index.__class__}.parquet",
    "data/{chunk_index!r}.parquet",
    "data/{chunk_index:>99999}.parquet",
    "data/{chunk_index:099d}.parquet",
    "data/{chunk_index:{file_index}}.parquet",
    "data/{chunk_index",
    "data/{}.parquet",
    "../navigation/data/chunk-000/file-000.parquet",
    "/data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "data/chunk\0{chunk_index:03d}.parquet",
    "data/chunk-000/file-000.arrow",
    3,
)
"""Templates of names of files that are none, lead elsewhere or would fill the memory."""


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (edit_info(codebase_version="v2.1"), "format v3.0, got v2.1"),
        (edit_info(fps=30), "expected 30 frames per second .* timestamps of 5"),
        (edit_info(total_episodes=99), "expected 99 episodes .* got "),
        *((edit_info(data_path=path), "data_path of chunk_index and file_index within") for path in BAD_PATHS),
        (edit_info(fps=float("nan")), "expected nan frames per second"),
        (edit_info(fps=10**400), "frames per second .* timestamps of 5"),
        (set_column(EPISODE_FILE, "data/file_index", -1), "whole numbers from 0 as data/file_index, got -1"),
        (set_column(EPISODE_FILE, "length", None), "whole numbers from 0 as length, got None"),
        (set_column(EPISODE_FILE, "length", 2**60), "expected frames 0 to .* of episode 0, got others"),
        (edit_info(features={}), "got no observation.state"),
        (edit_feature(RGB, dtype="video"), "as image .* got video .* no longer exact"),
        (edit_feature(DEPTH, shape=None), r"as image \[36, 64, 1\], got image None"),
        (edit_feature(DEPTH, shape=[8, 8, 1]), r"as image \[36, 64, 1\], got image \[8, 8, 1\]"),
        (lambda folder: (folder / "meta/info.json").unlink(), "info.json does not exist"),
        (lambda folder: (folder / "meta/wiw.json").unlink(), "wiw.json does not exist; expected .* `wiw data export`"),
        (lambda folder: (folder / EPISODE_FILE).unlink(), "episodes as meta/info.json says, got 0"),
        (lambda folder: (folder / FRAME_FILE).unlink(), "file-000.parquet is missing"),
        (drop_column(FRAME_FILE, "T_world_camera"), "expected columns .* got no T_world_camera"),
        (drop_column(EPISODE_FILE, "length"), "got no length"),
        (drop_column(EPISODE_FILE, "scene"), "got no scene"),
        (set_column(EPISODE_FILE, "file", "../elsewhere.parquet"), "in the new folder, got ../elsewhere"),
        (set_column(EPISODE_FILE, "file", "/elsewhere.parquet"), "in the new folder, got /elsewhere"),
        (set_column(EPISODE_FILE, "file", "//elsewhere.parquet"), "in the new folder, got //elsewhere"),
        (set_column(FRAME_FILE, RGB, None), f"images of {RGB} in it, but some are missing"),
        (set_column(FRAME_FILE, "index", 3), "expected frames 0 to .* of episode 0, got others"),
        (cut_short(FRAME_FILE), "got a damaged one"),
        (cut_short(EPISODE_FILE), "damaged file"),
        (write("meta/info.json", "[]"), "expected a LeRobot dataset"),
        (write("meta/wiw.json", '{"what": "flying"}'), "navigation or manipulation, got flying"),
        (
            write("meta/wiw.json", '{"what": "navigation", "meta": {"camera": 1}}'),
            "expected meta with .* got no format",
        ),
        (write("meta/wiw.json", '{"what": "manipulation"}'), "expected manifest with .* got none"),
    ],
)
def test_what_cannot_be_imported_is_told(
    exported: Path, tmp_path: Path, damage: Callable[[Path], None], words: str
) -> None:
    folder = shutil.copytree(exported / "navigation", tmp_path / "bad")
    damage(folder)
    with pytest.raises(FileError, match=words):
        import_lerobot(folder, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad"], "no partial file is left"


def test_depth_that_is_no_depth_is_told(exported: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(exported / "manipulation", tmp_path / "bad")
    set_column(FRAME_FILE, FRONT + "_depth", {"bytes": b"no picture", "path": None})(folder)
    with pytest.raises(FileError, match="expected depth as TIFF"):
        import_lerobot(folder, tmp_path / "out")


def test_what_cannot_be_exported_is_told(navigation: Path, manipulation: Path, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"manifest\.json does not exist"):
        export_lerobot(tmp_path / "nothing", tmp_path / "out")
    with pytest.raises(ArgumentError, match="at least 1 frame per second, got 0"):
        export_lerobot(navigation, tmp_path / "out", fps=0)
    with pytest.raises(ArgumentError, match="1 worker or more, got 0"):
        export_lerobot(navigation, tmp_path / "out", workers=0)
    begun = shutil.copytree(navigation, tmp_path / "begun")
    (begun / "meta.json").unlink()
    with pytest.raises(FileError, match="repeat that command until it finishes"):
        export_lerobot(begun, tmp_path / "out")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("kept")
    with pytest.raises(FileError, match="is not empty"):
        export_lerobot(manipulation, tmp_path / "full")
    assert contents(tmp_path / "full") == {"mine": b"kept"} and not (tmp_path / "out").exists()


def test_a_damaged_picture_stops_the_export(manipulation: Path, tmp_path: Path) -> None:
    bad = shutil.copytree(manipulation, tmp_path / "bad")
    (path, *_) = sorted(bad.glob("*.parquet"))
    shard = shards.Shard(path)
    (first, *rest) = (shard[index] for index in range(len(shard)))
    damaged = Demonstration(**{**vars(first), "encoded_images": (b"no picture", *first.encoded_images[1:])})
    facts = {name: value for name, value in shard.facts.items() if name not in ("format", "columns")}
    shards.write(path, [damaged, *rest], facts)
    with pytest.raises(FileError, match="colour images of 32 x 32, got something else"):
        export_lerobot(bad, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad"]


def test_pyarrow_is_asked_for_by_name(navigation: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for convert in (export_lerobot, import_lerobot):
        with pytest.raises(DependencyError, match=r"LeRobot datasets .* pip install 'wiw\[export\]'"):
            convert(navigation, tmp_path / "out")


# -- LeRobot itself ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lerobot_python() -> str:
    python = os.environ.get("WIW_LEROBOT_PYTHON")
    if not python:
        pytest.skip("set WIW_LEROBOT_PYTHON to the python of an environment that has the package lerobot")
    return python


@pytest.mark.parametrize("name", ["navigation", "manipulation"])
def test_lerobot_reads_it(lerobot_python: str, exported: Path, tmp_path: Path, name: str) -> None:
    """The package itself says the same about frames, windows of actions, episodes, tasks and statistics."""
    folder, out = exported / name, tmp_path / "read.npz"
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "cache")}
    command = [lerobot_python, str(TESTS / "read_lerobot.py"), str(folder), str(out)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    read = dict(np.load(out))
    about = json.loads(str(read.pop("about")))
    version = tuple(int(each) for each in about["lerobot"].split(".")[:2])
    frames, stored = read_frames(folder), json.loads((folder / "meta/stats.json").read_text())
    episodes = parquet.read_table(folder / EPISODE_FILE).to_pylist()
    features: dict[str, Any] = json.loads((folder / "meta/info.json").read_text())["features"]

    assert about["bounds"] == [[row["dataset_from_index"], row["dataset_to_index"]] for row in episodes]
    assert about["frames"] == len(frames["index"]) and about["cameras"] == [key for key in features if "image" in key]
    spoken = [about["tasks"][index] for index in frames["task_index"]]
    assert read["item/task"].tolist() == spoken and {each for row in episodes for each in row["tasks"]} == set(spoken)
    for key, feature in features.items():
        values = read[f"item/{key}"]
        if feature["dtype"] != "image":
            np.testing.assert_allclose(values, frames[key], rtol=1e-6, atol=1e-6, err_msg=key)
        elif feature["shape"][2] == 3:
            np.testing.assert_allclose(255 * values.transpose(0, 2, 3, 1), frames[key], atol=1e-4)
        else:  # from 0.6 on in millimetres
            scale = 1000 if feature["info"]["depth_unit"] == "m" and version >= (0, 6) else 1
            np.testing.assert_allclose(values[:, 0], scale * frames[key].astype(float), rtol=1e-6)
    check_windows(read, frames, episodes)
    np.testing.assert_array_equal(read["second/index"], np.arange(*about["bounds"][1]))
    check_lerobot_statistics(read, stored, episodes, version)


def check_windows(read: dict[str, Any], frames: dict[str, Any], episodes: list[dict[str, Any]]) -> None:
    """Windows of three actions end with their episode."""
    for row in episodes:
        last = row["dataset_to_index"] - 1
        for start in range(row["dataset_from_index"], last + 1):
            at = np.minimum(start + np.arange(3), last)
            np.testing.assert_allclose(read["ahead/action"][start], frames["action"][at], rtol=1e-6, atol=1e-6)
            np.testing.assert_array_equal(read["ahead/action_is_pad"][start], start + np.arange(3) > last)


def check_lerobot_statistics(
    read: dict[str, Any], stored: dict[str, Any], episodes: list[dict[str, Any]], version: tuple[int, int]
) -> None:
    """LeRobot computes in float32 and reads quantiles off bins; before 0.6, squares of bytes overflow in `std`."""
    compared = 0
    for index, row in enumerate(episodes):
        for key in {each.removeprefix("stats/").rpartition("/")[0] for each in row if each.startswith("stats/")}:
            span = np.ptp([row[f"stats/{key}/min"], row[f"stats/{key}/max"]], axis=0)
            for name in ("min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"):
                if f"computed/{index}/{key}/{name}" not in read or (name == "std" and version < (0, 6)):
                    continue
                theirs, ours = read[f"computed/{index}/{key}/{name}"], np.array(row[f"stats/{key}/{name}"])
                assert theirs.shape == ours.shape
                assert (np.abs(theirs - ours) <= 0.002 * span + 1e-5).all(), (index, key, name, theirs, ours)
                compared += 1
    assert compared > 50 * len(episodes)
    for key, each in stored.items():
        for name in ("min", "max", "mean", "count"):
            scale = 1000 if version >= (0, 6) and key == FRONT + "_depth" and name != "count" else 1
            np.testing.assert_allclose(read[f"stored/{key}/{name}"], scale * np.array(each[name]), rtol=1e-6)
            if f"total/{key}/{name}" in read:
                np.testing.assert_allclose(read[f"total/{key}/{name}"], each[name], rtol=1e-4, atol=1e-4)
