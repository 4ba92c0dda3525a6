# SPDX-License-Identifier: Apache-2.0
"""World models that run diffusers' pipelines: options, alignment of frames and actions, weights, errors.

The contract test asks them as the loop does; here is what only they have.
"""

from __future__ import annotations

import http.server
import importlib.util
import json
import pickle
import re
import shutil
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import wiw
from wiw import action
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.cli import main
from wiw.errors import ArgumentError, ContractError, DependencyError, DeviceMemoryError, RegistryError, WeightsError
from wiw.studies.run_log import load_run
from wiw.types import Conditioning, Control

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")

from wiw.world_models.video.sana import interpolate_path
from wiw.world_models.video.weights import SAMPLE_BYTES, SAMPLES, digest_folder

NAMES = ["svd", "ltx", "hunyuan", "wan2.1", "wan2.2-5b", "wan2.2-a14b", "cosmos-predict2", "sana-wm"]
BATCHED = ["svd", "ltx", "cosmos-predict2"]


@pytest.fixture
def made(world_model_options):
    """A world model with tiny weights and the options of the test."""
    return lambda name, **options: wiw.world_model(name, **{**world_model_options(name), **options})


def control(actions, frames: int) -> Control:
    plan = action.pad(actions, frames - 1)
    views = action.to_trajectory(plan), action.to_viewpoints(plan)
    return Control(plan, *views, action.to_text(actions), length=len(actions))


def picture(model, rows: int = 1) -> Conditioning:
    return Conditioning(np.random.default_rng(0).integers(0, 256, (rows, *model.size, 3), np.uint8))


def rollout(model, plans=((FORWARD, FORWARD),), seeds=(7,)):
    controls = [control(plan, model.frames) for plan in plans]
    return model.rollout(picture(model, len(plans)), controls, np.array(seeds, np.uint64))


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_from_the_command_line(name, world_model_options, two_rooms, tmp_path):
    (tmp_path / "short.yaml").write_text("base: paper\ndecisions: 1\n")
    command = ["run", "imagenav", "--scenes", two_rooms, "--preset", str(tmp_path / "short.yaml"), "--episodes", "1"]
    for key, value in world_model_options(name).items():
        command += ["--world-model-option", f"{key}={list(value) if isinstance(value, tuple) else value}"]
    assert main([*command, "--world-model", name, "--out", str(tmp_path / "run"), "--no-report", "--cache", "off"]) == 0
    log = load_run(tmp_path / "run")
    assert [episode["status"] for episode in log.episodes] == ["done"]
    assert log.decisions[0]["calls"]["rows"] > 0
    said = log.store.info["built"][name]["model"]
    assert said["steps"] == world_model_options(name)["steps"] and said["digest"] and said["diffusers"]
    assert "torchvision" not in sys.modules


@pytest.mark.parametrize("name", NAMES)
def test_frames_are_a_function_of_the_seed_and_survive_pickling(name, made):
    model = made(name)
    frames = rollout(model)
    np.testing.assert_array_equal(frames[:, 0], picture(model).image)
    again = pickle.loads(pickle.dumps(model))
    assert again.describe() == model.describe() and again.fingerprint() == model.fingerprint()
    np.testing.assert_array_equal(rollout(again), frames)
    assert np.abs(rollout(model, seeds=[2**64 - 1]).astype(float) - frames).max() > 2


@pytest.mark.parametrize("name", BATCHED)
def test_rows_of_one_call_do_not_meet(name, made):
    plans, seeds = ((FORWARD, TURN_LEFT), (TURN_RIGHT,), (FORWARD,)), (1, 2, 3)
    one, three = made(name), made(name, batch=3)
    apart, together = rollout(one, plans, seeds), rollout(three, plans, seeds)
    assert np.abs(apart.astype(int) - together).max() <= 1
    assert three.accepts.best_batch == 3 and three.fingerprint() == one.fingerprint()


def test_a_clip_shows_the_plan_evenly(made):
    model = made("ltx", frames=17)
    shades = np.linspace(0, 1, 17, dtype=np.float32)
    model.generate = lambda images, controls, generators: np.broadcast_to(
        shades[None, :, None, None, None], (len(images), 17, *model.size, 3)
    )
    for length, expected in ((1, [16]), (2, [8, 16]), (5, [3, 6, 10, 13, 16]), (16, list(range(1, 17)))):
        frames = rollout(model, [(FORWARD,) * length])[0]
        np.testing.assert_array_equal(frames[1 : 1 + length, 0, 0, 0], np.rint(shades[expected] * 255))
        assert (frames[1 + length :] == 255).all(), "padding is the plan's end"


def test_a_model_that_knows_no_plan_gives_its_frames_in_order(made):
    model = made("svd")
    shades = np.linspace(0, 1, model.frames, dtype=np.float32)
    model.generate = lambda *_: np.broadcast_to(shades[None, :, None, None, None], (1, model.frames, *model.size, 3))
    np.testing.assert_array_equal(rollout(model)[0, 1:, 0, 0, 0], np.rint(shades[1:] * 255))


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("svd", "sana-wm")])
def test_the_plan_reaches_the_pipeline_in_words(name, made):
    model = made(name)
    pipeline, asked = model.pipeline, {}

    def listening(**given):
        asked.update(given)
        return pipeline(**given)

    model.pipeline = listening
    listening.transformer = pipeline.transformer
    rollout(model)
    prompt = asked["prompt"] if isinstance(asked["prompt"], str) else asked["prompt"][0]
    assert "move forward 0.2 m, then move forward 0.2 m." in prompt
    assert asked["guidance_scale"] == model.guidance and asked["num_inference_steps"] == model.steps


def test_the_camera_path_is_interpolated_in_the_pipelines_axes():
    path = interpolate_path(control([TURN_LEFT, FORWARD], 9), 9)
    angle = np.deg2rad(22.5)
    ahead = np.array([-np.sin(angle), 0, np.cos(angle)])  # x right, y down, z ahead
    np.testing.assert_allclose(path[0], np.eye(4), atol=1e-6)
    np.testing.assert_allclose(path[4, :3, 2], ahead, atol=1e-6)
    np.testing.assert_allclose(path[8, :3, 3], 0.2 * ahead, atol=1e-6)
    np.testing.assert_allclose(path[6, :3, 3], 0.1 * ahead, atol=1e-6)
    np.testing.assert_allclose(path[2, :3, 2], [-np.sin(angle / 2), 0, np.cos(angle / 2)], atol=1e-6)


def test_hunyuan_keeps_the_frames_of_both_kinds_of_checkpoint(made, tmp_path):
    import tiny_pipelines

    concatenating = made("hunyuan")
    assert rollout(concatenating).shape == (1, 5, *concatenating.size, 3)
    tiny_pipelines.hunyuan("token_replace").save_pretrained(tmp_path)
    assert rollout(made("hunyuan", weights=str(tmp_path))).shape == (1, 5, *concatenating.size, 3)


def test_ltx_runs_with_the_decoders_that_take_away_noise(made, tmp_path):
    import tiny_pipelines

    tiny_pipelines.ltx(timestep_conditioning=True).save_pretrained(tmp_path)
    model = made("ltx", weights=tmp_path)
    first, again, other = (rollout(model, seeds=[seed]) for seed in (2**64 - 1, 2**64 - 1, 5))
    np.testing.assert_array_equal(first, again)
    assert first.shape == (1, 9, *model.size, 3) and (first != other).any()
    with pytest.raises(ArgumentError, match=r"one row at a time .* got batch=2"):
        made("ltx", weights=tmp_path, batch=2)


def test_hunyuan_shows_the_end_of_a_clip_whose_beginning_is_dropped(made):
    from types import SimpleNamespace

    model = made("hunyuan", frames=9)
    shades = np.linspace(0, 1, 9 + 4, dtype=np.float32)  # of the clip with its beginning
    transformer = model.pipeline.transformer

    def dropping(**given):
        assert given["num_frames"] == len(shades)
        return SimpleNamespace(frames=np.broadcast_to(shades[None, 4:, None, None, None], (1, 9, *model.size, 3)))

    model.pipeline = dropping
    dropping.transformer = transformer
    found = rollout(model, [(FORWARD,) * 8])[0, 1:, 0, 0, 0]
    np.testing.assert_array_equal(found, np.rint(shades[[4, 4, 4, 6, 8, 9, 10, 12]] * 255))


@pytest.mark.parametrize(("name", "kin"), [("ltx", "LTXPipeline"), ("wan2.2-5b", "WanPipeline")])
def test_folders_of_kindred_pipelines_serve(name, kin, made, world_model_options, tmp_path):
    folder = shutil.copytree(world_model_options(name)["weights"], tmp_path / "kin")
    index = json.loads((folder / "model_index.json").read_text())
    index = {key: value for key, value in index.items() if not key.startswith("image_")} | {"_class_name": kin}
    (folder / "model_index.json").write_text(json.dumps(index))
    np.testing.assert_array_equal(rollout(made(name, weights=folder)), rollout(made(name)))


@pytest.mark.parametrize(
    ("name", "asked", "size", "frames"),
    [
        ("svd", {"size": (99, 63), "frames": 6}, (96, 64), 6),
        ("ltx", {"size": [50, 40], "frames": 10}, (64, 32), 17),
        ("wan2.1", {"size": (40, 33), "frames": 6}, (32, 32), 9),
        ("wan2.2-5b", {"size": (40, 56), "frames": 5}, (32, 64), 5),
    ],
)
def test_sizes_and_frames_are_rounded_to_what_the_networks_divide(name, asked, size, frames, made):
    model = made(name, **asked)
    assert (model.size, model.frames) == (size, frames) == (model.accepts.size, model.accepts.frames)
    assert rollout(model).shape == (1, frames, *size, 3)


def test_long_plans_go_on_from_the_last_frame(made, two_rooms):
    from wiw.loop.clock import Clock
    from wiw.loop.imagination import ModelInput, Request
    from wiw.loop.plan_space import plan_space
    from wiw.policies.base import FrameSpec
    from wiw.tasks.imagenav import ImageNav
    from wiw.types import Key, Proposal

    model = made("wan2.2-5b")
    starts, answers, whole = [], [], model.rollout

    def watched(observations, controls, seeds):
        starts.append(observations.image)
        answers.append(whole(observations, controls, seeds))
        return answers[-1]

    model.rollout = watched
    task = ImageNav(scenes=two_rooms)
    env = task.environment(depth=False)
    observation = env.begin(task.episode(0))
    plan = Proposal([FORWARD] * 10)
    space, asked = plan_space("discrete"), ([Key(0, 0)], [observation], [ModelInput(observation)])
    request = Request(space, *asked, [[plan]], [range(1)], FrameSpec("front", (32, 32)), Clock())
    futures = space.imagine(model, request)
    assert len(futures.rollouts[0][0].frames) == 10
    assert len(answers) == 3, "four actions a clip"
    np.testing.assert_array_equal(starts[1], answers[0][:, 4])
    np.testing.assert_array_equal(starts[2], answers[1][:, 4])


@pytest.mark.parametrize("name", [name for name in NAMES if name != "sana-wm"])  # whose network refuses it on a CPU
def test_half_precision_is_close(name, made):
    whole, half = (
        made(name, precision="float32"),
        made(name, precision=wiw.registry.WORLD_MODELS.find(name).half_precision),
    )
    difference = np.abs(rollout(whole).astype(float) - rollout(half))
    assert 0 < difference.mean() < 4
    assert whole.fingerprint() != half.fingerprint()


def test_half_precision_leaves_some_networks_whole(made):
    import torch

    networks = made("wan2.1", precision="bfloat16").pipeline.components
    assert networks["transformer"].dtype == networks["text_encoder"].dtype == torch.bfloat16
    assert networks["vae"].dtype == networks["image_encoder"].dtype == torch.float32


def test_the_weights_tell_models_apart_and_their_place_does_not(made, world_model_options, tmp_path):
    import torch
    from safetensors.torch import load_file, save_file

    there = Path(world_model_options("ltx")["weights"])
    here = shutil.copytree(there, tmp_path / "copy")
    (here / "README.md").write_text("a card")
    first, second = made("ltx"), made("ltx", weights=here)
    assert first.fingerprint() == second.fingerprint() and first.describe() != second.describe()
    assert first.fingerprint() != made("ltx", steps=2).fingerprint()
    file = here / "transformer/diffusion_pytorch_model.safetensors"
    save_file({name: torch.add(tensor, 1e-3) for name, tensor in load_file(file).items()}, file)
    assert made("ltx", weights=here).fingerprint() != first.fingerprint()


def test_weights_behind_a_link_tell_models_apart(tmp_path):
    found = set()
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "diffusion_pytorch_model.safetensors").write_text(name)
        pipeline = tmp_path / f"pipeline of {name}"
        pipeline.mkdir()
        (pipeline / "transformer").symlink_to(tmp_path / name)
        found.add(digest_folder(pipeline))
        (pipeline / "transformer").unlink()
        shutil.copytree(tmp_path / name, pipeline / "transformer")
        assert digest_folder(pipeline) in found
    assert len(found) == 2


def test_large_weights_are_told_apart_by_samples(tmp_path):
    size = 2 * SAMPLES * SAMPLE_BYTES
    weights = np.random.default_rng(0).integers(0, 256, size, np.uint8)
    file = tmp_path / "a.safetensors"
    found = set()
    for place in (None, 0, size // 2 - size // 60, size - 1):
        changed = weights.copy()
        if place is not None:
            changed[place : place + size // 20] += 1
        file.write_bytes(changed.tobytes())
        found.add(digest_folder(tmp_path))
    assert len(found) == 4


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"steps": 0}, "steps"),
        ({"frames": 1}, "frames"),
        ({"frames": "many"}, "frames"),
        ({"size": 32}, "size"),
        ({"size": (32, 0)}, "size"),
        ({"batch": 2}, "takes 1 at a time"),
        ({"precision": "int8"}, "float32, bfloat16, float16"),
        ({"offload": "disk"}, "none, model, sequential"),
        ({"offload": "model"}, "leave it out on the CPU"),
        ({"device": "tpu"}, "device"),
        ({"device": "cuda:99"}, "device='cpu'"),
        ({"revision": "main"}, "is a folder"),
    ],
)
def test_options_out_of_range_are_named(options, said, made):
    with pytest.raises(ArgumentError, match=said):
        made("wan2.2-5b", **options)


def test_unknown_options_are_answered_with_the_known_ones(made):
    with pytest.raises(RegistryError, match=r"it takes .*weights.*steps"):
        made("svd", speed=3)


def test_the_filter_of_cosmos_is_the_users_choice(made):
    with pytest.raises(ArgumentError, match="guardrail=False"):
        made("cosmos-predict2", guardrail=None)
    with pytest.raises(DependencyError, match="pip install cosmos_guardrail"):
        made("cosmos-predict2", guardrail=True)


def test_a_missing_package_is_named_with_the_extra(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "ftfy" else find(name))
    with pytest.raises(DependencyError, match=r"ftfy not installed; pip install 'wiw\[diffusers\]'"):
        wiw.world_model("wan2.1", weights="/models/wan")


def test_a_tokenizer_that_takes_protobuf_to_read_says_so(made, world_model_options, tmp_path, monkeypatch):
    folder = shutil.copytree(world_model_options("ltx")["weights"], tmp_path / "copy")
    (folder / "tokenizer/spiece.model").write_bytes(b"")
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "google.protobuf" else find(name))
    made("ltx", weights=folder)  # has tokenizer.json too
    (folder / "tokenizer/tokenizer.json").unlink()
    with pytest.raises(DependencyError, match=r"google\.protobuf not installed; pip install 'wiw\[diffusers\]'"):
        made("ltx", weights=folder)


def test_weights_that_are_not_there_or_of_another_model(made, world_model_options, tmp_path):
    from safetensors.torch import load_file, save_file

    def refused(name: str, weights, kind: str, said: str) -> None:
        with pytest.raises(WeightsError, match=said) as refusal:
            made(name, weights=str(weights))
        assert refusal.value.kind == kind

    refused("svd", tmp_path / "nowhere", "missing", "no folder")
    refused("svd", "somewhere", "missing", "no folder")
    refused("svd", tmp_path, "missing", "model_index.json")
    refused("svd", world_model_options("ltx")["weights"], "unfit", "expected .*StableVideo.* found .*LTX")
    refused("wan2.1", world_model_options("wan2.2-a14b")["weights"], "unfit", "boundary_ratio")
    refused("wan2.2-5b", world_model_options("wan2.1")["weights"], "unfit", "expand_timesteps")
    copy = shutil.copytree(world_model_options("ltx")["weights"], tmp_path / "copy")
    file = copy / "transformer/diffusion_pytorch_model.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    refused("ltx", copy, "unfit", "damaged")
    whole = load_file(Path(world_model_options("ltx")["weights"]) / "transformer" / file.name)
    save_file({name: value for name, value in whole.items() if name != "proj_in.bias"}, file)
    refused("ltx", copy, "unfit", r"lacks 1 parameters, such as transformer\.proj_in\.bias")
    text = copy / "text_encoder/model.safetensors"
    kept = text.read_bytes()
    save_file({name: value[..., :3].contiguous() for name, value in load_file(text).items()}, text, {"format": "pt"})
    save_file(whole, file)
    refused("ltx", copy, "unfit", "cannot be loaded")
    text.write_bytes(kept)
    file.unlink()
    refused("ltx", copy, "unfit", "missing")
    for text in ("{", "[" * 5000, '["LTXPipeline"]'):
        (copy / "model_index.json").write_text(text)
        refused("ltx", copy, "unfit", "is damaged")


REFUSALS = {"gated": (403, "GatedRepo"), "absent": (404, "RepoNotFound"), "old": (404, "RevisionNotFound")}


class Hub(http.server.BaseHTTPRequestHandler):
    """Says no as the Hugging Face hub does."""

    def do_GET(self) -> None:
        status, code = next(REFUSALS[name] for name in REFUSALS if f"/some/{name}" in self.path)
        body = json.dumps({"error": code}).encode()
        self.send_response(status)
        self.send_header("X-Error-Code", code)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    do_HEAD = do_GET  # noqa: N815

    def log_message(self, *_) -> None:
        pass


@pytest.fixture
def hub(monkeypatch, tmp_path):
    from huggingface_hub import constants, hf_api

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}"
    monkeypatch.setattr(constants, "ENDPOINT", url)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(hf_api.api, "endpoint", url)
    yield server
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [
        ("gated", "gated", "accept its terms"),
        ("absent", "missing", "no repository"),
        ("old", "revision", "no revision 'abc'"),
    ],
)
def test_what_the_hub_refuses_is_said_in_plain_words(name, kind, said, hub, made):
    with pytest.raises(WeightsError, match=said) as refusal:
        made("ltx", weights=f"some/{name}", revision="abc")
    assert refusal.value.kind == kind


def test_without_a_network_the_error_says_how_to_do_without(hub, made):
    hub.shutdown()
    hub.server_close()
    with pytest.raises(WeightsError, match="hf download some/gated --local-dir") as refusal:
        made("ltx", weights="some/gated")
    assert refusal.value.kind == "network"


def test_weights_in_the_hubs_cache_need_no_network(hub, made, world_model_options, tmp_path, monkeypatch):
    from huggingface_hub import constants

    commit = "0123456789abcdef0123456789abcdef01234567"
    repository = tmp_path / "hub/models--some--model"
    shutil.copytree(world_model_options("ltx")["weights"], repository / "snapshots" / commit)
    (repository / "refs").mkdir()
    (repository / "refs/main").write_text(commit)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    model = made("ltx", weights="some/model", revision=commit)
    assert model.describe()["commit"] == commit
    np.testing.assert_array_equal(rollout(model), rollout(made("ltx")))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    from wiw.networks import in_hub_cache

    assert in_hub_cache("some/model") and not in_hub_cache("some/other")


@pytest.mark.parametrize(
    "said",
    [
        "CUDA out of memory. Tried to allocate 2.00 GiB.\nmore",
        "CUDA error: out of memory",
        "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`",
        "DefaultCPUAllocator: can't allocate memory: you tried to allocate 8000000000000 bytes. Error code 12",
    ],
)
def test_a_full_gpu_is_answered_with_the_options_that_need_less(said, made):
    import torch

    model = made("ltx", batch=4)

    def full(**_):
        raise (torch.OutOfMemoryError if "GiB" in said else RuntimeError)(said)

    model.pipeline = full
    first = re.escape(said.splitlines()[0])
    with pytest.raises(DeviceMemoryError, match=rf"{first}.*batch=1.*bfloat16.*offload='model'.*smaller size.*frames"):
        rollout(model)


def test_other_errors_of_the_gpu_stay_what_they_are(made):
    model = made("ltx")

    def lost(**_):
        raise RuntimeError("CUDA error: unspecified launch failure")

    model.pipeline = lost
    with pytest.raises(RuntimeError, match="launch failure"):
        rollout(model)


def test_nan_is_no_picture(made):
    model = made("ltx")
    model.generate = lambda *_: np.full((1, model.frames, *model.size, 3), np.nan, np.float32)
    with pytest.raises(ContractError, match="NaN in float32") as breach:
        rollout(model)
    assert breach.value.kind == "nan"


@pytest.mark.parametrize("name", NAMES)
def test_weights_that_give_nan_are_found(name, made):
    """Also where the pipeline makes bytes of its frames, in which NaN is black."""
    model = made(name)
    denoiser = getattr(model.pipeline, "transformer", None) or model.pipeline.unet
    next(value for value in denoiser.parameters() if value.ndim > 1).data.fill_(np.nan)
    with pytest.raises(ContractError, match="NaN in float32"):
        rollout(model)


@pytest.mark.parametrize("columns", [80, 120])
def test_list_says_what_each_model_takes_and_lacks(columns, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    monkeypatch.delenv("RUNWAYML_API_SECRET", raising=False)
    assert main(["list", "world-models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= columns
    rows, name = {}, ""
    for line in lines:
        name = line.split()[0] if line[:1].strip() else name
        rows[name] = " ".join([rows.get(name, ""), *line.split()]).strip()
    assert set(wiw.registry.list_world_models()) <= set(rows)
    for name in NAMES:
        control = {"svd": "image", "sana-wm": "trajectory"}.get(name, "text")
        assert rows[name].startswith(f"{name} {control} perspective perspective") and "needs weights" in rows[name]
    assert "RUNWAYML_API_SECRET" in rows["runway-gen4"]
    depth = "panorama + panorama 576x1024 any depth" if columns == 80 else "panorama + depth panorama 576x1024 any"
    assert rows["warp"] == f"warp trajectory {depth} ready"
    assert "480x480 25 Wan-AI/Wan2.2-I2V-A14B-Diffusers needs" in rows["wan2.2-a14b"]
    assert rows["wan2.1-action"].endswith("checkpoint=...")
