# SPDX-License-Identifier: Apache-2.0
"""Generators that follow actions: the encoder, the hooks on the real denoisers, and their checkpoints."""

from __future__ import annotations

import inspect
import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

import wiw
from wiw import action
from wiw.action import FORWARD, NULL, STOP, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError, DeviceMemoryError, RegistryError, WeightsError
from wiw.types import Conditioning, Control
from wiw.world_models.video.actions.config import ActionConfig

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")
pytest.importorskip("peft", reason="no peft: pip install 'wiw[diffusers]'")

import torch
from safetensors import safe_open
from test_loop_poses import imagine_plans, plan_of

from wiw.world_models.video.actions import checkpoint
from wiw.world_models.video.actions.encoder import HIDDEN, ActionEncoder
from wiw.world_models.video.actions.injection import Injection

NAMES = [
    "svd-action",
    "ltx-action",
    "wan2.1-action",
    "wan2.2-5b-action",
    "wan2.2-a14b-action",
    "cosmos-predict2-action",
]
BOX = {"low": (-0.3, -0.5, 0.6), "high": (0.7, 0.5, 1.6)}


def config(**changes) -> ActionConfig:
    return ActionConfig(**{"base": "svd", "weights": "somewhere", "width": 12, "stride": 4, **changes})


def trained(**changes) -> ActionEncoder:
    torch.manual_seed(0)
    encoder = ActionEncoder(config(**changes)).requires_grad_(False)
    torch.nn.init.normal_(encoder.mlp[-1].weight)
    return encoder


@pytest.fixture
def made(world_model_options):
    """A world model with tiny weights, a random checkpoint and the options of the test."""
    return lambda name, **options: wiw.world_model(name, **{**world_model_options(name), **options})


def control(model, plan) -> Control:
    padded = action.pad(plan, model.accepts.frames - 1)
    views = action.to_trajectory(padded), action.to_viewpoints(padded)
    return Control(padded, *views, ids=action.with_null(padded), length=len(plan))


def rollout(model, *plans, seed: int = 7):
    image = np.random.default_rng(0).integers(0, 256, (1, *model.accepts.size, 3), np.uint8).repeat(len(plans), 0)
    controls = [control(model, plan) for plan in plans]
    return model.rollout(Conditioning(image), controls, np.full(len(plans), seed, np.uint64)).astype(int)


def test_an_untrained_encoder_says_nothing() -> None:
    ids = torch.randint(0, 5, (2, 9), generator=torch.Generator().manual_seed(0))
    assert not ActionEncoder(config())(ids).any()
    assert trained()(ids).any()


@pytest.mark.parametrize("stride", [1, 4, 8])
def test_each_latent_is_told_the_actions_of_its_frames(stride: int) -> None:
    """The grouping written out frame by frame."""
    encoder = trained(stride=stride)
    ids = torch.randint(0, 5, (2, 1 + 3 * stride), generator=torch.Generator().manual_seed(1))
    table = encoder.embed.weight
    for row in range(2):
        groups = [[ids[row, 0]] * stride] + [ids[row, 1 + stride * k : 1 + stride * (k + 1)] for k in range(3)]
        for latent, group in enumerate(groups):
            told = torch.cat([table[index] for index in group])
            assert told.shape == (stride * HIDDEN,)
            torch.testing.assert_close(encoder(ids)[row, latent], encoder.mlp(told))


def test_a_dropped_row_is_told_the_null_token() -> None:
    encoder, ids = trained(), torch.tensor([[0, 1, 1, 2, 1], [0, 3, 1, 1, 4]])
    found = encoder(ids, dropped=torch.tensor([True, False]))
    torch.testing.assert_close(found, encoder(torch.tensor([[0] * 5, [0, 3, 1, 1, 4]])))
    encoder = trained(vocabulary=("forward", "turn_left", "turn_right", "stop", "null"))
    torch.testing.assert_close(encoder(ids, dropped=torch.tensor([True, True])), encoder(torch.full((2, 5), 4)))


def test_poses_are_seen_in_the_workspace() -> None:
    encoder = trained(kind="pose7", stride=1, **BOX)
    seen = []
    encoder.embed.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    poses = torch.tensor([[[-0.3, 0.0, 1.6, 0.0, np.pi / 2, np.pi, 1.0], [0.2, 0.0, 1.1, 0.1, 0.2, 0.3, 0.0]]])
    assert encoder(poses).shape == (1, 2, 12)
    np.testing.assert_allclose(seen[0][0, 0], [-1, 0, 1, 0, 1, 0, 1, 0, -1, 1], atol=1e-6)
    turned = poses + torch.tensor([0, 0, 0, 0, 0, 2 * np.pi, 0])  # a full circle more is the same pose
    torch.testing.assert_close(encoder(turned.float()), encoder(poses), atol=1e-4, rtol=1e-4)
    dropped = encoder(poses, dropped=torch.tensor([True]))
    torch.testing.assert_close(dropped, encoder(poses + 0.1, dropped=torch.tensor([True])))


def test_what_does_not_fit_the_encoder_is_named() -> None:
    for actions in (torch.zeros(2, 8, dtype=torch.long), torch.zeros(5, dtype=torch.long), torch.zeros(2, 5, 7)):
        with pytest.raises(ArgumentError, match="one more than a multiple of 4"):
            trained()(actions)
    with pytest.raises(ArgumentError, match="expected poses"):
        trained(kind="pose7", **BOX)(torch.zeros(2, 5, dtype=torch.long))
    with pytest.raises(ArgumentError, match="needs low < high"):
        config(kind="pose7", low=(0, 0, 0), high=(1, 0, 1))
    with pytest.raises(ArgumentError, match="in some order"):
        config(vocabulary=("null", "go"))
    with pytest.raises(ArgumentError, match="a Linear cannot be conditioned on actions"):
        Injection(torch.nn.Linear(1, 1))


def test_primitives_have_the_ids_of_the_vocabulary() -> None:
    assert config().ids == {int(NULL): 0, int(FORWARD): 1, int(TURN_LEFT): 2, int(TURN_RIGHT): 3, int(STOP): 4}
    assert config(vocabulary=("stop", "null", "forward", "turn_left", "turn_right")).ids[int(FORWARD)] == 2


@pytest.mark.parametrize("name", NAMES)
def test_actions_steer_and_leave_no_trace(name: str, made) -> None:
    model = made(name, steps=2)
    left, right = rollout(model, [TURN_LEFT] * 2), rollout(model, [TURN_RIGHT] * 2)
    assert np.abs(left - right).mean() > 0.02
    for encoder in model.conditioning.encoders.values():
        torch.nn.init.zeros_(encoder.mlp[-1].weight)
        torch.nn.init.zeros_(encoder.mlp[-1].bias)
    untrained = rollout(model, [TURN_LEFT] * 2)
    assert np.abs(left - untrained).mean() > 0.02
    for injection in model.conditioning.injections.values():
        injection.remove()
    stock = rollout(model, [TURN_LEFT] * 2)
    assert np.abs(stock - untrained).max() <= 1  # the time goes token by token where it went in one piece
    np.testing.assert_array_equal(stock, rollout(model, [TURN_RIGHT] * 2))
    if not model._lora:  # the trained denoiser is the stock one here, so the stock world model gives the same clip
        again = rollout(type(model.generator)(**model.generator.options), [TURN_LEFT] * 2)
        np.testing.assert_array_equal(again[:, -1], stock[:, -1])


@pytest.mark.parametrize("name", ["svd-action", "ltx-action", "cosmos-predict2-action"])
def test_rows_follow_their_own_actions_with_guidance_too(name: str, made) -> None:
    model = made(name, batch=2, guidance=3.0)
    plans = [TURN_LEFT, FORWARD], [FORWARD, FORWARD]
    both = rollout(model, *plans)
    for row, plan in enumerate(plans):
        assert np.abs(both[row] - rollout(model, plan)[0]).max() <= 1


@pytest.mark.parametrize("name", ["svd-action", "ltx-action", "wan2.2-a14b-action"])
def test_layers_may_be_moved_in_and_out_while_told(name: str, made) -> None:
    """As offload="sequential" does, with the CPU in the GPU's place."""
    from accelerate import cpu_offload

    model = made(name)
    frames = rollout(model, [FORWARD, TURN_LEFT])
    for network in model.generator.pipeline.components.values():
        if isinstance(network, torch.nn.Module):
            cpu_offload(network, torch.device("cpu"), offload_buffers=len(network._parameters) > 0)
    assert getattr(model.generator.pipeline, model.denoisers[0]).device.type == "meta"
    for _ in range(2):
        np.testing.assert_array_equal(rollout(model, [FORWARD, TURN_LEFT]), frames)


@pytest.mark.parametrize("name", ["svd-action", "wan2.2-a14b-action"])
def test_checkpoints_come_back_as_they_went(name: str, made, tmp_path: Path) -> None:
    model = made(name)
    frames = rollout(model, [FORWARD, TURN_LEFT])
    written = checkpoint.save(
        tmp_path / "again", model.conditioning.encoders, model.generator.pipeline, lora=model._lora
    )
    assert (written / "pytorch_lora_weights.safetensors").is_file() == model._lora
    assert json.loads((written / "config.json").read_text())["base"] == model.base
    again = made(name, checkpoint=str(written))
    np.testing.assert_array_equal(rollout(again, [FORWARD, TURN_LEFT]), frames)
    same = pickle.loads(pickle.dumps(model))
    assert same.describe() == model.describe() and same.fingerprint() == model.fingerprint()
    assert model.accepts.view == "panorama" and model.accepts.null_first and model.describe()["checkpoint_digest"]


def test_equal_loras_are_equal_bytes(made, tmp_path: Path) -> None:
    """Also what the file says of them, in whose order the library that writes it follows no rule."""
    model = made("wan2.1-action")
    assert model._lora
    files = []
    for number in range(8):
        folder = checkpoint.save(
            tmp_path / str(number), model.conditioning.encoders, model.generator.pipeline, lora=True
        )
        files.append((folder / "pytorch_lora_weights.safetensors").read_bytes())
    assert len(set(files)) == 1
    with safe_open(folder / "pytorch_lora_weights.safetensors", "pt") as read:
        said = json.loads(read.metadata()["lora_adapter_metadata"])
        assert read.metadata()["format"] == "pt" and len(list(read.keys())) == 2 * count_lora_layers(model)
    assert said["transformer.target_modules"] == sorted(said["transformer.target_modules"])


def count_lora_layers(model) -> int:
    """Number of layers of the denoiser that the LoRA is on."""
    return sum(name.endswith("lora_A.actions") for name, _ in model.generator.pipeline.transformer.named_modules())


def test_both_experts_and_their_lora_count(made, tmp_path: Path) -> None:
    model = made("wan2.2-a14b-action")
    whole = rollout(model, [FORWARD])
    folder = Path(model.checkpoint)
    for number, file in enumerate(("pytorch_lora_weights.safetensors", "pytorch_lora_weights_2.safetensors")):
        other = shutil.copytree(folder, tmp_path / str(number))
        from safetensors import safe_open
        from safetensors.torch import save_file

        with safe_open(other / file, "pt") as opened:
            tensors, metadata = {key: opened.get_tensor(key) * 3 for key in opened.keys()}, opened.metadata()  # noqa: SIM118
        save_file(tensors, other / file, metadata)
        assert np.abs(rollout(made("wan2.2-a14b-action", checkpoint=str(other)), [FORWARD]) - whole).max() > 1
    for place, encoder in model.conditioning.encoders.items():
        kept = encoder.mlp[-1].weight.clone()
        encoder.mlp[-1].weight.zero_()
        assert np.abs(rollout(model, [FORWARD]) - whole).max() > 1, place
        encoder.mlp[-1].weight.copy_(kept)
    np.testing.assert_array_equal(rollout(model, [FORWARD]), whole)


def test_poses_steer_a_front_view(made, world_model_options, tmp_path: Path) -> None:
    import tiny_actions
    import tiny_pipelines

    torch.manual_seed(0)
    options = world_model_options("svd-action")
    folder = tiny_actions.save("svd-action", tiny_pipelines.BUILDERS["svd"](), tmp_path / "poses", kind="pose7", **BOX)
    model = made("svd-action", checkpoint=str(folder), size=(64, 64))
    assert (model.accepts.space, model.accepts.view, model.accepts.null_first) == ("pose7", "perspective", False)

    def told(height: float):
        poses = np.tile([0.2, 0, height, 0, 0, 0, 1.0], (model.accepts.frames, 1))
        row = Control(np.zeros(model.accepts.frames - 1, np.int8), np.zeros((2, 3)), np.zeros((2, 4, 4)), ids=poses)
        image = np.full((1, 64, 64, 3), 90, np.uint8)
        return model.rollout(Conditioning(image), [row], np.array([1], np.uint64)).astype(int)

    assert np.abs(told(0.7) - told(1.5)).mean() > 0.02
    assert options["frames"] == model.accepts.frames
    usual = made("svd-action", checkpoint=str(folder), size=None)
    assert usual.accepts.size == (448, 448) == pickle.loads(pickle.dumps(usual)).accepts.size
    assert made("svd-action", checkpoint=str(folder), size=[576, 1024]).accepts.size == (576, 1024)
    (rollouts,) = imagine_plans(model, [plan_of(5, 0.3), plan_of(5, 0.7)]).rollouts
    assert [rollout.frames.shape for rollout in rollouts] == [(5, 48, 48, 3)] * 2
    assert np.abs(rollouts[0].frames.astype(int) - rollouts[1].frames).mean() > 0.02


def test_checkpoints_that_do_not_fit_are_named(made, world_model_options, tmp_path: Path) -> None:
    given = Path(world_model_options("svd-action")["checkpoint"])

    def refused(match: str, name: str = "svd-action", kind: str = "unfit", **options) -> None:
        with pytest.raises(WeightsError, match=match) as caught:
            made(name, **{"checkpoint": str(folder), **options})
        assert caught.value.kind == kind

    def copied(name: str, **changes) -> Path:
        other = shutil.copytree(given, tmp_path / name)
        said = json.loads((other / "config.json").read_text())
        (other / "config.json").write_text(json.dumps({**said, **changes}))
        return other

    folder = tmp_path / "nowhere"
    refused(r"no .*config\.json.*those that you train", kind="missing")
    folder = given
    refused(
        "trained for svd with 1 frames per latent, but this is ltx with 8; use the world model svd-action", "ltx-action"
    )
    folder = copied("stride", stride=4)
    refused("with 4 frames per latent")
    folder = copied("width", width=64)
    refused("does not fit its config.json: unet.mlp")
    folder = copied("format", colour="red")
    refused("cannot be used .*colour.*it has base")
    (folder / "config.json").write_text("[" * 5000)
    refused("cannot be used .*levels of nested lists")
    folder = copied("encoder")
    (folder / "action_encoder.safetensors").write_bytes(b"nothing")
    refused("action_encoder.safetensors is damaged")
    (folder / "action_encoder.safetensors").unlink()
    refused("no .*action_encoder.safetensors", kind="missing")
    folder = copied("denoiser")
    (folder / "unet/diffusion_pytorch_model.safetensors").write_bytes(b"nothing")
    refused("denoiser cannot be loaded")
    shutil.rmtree(folder / "unet")
    refused("no trained denoiser: expected unet/", kind="missing")


@pytest.mark.parametrize("name", ["svd-action", "cosmos-predict2-action"])
def test_a_lora_of_a_pipeline_that_takes_none_is_refused(name: str, made, tmp_path: Path) -> None:
    model = made(name)
    with pytest.raises(ArgumentError, match="does not support LoRA: save its whole denoiser"):
        checkpoint.save(tmp_path / "lora", model.conditioning.encoders, model.generator.pipeline, lora=True)
    folder = shutil.copytree(model.checkpoint, tmp_path / "checkpoint")
    (folder / "pytorch_lora_weights.safetensors").write_bytes(b"of another trainer")
    rollout(made(name, checkpoint=str(folder)), [FORWARD])  # its whole denoiser counts
    shutil.rmtree(folder / model.denoisers[0])
    with pytest.raises(WeightsError, match=r"as written by save_pretrained, since \w+ takes no LoRA"):
        made(name, checkpoint=str(folder))


def test_a_lora_of_another_network_is_not_passed_over(made, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    folder = shutil.copytree(made("wan2.2-a14b-action").checkpoint, tmp_path / "checkpoint")
    file = folder / "pytorch_lora_weights_2.safetensors"
    save_file({name.replace("transformer.", "unet."): value for name, value in load_file(file).items()}, file)
    with pytest.raises(WeightsError, match=r"weights_2\.safetensors holds no LoRA of the denoiser: .*'transformer\.'"):
        made("wan2.2-a14b-action", checkpoint=str(folder))


def test_where_a_checkpoint_lies_does_not_count(made, tmp_path: Path) -> None:
    model = made("svd-action")
    elsewhere = shutil.copytree(model.checkpoint, tmp_path / "elsewhere")
    assert made("svd-action", checkpoint=str(elsewhere)).fingerprint() == model.fingerprint()
    said = json.loads((elsewhere / "config.json").read_text())
    (elsewhere / "config.json").write_text(json.dumps({**said, "vocabulary": said["vocabulary"][::-1]}))
    assert made("svd-action", checkpoint=str(elsewhere)).fingerprint() != model.fingerprint()


def test_the_versions_of_generator_and_conditioning_count(made, monkeypatch) -> None:
    model = made("svd-action")
    before = model.fingerprint()
    for part in (type(model), type(model.generator)):
        with monkeypatch.context() as patch:
            patch.setattr(part, "version", "2")
            assert model.fingerprint() != before, part
    assert before and model.fingerprint() == before


@pytest.mark.parametrize("name", NAMES)
def test_options_are_those_of_the_generator_and_a_checkpoint(name: str, made) -> None:
    model = wiw.registry.WORLD_MODELS.find(name)
    options = inspect.signature(model).parameters
    of_generator = [
        option
        for option in inspect.signature(model.generator_class).parameters
        if option not in model.generator_class.wording_options
    ]
    assert list(options) == ["checkpoint", *of_generator]
    assert options["checkpoint"].default is inspect.Parameter.empty and options["weights"].default == ""
    assert options["frames"].default == model.accepts.frames
    assert options["guidance"].default == (3.0 if name == "svd-action" else 1.0)
    with pytest.raises(RegistryError, match=r"it takes .*checkpoint.*steps"):
        made(name, speed=3)


def test_a_description_is_the_generators_under_its_own_name(made) -> None:
    model = made("ltx-action")
    stock = {**model.generator.describe(), "name": "LTXAction", "checkpoint": model.checkpoint}
    assert {**stock, "checkpoint_digest": model.describe()["checkpoint_digest"]} == model.describe()
    assert model.describe()["pipeline"] == "LTXImageToVideoPipeline" and model.describe()["guidance"] == 1.0


def test_a_lora_that_does_not_fit_on_the_gpu_is_answered_with_what_needs_less(made, monkeypatch) -> None:
    def full(*_, **__):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    monkeypatch.setattr("diffusers.WanImageToVideoPipeline.load_lora_weights", full)
    with pytest.raises(DeviceMemoryError, match=r"2\.00 GiB.*offload='model'"):
        made("wan2.1-action")


def test_the_base_is_what_the_checkpoint_names(made, world_model_options) -> None:
    options = world_model_options("wan2.1-action")
    model = made("wan2.1-action", weights="")
    assert model.describe()["weights"] == options["weights"]
