# SPDX-License-Identifier: Apache-2.0
"""pocket's training: what its batches show, that it learns, stops, resumes, and is measured."""

from __future__ import annotations

import json
import math
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw.cli import main
from wiw.datasets.navigation import NavigationData
from wiw.errors import ArgumentError, FileError, TrainingError
from wiw.studies.run_log import load_run
from wiw.training.collect_navigation import collect_navigation

pytest.importorskip("pyarrow", reason="needs wiw[export]")
torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.training.held_out_clips import imagine_with  # noqa: E402
from wiw.training.held_out_panoramas import select_panoramas  # noqa: E402
from wiw.training.learners import make_learner  # noqa: E402
from wiw.training.place_trainer import PlaceTrainer  # noqa: E402
from wiw.training.pocket.batches import compute_displacements, draw_batch, draw_places  # noqa: E402
from wiw.training.pocket.held_out import BASELINES, draw_windows, measure, pair_controls, shuffle_places  # noqa: E402
from wiw.training.pocket.recipe import PocketRecipe  # noqa: E402
from wiw.training.pocket.trainer import PocketTrainer, average_sphere  # noqa: E402
from wiw.training.post_training.corpora import NavigationCorpus  # noqa: E402
from wiw.training.post_training.recipe import load_recipe  # noqa: E402
from wiw.training.post_training.validation import ValidationSet  # noqa: E402
from wiw.training.reduced_frames import ReducedFrames, reduce_frames  # noqa: E402
from wiw.training.train_on_clips import create_sampler, train_on_clips  # noqa: E402
from wiw.types import Conditioning  # noqa: E402
from wiw.world_models.pocket.model import Pocket  # noqa: E402
from wiw.world_models.pocket.network import Denoiser, Views  # noqa: E402
from wiw.world_models.pocket.weights import load  # noqa: E402
from wiw.world_models.warpnet.network import warp  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

RULES = {"min_samples": 60, "spacing": 1.5, "leaf_ratio": 0.5}
SIZE = (16, 32)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, two_rooms: str) -> Path:
    folder = tmp_path_factory.mktemp("navigation")
    collect_navigation(folder, two_rooms, rules=RULES, size=(64, 128), seed=3, backend="cpu", lossless=True)
    return folder


@pytest.fixture(scope="module")
def frames(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> ReducedFrames:
    return reduce_frames(NavigationData(dataset), (64, 128), tmp_path_factory.mktemp("frames"))


def recipe(**changes: Any) -> PocketRecipe:
    small = {"size": SIZE, "widths": (8, 32, 32, 32), "frames": 8, "places": 3, "clips": 4, "precision": "float32"}
    return load_recipe("pocket", options={**small, **changes}, kind=PocketRecipe)


def trainer(dataset: Path, cache: Path, **changes: Any) -> PocketTrainer:
    data, chosen = NavigationData(dataset), recipe(**changes)
    return PocketTrainer(data.clips(chosen.frames), reduce_frames(data, chosen.size, cache), chosen)


# -- data --------------------------------------------------------------------------------------------------------------


def test_frames_are_decoded_once_and_show_what_the_dataset_shows(
    dataset: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    data = NavigationData(dataset)
    frames = reduce_frames(data, (64, 128), tmp_path)
    for index in (0, len(data) - 1):
        segment = data[index]
        places = frames.find_places(index, 0, len(segment))
        assert len(places) == len(np.unique(segment.sources))
        first = frames.starts[index]
        for at in range(len(segment)):
            picture = int(frames.pictures[first + at])
            shown = np.roll(frames.images[picture], int(segment.rolls[at]), axis=1)
            np.testing.assert_array_equal(shown, segment.images[at])
    monkeypatch.setattr("wiw.training.reduced_frames._write_arrays", None)
    again = reduce_frames(data, (64, 128), tmp_path)
    np.testing.assert_array_equal(again.images, frames.images)


def test_with_the_true_distances_a_batch_is_the_warp_of_its_source(frames: ReducedFrames, dataset: Path) -> None:
    """So places, turns, mirrors and distances belong together."""
    rng = np.random.default_rng(0)
    clips = NavigationData(dataset).clips(8)
    chosen = [frames.find_places(*clips.locate(int(row)), 8) for row in rng.integers(0, len(clips), 24)]
    batch = draw_batch(frames, [clip for clip in chosen if len(clip) > 4], 3, rng)
    assert batch.log_distances is not None
    right, ahead = batch.places.flatten(0, 1).unbind(1)
    source = batch.source.repeat_interleave(3, dim=0)
    made = warp(source, batch.log_distances.flatten(0, 1), ahead, right).unflatten(0, batch.places.shape[:2])
    error = average_sphere((made - batch.views).abs())
    still = average_sphere((batch.source[:, None] - batch.views).abs())
    assert (error < 0.75 * still).all() and error.mean() < 0.5 * still.mean()


@pytest.mark.parametrize("name", ["pocket", "warpnet"])
def test_a_step_is_computed_on_the_trainers_device(
    name: str, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a device without data a tensor that is left on the CPU is an error, as on a GPU."""
    monkeypatch.setattr("wiw.world_models.warpnet.network._log", math.log)  # a number of Python: it needs data
    monkeypatch.setattr(PlaceTrainer, "reduce_precision", nullcontext)  # which torch has on real devices alone
    data, learner = NavigationData(dataset), make_learner(name)
    chosen = learner.create_recipe(frames=8, size=SIZE, batch=2, clips=2, seed=0)
    made = learner.trainer(data.clips(8), reduce_frames(data, SIZE, tmp_path), chosen, "meta")
    losses = made.compute_losses(np.arange(2), torch.Generator().manual_seed(0))
    assert losses.device.type == "meta" and losses.shape == (2,)
    losses.sum().backward()
    assert all(value.device.type == "meta" for value in made.network.parameters())


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_device_that_is_not_there_is_refused_before_anything_is_written(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["train", "pocket", "--data", str(dataset), "--part", "all", "--out", str(tmp_path / "out")]
    assert main([*given, "--device", "cuda:1", "--cache", str(tmp_path / "cache")]) == 2
    assert "there is no 'cuda:1'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_displacements_are_right_and_ahead_of_who_faces_there() -> None:
    positions = np.array([[[1.0, 2.0], [1.0, 1.0], [3.0, 2.0]]])  # (x, z); -z is ahead at heading 0
    np.testing.assert_allclose(compute_displacements(positions, np.zeros(1))[0], [[0, 0], [0, 1], [2, 0]], atol=1e-12)
    left = compute_displacements(positions, np.array([np.pi / 2]))[0]  # faces -x
    np.testing.assert_allclose(left, [[0, 0], [1, 0], [0, -2]], atol=1e-12)


def test_places_are_in_order_from_one_end_of_the_clip() -> None:
    rng, clip = np.random.default_rng(0), np.arange(10, 16)
    for _ in range(20):
        drawn = draw_places(clip, 4, rng)
        steps = np.abs(drawn - drawn[0])
        assert drawn[0] in (10, 15) and (np.diff(steps) > 0).all()
    assert set(draw_places(clip[:2], 4, rng)) == {10, 11}
    assert draw_places(clip[:1], 4, rng).tolist() == [10] * 5


# -- training ----------------------------------------------------------------------------------------------------------


def test_it_learns_four_clips_by_heart(dataset: Path, tmp_path: Path) -> None:
    learner = trainer(dataset, tmp_path, epochs=40, pure_noise=0.99)
    losses = [learner.train_step(3e-3) for _ in range(40)]
    assert np.mean(losses[-8:]) < 0.8 * np.mean(losses[:8])
    assert any(not torch.equal(value, learner.averages[name]) for name, value in learner.trained.items())


def test_it_resumes_exactly(dataset: Path, tmp_path: Path) -> None:
    whole, half = (trainer(dataset, tmp_path, epochs=4) for _ in range(2))
    for _ in range(4):
        whole.train_step(1e-3)
    for _ in range(2):
        half.train_step(1e-3)
    resumed = trainer(dataset, tmp_path, epochs=4)
    resumed.load_state_dict(half.state_dict())
    for _ in range(2):
        resumed.train_step(1e-3)
    assert resumed.mean_loss == whole.mean_loss
    for one, other in ((resumed.trained, whole.trained), (resumed.averages, whole.averages)):
        for name, value in one.items():
            assert torch.equal(value, other[name]), name


def test_the_first_update_of_a_training_has_an_effect(dataset: Path, tmp_path: Path) -> None:
    rates = {"rate": 1e-3, "warmup": 0.5, "decay": 0.5, "validate_every": None}
    train_on_clips("pocket", dataset, tmp_path / "out", tmp_path, recipe(epochs=2, **rates), "all")
    log = (tmp_path / "out.log" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["rate"] for line in log] == pytest.approx([5e-4, 5e-4])


def test_after_few_updates_averages_are_near_the_weights(dataset: Path, tmp_path: Path) -> None:
    learner = trainer(dataset, tmp_path, epochs=8)
    start = {name: value.detach().clone() for name, value in learner.trained.items()}
    for _ in range(8):
        learner.train_step(1e-3)
    moved, behind = (
        sum(float((value - other[name]).detach().square().sum()) for name, value in learner.trained.items())
        for other in (start, learner.averages)
    )
    assert learner.recipe.ema == 0.995 and behind < 0.2 * moved


def test_a_loss_that_is_not_finite_stops_it_and_names_the_clips(dataset: Path, tmp_path: Path) -> None:
    learner = trainer(dataset, tmp_path)
    before = [value.clone() for value in learner.network.parameters()]
    with torch.no_grad():
        learner.network.last.bias.fill_(float("nan"))
    with pytest.raises(TrainingError, match=r"step 1: the loss is not finite on a batch of clip \d+ \(scene"):
        learner.train_step(1e-3)
    changed = [
        name
        for (name, value), old in zip(learner.network.named_parameters(), before, strict=True)
        if not torch.equal(value, old)
    ]
    assert changed == ["last.bias"]


def test_the_rate_rises_stays_and_falls() -> None:
    chosen = recipe(warmup=0.1, decay=0.5)
    assert [round(chosen.scale_rate(at), 3) for at in (0, 0.05, 0.1, 0.5, 0.75, 1.0)] == [0, 0.5, 1, 1, 0.5, 0]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"size": (24, 48)}, "size: expected a height of a multiple of 16"),
        ({"widths": (8, 8, 8)}, "widths: expected four"),
        ({"widths": (16, 16, 32, 32)}, "widths: expected 32 or more after the first"),
        ({"widths": (64, 104, 160, 224)}, r"share the channels evenly, got \(64, 104, 160, 224\)"),
        ({"places": 0}, "places: expected 1 or more"),
        ({"pure_noise": 1.5}, "pure_noise: expected a share"),
        ({"least_level": 0}, "least_level: expected a level"),
        ({"lora": 4}, "recipe: unknown name 'lora'"),
        ({"absolute": float("nan")}, "finite weights of errors of 0 or more"),
    ],
)
def test_a_recipe_that_cannot_be_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        recipe(**changes)


@pytest.mark.parametrize("widths", [(8, 40, 48, 56), (32, 48, 72, 96), (32, 48, 64, 88)])
def test_widths_that_a_recipe_takes_can_be_run(widths: tuple[int, ...]) -> None:
    network = Denoiser(16, recipe(widths=widths).widths)
    source, places = torch.zeros(1, 3, *SIZE), torch.zeros(1, 2, 2)
    estimate = network(torch.zeros(1, 2, 3, *SIZE), torch.ones(1), Views.around(source, places).sweep, places)
    assert estimate.residual.shape == (2, 3, *SIZE)


# -- measuring ---------------------------------------------------------------------------------------------------------


def test_windows_show_what_their_trajectories_say(two_rooms: str) -> None:
    windows = draw_windows(two_rooms, 2, 0)
    assert {window.kind for window in windows} == {"mixed", "straight"}
    straight = next(window for window in windows if window.kind == "straight")
    np.testing.assert_allclose(straight.trajectory[:, :2], [[0.2 * k, 0] for k in range(1, 9)], atol=1e-6)
    rows = list(measure(windows, BASELINES, 0))
    assert {(row["kind"], row["control"]) for row in rows} == {
        ("mixed", "true"), ("mixed", "shuffled"), ("straight", "true")
    }  # fmt: skip
    mean = {name: np.mean([row["psnr"] for row in rows if row["model"] == name]) for name in BASELINES}
    assert mean["one room"] > mean["rolled"] >= mean["copy"]
    rolled: dict[str, dict[tuple[int, int], float]] = {"true": {}, "shuffled": {}}
    for row in (row for row in rows if row["model"] == "rolled"):
        rolled[row["control"]][row["window"], row["step"]] = row["psnr"]
    assert rolled["shuffled"].items() <= rolled["true"].items()  # turns are the window's own
    elsewhere = [replace(window, scene="another", image=window.image // 2) for window in windows]
    assert [row for row in measure([*elsewhere, *windows], BASELINES, 0) if row["scene"] != "another"] == rows


def test_places_that_happen_to_be_the_same_do_not_count_in_the_gap(two_rooms: str) -> None:
    one = next(window for window in draw_windows(two_rooms, 1, 0) if window.kind == "mixed")
    assert {row["control"] for row in measure([one], BASELINES, 0)} == {"true"}, "there is no other"
    places = one.trajectory.copy()
    places[2:, 0] += 0.3
    rows = list(measure([one, replace(one, trajectory=places)], BASELINES, 0))
    assert {row["step"] for row in rows if row["control"] == "shuffled"} == set(one.truth) - {1}
    paired = pair_controls(rows, "one room", "psnr")
    assert {step for _, _, step in paired} == set(one.truth) - {1} and len(paired) == 2 * len(set(one.truth) - {1})


def test_shuffled_windows_walk_as_another_does(two_rooms: str) -> None:
    windows = [window for window in draw_windows(two_rooms, 3, 0) if window.kind == "mixed"]
    others = shuffle_places(windows, 0)
    for window, other in zip(windows, others, strict=True):
        np.testing.assert_array_equal(window.trajectory[:, 2], other[:, 2])
        assert not np.array_equal(window.trajectory[:, :2], other[:, :2])


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_trains_measures_and_is_run(
    dataset: Path, two_rooms: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from functools import partial

    from wiw.training.pocket.held_out import evaluate

    def fail(*_: Any, **__: Any) -> None:
        raise FileError("the disk is full")

    out = tmp_path / "pocket.safetensors"
    options = [
        f"--option={pair}" for pair in ("frames=8", "places=2", "clips=8", "size=[16,32]", "widths=[8,32,32,32]")
    ]
    command = ["train", "pocket", "--data", str(dataset), "--out", str(out), "--cache", str(tmp_path / "cache")]
    command += ["--part", "all", *options]
    assert main([*command, "--val", two_rooms]) == 2 and not out.exists()
    assert "held-out scenes, got " + two_rooms in capsys.readouterr().err
    val = shutil.copy(two_rooms, tmp_path / "another.obj")
    monkeypatch.setattr("wiw.training.pocket.held_out.evaluate", fail)
    assert main([*command, "--val", str(val)]) == 2 and "held_out" not in Pocket(out).card
    monkeypatch.setattr("wiw.training.pocket.held_out.evaluate", partial(evaluate, count=2))
    with monkeypatch.context() as patch:
        patch.setattr(PocketTrainer, "train_step", None)  # what is trained is not trained again, but measured
        assert main([*command, "--val", str(val)]) == 0
    said = capsys.readouterr().out
    assert "2 steps of 4 clips" in said and "control gap" in said
    card = Pocket(out).card
    assert card["steps"] == 2 and set(card["held_out"]) == {"mixed", "straight"}
    assert set(card["held_out"]["mixed"]["psnr"]) == {"copy", "rolled", "one room", "pocket"}
    assert not list(tmp_path.glob("*.checkpoint"))
    with monkeypatch.context() as patch:
        patch.setattr(PocketTrainer, "train_step", None)
        patch.setattr("wiw.training.pocket.held_out.evaluate", None)
        assert main([*command, "--val", str(val)]) == 0 and "trained and measured before" in capsys.readouterr().out
        assert main([*command, "--val", str(val), "--seed", "1"]) == 2
    assert f"{out} has the weights of another training (of other recipe)" in capsys.readouterr().err
    assert Pocket(out).card == card and Path(f"{out}.log").exists()
    preset = tmp_path / "short.yaml"
    preset.write_text("base: paper\ndecisions: 2\n")
    command = ["run", "imagenav", "--scenes", two_rooms, "--preset", str(preset), "--episodes", "1", "--no-report"]
    command += ["--arms", f"pocket=pocket?weights={out}&size=[144, 256]", "--out", str(tmp_path / "run")]
    assert main([*command, "--cache", "off"]) == 0
    log = load_run(tmp_path / "run")
    assert [episode["status"] for episode in log.episodes] == ["done"] and len(log.decisions) == 2
    assert all(decision["calls"]["rows"] > 0 for decision in log.decisions)
    assert log.store.info["built"]["pocket"]["model"]["digest"] == Pocket(out).describe()["digest"]


def test_a_dataset_with_a_file_cut_short_is_refused_before_training(dataset: Path, tmp_path: Path) -> None:
    cut = shutil.copytree(dataset, tmp_path / "cut")
    path = next(cut.glob("data/*.parquet"))
    path.write_bytes(path.read_bytes()[:-9])
    out, recipe = tmp_path / "pocket.safetensors", PocketRecipe(frames=4, rate=1e-3)
    with pytest.raises(FileError, match=rf"{path.name}: expected \d+ bytes, as in meta.json"):
        train_on_clips("pocket", cut, out, tmp_path / "cache", recipe)
    assert not out.exists()


@pytest.mark.parametrize(("given", "seed"), [([], 5), (["--seed", "0"], 0), (["--seed", "3"], 3)])
def test_a_seed_replaces_that_of_the_recipe_file(
    given: list[str], seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[int] = []

    def note(*arguments: Any) -> None:
        found.append(arguments[5].seed)
        raise FileError("as far as the test goes")

    monkeypatch.setattr("wiw.cli.train.pocket.train_and_measure", note)
    (tmp_path / "mine.yaml").write_text("seed: 5\n")
    command = ["train", "pocket", "--data", str(tmp_path), "--out", str(tmp_path / "p")]
    assert main([*command, "--recipe", str(tmp_path / "mine.yaml"), *given]) == 2
    assert found == [seed]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "pocket trains on a dataset; give a folder of `wiw collect navigation` with --data"),
        (["--data", "nowhere"], "nowhere"),
        (["--data", "d", "--option", "lr=1"], "recipe: unknown name 'lr'"),
    ],
)
def test_what_it_cannot_use_is_refused(options: list[str], said: str, tmp_path: Path, capsys: Any) -> None:
    assert main(["train", "pocket", "--out", str(tmp_path / "p"), *options]) == 2
    assert said in capsys.readouterr().err


def test_scenes_to_measure_on_must_be_there(dataset: Path, tmp_path: Path, capsys: Any) -> None:
    command = ["train", "pocket", "--data", str(dataset), "--out", str(tmp_path / "p"), "--part", "all"]
    assert main([*command, "--val", "castle:1"]) == 2
    assert "castle:1" in capsys.readouterr().err


def test_validation_keeps_the_best_weights_and_changes_no_training(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clips = select_panoramas(NavigationData(dataset).clips(8), 3, 0, SIZE)
    checked = ValidationSet(clips, None, 1, {"made": "of what is trained on, for the test"})
    monkeypatch.setattr(
        "wiw.training.train_on_clips.find_held_out", lambda *_: NavigationCorpus(NavigationData(dataset), "all")
    )
    monkeypatch.setattr("wiw.training.train_on_clips.build_validation_set", lambda *_: checked)
    told: dict[int, float] = {}
    options = {"on_validation": lambda step, found: told.update({step: found["psnr"]})}
    out = tmp_path / "pocket.safetensors"
    card = train_on_clips("pocket", dataset, out, tmp_path, recipe(epochs=3), "all", **options)
    assert list(told) == [0, 1, 2, 3] and card["trained_steps"] == 3
    assert card["steps"] == max((1, 2, 3), key=told.__getitem__)
    assert card["validation"]["psnr"] == told[card["steps"]] and load(out)[1] == card
    log = [
        json.loads(line) for line in (tmp_path / "pocket.safetensors.log" / "metrics.jsonl").read_text().splitlines()
    ]
    assert [line["step"] for line in log if "loss" in line] == [1, 2, 3]
    assert (tmp_path / "pocket.safetensors.log" / "step-0000003.png").exists()

    monkeypatch.setattr("wiw.training.train_on_clips.find_held_out", lambda *_: None)
    plain = train_on_clips("pocket", dataset, tmp_path / "plain.safetensors", tmp_path, recipe(epochs=3), "all")
    assert plain["loss"] == card["loss"] and plain["steps"] == 3 and "validation" not in plain


def test_what_is_validated_are_the_averaged_weights_and_they_are_put_back(dataset: Path, tmp_path: Path) -> None:
    learner = trainer(dataset, tmp_path, ema=0.5)
    learner.train_step(1e-2)
    imagine = create_sampler(make_learner("pocket"), learner)
    before = {name: value.clone() for name, value in learner.trained.items()}
    image = np.random.default_rng(0).integers(0, 255, (1, *SIZE, 3)).astype(np.uint8)
    asked = Conditioning(image), np.ones((1, 7), np.int8), np.zeros(1, np.uint64), np.array([[7]])
    shown = imagine(*asked)
    assert all(torch.equal(value, before[name]) for name, value in learner.trained.items()) and learner.network.training
    with torch.no_grad():
        for name, value in learner.trained.items():
            value.copy_(learner.averages[name])
    np.testing.assert_array_equal(imagine_with(Pocket.of(learner.network))(*asked), shown)
