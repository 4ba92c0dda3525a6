# SPDX-License-Identifier: Apache-2.0
"""Post-training on manipulation demonstrations: clips are plans as the loop puts them to a model."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw import action
from wiw.errors import ArgumentError, FileError
from wiw.types import Conditioning, Control

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")
pytest.importorskip("peft", reason="no peft: pip install 'wiw[diffusers]'")
pytest.importorskip("pyarrow", reason="no pyarrow: pip install 'wiw[export]'")

import torch
from post_training_parts import (
    SIZES,
    make_trainer,
    read_log,
    require_same_bytes_when_stopped_at_sample,
    require_sampling_unnoticed,
    save_dataset,
    save_stock,
    tiny_recipe,
    with_nightly,
)

from wiw.action import PoseGrid
from wiw.datasets.demonstrations import Demonstrations
from wiw.training.held_out_clips import measure_clips
from wiw.training.held_out_demonstrations import DemonstratedPlan, select_demonstrations
from wiw.training.post_training.corpora import find_ends, open_corpus, spread_frames
from wiw.training.post_training.families import FAMILIES, VideoFamily, find_family
from wiw.training.post_training.sampling import create_sampler
from wiw.training.post_training.train import post_train, write_checkpoint
from wiw.types import GRIPPER_POSES

pytestmark = pytest.mark.usefixtures("one_torch_thread", "fewer_denoising_steps")

NAMES = sorted(name for name, family in FAMILIES.items() if isinstance(family, VideoFamily))
SHAPES: dict[str, Any] = {name: {"size": SIZES.get(name, (32, 32))} for name in NAMES}


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("arm") / "demos"
    wiw.collect(folder, ["slide_block", "push_buttons"], episodes=2, size=64, frames=24, backend="cpu")
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory):
    return partial(save_stock, tmp_path_factory.mktemp("stock"))


def test_clips_are_plans_as_the_loop_puts_them_to_a_model(demos: Path) -> None:
    """All plans of each demonstration, its own poses where they end, the frames in which they are reached."""
    corpus, data = open_corpus(demos, "all"), Demonstrations(demos)
    assert corpus.space == GRIPPER_POSES and corpus.view == "perspective"
    clips = corpus.clips(13)
    counts = [int(each.ended.sum()) for each in data]
    assert len(clips) == sum(count * (count + 1) // 2 for count in counts)
    first = data[0]
    ends = find_ends(first.ended)
    for index, (start, stop) in enumerate([(a, b) for a in range(counts[0]) for b in range(a + 1, counts[0] + 1)]):
        clip, plan = clips[index], first.actions[ends[start + 1 : stop + 1]]
        asked = action.resample(plan, 12, start=first.poses[ends[start]])  # as wiw.loop.imagine_poses asks
        np.testing.assert_array_equal(clip.actions, [first.poses[ends[start]], *asked])
        np.testing.assert_array_equal(clip.actions[-1], plan[-1])
        np.testing.assert_array_equal(clip.images[0], first.images[ends[start]])
        np.testing.assert_array_equal(clip.images[-1], first.images[ends[stop]])
        shown = action.frames_of_actions(len(plan), 13, "resample")[:, 1]
        if 12 % len(plan) == 0:  # else the frame nearest to the pose is a little before or after
            np.testing.assert_array_equal(clip.images[shown], first.images[ends[start + 1 : stop + 1]])
    assert f"demonstration 0 of the dataset, actions 1 to {counts[0]}" in clips.describe(counts[0] - 1)


def test_frames_are_spread_evenly_over_actions_however_long() -> None:
    assert spread_frames(np.array([0, 4, 24]), 5).tolist() == [0, 2, 4, 14, 24]
    assert spread_frames(np.array([3, 9]), 3).tolist() == [3, 6, 9]
    assert find_ends(np.array([False, False, True, False, True])).tolist() == [0, 2, 4]


def test_parts_share_no_demonstration(demos: Path) -> None:
    whole, trained = (open_corpus(demos, part, held_out=0.5) for part in ("all", "train"))
    assert 0 < len(trained.clips(13)) < len(whole.clips(13))
    assert trained.describe()["part"] == "train" and trained.describe()["sha256"] == whole.describe()["sha256"]
    lighter = open_corpus(demos, "train", held_out=0.0)
    assert len(lighter.clips(13)) == len(whole.clips(13)) and lighter.describe() != trained.describe()
    with pytest.raises(ArgumentError, match="expected demonstrations with an action in the part 'train', got none"):
        open_corpus(demos, "train", held_out=1.0).clips(13)


@pytest.mark.parametrize("name", with_nightly(NAMES, ("svd-action", "ltx-action")))
def test_the_loss_falls_on_clips_learnt_by_heart_and_the_encoder_learns(name: str, demos: Path, weights: Any) -> None:
    steps = 6 if name in ("svd-action", "wan2.2-a14b-action") else 12
    trainer = make_trainer(name, demos, weights(name), epochs=steps, drop=0.0, checkpointing=False, **SHAPES[name])
    rows = np.tile(trainer.order.select(0), 4)

    def measure(place: str) -> float:
        with torch.no_grad():
            return float(trainer._compute_losses(place, rows, torch.Generator().manual_seed(9)).mean())

    before = {place: measure(place) for place in trainer.model.places}
    embeddings = {place: encoder.embed.weight.detach().clone() for place, encoder in trainer.model.encoders.items()}
    for _ in range(steps * trainer.steps_per_epoch):
        trainer.train_step(3e-3)
    for place in trainer.model.places:
        assert measure(place) < 0.95 * before[place], (place, before[place], measure(place))
        encoder = trainer.model.encoders[place]
        assert encoder.config.kind == "pose7" and not torch.equal(encoder.embed.weight, embeddings[place])


def test_dropped_clips_get_the_null_vector(demos: Path, weights: Any) -> None:
    name = "wan2.2-5b-action"
    trainer = make_trainer(name, demos, weights(name), drop=0.5, rows=4, epochs=6, **SHAPES[name])
    given: list[tuple[torch.Tensor, torch.Tensor]] = []
    encoder = trainer.model.encoders["transformer"]
    encoder.register_forward_pre_hook(lambda _, args: given.append(args))
    null = encoder.null.detach().clone()
    for _ in range(6):
        trainer.train_step(1e-2)
    assert 0.2 < float(torch.cat([dropped for _, dropped in given]).float().mean()) < 0.8
    assert all(poses.shape == (4, 5, 7) and poses.dtype == torch.float64 for poses, _ in given)
    assert not torch.equal(encoder.null, null)


@pytest.mark.parametrize("name", ["svd-action", "cosmos-predict2-action"])
def test_a_checkpoint_runs_on_poses(name: str, demos: Path, weights: Any, tmp_path: Path) -> None:
    """The two models that the paper trains on manipulation."""
    recipe = tiny_recipe(name, **SHAPES[name])
    out = tmp_path / "out"
    card = post_train(name, demos, out, weights=weights(name), device="cpu", recipe=recipe, part="all")
    config = json.loads((out / "config.json").read_text())
    assert config["kind"] == "pose7" and tuple(config["low"]) == PoseGrid.low and tuple(config["high"]) == PoseGrid.high
    options = {"guardrail": False} if name.startswith("cosmos") else {}
    assert card["run"]["task"] == "manipulation"
    model = wiw.world_model(name, checkpoint=str(out), device="cpu", steps=2, **card["run"]["options"], **options)
    assert model.accepts.space == GRIPPER_POSES and model.accepts.view == "perspective"
    clip = open_corpus(demos, "all").clips(recipe.frames)[0]
    control = Control.of_poses(recipe.frames - 1, ids=clip.actions)
    image = np.full((1, *recipe.size, 3), 90, np.uint8)
    frames = model.rollout(Conditioning(image), [control], np.zeros(1, np.uint64))
    assert frames.shape == (1, recipe.frames, *recipe.size, 3)


def test_sizes_are_those_of_the_paper(demos: Path) -> None:
    """448 x 448 for SVD, 480 x 480 for the others, unless the recipe says otherwise."""
    for name in NAMES:
        family, recipe = find_family(name), tiny_recipe(name, size=None)
        expected = (448, 448) if name == "svd-action" else (480, 480)
        corpus, fitted = family.fit(open_corpus(demos, "all"), recipe)
        assert fitted.size == expected and not family.list_options(corpus, fitted).get("size")


def test_corpora_that_do_not_fit_are_refused(demos: Path, weights: Any, tmp_path: Path) -> None:
    options: dict[str, Any] = {"device": "cpu", "part": "all"}
    with pytest.raises(ArgumentError, match="nwm-action follows a moving agent, but this dataset is of a gripper"):
        post_train("nwm-action", demos, tmp_path / "out", recipe=tiny_recipe("nwm-action"), **options)
    mirrored = tiny_recipe("svd-action", mirror=0.5)
    with pytest.raises(ArgumentError, match="the mirror image of a robot arm is a different arm"):
        post_train("svd-action", demos, tmp_path / "out", recipe=mirrored, **options)
    with pytest.raises(FileError, match=r"meta.json does not exist"):
        post_train("svd-action", tmp_path, tmp_path / "out", recipe=tiny_recipe("svd-action"), **options)


def test_a_state_of_another_corpus_is_refused(demos: Path, weights: Any, tmp_path: Path) -> None:
    name, out = "wan2.2-5b-action", tmp_path / "out"
    recipe = tiny_recipe(name, epochs=3, size=(32, 64))
    options: dict[str, Any] = {"weights": weights(name), "device": "cpu", "part": "all", "recipe": recipe}

    def stop(step: int, *_: Any) -> None:
        if step == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        post_train(name, demos, out, seconds=0, on_step=stop, **options)
    with pytest.raises(ArgumentError, match="different data or options"):
        post_train(name, save_dataset(tmp_path / "data"), out, **options)


# -- validation --------------------------------------------------------------------------------------------------------

ON = "wan2.2-5b-action"
"""The model whose training is validated here."""


@pytest.fixture
def train(demos: Path, weights: Any) -> Any:
    def train(out: Path, **options: Any) -> dict[str, Any]:
        split = {"held_out": 0.5, "validate_every": 2, "validate_clips": 2}
        recipe = tiny_recipe(ON, **{"epochs": 2, **SHAPES[ON], **split, **options.pop("numbers", {})})
        given = {"weights": weights(ON), "device": "cpu", "recipe": recipe, "seconds": 0, **options}
        return post_train(ON, demos, out, **given)

    return train


def make_plan(name: str, start: float, targets: list[float], frames: int = 5) -> DemonstratedPlan:
    """A gripper that moves along x, and pictures that are as bright as it is far."""
    poses = np.zeros((len(targets), 7))
    poses[:, 0] = targets
    shown = action.resample(poses, frames - 1, start=np.array([start, *[0.0] * 6]))[:, 0]
    bright = (200 * np.array([start, *shown])).astype(np.uint8)
    images = np.repeat(bright, 16 * 16 * 3).reshape(frames, 16, 16, 3)
    return DemonstratedPlan(name, images, np.array([start, *[0.0] * 6]), poses)


def imagine_brightness(observations: Any, plans: np.ndarray, seeds: Any, wanted: np.ndarray) -> np.ndarray:
    bright = (200 * np.take_along_axis(plans[..., 0], wanted, axis=1)).astype(np.uint8)
    return np.broadcast_to(bright[..., None, None, None], (*bright.shape, 16, 16, 3)).copy()


def test_who_follows_the_gripper_has_no_error_and_a_gap() -> None:
    plans = [make_plan("a", 0.2, [0.4, 0.8]), make_plan("b", 0.5, [0.1]), make_plan("c", 0.6, [0.7, 0.2, 0.3])]
    clips = select_demonstrations(plans, 8, 0, (16, 16))
    assert sorted(clips.scenes) == ["a", "b", "c"] and clips.steps == (1, 4)
    np.testing.assert_array_equal(clips.shuffled[:, 0], clips.plans[:, 0])  # other plans begin at one's own place
    assert sorted(clips.shuffled[:, -1, 0]) == sorted(clips.plans[:, -1, 0])
    assert (clips.shuffled[:, -1, 0] != clips.plans[:, -1, 0]).all()
    found = measure_clips(imagine_brightness, clips)[0].summarise()
    assert found["psnr"] == found["psnr/1"] == found["psnr/4"] == 100 and found["gap"] > 50
    assert set(found) == {"psnr", "psnr/1", "psnr/4", "ssim/1", "ssim/4", "gap"}
    still = measure_clips(lambda seen, *_: np.repeat(seen.image[:, None], 2, axis=1), clips)[0].summarise()
    assert still["psnr"] < 30 and still["gap"] == 0
    alone = select_demonstrations(plans[:1], 8, 0, (16, 16))
    assert alone.shuffled[0, -1, 0] == 0.4  # a single clip: its poses in reverse
    apart = measure_clips(imagine_brightness, alone)[0].apart
    assert apart.tolist() == [[True, True]]


@pytest.mark.parametrize("name", with_nightly(NAMES, (ON,)))
def test_training_does_not_notice_that_it_is_sampled_and_the_checkpoint_imagines_the_same(
    name: str, demos: Path, weights: Any, tmp_path: Path
) -> None:
    plain, sampled = (make_trainer(name, demos, weights(name), **SHAPES[name], epochs=4, rows=4) for _ in range(2))
    recipe, sampler = sampled.recipe, create_sampler(sampled)
    clips = sampled.model.select_clips(open_corpus(demos, "all"))
    asked = clips.observe(slice(0, 2)), clips.plans[:2], np.arange(2, dtype=np.uint64), np.array([[1, 2]] * 2)
    require_sampling_unnoticed(plain, sampled, lambda: sampler(*asked))
    write_checkpoint(tmp_path / "out", sampled, {})
    options = {"guardrail": False} if name.startswith("cosmos") else {}
    options |= {"size": recipe.size, "frames": recipe.frames}
    model = wiw.world_model(name, checkpoint=str(tmp_path / "out"), device="cpu", **options)
    controls = [Control.of_poses(recipe.frames - 1, ids=plan) for plan in asked[1]]
    frames = np.concatenate(
        [model.rollout(asked[0].rows([row]), controls[row : row + 1], asked[2][row : row + 1]) for row in range(2)]
    )
    np.testing.assert_array_equal(sampler(*asked), frames[:, 1:3])


def test_validation_is_on_held_out_demonstrations(train: Any, demos: Path, tmp_path: Path) -> None:
    told: dict[int, float] = {}
    card = train(tmp_path / "out", on_validation=lambda step, found: told.update({step: found["psnr"]}))
    assert list(told) == [0, 2] and card["steps"] == 2
    held_out, trained = (open_corpus(demos, part, 0.5).units for part in ("held-out", "train"))
    assert set(card["validated_on"]["demonstrations"]) <= held_out and not held_out & trained
    assert held_out | trained == open_corpus(demos, "all").units and len(trained | held_out) == 4
    names = {"psnr", "psnr/1", "psnr/4", "ssim/1", "ssim/4", "gap"}
    assert set(card["validation"]) == names and all(np.isfinite(value) for value in card["validation"].values())
    assert {line["step"]: line["validation/psnr"] for line in read_log(tmp_path / "out") if "loss" not in line} == told
    assert (tmp_path / "out.log" / "step-0000002.png").exists()


def test_validation_on_what_is_trained_on_or_of_another_kind_is_refused(
    train: Any, demos: Path, tmp_path: Path
) -> None:
    with pytest.raises(ArgumentError, match="expected demonstrations that are not trained on, got push_buttons"):
        train(tmp_path / "same", part="all", validation=demos)
    with pytest.raises(ArgumentError, match=r"`wiw collect manipulation`, .* is from `wiw collect navigation`"):
        train(tmp_path / "moves", validation=save_dataset(tmp_path / "data"))
    with pytest.raises(ArgumentError, match="decisions: those of `wiw collect decisions` are for a moving agent"):
        train(tmp_path / "decisions", decisions=tmp_path / "d.parquet")
    with pytest.raises(ArgumentError, match=r"no demonstration of .* is held out; collect more demonstrations"):
        train(tmp_path / "none", numbers={"held_out": 0.0})


@pytest.mark.nightly
def test_a_training_that_is_stopped_while_it_validates_ends_with_the_same_bytes(
    train: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    longer = partial(train, numbers={"epochs": 3})
    require_same_bytes_when_stopped_at_sample(3, 2, longer, tmp_path, monkeypatch)
