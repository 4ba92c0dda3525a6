# SPDX-License-Identifier: Apache-2.0
"""Post-training of action-conditioned models, on diffusers' real classes with tiny random weights."""

from __future__ import annotations

import io
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw import action
from wiw.cli.app import main
from wiw.cli.stop import EXIT_RESUME
from wiw.cli.train.progress import TrainingProgress
from wiw.cli.train.video import RUN_AS, VIDEO
from wiw.errors import ArgumentError, FileError, TrainingError
from wiw.studies.run_log import load_run
from wiw.types import Conditioning, Control

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")
pytest.importorskip("peft", reason="no peft: pip install 'wiw[diffusers]'")
pytest.importorskip("pyarrow", reason="no pyarrow: pip install 'wiw[export]'")

import torch
from folders import contents
from post_training_parts import (
    make_trainer,
    read_log,
    run_in_a_process,
    save_dataset,
    save_stock,
    tiny_recipe,
    train_until_killed,
    with_nightly,
)

import tiny_pipelines
from wiw.training.post_training import svd, train
from wiw.training.post_training.clip_order import ClipOrder
from wiw.training.post_training.clips import load_clips
from wiw.training.post_training.conditioned_generator import add_lora
from wiw.training.post_training.corpora import open_corpus
from wiw.training.post_training.families import FAMILIES, VideoFamily, find_family
from wiw.training.post_training.noise import draw_shifted_uniform, weigh_by_bell
from wiw.training.post_training.nwm import TrainableNWM
from wiw.training.post_training.objective import to_image
from wiw.training.post_training.recipe import load_recipe
from wiw.training.post_training.train import post_train
from wiw.training.post_training.trainer import PostTrainer
from wiw.training.trainer import run_training, take_middles

pytestmark = pytest.mark.usefixtures("one_torch_thread")

NAMES = sorted(FAMILIES)
GENERATORS = sorted(name for name, family in FAMILIES.items() if isinstance(family, VideoFamily))
STEPS = {name: {"svd-action": 3, "wan2.2-a14b-action": 4}.get(name, 6) for name in NAMES}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_dataset(tmp_path_factory.mktemp("post") / "data")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory):
    return partial(save_stock, tmp_path_factory.mktemp("stock"))


# -- every recipe ------------------------------------------------------------------------------------------------------


EVERY_KIND = ("ltx-action", "nwm-action", "wan2.2-a14b-action")
"""A video generator, another trainable model, and one of two experts: what hardly differs between families is tried on
these for every change."""


@pytest.mark.parametrize("name", with_nightly(NAMES, EVERY_KIND))
def test_the_loss_falls_on_four_clips_learnt_by_heart(name: str, data: Path, weights: Any) -> None:
    """Measured on the same noise before and after."""
    trainer = make_trainer(name, data, weights(name), epochs=STEPS[name], drop=0.0, checkpointing=False)

    def measure(place: str) -> float:
        clips = np.tile(trainer.order.select(0), 4)
        with torch.no_grad():
            return float(trainer._compute_losses(place, clips, torch.Generator().manual_seed(9)).mean())

    before = {place: measure(place) for place in trainer.model.places}
    for _ in range(STEPS[name] * trainer.steps_per_epoch):
        trainer.train_step(3e-3)
    for place in trainer.model.places:
        assert measure(place) < 0.95 * before[place], (place, before[place], measure(place))


@pytest.mark.parametrize("name", ["ltx-action", "wan2.2-5b-action", "cosmos-predict2-action"])
def test_the_first_frame_is_given_and_out_of_the_loss(name: str, data: Path, weights: Any) -> None:
    trainer = make_trainer(name, data, weights(name), checkpointing=False)
    objective, clips = trainer.model.objective, torch.rand(2, 3, trainer.recipe.frames, *trainer.recipe.size) * 2 - 1
    encoded = dict(objective.sample(objective.encode(clips), torch.Generator().manual_seed(0)))

    def measure() -> torch.Tensor:
        with torch.no_grad():
            return objective.compute_losses("transformer", encoded, torch.Generator().manual_seed(1))

    before, latents = measure(), encoded["latents"]
    encoded["latents"] = torch.cat([latents[:, :, :1] + 1, latents[:, :, 1:]], dim=2)
    torch.testing.assert_close(measure(), before, rtol=0, atol=0)  # the target of the first frame plays no part
    encoded["latents"] = torch.cat([latents[:, :, :1], latents[:, :, 1:] + 1], dim=2)
    assert (measure() - before).abs().min() > 1e-3
    encoded |= {"latents": latents, "first": encoded["first"] + 1}
    assert (measure() - before).abs().min() > 1e-6  # the denoiser sees the one that is given


@pytest.mark.parametrize("name", with_nightly(NAMES, EVERY_KIND))
def test_each_recipe_resumes_exactly(name: str, data: Path, weights: Any) -> None:
    """From the middle; where there are two experts, from the middle of the second."""
    changes = {"epochs": 4, "batch": 4, "rows": 4}
    whole = make_trainer(name, data, weights(name), **changes)
    steps = whole.steps_per_epoch * 4
    state = io.BytesIO()
    for step in range(steps):
        whole.train_step(1e-3)
        if step + 1 == 3 * steps // 4:
            torch.save(whole.state_dict(), state)
    resumed = make_trainer(name, data, weights(name), **changes)
    state.seek(0)
    resumed.load_state_dict(torch.load(state, weights_only=True))
    assert resumed.step_count == 3 * steps // 4
    for _ in range(steps - resumed.step_count):
        resumed.train_step(1e-3)
    assert resumed.mean_loss == whole.mean_loss
    assert all(torch.equal(value, resumed.trained[key]) for key, value in whole.trained.items())


def test_actions_are_those_of_the_clips_and_dropped_in_a_share(data: Path, weights: Any) -> None:
    trainer = make_trainer("ltx-action", data, weights("ltx-action"), drop=0.5, rows=4)
    told: list[tuple[torch.Tensor, torch.Tensor]] = []
    trainer.model.encoders["transformer"].register_forward_pre_hook(lambda _, args: told.append(args))
    for _ in range(6):
        trainer.train_step(1e-3)
    assert 0.2 < float(torch.cat([dropped for _, dropped in told]).float().mean()) < 0.8
    assert len({tuple(dropped.tolist()) for _, dropped in told}) > 1  # drawn anew in each step
    actions = torch.cat([actions for actions, _ in told])
    assert not actions[:, 0].any() and set(actions[:, 1:].flatten().tolist()) == {1, 2, 3}


def test_each_expert_is_trained_on_its_side_of_the_boundary(data: Path, weights: Any) -> None:
    name = "wan2.2-a14b-action"
    trainer = make_trainer(name, data, weights(name))
    like = torch.zeros(2000, 1, 1, 1, 1)
    random = torch.Generator().manual_seed(0)
    high, low = (trainer.model.objective.draw_levels(place, like, random) for place in ("transformer", "transformer_2"))
    assert high.min() >= 0.9 and low.max() <= 0.9 and low.min() < 0.1
    assert [trainer.locate(step) for step in range(4)] == [
        ("transformer", 0),
        ("transformer", 1),
        ("transformer_2", 0),
        ("transformer_2", 1),
    ]
    before = {key: value.detach().clone() for key, value in trainer.trained.items()}
    trainer.train_step(1e-2)
    moved = {key for key, value in trainer.trained.items() if not torch.equal(value, before[key])}
    assert moved and not any("transformer_2" in key for key in moved)


@pytest.mark.parametrize("name", with_nightly(NAMES, EVERY_KIND))
def test_half_precision_trains_weights_in_float32(name: str, data: Path, weights: Any) -> None:
    trainer = make_trainer(name, data, weights(name), precision="bfloat16")
    assert np.isfinite(trainer.train_step(1e-3)) and np.isfinite(trainer.train_step(1e-3))
    assert {value.dtype for value in trainer.trained.values()} == {torch.float32}
    if trainer.recipe.lora:
        denoiser = trainer.model.find_denoiser(trainer.model.places[0])
        assert torch.bfloat16 in {value.dtype for value in denoiser.parameters() if not value.requires_grad}


def list_networks(trainer: PostTrainer) -> dict[str, torch.nn.Module]:
    """All networks of a model, also those that are not trained, by their place."""
    if isinstance(trainer.model, TrainableNWM):
        return {"cdit": trainer.model.network, "codec": trainer.model.codec}
    components = trainer.model.objective.pipeline.components
    return {place: network for place, network in components.items() if isinstance(network, torch.nn.Module)}


@pytest.mark.parametrize("name", NAMES)
def test_gradients_reach_what_is_trained_and_nothing_else(name: str, data: Path, weights: Any) -> None:
    trainer = make_trainer(name, data, weights(name), drop=0.0)

    def read_weights() -> dict[str, torch.Tensor]:
        return {
            f"{place}.{key}": value.detach().clone()
            for place, network in list_networks(trainer).items()
            for key, value in network.named_parameters()
        }

    before = read_weights()
    for _ in range(2 * trainer.steps_per_epoch):
        trainer.train_step(1e-2)
    moved = {key for key, value in read_weights().items() if not torch.equal(value, before[key])}
    expected = {key for key in trainer.trained if not key.startswith("encoder.")}
    assert moved <= expected and expected
    assert all((".actions." in key) == bool(trainer.recipe.lora) for key in expected)
    still = {key for key in expected - moved if not key.endswith(".bias")}  # a key's bias has no effect on attention
    assert len(still) <= 0.1 * len(expected), sorted(still)
    for encoder in getattr(trainer.model, "encoders", {}).values():
        assert all(torch.isfinite(value).all() for value in encoder.parameters())
        assert encoder.mlp[-1].weight.abs().max() > 1e-3


@pytest.mark.parametrize("name", GENERATORS)
def test_denoisers_are_called_as_world_models_call_them(
    name: str, data: Path, weights: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Same arguments but for noise and time, and the same first frame: trained on what inference gives."""
    from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution as Gaussian

    stock = Gaussian.__init__
    monkeypatch.setattr(
        Gaussian, "__init__", lambda self, parameters, deterministic=False: stock(self, parameters, True)
    )
    monkeypatch.setattr("wiw.training.post_training.svd.LOG_GIVEN", (-4.0, 0.0))  # about the noise of the pipeline
    trainer = make_trainer(name, data, weights(name), checkpointing=False, rows=1, drop=0.0)
    clip, place, rows = trainer.clips[0], trainer.model.places[0], np.zeros(1, np.int64)
    trained = _record(trainer, lambda: trainer._compute_losses(place, rows, torch.Generator().manual_seed(0)))
    generator = trainer.model.objective.generator
    control = Control(clip.actions[1:], action.to_trajectory(clip.actions[1:]), action.to_viewpoints(clip.actions[1:]))
    generator.guidance = 1.0
    image = load_clips([clip], generator.size).frames[:, 0].numpy()
    with torch.no_grad():
        inferred = _record(trainer, lambda: generator.make_clips(image, [control], np.zeros(1, np.uint64)))
    assert trained.keys() | {"attention_kwargs"} == inferred.keys() | {"attention_kwargs"}
    if name == "svd-action":  # what it says of the observation's noise is drawn anew for each clip
        assert trained.pop("added_time_ids")[0, :2].tolist() == inferred.pop("added_time_ids")[0, :2].tolist()
    for key in trained.keys() - {"hidden_states", "timestep", "sample"}:
        if isinstance(trained[key], torch.Tensor):
            torch.testing.assert_close(trained[key].expand_as(inferred[key]), inferred[key], msg=key)
        else:
            assert trained[key] == inferred[key], key
    _compare_first_frames(name, trainer, trained, inferred)


def _record(trainer: PostTrainer, call: Any) -> dict[str, Any]:
    """The arguments of the first call of a denoiser."""
    calls: list[dict[str, Any]] = []
    denoiser = trainer.model.find_denoiser(trainer.model.places[0])

    def note(_: Any, args: Any, kwargs: Any) -> None:
        positional = dict(zip(("sample", "timestep"), args, strict=False))
        calls.append({**positional, **kwargs})

    handle = denoiser.register_forward_pre_hook(note, with_kwargs=True, prepend=True)
    call()
    handle.remove()
    return calls[0]


def _compare_first_frames(name: str, trainer: PostTrainer, trained: dict[str, Any], inferred: dict[str, Any]) -> None:
    if name == "ltx-action":
        first = 2 * 4  # tokens of the first frame
        torch.testing.assert_close(trained["hidden_states"][:, :first], inferred["hidden_states"][:, :first])
        assert not trained["timestep"][:, :first].any() and not inferred["timestep"][:, :first].any()
        assert trained["timestep"][:, first:].min() > 0
    elif name == "wan2.2-5b-action":
        first = 1 * 2  # of 2 x 4 latents, patches of 2 x 2
        torch.testing.assert_close(trained["hidden_states"][:, :, 0], inferred["hidden_states"][:, :, 0])
        assert not trained["timestep"][:, :first].any() and trained["timestep"][:, first:].min() > 0
    elif name.startswith("wan"):  # mask and observation in channels of their own
        torch.testing.assert_close(trained["hidden_states"][:, 16:], inferred["hidden_states"][:, 16:])
        assert trained["hidden_states"][:, 16:20, 0].all() and not trained["hidden_states"][:, 16:20, 1:].any()
    elif name == "cosmos-predict2-action":
        torch.testing.assert_close(trained["hidden_states"][:, :, 0], inferred["hidden_states"][:, :, 0])
        torch.testing.assert_close(trained["timestep"][:, :, 0], inferred["timestep"][:, :, 0])
    if name == "svd-action":
        assert trained["sample"].shape == inferred["sample"].shape
        seen, shown = (each["sample"][0, :, 4:].flatten(1) for each in (trained, inferred))
        assert torch.equal(seen[0], seen[-1]) and float(torch.corrcoef(torch.stack([seen[0], shown[0]]))[0, 1]) > 0.9
        assert float(inferred["timestep"]) == pytest.approx(0.25 * np.log(700), rel=1e-3)  # a quarter of ln sigma
    else:
        assert trained["timestep"].shape == inferred["timestep"].shape
        assert trained["hidden_states"].shape == inferred["hidden_states"].shape


def _predict_perfectly(name: str, latents: torch.Tensor) -> Any:
    """Forward of a denoiser that knows the clip's latents."""

    def predict(*args: Any, **kwargs: Any) -> tuple[torch.Tensor]:
        if name == "svd-action":
            noisy, log = args[0][:, :, :4], 4 * args[1].double().reshape(-1, 1, 1, 1, 1)
            sigma, scale = log.exp(), (log.exp().square() + 1).sqrt()
            noise = (noisy * scale - latents) / sigma
            return (((noise - sigma * latents) / scale).float(),)
        noisy, times = kwargs["hidden_states"], kwargs["timestep"].double()
        if name == "ltx-action":
            known = latents.flatten(2).transpose(1, 2)
            return (((noisy - known) / (times[..., None] / 1000).clamp(min=1e-9)).float(),)
        level = times if name.startswith("cosmos") else times.reshape(len(times), -1).amax(1) / 1000
        level = level if name.startswith("cosmos") else level[:, None, None, None, None]
        return (((noisy[:, : latents.shape[1]] - latents) / level).float(),)

    return predict


@pytest.mark.parametrize("name", GENERATORS)
def test_what_has_no_loss_in_training_generates_the_clip(
    name: str, data: Path, weights: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise, times, signs and scales of the loss are those of the pipeline: one perfect denoiser serves both."""
    from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution as Gaussian

    stock = Gaussian.__init__
    monkeypatch.setattr(
        Gaussian, "__init__", lambda self, parameters, deterministic=False: stock(self, parameters, True)
    )
    trainer = make_trainer(name, data, weights(name), checkpointing=False, drop=0.0)
    objective, generator = trainer.model.objective, trainer.model.objective.generator
    clip = load_clips([trainer.clips[0]], generator.size).pixels
    encoded = objective.sample(objective.encode(clip), torch.Generator().manual_seed(0))
    for place in trainer.model.places:
        monkeypatch.setattr(getattr(objective.pipeline, place), "forward", _predict_perfectly(name, encoded["latents"]))
    with torch.no_grad():
        losses = [
            objective.compute_losses(place, encoded, torch.Generator().manual_seed(1)) for place in trainer.model.places
        ]
    assert float(torch.cat(losses).max()) < 1e-6
    plan = trainer.clips[0].actions[1:]
    control = Control(plan, action.to_trajectory(plan), action.to_viewpoints(plan))
    arguments = generator.arguments
    generator.arguments = lambda *each: {**arguments(*each), "output_type": "latent"}
    generator.guidance, generator.steps = 1.0, 3
    image = to_image(clip[0, :, 0])
    with torch.no_grad():
        made = torch.from_numpy(generator.generate([image], [control], [torch.Generator().manual_seed(2)]))
    wanted = encoded["latents"]
    wanted = wanted.flatten(2).transpose(1, 2) if name == "ltx-action" else wanted
    torch.testing.assert_close(made.float(), wanted, rtol=0, atol=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_a_checkpoint_runs_as_a_world_model(name: str, data: Path, weights: Any, tmp_path: Path) -> None:
    out, family, recipe = tmp_path / "out", find_family(name), tiny_recipe(name)
    card = post_train(name, data, out, weights=weights(name), device="cpu", recipe=recipe, part="all")
    assert card["steps"] == (4 if name == "wan2.2-a14b-action" else 2) and np.isfinite(card["loss"])
    assert not (tmp_path / "out.checkpoint").exists()
    options: dict[str, Any] = {"guardrail": False} if name.startswith("cosmos") else {}
    if isinstance(family, VideoFamily):
        options |= {"size": recipe.size, "frames": recipe.frames}
    model = wiw.world_model(
        family.world_model, **{family.checkpoint_option: str(out)}, device="cpu", steps=2, **options
    )
    plan = action.pad([action.TURN_LEFT], recipe.frames - 1)
    views = action.to_trajectory(plan), action.to_viewpoints(plan)
    control = Control(plan, *views, ids=action.with_null(plan), length=1)
    image = np.full((1, *model.accepts.size, 3), 90, np.uint8)
    frames = model.rollout(Conditioning(image), [control], np.zeros(1, np.uint64))
    assert frames.shape == (1, recipe.frames, *model.accepts.size, 3)
    np.testing.assert_array_equal(frames[:, 0], image)
    assert json.loads((out / "training.json").read_text())["model"] == name


# -- resuming ----------------------------------------------------------------------------------------------------------

STEPS_IN_ALL, KEPT = 20, 10


@pytest.mark.parametrize("name", with_nightly(NAMES, ["ltx-action"]))
def test_a_killed_training_ends_with_the_same_bytes(name: str, data: Path, weights: Any, tmp_path: Path) -> None:
    options: dict[str, Any] = {"weights": weights(name), "device": "cpu", "part": "all"}
    recipe = tiny_recipe(name, epochs=STEPS_IN_ALL // (2 if name == "wan2.2-a14b-action" else 1))
    post_train(name, data, tmp_path / "whole", recipe=recipe, **options)
    killed = run_in_a_process(train_until_killed, KEPT + 1, name, data, tmp_path / "killed", recipe=recipe, **options)
    assert killed == -signal.SIGKILL
    steps: list[int] = []
    post_train(name, data, tmp_path / "killed", recipe=recipe, on_step=lambda step, *_: steps.append(step), **options)
    assert steps == list(range(KEPT + 1, STEPS_IN_ALL + 1))
    assert contents(tmp_path / "whole") == contents(tmp_path / "killed")
    assert not list(tmp_path.glob("*.checkpoint"))


def test_sigterm_writes_the_state_and_other_numbers_do_not_resume(
    data: Path, weights: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a batch system stops the command."""
    name, out, stock = "ltx-action", tmp_path / "out", TrainingProgress.__call__

    def stop(self: TrainingProgress, step: int, *numbers: Any) -> None:
        stock(self, step, *numbers)
        if step == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(TrainingProgress, "__call__", stop)
    monkeypatch.setattr("wiw.cli.stop.GRACE", 100.0)  # after that it would end the tests
    numbers = ["frames=9", "size=[64, 128]", "batch=4", "clips=4", "epochs=5"]
    command = ["train", name, "--data", str(data), "--weights", str(weights(name)), "--part", "all", "--out", str(out)]
    assert main([*command, *(each for number in numbers for each in ("--option", number))]) == EXIT_RESUME
    assert "Repeat the command to resume" in capsys.readouterr().err
    assert torch.load(tmp_path / "out.checkpoint", weights_only=True)["step"] == 3 and not out.exists()
    options: dict[str, Any] = {"weights": weights(name), "device": "cpu", "part": "all"}
    with pytest.raises(ArgumentError, match="different data or options"):
        post_train(name, data, out, recipe=tiny_recipe(name, epochs=5, seed=1), **options)


def test_sigusr1_writes_the_state_and_goes_on(data: Path, weights: Any, tmp_path: Path) -> None:
    found: list[int] = []
    state = tmp_path / "out.checkpoint"

    def on_step(step: int, steps: int, loss: float) -> None:
        if step == 2:
            os.kill(os.getpid(), signal.SIGUSR1)
        if step > 2 and state.exists():
            found.append(torch.load(state, weights_only=True)["step"])

    before = signal.getsignal(signal.SIGUSR1)
    options: dict[str, Any] = {"weights": weights("ltx-action"), "device": "cpu", "part": "all"}
    recipe = tiny_recipe("ltx-action", epochs=4)
    post_train("ltx-action", data, tmp_path / "out", recipe=recipe, on_step=on_step, **options)
    assert found == [2, 2] and signal.getsignal(signal.SIGUSR1) == before


def test_sigusr1_before_the_first_step_is_kept_for_it_and_after_the_last_does_nothing(
    data: Path, weights: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[int] = []
    state = tmp_path / "out.checkpoint"
    fit, publish = VideoFamily.fit, train.publish_checkpoint

    def send(function: Any) -> Any:
        return lambda *given: (os.kill(os.getpid(), signal.SIGUSR1), function(*given))[1]

    def on_step(step: int, steps: int, loss: float) -> None:
        if state.exists():
            found.append(torch.load(state, weights_only=True)["step"])

    monkeypatch.setattr(VideoFamily, "fit", send(fit))
    monkeypatch.setattr(train, "publish_checkpoint", send(publish))
    options: dict[str, Any] = {"weights": weights("ltx-action"), "device": "cpu", "part": "all"}
    recipe = tiny_recipe("ltx-action", epochs=3)
    before = signal.getsignal(signal.SIGUSR1)
    post_train("ltx-action", data, tmp_path / "out", recipe=recipe, on_step=on_step, **options)
    assert found == [1, 1] and (tmp_path / "out/training.json").exists() and not state.exists()
    assert signal.getsignal(signal.SIGUSR1) == before


@pytest.mark.parametrize("name", ["ltx-action", "pocket"])
def test_sigusr1_does_not_end_a_command_that_has_no_step_yet(name: str, tmp_path: Path) -> None:
    """It comes while the command looks for its data."""
    code = (
        "import os, signal, sys, importlib\n"
        "from wiw.cli.train import corpus\n"
        f"module = importlib.import_module('wiw.cli.train.{'pocket' if name == 'pocket' else 'video'}')\n"
        "require = corpus.require_data\n"
        "module.require_data = lambda *given: (os.kill(os.getpid(), signal.SIGUSR1), require(*given))[1]\n"
        "from wiw.cli import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    command = ["train", name, "--data", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]
    done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "nowhere" in done.stderr


@pytest.mark.parametrize("kept", ["notes.txt", "best/weights", "out/mine.txt", "step-1.png"])
def test_a_folder_of_others_in_the_place_of_the_log_is_left_alone(kept: str, data: Path, tmp_path: Path) -> None:
    path = tmp_path / "out.log" / kept
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    options: dict[str, Any] = {"recipe": tiny_recipe("ltx-action"), "weights": tmp_path / "nowhere", "device": "cpu"}
    said = rf"out\.log: expected a folder for the log, .* has {re.escape(Path(kept).parts[0])}; "
    with pytest.raises(ArgumentError, match=said):
        post_train("ltx-action", data, tmp_path / "out", **options)
    assert path.read_text() == "mine"
    (tmp_path / "file.log").write_text("mine")
    with pytest.raises(ArgumentError, match=r"file\.log: expected a folder for the log, .* got a file"):
        post_train("ltx-action", data, tmp_path / "file", **options)


def test_the_log_of_a_training_of_before_begins_anew(data: Path, weights: Any, tmp_path: Path) -> None:
    log = tmp_path / "out.log"
    for name in (
        "metrics.jsonl",
        "step-0000002.png",
        "best/training.json",
        "out/events.out.tfevents.1",
        "out/1/hparams.yml",
    ):
        (log / name).parent.mkdir(parents=True, exist_ok=True)
        (log / name).write_text("{}\n")
    options: dict[str, Any] = {"weights": weights("ltx-action"), "device": "cpu", "part": "all"}
    post_train("ltx-action", data, tmp_path / "out", recipe=tiny_recipe("ltx-action", epochs=1), **options)
    assert [path.name for path in log.iterdir()] == ["metrics.jsonl"] and len(read_log(tmp_path / "out")) == 1


def test_a_loss_that_is_not_finite_names_the_batch_and_keeps_the_state(
    data: Path, weights: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stock = PostTrainer._compute_losses

    def spoil(self: PostTrainer, *args: Any) -> torch.Tensor:
        return stock(self, *args) * (torch.nan if self.step_count == 3 else 1)

    monkeypatch.setattr(PostTrainer, "_compute_losses", spoil)
    options: dict[str, Any] = {"weights": weights("ltx-action"), "device": "cpu", "part": "all"}
    recipe = tiny_recipe("ltx-action", epochs=6)
    with pytest.raises(TrainingError, match=r"step 4: the loss is not finite on a batch of clip \d+ \(scene "):
        post_train("ltx-action", data, tmp_path / "out", recipe=recipe, **options)
    content = torch.load(tmp_path / "out.checkpoint", weights_only=True)
    assert content["step"] == 3
    assert all(torch.isfinite(value).all() for value in content["state"]["weights"].values())
    monkeypatch.undo()
    assert post_train("ltx-action", data, tmp_path / "out", recipe=recipe, **options)["steps"] == 6


def test_a_clip_that_cannot_be_read_keeps_the_state(
    data: Path, weights: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A picture of the dataset was damaged meanwhile; once it is mended, the training goes on."""
    stock = PostTrainer._load_clip

    def spoil(self: PostTrainer, *args: Any) -> Any:
        if self.step_count == 3:
            raise FileError("frames.parquet: row 5: the picture cannot be decoded")
        return stock(self, *args)

    options: dict[str, Any] = {"weights": weights("ltx-action"), "device": "cpu", "part": "all"}
    recipe = tiny_recipe("ltx-action", epochs=6)
    post_train("ltx-action", data, tmp_path / "whole", recipe=recipe, **options)
    monkeypatch.setattr(PostTrainer, "_load_clip", spoil)
    with pytest.raises(FileError, match="row 5"):
        post_train("ltx-action", data, tmp_path / "out", recipe=recipe, **options)
    assert torch.load(tmp_path / "out.checkpoint", weights_only=True)["step"] == 3
    monkeypatch.undo()
    post_train("ltx-action", data, tmp_path / "out", recipe=recipe, **options)
    assert contents(tmp_path / "whole") == contents(tmp_path / "out")


# -- order, noise, recipes ---------------------------------------------------------------------------------------------


def test_the_order_covers_the_clips_and_subsets_are_nested() -> None:
    order = ClipOrder(total=50, count=12, batch=4, seed=3)
    assert order.steps_per_epoch == 3
    epochs = [np.concatenate([order.select(3 * epoch + step) for step in range(3)]) for epoch in range(2)]
    assert len(set(epochs[0])) == 12 and set(epochs[0]) == set(epochs[1]) and list(epochs[0]) != list(epochs[1])
    more = replace(order, count=24)
    assert set(epochs[0]) < set(np.concatenate([more.select(step) for step in range(6)]))
    np.testing.assert_array_equal(order.select(4), ClipOrder(50, 12, 4, 3).select(4))


def test_the_order_is_that_of_permutations_which_are_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    stock = np.random.default_rng
    order, other = ClipOrder(total=90, count=20, batch=3, seed=11), ClipOrder(total=90, count=20, batch=3, seed=12)
    monkeypatch.setattr(np.random, "default_rng", lambda key: (drawn.append(key), stock(key))[1])
    for step in (*range(3 * order.steps_per_epoch), 2):
        epoch, place = divmod(step, 6)
        for each in (order, other):
            chosen = stock((each.seed, 0)).permutation(90)[:20]
            expected = chosen[stock((each.seed, 1, epoch)).permutation(20)[3 * place : 3 * place + 3]]
            np.testing.assert_array_equal(each.select(step), expected)
    assert len(drawn) == 2 * (1 + 3 + 1) and order == replace(order)


def test_levels_of_a_shifted_schedule_stay_on_their_side() -> None:
    random = torch.Generator().manual_seed(0)
    high = draw_shifted_uniform(20000, 5.0, random, 0.9, 1.0)
    assert high.min() >= 0.9 and high.max() <= 1
    both = draw_shifted_uniform(20000, 5.0, random)
    assert abs(float((both >= 0.9).float().mean()) - 0.357) < 0.02  # the noisy expert's share of the schedule
    weights = weigh_by_bell(both, 5.0)
    assert abs(float(weights.mean()) - 1) < 0.02 and weights.min() >= 0
    assert weigh_by_bell(torch.tensor([0.5]), 5.0) > weigh_by_bell(torch.tensor([0.95]), 5.0)


def test_shipped_recipes_are_those_of_the_world_models() -> None:
    for name in NAMES:
        recipe, family = load_recipe(name), find_family(name)
        assert recipe.size is None and recipe.epochs == 1 and recipe.clips == 40_000
        if isinstance(family, VideoFamily):
            assert recipe.frames == family.model.accepts.frames and recipe.drop == 0.1


NUMBERS = {
    # frames, rate, schedule, warmup, clip_norm, LoRA, shift
    "svd-action": (14, 2e-5, "cosine", 0.2, 0.5, 0, 1.0),  # warm-up: 500 of 2,500 steps of 16 clips
    "ltx-action": (17, 1e-5, "linear", 0.0, 1.0, 0, 1.0),  # its noise is shifted by the number of tokens instead
    "wan2.1-action": (13, 1e-4, "constant", 0.0, 1.0, 32, 5.0),
    "wan2.2-5b-action": (13, 1e-5, "constant", 0.0, 1.0, 0, 5.0),
    "wan2.2-a14b-action": (13, 1e-4, "constant", 0.0, 1.0, 32, 5.0),
    "cosmos-predict2-action": (13, 4e-5, "constant", 0.0, 1.0, 0, 1.0),
    "nwm-action": (5, 8e-5, "constant", 0.0, 10.0, 0, 1.0),
}
"""Frames, and which models are trained by LoRA, are the paper's, which leaves NWM as it is; the rest follow each
model's own training where that is published."""


@pytest.mark.parametrize("name", NAMES)
def test_shipped_recipes_have_these_numbers(name: str) -> None:
    recipe = load_recipe(name)
    chosen = recipe.frames, recipe.rate, recipe.schedule, recipe.warmup, recipe.clip_norm, recipe.lora, recipe.shift
    assert chosen == NUMBERS[name] and recipe.batch == 16


def test_the_noise_of_svd_is_log_normal_with_its_published_moments() -> None:
    assert svd.LOG_SIGMA == (0.7, 1.6) and svd.LOG_GIVEN == (-3.0, 0.5)


def test_rates_are_those_of_the_middle_of_a_step() -> None:
    class Noted:
        def train_step(self, learning_rate: float) -> float:
            rates.append(learning_rate)
            return 0.0

    rates: list[float] = []
    recipe = load_recipe("ltx-action", options={"schedule": "linear", "warmup": 0.5, "rate": 1.0, "epochs": 2})
    run_training(Noted, recipe, 2, None, take_middles(recipe.scale_rate, 4), lambda *_: None)
    assert rates == [0.25, 0.75, 0.75, 0.25]


def test_rates_follow_the_schedule() -> None:
    recipe = load_recipe("ltx-action", options={"schedule": "cosine", "warmup": 0.2})
    assert recipe.scale_rate(0.1) == pytest.approx(0.5) and recipe.scale_rate(0.2) == pytest.approx(1)
    assert recipe.scale_rate(0.6) == pytest.approx(0.5) and recipe.scale_rate(1.0) == pytest.approx(0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"lr": 1}, "recipe: unknown name 'lr'"),
        ({"rate": "fast"}, "rate: expected a number, got 'fast'"),
        ({"rate": -1.0}, "rate: expected a finite number above 0"),
        ({"batch": 3, "rows": 2}, "rows: expected a divisor of batch"),
        ({"schedule": "step"}, "one of constant, linear, cosine"),
        ({"frames": 1}, "frames: expected 2 or more"),
        ({"drop": 1.0}, "drop: expected a share"),
        ({"weight_decay": math.nan}, "finite weight_decay of 0 or more, .* got nan"),
        ({"weight_decay": math.inf}, "finite weight_decay of 0 or more, .* got inf"),
    ],
)
def test_recipes_that_make_no_sense_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        load_recipe("ltx-action", options=options)


def test_what_cannot_be_trained_is_refused(data: Path, weights: Any, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"'nwm' is not trained here; expected one of .*, nwm-action"):
        post_train("nwm", data, tmp_path / "out")
    front = save_dataset(tmp_path / "front", projection="perspective")
    options: dict[str, Any] = {"weights": weights("ltx-action"), "device": "cpu", "part": "all"}
    recipe = tiny_recipe("ltx-action")
    with pytest.raises(ArgumentError, match="see panoramas"):
        post_train("ltx-action", front, tmp_path / "out", recipe=recipe, **options)
    named = save_dataset(tmp_path / "named", scenes=["flat", "apartments:val/3"])
    with pytest.raises(
        ArgumentError, match="expected scenes of a train split, got scene apartments:val/3 of split val"
    ):
        post_train("ltx-action", named, tmp_path / "out", recipe=recipe, **options)
    evaluated = save_dataset(tmp_path / "evaluated", split="test")
    with pytest.raises(ArgumentError, match="expected scenes of a train split, got split test"):
        post_train("ltx-action", evaluated, tmp_path / "out", recipe=recipe, **options)
    tall = save_dataset(tmp_path / "tall", scenes=["cellar"], height=1.5)
    with pytest.raises(ArgumentError, match=r"expected a camera 1.0 m above the floor, .* has one at 1.5 m"):
        post_train("ltx-action", data, tmp_path / "out", recipe=recipe, validation=tall, **options)
    with pytest.raises(ArgumentError, match="no segment has 33 frames"):
        post_train("ltx-action", data, tmp_path / "out", recipe=replace(recipe, frames=33), **options)
    with pytest.raises(ArgumentError, match="expected at least 400 clips"):
        post_train("ltx-action", data, tmp_path / "out", recipe=replace(recipe, batch=400), **options)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note").touch()
    with pytest.raises(ArgumentError, match="is not empty"):
        post_train("ltx-action", data, tmp_path / "full", recipe=recipe, **options)


@pytest.mark.parametrize(
    ("kept", "said"),
    [(None, "frames.parquet is missing"), (0.9, r"frames.parquet: expected \d+ bytes, as in meta.json, got \d+")],
)
def test_a_file_that_is_not_whole_is_told_before_weights_are_loaded(
    kept: float | None, said: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(data, tmp_path / "data"))
    assert open_corpus(folder, "train").units
    path = folder / "frames.parquet"
    whole = path.read_bytes()
    path.unlink()
    if kept is not None:
        path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(FileError, match=said + ".*; copy it again, or repeat `wiw collect navigation`"):
        open_corpus(folder, "train")
    command = ["train", "ltx-action", "--data", str(folder), "--out", str(tmp_path / "out")]
    assert main([*command, "--weights", str(tmp_path / "no-weights")]) == 2
    assert re.search(said, " ".join(capsys.readouterr().err.split()))
    assert not list(tmp_path.glob("out*"))


def test_a_lora_that_covers_nothing_is_refused() -> None:
    pipeline = tiny_pipelines.ltx()
    with pytest.raises(ArgumentError, match=r"has no layers ffn.net.0.proj, ffn.net.2"):
        add_lora(pipeline, "transformer", 4)


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_trains_and_names_one_that_runs_the_checkpoint(
    data: Path, weights: Any, two_rooms: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("{frames: 9, size: [64, 128], batch: 2, clips: 4}")
    command = ["train", "ltx-action", "--data", str(data), "--weights", str(weights("ltx-action")), "--part", "all"]
    out = tmp_path / "out"
    assert main([*command, "--recipe", str(recipe), "--option", "rate=1e-3", "--epochs", "2", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "4 steps of 2 clips, loss " in said.out and f"checkpoint={out} --world-model-option 'size=[64, 128]'" in (
        said.out
    )
    assert "training: step 4/4" in said.err and "clips/s" in said.err and "GB" in said.err
    card = json.loads((out / "training.json").read_text())
    assert card["recipe"]["rate"] == 1e-3 and card["recipe"]["batch"] == 2 and card["steps"] == 4
    named = re.search(r"wiw (run imagenav --world-model ltx-action .*)", said.out)
    assert named is not None
    preset = tmp_path / "short.yaml"
    preset.write_text("base: paper\ndecisions: 2\n")
    short = ["--scenes", two_rooms, "--preset", str(preset), "--episodes", "1", "--no-report", "--cache", "off"]
    command = [*shlex.split(named[1]), "--world-model-option", "steps=2", *short, "--out", str(tmp_path / "run")]
    assert main(command) == 0
    log = load_run(tmp_path / "run")
    assert [episode["status"] for episode in log.episodes] == ["done"] and len(log.decisions) == 2
    assert all(decision["calls"]["rows"] > 0 for decision in log.decisions)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["ltx-action"], "ltx-action trains on a dataset; give a folder"),
        (["ltx-action", "--data", "nowhere"], "meta.json does not exist"),
        (["ltx-action", "--data", "nowhere", "--option", "lr=1"], "recipe: unknown name 'lr'"),
    ],
)
def test_the_command_refuses(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", *arguments]) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_the_command_names_all_that_is_trained() -> None:
    assert set(VIDEO) == set(FAMILIES)
    assert all(RUN_AS.get(name, name) == family.world_model for name, family in FAMILIES.items())
