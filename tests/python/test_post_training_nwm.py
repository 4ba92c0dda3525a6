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
from post_training_parts import make_trainer, save_dataset, save_stock

from wiw.training.post_training.clips import load_clips, mirror_clip
from wiw.training.post_training.corpora import Clip, open_corpus
from wiw.training.post_training.nwm import VariationalDiffusion, measure_likelihood
from wiw.world_models.nwm.diffusion import sample
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
