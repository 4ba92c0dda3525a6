# SPDX-License-Identifier: Apache-2.0
"""Post-training of NWM: its loss against formulas, and the same inputs in training as in the loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from wiw import action
from wiw._core import planner
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError
from wiw.types import Conditioning, Control, History

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")
pytest.importorskip("pyarrow", reason="no pyarrow: pip install 'wiw[export]'")

import torch
from post_training_parts import (
    make_trainer,
    read_log,
    require_same_bytes_when_stopped_at_sample,
    require_sampling_unnoticed,
    save_dataset,
    save_stock,
    tiny_recipe,
)

from wiw.datasets.decisions import Decisions, save_decisions
from wiw.training.decision_errors import measure_decisions
from wiw.training.held_out_clips import imagine_with, measure_clips
from wiw.training.held_out_front_views import FrontView, FrontViewClips
from wiw.training.held_out_panoramas import turn_panoramas
from wiw.training.post_training.clips import load_clips, mirror_clip
from wiw.training.post_training.corpora import Clip, cut_front_views, open_corpus
from wiw.training.post_training.families import find_family
from wiw.training.post_training.nwm import VariationalDiffusion, measure_likelihood
from wiw.training.post_training.sampling import create_sampler
from wiw.training.post_training.train import post_train, write_checkpoint
from wiw.world_models.nwm.diffusion import sample
from wiw.world_models.nwm.images import rows_seen, to_network
from wiw.world_models.nwm.model import NWM

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_dataset(tmp_path_factory.mktemp("post") / "data")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_stock(tmp_path_factory.mktemp("stock"), "nwm-action")


def test_the_loss_is_its_formula() -> None:
    """Squared error of the noise, and the variational bound in bits a dimension, row by row in NumPy."""
    latents = 0.5 * torch.randn(3000, 2, 2, 2, generator=torch.Generator().manual_seed(0))
    given: dict[str, np.ndarray] = {}

    def predict(noisy: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        output = torch.cat([0.9 * noisy, torch.tanh(2 * noisy)], dim=1)
        given.update(noisy=noisy.numpy(), times=times.numpy(), output=output.numpy())
        return output

    losses = VariationalDiffusion().compute_losses(predict, latents, torch.Generator().manual_seed(3)).numpy()
    beta = np.linspace(1e-4, 0.02, 1000)
    kept = np.cumprod(1 - beta)
    first = np.flatnonzero(given["times"] == 0)
    assert len(first)
    for row in [*first, *range(300)]:
        t = given["times"][row]
        x, noisy = latents[row].numpy().astype(float), given["noisy"][row].astype(float)
        epsilon, share = np.split(given["output"][row].astype(float), 2)
        noise = (noisy - np.sqrt(kept[t]) * x) / np.sqrt(1 - kept[t])
        before = kept[t - 1] if t else 1.0
        variance = max(beta[t] * (1 - before) / (1 - kept[t]), beta[1] * (1 - kept[0]) / (1 - kept[1]))
        log = np.log(variance) + (share + 1) / 2 * (np.log(beta[t]) - np.log(variance))
        guess = (noisy - np.sqrt(1 - kept[t]) * epsilon) / np.sqrt(kept[t])
        means = [
            np.sqrt(before) * beta[t] / (1 - kept[t]) * each
            + np.sqrt(1 - beta[t]) * (1 - before) / (1 - kept[t]) * noisy
            for each in (x, guess)
        ]
        if t:
            ratio = variance / np.exp(log)
            nats = 0.5 * (ratio - 1 - np.log(ratio) + (means[0] - means[1]) ** 2 / np.exp(log))
        else:
            deviation = np.exp(log / 2)
            upper = np.where(x > 0.999, 1, norm.cdf((x + 1 / 255 - means[1]) / deviation))
            lower = np.where(x < -0.999, 0, norm.cdf((x - 1 / 255 - means[1]) / deviation))
            nats = -np.log(np.maximum(upper - lower, 1e-12))
        expected = ((noise - epsilon) ** 2).mean() + nats.mean() / np.log(2)
        assert losses[row] == pytest.approx(expected, rel=2e-2 if t < 2 else 2e-3, abs=2e-4), (row, t)


def test_the_bins_of_the_likelihood_make_up_all_mass() -> None:
    values = torch.linspace(-1, 1, 256)[None]
    mass = measure_likelihood(values, torch.full_like(values, 0.3), torch.full_like(values, -1.0)).exp()
    assert float(mass.sum()) == pytest.approx(1, abs=1e-5)


def test_the_likelihood_of_what_is_not_finite_is_not_finite() -> None:
    """The trainer then says which batch it was."""
    values, mean = torch.zeros(1, 2), torch.tensor([[0.0, torch.nan]])
    assert torch.isfinite(measure_likelihood(values, mean, torch.zeros(1, 2))).tolist() == [[True, False]]


def test_no_gradient_of_the_bound_reaches_the_noise() -> None:
    noise = torch.zeros(4, 2, 3, 3, requires_grad=True)
    shares = torch.zeros(4, 2, 3, 3, requires_grad=True)
    latents = torch.randn(4, 2, 3, 3, generator=torch.Generator().manual_seed(0))
    loss = VariationalDiffusion().compute_losses(
        lambda *_: torch.cat([noise, shares], dim=1), latents, torch.Generator().manual_seed(1)
    )
    loss.sum().backward()
    draws = torch.Generator().manual_seed(1)
    torch.randint(0, 1000, (4,), generator=draws)
    error = -2 * torch.randn(latents.shape, generator=draws) / noise[0].numel()  # of the squared error alone
    torch.testing.assert_close(noise.grad, error)
    assert shares.grad is not None and shares.grad.abs().max() > 0


def test_what_has_no_loss_in_training_generates_the_frame() -> None:
    clean = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0)).clamp(-1, 1)
    diffusion = VariationalDiffusion()

    def predict(noisy: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        kept = diffusion._kept[times.long()].float()[:, None, None, None]
        noise = (noisy - kept.sqrt() * clean) / (1 - kept).sqrt()
        return torch.cat([noise, torch.full_like(noise, -1)], dim=1)

    losses = torch.stack(
        [diffusion.compute_losses(predict, clean, torch.Generator().manual_seed(seed)) for seed in range(50)]
    )
    assert losses.abs().max() < 1e-3
    generators = [torch.Generator().manual_seed(seed) for seed in range(2)]
    made = sample(predict, clean.shape, generators, 10, torch.device("cpu"))
    torch.testing.assert_close(made, clean, rtol=0, atol=1e-3)


@pytest.mark.parametrize("still", [False, True])
def test_the_network_is_called_as_the_world_model_calls_it(data: Path, weights: Path, still: bool) -> None:
    """Same context, motion and time shift, also for the first decision, where nothing was seen before."""
    trainer = make_trainer("nwm-action", data, weights, frames=5, size=(480, 480), still=0.999 if still else 0.0)
    trained = _record(
        trainer.model.network,
        lambda: trainer._compute_losses("cdit", np.array([3]), torch.Generator().manual_seed(0)),
    )
    clip = trainer.clips[3]
    model = NWM(weights=str(weights), steps=2, device="cpu")
    plan = clip.actions[4:5]
    control = Control(plan, action.to_trajectory(plan), action.to_viewpoints(plan), length=1)
    history = History(
        images=clip.images[None, :4],
        poses=np.zeros((1, 4, 3)),
        actions=clip.actions[None, 1:4, None],
        lengths=np.ones((1, 3), np.int64),
        count=np.array([4]),
    )
    observation = Conditioning(clip.images[3:4], history=None if still else history)
    inferred = _record(model._network, lambda: model.rollout(observation, [control], np.zeros(1, np.uint64)))
    for name, ours, theirs in zip(("motion", "context", "shift"), trained[2:], inferred[2:], strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-6, msg=name)
    assert trained[0].shape == inferred[0].shape


def _record(network: Any, call: Any) -> tuple[torch.Tensor, ...]:
    """The arguments of a network's first call."""
    calls: list[tuple[torch.Tensor, ...]] = []
    handle = network.register_forward_pre_hook(lambda _, args: calls.append(args))
    call()
    handle.remove()
    return calls[0]


def test_frames_further_ahead_come_with_their_motion_and_time(data: Path, weights: Path) -> None:
    trainer = make_trainer("nwm-action", data, weights, frames=8, rows=4)
    actions = torch.tensor([[0, 1, 1, 1, 2, 1, 3, 1]])
    left, ahead = np.radians(22.5), 0.2 * np.cos(np.radians(22.5))
    found = trainer.model.measure_motions(actions.repeat(3, 1), torch.tensor([1, 2, 4])).numpy()
    across = 0.2 * np.sin(left)
    moved = np.array([[0, 0, left], [ahead, across, left], [ahead + 0.2, across, 0]])
    mapped = 2 * (moved[:, :2] / 0.25 - [-2.5, -4]) / [7.5, 8] - 1
    np.testing.assert_allclose(found, np.concatenate([mapped, moved[:, 2:]], axis=1), atol=1e-6)
    shifts = []
    trainer.model.network.register_forward_pre_hook(lambda _, args: shifts.extend((128 * args[4]).tolist()))
    for _ in range(4):
        trainer.train_step(1e-4)
    assert set(np.rint(shifts)) == {1, 2, 3, 4}


def test_front_views_are_those_that_the_loop_shows(data: Path) -> None:
    corpus = open_corpus(data, "all")
    panoramas, views = corpus.clips(3)[5], corpus.show_front((96, 96)).clips(3)[5]
    ahead = planner.Batch.build([[np.array([FORWARD], np.int8)]] * 3)
    shown = ahead.observations(panoramas.images, planner.ViewMaker("front", (96, 96)))
    np.testing.assert_array_equal(views.images, shown)
    np.testing.assert_array_equal(views.actions, panoramas.actions)


def test_a_dataset_of_front_views_is_taken_as_it_is(tmp_path: Path, weights: Path) -> None:
    front = save_dataset(tmp_path / "front", projection="perspective")
    trainer = make_trainer("nwm-action", front, weights)
    assert trainer.clips[0].images.shape == (6, 64, 128, 3) and np.isfinite(trainer.train_step(1e-4))


def test_a_mirrored_clip_turns_the_other_way(data: Path, weights: Path) -> None:
    """What the network sees of a mirrored clip is the mirror image of what it sees of the clip."""
    trainer = make_trainer("nwm-action", data, weights)
    clip = trainer.clips[1]
    clip = Clip(clip.images, np.array([0, FORWARD, TURN_LEFT, TURN_RIGHT, TURN_LEFT, FORWARD], np.int8))
    mirrored = mirror_clip(clip)
    assert mirrored.actions.tolist() == [0, FORWARD, TURN_RIGHT, TURN_LEFT, TURN_RIGHT, FORWARD]
    frames, other = (load_clips([each], (48, 48)).frames for each in (clip, mirrored))
    torch.testing.assert_close(other, frames.flip(3))
    motions = [
        trainer.model.measure_motions(torch.from_numpy(each.actions[None].astype(int)), torch.tensor([2]))
        for each in (clip, mirrored)
    ]
    torch.testing.assert_close(motions[1], motions[0] * torch.tensor([1, -1, -1]))


@pytest.mark.parametrize(
    ("options", "said"),
    [({"frames": 4}, "frames: expected over 4"), ({"drop": 0.1}, "no null action"), ({"lora": 8}, "has no LoRA")],
)
def test_recipes_that_nwm_cannot_have_are_refused(
    options: dict[str, Any], said: str, data: Path, weights: Path
) -> None:
    with pytest.raises(ArgumentError, match=said):
        make_trainer("nwm-action", data, weights, **options)


# -- validation --------------------------------------------------------------------------------------------------------


@pytest.fixture
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two steps of diffusion in place of 250."""
    monkeypatch.setattr(NWM, "steps", 2)


@pytest.fixture
def train(data: Path, weights: Path, few_steps: None) -> Any:
    def train(out: Path, **options: Any) -> dict[str, Any]:
        split = {"held_out": 0.76, "validate_every": 2, "validate_clips": 3}  # leaves "house" for training
        recipe = tiny_recipe("nwm-action", **{"epochs": 3, **split, **options.pop("numbers", {})})
        return post_train("nwm-action", data, out, weights=weights, device="cpu", recipe=recipe, seconds=0, **options)

    return train


def select_clips(trainer: Any, data: Path) -> FrontViewClips:
    corpus, _ = find_family("nwm-action").fit(open_corpus(data, "all"), trainer.recipe)
    return trainer.model.select_clips(corpus)


def test_clips_have_a_context_and_what_the_network_sees_of_the_front_view(
    data: Path, weights: Path, few_steps: None
) -> None:
    trainer = make_trainer("nwm-action", data, weights, validate_clips=60)
    clips = select_clips(trainer, data)
    assert clips.steps == (1, 4, 8) and clips.frames.shape[1:] == (4, 36, 48, 3)
    whole = open_corpus(data, "all").clips(12)  # the segments have 12 frames: 4 of context, and 8 actions
    assert len(clips) == len(whole) == 3
    for row, plan in enumerate(clips.plans):
        clip = next(each for each in whole if np.array_equal(each.actions[4:], plan))
        views = cut_front_views(clip.images, (48, 48))[:, rows_seen(48, 48)]
        np.testing.assert_array_equal(clips.frames[row], views[[3, 4, 7, 11]])
        history = clips.observe(slice(row, row + 1)).history
        np.testing.assert_array_equal(history.images[0], views[:4])
        np.testing.assert_array_equal(history.actions[0, :, 0], clip.actions[1:4])
        np.testing.assert_array_equal(history.lengths, [[1, 1, 1]])
        np.testing.assert_allclose(
            action.to_trajectory(clip.actions[1:4])[-1, :2], _invert(history.poses[0, 0]), atol=1e-12
        )
        full = cut_front_views(clip.images[:2], (48, 48))
        torch.testing.assert_close(to_network(views[:2], 16), to_network(full, 16), rtol=0, atol=0)


def _invert(pose: np.ndarray) -> np.ndarray:
    """The place of the last frame in the frame of one whose pose in the last frame is given."""
    x, y, azimuth = pose
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    return np.array([-cos * x - sin * y, sin * x - cos * y])


def test_frames_that_turns_lead_to_count_and_others_that_lead_elsewhere_make_the_gap() -> None:
    view = FrontView((48, 48), rows_seen(48, 48))
    plans = np.array([[TURN_LEFT, TURN_RIGHT], [FORWARD, FORWARD], [TURN_LEFT, TURN_LEFT]], np.int8)
    frames = np.random.default_rng(0).integers(0, 255, (3, 3, 36, 48, 3)).astype(np.uint8)
    context = np.repeat(frames[:, :1], 4, axis=1)
    others = plans[[2, 0, 1]]
    clips = FrontViewClips(("a",) * 3, frames, plans, others, (1, 2), view, context, np.zeros((3, 3), np.int8))
    truth = {tuple(plan): shown for plan, shown in zip(plans, frames, strict=True)}
    errors, _ = measure_clips(lambda _, asked, *__: np.stack([truth[tuple(plan)][1:] for plan in asked]), clips)
    assert errors.counted.tolist() == [[True, False], [True, True], [True, True]]
    assert errors.apart.tolist() == [[False, False], [True, True], [True, True]]
    found = errors.summarise()
    assert found["psnr"] == found["psnr/2"] == 100 and found["ssim/1"] == pytest.approx(1) and found["gap"] > 80
    assert set(found) == {"psnr", "psnr/1", "psnr/2", "ssim/1", "ssim/2", "gap"}


def test_training_does_not_notice_that_it_is_sampled(data: Path, weights: Path, few_steps: None) -> None:
    plain, sampled = (make_trainer("nwm-action", data, weights, epochs=4, rows=4, ema=0.5) for _ in range(2))
    clips, sampler = select_clips(sampled, data), create_sampler(sampled)
    require_sampling_unnoticed(plain, sampled, lambda: measure_clips(sampler, clips))
    assert all(torch.equal(value, sampled.averages[name]) for name, value in plain.averages.items())


def test_what_is_sampled_in_training_is_what_the_checkpoint_imagines(
    data: Path, weights: Path, tmp_path: Path, few_steps: None
) -> None:
    trainer = make_trainer("nwm-action", data, weights)
    trainer.train_step(1e-2)
    write_checkpoint(tmp_path / "out", trainer, {})
    clips = select_clips(trainer, data)
    asked = clips.observe(slice(0, 2)), clips.plans[:2], np.arange(2, dtype=np.uint64), np.array([[1, 4], [2, 3]])
    shown = create_sampler(trainer)(*asked)
    np.testing.assert_array_equal(
        shown, imagine_with(NWM(weights=str(tmp_path / "out"), steps=2, device="cpu"))(*asked)
    )
    alone = create_sampler(trainer)(Conditioning(asked[0].image), *asked[1:])
    assert not np.array_equal(shown, alone)  # the context is looked at


def test_validation_is_on_front_views_of_held_out_scenes(train: Any, data: Path, tmp_path: Path) -> None:
    told: dict[int, float] = {}
    card = train(tmp_path / "out", on_validation=lambda step, found: told.update({step: found["psnr"]}))
    assert list(told) == [0, 2, 3] and card["steps"] == max((2, 3), key=told.__getitem__)
    assert card["validated_on"]["scenes"] == ["flat", "loft"]
    names = {"psnr", "psnr/1", "psnr/4", "psnr/8", "ssim/1", "ssim/4", "ssim/8", "gap"}
    assert set(card["validation"]) == names and all(np.isfinite(value) for value in card["validation"].values())
    assert {line["step"]: line["validation/psnr"] for line in read_log(tmp_path / "out") if "loss" not in line} == told
    assert (tmp_path / "out.log" / "step-0000003.png").exists()
    with pytest.raises(ArgumentError, match="scenes that are not trained on, got flat, house, loft"):
        train(tmp_path / "same", part="all", validation=data)


def test_a_training_that_is_stopped_while_it_validates_ends_with_the_same_bytes(
    train: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    require_same_bytes_when_stopped_at_sample(3, 2, train, tmp_path, monkeypatch)


def test_rank_agreement_is_measured_on_front_views_of_stored_decisions(train: Any, tmp_path: Path) -> None:
    """Who imagines what is truly seen ahead chooses as the oracle does, which sees no more than that."""
    rng = np.random.default_rng(0)
    seen = rng.integers(0, 255, (2, 5, 32, 64, 3)).astype(np.uint8)
    plans = np.array([[[1, 1, 0], [2, 1, 1], [3, 1, 0]]] * 2, np.int8)
    stored = Decisions(("a", "b"), seen[:, 0], seen[:, 1], plans, seen[:, 2:], rng.random((2, 3)))
    view = FrontView((48, 48), rows_seen(48, 48))

    def imagine_truth(observations: Conditioning, asked: np.ndarray, *_: Any) -> np.ndarray:
        starts = [cut_front_views(image[None], (48, 48))[0, rows_seen(48, 48)] for image in stored.images]
        index = next(i for i, start in enumerate(starts) if np.array_equal(start, observations.image[0]))
        turned = turn_panoramas(stored.futures[index], action.to_trajectory(asked)[:, -1, 2])
        return cut_front_views(turned, (48, 48))[:, rows_seen(48, 48)][:, None]

    errors = measure_decisions(imagine_truth, stored, view=view)
    assert errors.agreement.tolist() == [1, 1] and np.array_equal(errors.regret, errors.oracle)
    save_decisions(tmp_path / "d.parquet", stored)
    card = train(tmp_path / "out", decisions=tmp_path / "d.parquet", numbers={"epochs": 1})
    assert -1 <= card["validation"]["rank"] <= 1 and card["validation"]["regret"] >= 0
