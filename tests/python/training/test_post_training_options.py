# SPDX-License-Identifier: Apache-2.0
"""Averaged weights, 8-bit Adam, memory, and the cache of latents in post-training."""

from __future__ import annotations

import importlib.util
import io
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw.errors import ArgumentError, DependencyError, DeviceMemoryError
from wiw.networks import autocast_uncached, memory_guard
from wiw.ray_cluster import HERE, Engine

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")
pytest.importorskip("peft", reason="no peft: pip install 'wiw[diffusers]'")
pytest.importorskip("pyarrow", reason="no pyarrow: pip install 'wiw[export]'")

import torch
from post_training_parts import make_trainer, save_dataset, save_stock, tiny_recipe, with_nightly
from safetensors.torch import load_file, save

import tiny_pipelines
from wiw.cli import main
from wiw.training.post_training import encode_clips
from wiw.training.post_training.clip_order import ClipOrder
from wiw.training.post_training.corpora import open_corpus
from wiw.training.post_training.encode_clips import ClipEncoder, _list_rows, choose_encoding_device
from wiw.training.post_training.families import NWMFamily, PretrainedWeights, find_family
from wiw.training.post_training.latent_cache import LatentCache
from wiw.training.post_training.train import list_remedies, open_cache, post_train
from wiw.training.post_training.trainable import Encoded
from wiw.training.post_training.trainer import PostTrainer

pytestmark = pytest.mark.usefixtures("one_torch_thread")

NAMES = ("svd-action", "ltx-action", "wan2.1-action", "cosmos-predict2-action", "nwm-action")
"""One of each way of encoding clips."""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_dataset(tmp_path_factory.mktemp("post") / "data")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory):
    return partial(save_stock, tmp_path_factory.mktemp("stock"))


def require_equal(first: PostTrainer, second: PostTrainer) -> None:
    assert first.mean_loss == second.mean_loss
    assert all(torch.equal(value, second.trained[name]) for name, value in first.trained.items())
    assert all(torch.equal(value, second.averages[name]) for name, value in first.averages.items())


def test_averages_are_their_formula_and_resume_exactly(data: Path, weights: Any) -> None:
    options: dict[str, Any] = {"epochs": 6, "ema": 0.25}
    whole = make_trainer("ltx-action", data, weights("ltx-action"), **options)
    expected = {name: value.detach().double() for name, value in whole.trained.items()}
    state = io.BytesIO()
    for step in range(6):
        whole.train_step(1e-2)
        kept = (0.1, 2 / 11, 0.25, 0.25, 0.25, 0.25)[step]
        expected = {name: kept * value + (1 - kept) * whole.trained[name].detach() for name, value in expected.items()}
        if step == 2:
            torch.save(whole.state_dict(), state)
    for name, value in expected.items():
        torch.testing.assert_close(whole.averages[name].double(), value, rtol=1e-5, atol=1e-7)
    resumed = make_trainer("ltx-action", data, weights("ltx-action"), **options)
    state.seek(0)
    resumed.load_state_dict(torch.load(state, weights_only=True))
    for _ in range(3):
        resumed.train_step(1e-2)
    require_equal(whole, resumed)


def test_only_the_expert_in_training_is_averaged(data: Path, weights: Any) -> None:
    name = "wan2.2-a14b-action"
    trainer = make_trainer(name, data, weights(name), ema=0.5)
    moved = []
    for _ in range(4):
        before = {key: value.clone() for key, value in trainer.averages.items()}
        trainer.train_step(1e-2)
        moved.append({key for key, value in trainer.averages.items() if not torch.equal(value, before[key])})
    assert moved[1] and not any("transformer_2" in key for key in moved[0] | moved[1])
    assert moved[2] and all("transformer_2" in key for key in moved[2] | moved[3])


def test_averages_of_each_expert_soon_forget_their_start(data: Path, weights: Any) -> None:
    name = "wan2.2-a14b-action"
    trainer = make_trainer(name, data, weights(name), ema=0.99)
    for step in range(4):
        active = trainer.list_active()
        before = {key: trainer.averages[key].clone() for key in active}
        trainer.train_step(1e-2)
        kept = (0.1, 2 / 11)[step % 2]
        for key in active:
            expected = torch.lerp(trainer.trained[key].detach(), before[key], kept)
            torch.testing.assert_close(trainer.averages[key], expected, rtol=1e-5, atol=1e-7)


def test_the_checkpoint_has_the_averages_and_training_goes_on_with_the_weights(
    data: Path, weights: Any, tmp_path: Path
) -> None:
    options: dict[str, Any] = {"weights": weights("nwm-action"), "device": "cpu", "part": "all"}
    found = {}
    for decay in (0.0, 0.9):
        recipe = tiny_recipe("nwm-action", epochs=4, ema=decay)
        post_train("nwm-action", data, tmp_path / str(decay), recipe=recipe, **options)
        found[decay] = load_file(tmp_path / str(decay) / "cdit.safetensors")
    twin = make_trainer("nwm-action", data, weights("nwm-action"), epochs=4, ema=0.9)
    for step in range(4):
        twin.train_step(twin.recipe.rate * twin.recipe.scale_rate((step + 0.5) / 4))
    for name, value in found[0.9].items():
        torch.testing.assert_close(value, twin.averages[f"cdit.{name}"], rtol=0, atol=0)
    assert any(not torch.equal(value, found[0.0][name]) for name, value in found[0.9].items())
    weights_before = {name: value.detach().clone() for name, value in twin.trained.items()}
    with twin.use_averages():
        assert all(torch.equal(value, found[0.9][name.removeprefix("cdit.")]) for name, value in twin.trained.items())
    assert all(torch.equal(value, weights_before[name]) for name, value in twin.trained.items())


@pytest.mark.parametrize("name", with_nightly(NAMES, ("ltx-action", "nwm-action")))
def test_a_cache_changes_nothing_but_is_read(
    name: str, data: Path, weights: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Same bytes without a cache, with an empty one and with a filled one, which needs neither clips nor encoders."""
    plain, filling, reading = (
        make_trainer(name, data, weights(name), epochs=3, mirror=0.5, checkpointing=False) for _ in range(3)
    )
    filling._cache = reading._cache = LatentCache(tmp_path, {"of": name})
    monkeypatch.setattr(reading.model, "encode", None)
    monkeypatch.setattr(reading, "_load_clip", None)
    for trainer in (plain, filling, reading):
        for _ in range(3):
            trainer.train_step(1e-3)
    require_equal(plain, filling)
    require_equal(plain, reading)
    files = [path.name for path in tmp_path.rglob("*.safetensors")]
    assert 4 < len(files) <= 8 and any("mirrored" in each for each in files) and not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize(
    ("given", "precision", "seed"),
    [
        ([], "bfloat16", 5),
        (["--seed", "0"], "bfloat16", 0),
        (["--seed", "0", "--option", "seed=7", "--option", "precision=float32"], "float32", 7),
    ],
)
def test_numbers_of_a_recipe_file_are_kept_unless_options_replace_them(
    given: list[str], precision: str, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[Any] = []
    monkeypatch.setattr(encode_clips, "encode_clips", lambda *_, **named: (found.append(named["recipe"]), 1)[1])
    (tmp_path / "mine.yaml").write_text("precision: bfloat16\nseed: 5\n")
    (tmp_path / "data").mkdir()
    asked = ["train", "nwm-action", "--data", str(tmp_path / "data"), "--cache", str(tmp_path / "cache")]
    asked += ["--encode-only", "--device", "cpu"]
    assert main([*asked, "--recipe", str(tmp_path / "mine.yaml"), *given]) == 0
    assert main(asked) == 0
    assert [(each.precision, each.seed) for each in found] == [(precision, seed), ("float32", 0)]


def test_clips_are_encoded_in_the_precision_of_the_actors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Actors of Ray may have GPUs where this machine has none."""
    found: list[str] = []
    monkeypatch.setattr(
        encode_clips, "encode_clips", lambda *_, **named: (found.append(named["recipe"].precision), 1)[1]
    )
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    (tmp_path / "data").mkdir()
    asked = ["train", "nwm-action", "--data", str(tmp_path / "data"), "--cache", str(tmp_path / "cache")]
    for more in ([], ["--engine", "ray"], ["--engine", "ray", "--worker-gpus", "1"]):
        assert main([*asked, "--encode-only", *more]) == 0
    assert found == ["float32", "float32", "bfloat16"]
    ray = Engine(engine="ray", worker_gpus=0.5)
    assert [choose_encoding_device(ray, each) for each in (None, "cpu")] == ["cuda", "cpu"]
    with pytest.raises(ArgumentError, match="CUDA devices"):
        choose_encoding_device(HERE, "cuda:99")


def test_clips_that_need_too_much_memory_say_what_to_lower(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(*_: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(NWMFamily, "load", fill)
    with pytest.raises(
        DeviceMemoryError, match=r"encoding clips for nwm-action on cpu .*memory\.\); a smaller size than"
    ):
        recipe = tiny_recipe("nwm-action", precision="bfloat16")
        ClipEncoder("nwm-action", str(data), "cache", recipe, "all", PretrainedWeights(device="cpu"))


def test_gradients_are_freed_after_a_step(data: Path, weights: Any) -> None:
    trainer = make_trainer("nwm-action", data, weights("nwm-action"))
    trainer.train_step(1e-3)
    assert [name for name, value in trainer.trained.items() if value.grad is not None] == []


def test_weights_in_half_precision_are_not_kept_until_the_end_of_a_pass() -> None:
    with autocast_uncached(torch.device("cpu"), True):
        assert torch.is_autocast_enabled("cpu") and not torch.is_autocast_cache_enabled()
    with autocast_uncached(torch.device("cpu"), False):
        assert not torch.is_autocast_enabled("cpu")


def test_of_nested_guards_the_outermost_says_what_to_lower() -> None:
    with (
        pytest.raises(DeviceMemoryError, match=r"^training does not fit .* \(full: out of memory\); rows=1$"),
        memory_guard("training", "rows=1"),
        memory_guard("LTX", "offload='model'"),
    ):
        raise RuntimeError("full: out of memory")
    with pytest.raises(RuntimeError, match=r"^another$"), memory_guard("training", "rows=1"):
        raise RuntimeError("another")


def test_the_clips_to_encode_are_those_that_a_training_takes(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = tiny_recipe("ltx-action", clips=7, batch=2, mirror=0.5)
    order = ClipOrder(len(open_corpus(data, "all").clips(recipe.frames)), 7, 2, recipe.seed)
    seen = {int(row) for step in range(9 * order.steps_per_epoch) for row in order.select(step)}
    monkeypatch.setattr(ClipOrder, "select", None)  # which draws an order for each step
    rows = list(_list_rows("ltx-action", data, recipe, "all"))
    assert [(row["clip"], row["mirrored"]) for row in rows] == [(row, side) for row in sorted(seen) for side in (0, 1)]


@pytest.mark.parametrize(
    ("name", "asked", "fitted"),
    [
        ("ltx-action", (10, (60, 120)), (17, (64, 128))),
        ("ltx-action", (9, (64, 128)), (9, (64, 128))),
        ("wan2.1-action", (6, (40, 64)), (9, (32, 64))),
        ("wan2.2-5b-action", (5, (40, 64)), (5, (32, 64))),
        ("svd-action", (3, (33, 63)), (3, (32, 64))),
        ("cosmos-predict2-action", (4, (24, 60)), (5, (32, 64))),
        ("ltx-action", (9, None), (9, (576, 1024))),
    ],
)
def test_clips_have_the_shape_that_the_model_takes_before_it_is_loaded(
    name: str, asked: tuple[Any, ...], fitted: tuple[Any, ...], data: Path, weights: Any
) -> None:
    family, corpus = find_family(name), open_corpus(data, "all")
    _, recipe = family.fit(corpus, replace(tiny_recipe(name), frames=asked[0], size=asked[1]))
    assert (recipe.frames, recipe.size) == fitted
    loaded = family.load(corpus, recipe, PretrainedWeights(str(weights(name)), device="cpu"))
    assert loaded.recipe == recipe


def test_clips_encoded_ahead_are_those_of_a_training_whose_frames_are_rounded(
    data: Path, weights: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    name, cache = "ltx-action", tmp_path / "cache"
    recipe = tiny_recipe(name, frames=4, size=(30, 64), epochs=1)
    options: dict[str, Any] = {"weights": weights(name), "device": "cpu", "recipe": recipe, "part": "all"}
    count = encode_clips.encode_clips(name, data, cache, **options)
    said = "ltx-action takes other shapes; it is trained with frames=9 in place of 4 and size=[32, 64] in place of"
    assert [each for each in caplog.messages if "shape" in each] == [f"{said} [30, 64]"]
    files = sorted(cache.rglob("*.safetensors"))
    assert count == len(files) == 4
    caplog.clear()
    monkeypatch.setattr("wiw.training.post_training.trainer.load_clip", None)
    card = post_train(name, data, tmp_path / "out", cache=cache, **options)
    assert (card["recipe"]["frames"], card["recipe"]["size"]) == (9, [32, 64]) and len(caplog.messages) == 1
    assert sorted(cache.rglob("*.safetensors")) == files


def test_clips_are_counted_as_the_model_takes_them_before_it_is_loaded(data: Path, tmp_path: Path) -> None:
    """Segments have 12 frames: enough for the 10 that are asked for, too few for the 17 that the model takes."""
    recipe, nowhere = tiny_recipe("ltx-action", frames=10), tmp_path / "nowhere"
    with pytest.raises(ArgumentError, match="no segment has 17 frames"):
        post_train("ltx-action", data, tmp_path / "out", recipe=recipe, weights=nowhere, device="cpu", part="all")


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("ltx-action", {"still": 0.5}, "still: ltx-action does not read it; leave it out, got 0.5"),
        ("svd-action", {"shift": 3.0}, "shift: svd-action does not read it"),
        ("cosmos-predict2-action", {"shift": 5.0}, "shift: cosmos-predict2-action does not read it"),
        ("wan2.1-action", {"still": 0.1}, "still: wan2.1-action does not read it"),
        ("nwm-action", {"shift": 2.0}, "shift: nwm-action does not read it"),
        ("svd-action", {"drop": 0.34}, "drop: svd-action drops .*expected a third at most, got 0.34"),
    ],
)
def test_options_without_effect_are_refused_before_weights_are_loaded(
    name: str, options: dict[str, Any], said: str, data: Path, tmp_path: Path
) -> None:
    with pytest.raises(ArgumentError, match=said):
        post_train(name, data, tmp_path / "out", recipe=tiny_recipe(name, **options), weights=tmp_path / "nowhere")
    assert not list(tmp_path.iterdir())
    find_family(name).fit(open_corpus(data, "all"), tiny_recipe(name))
    read = {"svd-action": {"drop": 1 / 3}, "wan2.1-action": {"shift": 2.0}, "nwm-action": {"still": 0.5}}
    find_family(name).fit(open_corpus(data, "all"), tiny_recipe(name, **read.get(name, {"drop": 0.9})))


@pytest.mark.parametrize("place", ["latents", "latents/more/folders"])
def test_a_cache_in_the_place_of_a_file_is_refused_before_weights_are_loaded(
    place: str, data: Path, tmp_path: Path
) -> None:
    (tmp_path / "latents").write_text("mine")
    options: dict[str, Any] = {"recipe": tiny_recipe("ltx-action"), "weights": tmp_path / "nowhere", "device": "cpu"}
    said = r"cache: expected a folder, new or not, got .*: .*latents is a file"
    with pytest.raises(ArgumentError, match=said):
        post_train("ltx-action", data, tmp_path / "out", cache=tmp_path / place, **options)
    with pytest.raises(ArgumentError, match=said):
        encode_clips.encode_clips("ltx-action", data, tmp_path / place, **options)


def test_a_damaged_file_of_the_cache_is_made_anew(data: Path, weights: Any, tmp_path: Path) -> None:
    plain, cached = (make_trainer("nwm-action", data, weights("nwm-action"), epochs=3) for _ in range(2))
    cached._cache = LatentCache(tmp_path, {})
    for step in range(3):
        for path in tmp_path.rglob("*.safetensors"):
            path.write_bytes(path.read_bytes()[: 40 * step])
        plain.train_step(1e-3)
        cached.train_step(1e-3)
    require_equal(plain, cached)


@pytest.mark.parametrize(
    "kept", [torch.arange(6.0).reshape(2, 3), torch.ones(4, dtype=torch.bfloat16), torch.tensor(3)]
)
def test_a_flipped_bit_of_the_cache_is_noticed(kept: torch.Tensor, tmp_path: Path) -> None:
    """Flipped in every byte of a file, one after the other: tensors, types, shapes, names and checksum."""
    cache, actions = LatentCache(tmp_path, {}), torch.arange(4, dtype=torch.int8)
    encodings: list[int] = []

    def make() -> tuple[Encoded, torch.Tensor]:
        encodings.append(7)
        return {"latents": kept}, actions

    def read() -> tuple[Encoded, torch.Tensor]:
        return cache.encode(7, False, make, torch.device("cpu"))

    read()
    (path,) = tmp_path.rglob("*.safetensors")
    whole = path.read_bytes()
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        found, read_actions = read()
        assert list(found) == ["latents"] and torch.equal(found["latents"], kept) and torch.equal(read_actions, actions)
        assert path.read_bytes() == whole and len(encodings) == at + 2
    path.write_bytes(save({"latents": kept, "actions": actions}))
    for _ in range(3):
        read()
    assert len(encodings) == len(whole) + 2, "a file without a checksum is made anew, once"


def test_trainings_share_a_cache_unless_latents_differ(data: Path, weights: Any, tmp_path: Path) -> None:
    options: dict[str, Any] = {"weights": weights("nwm-action"), "device": "cpu", "part": "all"}
    options["cache"] = tmp_path / "cache"

    def count(number: int, **changes: Any) -> int:
        recipe = tiny_recipe("nwm-action", **changes)
        post_train("nwm-action", data, tmp_path / f"out{number}", recipe=recipe, **options)
        return len(list((tmp_path / "cache").iterdir()))

    assert [count(0), count(1, rate=1e-2, ema=0.5), count(2, size=(64, 64))] == [1, 1, 2]


def test_variants_of_weights_in_one_folder_are_different_weights(data: Path, weights: Any, tmp_path: Path) -> None:
    name, folder = "ltx-action", tmp_path / "both"
    shutil.copytree(weights(name), folder)
    tiny_pipelines.ltx().save_pretrained(folder, variant="fp16")
    family = find_family(name)
    corpus, recipe = family.fit(open_corpus(data, "all"), tiny_recipe(name))
    plain, half = (
        family.load(corpus, recipe, PretrainedWeights(str(folder), variant=variant, device="cpu"))
        for variant in (None, "fp16")
    )
    assert "variant" not in plain.identity and half.identity == {**plain.identity, "variant": "fp16"}
    assert open_cache(tmp_path, plain, corpus).folder != open_cache(tmp_path, half, corpus).folder


@pytest.mark.extra
def test_8_bit_adam_is_near_adam_and_resumes_exactly(data: Path, weights: Any) -> None:
    pytest.importorskip("bitsandbytes", reason="no bitsandbytes: pip install 'wiw[lowbit]'")
    name = "nwm-action"
    whole, half, plain = (
        make_trainer(name, data, weights(name), epochs=6, optimizer=kind)
        for kind in ("adamw8bit", "adamw8bit", "adamw")
    )
    first = {key: value.detach().clone() for key, value in plain.trained.items()}
    state = io.BytesIO()
    for step in range(6):
        whole.train_step(1e-3)
        plain.train_step(1e-3)
        if step == 2:
            torch.save(whole.state_dict(), state)
    state.seek(0)
    half.load_state_dict(torch.load(state, weights_only=True))
    for _ in range(3):
        half.train_step(1e-3)
    require_equal(whole, half)
    apart, moved = (
        sum(float((value - other[key]).abs().sum()) for key, value in plain.trained.items())
        for other in (whole.trained, first)
    )
    assert 0 < apart < 0.5 * moved


def test_8_bit_adam_that_is_not_installed_is_told(data: Path, weights: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "bitsandbytes" else found(name))
    with pytest.raises(
        DependencyError,
        match=r"optimizer=adamw8bit needs bitsandbytes, which is not installed; pip install 'wiw\[lowbit\]'",
    ):
        make_trainer("nwm-action", data, weights("nwm-action"), optimizer="adamw8bit")


def test_remedies_name_what_is_not_yet_lowered() -> None:
    said = "; ".join(list_remedies(tiny_recipe("svd-action", ema=0.9, precision="bfloat16")))
    assert "rows=1 (now 2)" in said and "optimizer=adamw8bit" in said and "ema=0" in said and "64x128" in said
    lean = tiny_recipe("svd-action", optimizer="adamw8bit", precision="bfloat16", rows=1)
    assert "validate_every=null" in list_remedies(lean)[-1]
    assert "validate_every" not in "".join(list_remedies(replace(lean, validate_every=None)))
    assert list_remedies(lean)[0] == "lora=32, for the Wan models" and np.isfinite(lean.rate)
