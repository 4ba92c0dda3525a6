# SPDX-License-Identifier: Apache-2.0
"""warpnet's training: what pairs are, that lessons can be repeated, and that a short one is worth something."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from wiw.cli.app import main
from wiw.datasets.navigation import NavigationData, read_meta
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, FileError
from wiw.training.collect_navigation import collect_navigation

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.training.checkpoint import Checkpoint  # noqa: E402
from wiw.training.held_out_panoramas import select_panoramas  # noqa: E402
from wiw.training.post_training.corpora import NavigationCorpus  # noqa: E402
from wiw.training.post_training.recipe import load_recipe  # noqa: E402
from wiw.training.post_training.validation import ValidationSet  # noqa: E402
from wiw.training.train_on_clips import train_on_clips  # noqa: E402
from wiw.training.walks import WalkRules, Walks, find_straight_paths, merge_walks, record_walks  # noqa: E402
from wiw.training.warpnet import Recipe, evaluate, sample_pairs, train  # noqa: E402
from wiw.training.warpnet_clips import WarpNetClipRecipe, WarpNetClipTrainer  # noqa: E402
from wiw.world_models.warpnet.model import WarpNet  # noqa: E402
from wiw.world_models.warpnet.network import Network, warp  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.fixture(scope="module")
def walks(two_rooms: str) -> Walks:
    return record_walks(world(two_rooms), 0, WalkRules(places=10, stops=3, height=24))


def test_walks_are_straight_and_free(two_rooms: str, walks: Walks) -> None:
    here = world(two_rooms)
    ways = find_straight_paths(here, 30, 5, 0.6, 2.4)
    assert len(ways) == 30
    for way in ways:
        assert 0.6 <= way.length + 1e-9 <= 2.4 + 2e-9
        poses = way.camera_poses(here, np.linspace(0, way.length, 9))
        assert here.navmesh.is_navigable(poses[:, :3, 3] - [0, 1, 0]).all()
        np.testing.assert_allclose(np.diff(poses[:, :3, 3], axis=0) @ -poses[0, :3, 2], way.length / 8, atol=1e-6)
    assert walks.images.shape == (10, 3, 24, 48, 3)
    assert (np.diff(walks.places, axis=1) >= 0).all()
    assert (walks.places[:, 0] == 0).all()
    again = record_walks(here, 0, WalkRules(places=10, stops=3, height=24))
    np.testing.assert_array_equal(again.images, walks.images)
    np.testing.assert_array_equal(again.distances, walks.distances)
    both = merge_walks([walks, again])
    assert len(both) == 20
    with pytest.raises(ArgumentError, match="walk straight"):
        merge_walks([])


def test_a_pair_is_a_way_ahead(walks: Walks) -> None:
    """Whichever way and however mirrored: with the true distances the source warped is the target."""
    pairs = sample_pairs(walks, 64, np.random.default_rng(0))
    assert (pairs.ahead >= 0).all() and pairs.ahead.max() > 0.5
    made = warp(pairs.source, pairs.log_distance, pairs.ahead)
    far = pairs.ahead > 0.2
    error = (made - pairs.target).abs().mean(dim=(1, 2, 3))[far]
    still = (pairs.source - pairs.target).abs().mean(dim=(1, 2, 3))[far]
    assert (error < still).float().mean() > 0.85
    assert error.mean() < 0.6 * still.mean()


def test_the_same_lesson_gives_the_same_network_stopped_or_not(walks: Walks, tmp_path: Path) -> None:
    once, again, other = (
        train(walks, Recipe(epochs=1, batch=10, widths=(4, 4, 4), seed=seed))[0].state_dict() for seed in (1, 1, 2)
    )
    assert all(torch.equal(once[name], again[name]) for name in once)
    assert not torch.equal(once["distance.last.weight"], other["distance.last.weight"])
    checkpoint = Checkpoint(tmp_path / "kept", {}, seconds=0)

    def cut(step: int, steps: int, loss: float) -> None:
        if step == 2:
            raise KeyboardInterrupt

    recipe = Recipe(epochs=2, batch=10, widths=(4, 4, 4), seed=1)
    whole = train(walks, recipe)[0].state_dict()
    with pytest.raises(KeyboardInterrupt):
        train(walks, recipe, on_step=cut, checkpoint=checkpoint)
    assert checkpoint.load().step == 1
    resumed = train(walks, recipe, checkpoint=checkpoint)[0].state_dict()
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
    hurried = train(walks, Recipe(epochs=500, batch=10, widths=(4, 4, 4)), minutes=0.5 / 60)[1]
    assert 1 <= hurried.epochs < 500
    with pytest.raises(ArgumentError, match="epochs"):
        Recipe(epochs=0)


def test_training_makes_it_better_than_a_plain_room(two_rooms: str, walks: Walks) -> None:
    """In the same rooms, on other ways."""
    others = record_walks(world(two_rooms), 1, WalkRules(places=10, stops=3, height=24))
    pairs = sample_pairs(others, 64, np.random.default_rng(0))
    network, _ = train(walks, Recipe(epochs=30, widths=(8, 16, 16)))
    with torch.inference_mode():
        trained, untrained = (
            (each(pairs.source, pairs.ahead).colours - pairs.target).abs().mean()
            for each in (network, Network(24, (8, 16, 16)))
        )
    assert trained < 0.95 * untrained


def test_the_command_makes_a_model_that_beats_the_floor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wiw.training.warpnet.Recipe", partial(Recipe, widths=(8, 16, 16)))
    monkeypatch.setattr("wiw.training.warpnet.evaluate", partial(evaluate, paths=1))
    out, cache = tmp_path / "weights.safetensors", tmp_path / "looks"
    command = ["train", "warpnet", "--scenes", "apartments:train:1", "--val", "apartments:val:1", "--places", "20"]
    options = ["--out", str(out), "--cache", str(cache), "--workers", "1"]
    assert main([*command, *options, "--epochs", "3"]) == 0
    assert "steps of 0.2 m ahead" in capsys.readouterr().out
    model = WarpNet(out)
    psnr = model.card["held_out"]["psnr"]
    assert psnr["warpnet"]["3"] > psnr["copy"]["3"] + 2
    assert psnr["warp"]["3"] > psnr["warpnet"]["3"]
    assert model.card["scenes"] == "apartments:train:1"
    assert model.card["recipe"]["epochs"] == 3
    assert [file.suffix for file in cache.iterdir()] == [".npz"]

    before = {file: file.stat().st_mtime_ns for file in cache.iterdir()}
    assert main([*command, *options, "--epochs", "1"]) == 2
    assert f"{out} exists, and there is no checkpoint" in capsys.readouterr().err
    options[1] = str(tmp_path / "others.safetensors")
    assert main([*command, *options, "--epochs", "1"]) == 0
    assert before == {file: file.stat().st_mtime_ns for file in cache.iterdir()}


def test_scenes_without_room_ahead_are_told(two_rooms: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wiw.training.warpnet.find_straight_paths", lambda *_: [])
    model = WarpNet.of(Network(8, (4, 4, 4)))
    with pytest.raises(ArgumentError, match=r"nowhere is 1\.6 m of free floor ahead"):
        evaluate(model, two_rooms, 0)


# -- on a dataset ------------------------------------------------------------------------------------------------------

SMALL = ("size=[24,48]", "widths=[4,4,4]", "frames=8", "clips=8", "precision=float32")


@pytest.fixture(scope="module", params=[True, False], ids=["depth", "no depth"])
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, two_rooms: str) -> Path:
    rules = {"min_samples": 60, "spacing": 1.5, "leaf_ratio": 0.5}
    folder, options = tmp_path_factory.mktemp("navigation"), {"size": (64, 128), "seed": 3, "backend": "cpu"}
    collect_navigation(folder, two_rooms, rules=rules, depth=request.param, **options)
    return folder


def test_it_trains_on_a_dataset_and_resumes(
    dataset: Path, tmp_path: Path, two_rooms: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    val = shutil.copy(two_rooms, tmp_path / "another.obj")
    monkeypatch.setattr("wiw.training.warpnet.evaluate", partial(evaluate, paths=1))

    numbers = tmp_path / "numbers.yaml"
    numbers.write_text("".join(f"{number.replace('=', ': ')}\n" for number in SMALL))

    def run(out: Path) -> int:
        command = ["train", "warpnet", "--data", str(dataset), "--part", "all", "--val", str(val), "--out", str(out)]
        command += ["--cache", str(tmp_path / "cache"), "--epochs", "4"]
        return main([*command, "--recipe", str(numbers)])

    if read_meta(dataset)["depth"] is None:
        assert run(tmp_path / "blind") == 2
        assert "warpnet learns distances, but the dataset has no depth" in " ".join(capsys.readouterr().err.split())
        assert not (tmp_path / "cache").exists(), "frames were decoded first"
        return
    assert run(tmp_path / "whole") == 0
    assert "8 steps of 4 clips" in capsys.readouterr().out
    with monkeypatch.context() as patch, pytest.raises(FileError, match="damaged"):
        patch.setattr(WarpNetClipTrainer, "compute_losses", fail_at(5))
        train_on_clips("warpnet", dataset, tmp_path / "parts", tmp_path / "cache", clip_recipe(), "all")
    assert torch.load(tmp_path / "parts.checkpoint", weights_only=True)["step"] == 5
    assert run(tmp_path / "parts") == 0
    whole, parts = WarpNet(tmp_path / "whole"), WarpNet(tmp_path / "parts")
    assert whole.describe()["digest"] == parts.describe()["digest"]
    assert whole.card["steps"] == 8 and set(whole.card["held_out"]["psnr"]) == {"copy", "warpnet", "warp"}


@pytest.mark.parametrize("dataset", [True], indirect=True, ids=["depth"])
def test_the_best_weights_in_validation_are_kept(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = NavigationData(dataset)
    checked = ValidationSet(select_panoramas(data.clips(8), 3, 0, (24, 48)), None, 1, {"made": "for the test"})
    monkeypatch.setattr("wiw.training.train_on_clips.find_held_out", lambda *_: NavigationCorpus(data, "all"))
    monkeypatch.setattr("wiw.training.train_on_clips.build_validation_set", lambda *_: checked)
    told: dict[int, Mapping[str, Any]] = {}
    out, options = tmp_path / "warpnet.safetensors", {"on_validation": lambda step, found: told.update({step: found})}
    recipe = replace(clip_recipe(), validate_every=1)
    card = train_on_clips("warpnet", dataset, out, tmp_path / "cache", recipe, "all", **options)
    assert list(told) == list(range(9)) and len({found["psnr"] for found in told.values()}) == 9
    assert card["steps"] == max(range(1, 9), key=lambda step: told[step]["psnr"])
    assert WarpNet(out).card == card and card["validation"]["psnr"] == told[card["steps"]]["psnr"]


def test_a_shift_of_noise_levels_is_refused_as_there_are_none() -> None:
    with pytest.raises(ArgumentError, match="shift: warpnet has no noise levels; leave it out, got 3"):
        replace(clip_recipe(), shift=3.0)


def clip_recipe() -> WarpNetClipRecipe:
    options = dict(each.split("=") for each in SMALL)
    return load_recipe(
        "warpnet", options={**{k: yaml.safe_load(v) for k, v in options.items()}, "epochs": 4}, kind=WarpNetClipRecipe
    )


def fail_at(step: int) -> Any:
    stock = WarpNetClipTrainer.compute_losses

    def compute_losses(self: WarpNetClipTrainer, *given: Any) -> Any:
        if self.step_count == step:
            raise FileError("frames.parquet: damaged")
        return stock(self, *given)

    return compute_losses


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--option", "clips=4"], "--option has no effect on a training on walks; they go with --data"),
        (["--validation", "other"], "--validation has no effect on a training on walks"),
        (["--recipe", "r.yaml"], "--recipe has no effect on a training on walks"),
        (["--tracker", "wandb"], "--tracker has no effect on a training on walks"),
        (["--decisions", "made"], "--decisions has no effect on a training on walks"),
        (["--data", "d", "--places", "3"], "--places has no effect on a training on --data"),
        (["--data", "d", "--minutes", "3"], "--minutes has no effect on a training on --data"),
        (["--data", "d", "--workers", "3"], "--workers has no effect on a training on --data"),
        (["--data", "d", "--scenes", "apartments:train:2"], "--scenes has no effect on a training on --data"),
        (["--data", "nowhere"], "nowhere"),
    ],
)
def test_options_of_the_other_source_are_refused(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "warpnet", "--out", str(tmp_path / "w"), *options]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
