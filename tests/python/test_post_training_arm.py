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
from post_training_parts import SIZES, make_trainer, save_dataset, save_stock, tiny_recipe, with_nightly

from wiw.action import PoseGrid
from wiw.datasets.demonstrations import Demonstrations
from wiw.training.post_training.corpora import find_ends, open_corpus, spread_frames
from wiw.training.post_training.families import FAMILIES, VideoFamily, find_family
from wiw.training.post_training.train import post_train
from wiw.types import GRIPPER_POSES

pytestmark = pytest.mark.usefixtures("one_torch_thread")

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
    count = recipe.frames - 1
    still = np.zeros(count, np.int8), np.zeros((count, 3)), np.broadcast_to(np.eye(4), (count, 4, 4))
    control = Control(*still, ids=clip.actions, length=count)
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
    with pytest.raises(ArgumentError, match="nwm-action follows an agent that moves, but in this dataset a gripper"):
        post_train("nwm-action", demos, tmp_path / "out", recipe=tiny_recipe("nwm-action"), **options)
    mirrored = tiny_recipe("svd-action", mirror=0.5)
    with pytest.raises(ArgumentError, match="the mirror image of an arm is another arm"):
        post_train("svd-action", demos, tmp_path / "out", recipe=mirrored, **options)
    with pytest.raises(FileError, match=r"meta.json is missing"):
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
    with pytest.raises(ArgumentError, match="other data or options"):
        post_train(name, save_dataset(tmp_path / "data"), out, **options)
