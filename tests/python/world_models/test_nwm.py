# SPDX-License-Identifier: Apache-2.0
"""NWM: parameters as published, the block against its formula, motions, sampling, and the world model made of them."""

from __future__ import annotations

import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import wiw
from wiw import action
from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError, ContractError, WeightsError
from wiw.types import Conditioning, Control, Goal, History, Key, Observation, Proposal
from wiw.world_models.nwm.context import nearest_frames
from wiw.world_models.nwm.motion import motions, normalise_steps

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")

import torch

from tiny_nwm import TINY, TinyNWM, randomised
from wiw.world_models.nwm.cdit import SIZES, Architecture, Block, CDiT, MotionEmbedder, NumberEmbedder
from wiw.world_models.nwm.diffusion import sample, scheduler
from wiw.world_models.nwm.images import rows_seen, to_frames, to_network
from wiw.world_models.nwm.model import NWM


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a user has it."""
    folder = tmp_path_factory.mktemp("nwm")
    torch.manual_seed(0)
    TinyNWM().save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def model(weights: Path) -> NWM:
    return NWM(weights=str(weights), steps=4, device="cpu")


def controls(*plans: list[int]) -> list[Control]:
    longest = max(map(len, plans))
    padded = [action.pad(plan, longest) for plan in plans]
    return [
        Control(actions, action.to_trajectory(actions), action.to_viewpoints(actions), length=len(plan))
        for actions, plan in zip(padded, plans, strict=True)
    ]


def observations(rows: int, seed: int = 0) -> Conditioning:
    coarse = np.random.default_rng(seed).integers(0, 256, (rows, 12, 12, 3))
    return Conditioning(np.kron(coarse, np.ones((1, 40, 40, 1))).astype(np.uint8))


def list_published_shapes(depth: int, width: int, context: int = 4, side: int = 28) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the parameters in the public checkpoints, by the rule that makes them."""

    def linear(name: str, out: int, into: int) -> dict[str, tuple[int, ...]]:
        return {f"{name}.weight": (out, into), f"{name}.bias": (out,)}

    def embedder(name: str, size: int) -> dict[str, tuple[int, ...]]:
        return linear(f"{name}.mlp.0", size, 256) | linear(f"{name}.mlp.2", size, size)

    names = {"pos_embed": (context + 1, (side // 2) ** 2, width)}
    names |= {"x_embedder.proj.weight": (width, 4, 2, 2), "x_embedder.proj.bias": (width,)}
    names |= embedder("t_embedder", width) | embedder("time_embedder", width)
    for part, size in (("x_emb", width // 3), ("y_emb", width // 3), ("angle_emb", width - 2 * (width // 3))):
        names |= embedder(f"y_embedder.{part}", size)
    for i in range(depth):
        block = f"blocks.{i}"
        names |= linear(f"{block}.attn.qkv", 3 * width, width) | linear(f"{block}.attn.proj", width, width)
        names |= {f"{block}.cttn.in_proj_weight": (3 * width, width), f"{block}.cttn.in_proj_bias": (3 * width,)}
        names |= {f"{block}.cttn.bias_k": (1, 1, width), f"{block}.cttn.bias_v": (1, 1, width)}
        names |= linear(f"{block}.cttn.out_proj", width, width)
        names |= linear(f"{block}.mlp.fc1", 4 * width, width) | linear(f"{block}.mlp.fc2", width, 4 * width)
        names |= linear(f"{block}.adaLN_modulation.1", 11 * width, width)
    names |= linear("final_layer.linear", 2 * 2 * 8, width)
    return names | linear("final_layer.adaLN_modulation.1", 2 * width, width)


@pytest.mark.parametrize("name", SIZES)
def test_parameters_have_the_published_names_and_shapes(name: str) -> None:
    size = SIZES[name]
    with torch.device("meta"):
        state = CDiT(size).state_dict()
    assert {key: tuple(value.shape) for key, value in state.items()} == list_published_shapes(size.depth, size.width)
    assert Architecture.of(state) == size
    if name == "XL":
        assert sum(value.numel() for value in state.values()) == pytest.approx(1.0e9, rel=0.03)  # "1B" in the paper


def test_a_block_is_its_formula() -> None:
    """adaLN-zero written out in NumPy, one head."""
    width, patches, past = 6, 5, 7
    block = randomised(Block(width, 1)).double()
    generator = torch.Generator().manual_seed(1)
    shapes = (1, patches, width), (1, past, width), (1, width)
    x, seen, condition = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in shapes)
    p = {name: value.numpy() for name, value in block.state_dict().items()}

    def norm(a):
        return (a - a.mean(-1, keepdims=True)) / np.sqrt(a.var(-1, keepdims=True) + 1e-6)

    def attend(q, k, v):
        weights = np.exp(q @ k.T / np.sqrt(width))
        return weights / weights.sum(-1, keepdims=True) @ v

    c = condition[0].numpy()
    m = p["adaLN_modulation.1.weight"] @ (c / (1 + np.exp(-c))) + p["adaLN_modulation.1.bias"]
    shift1, scale1, gate1, shift_c, scale_c, shift2, scale2, gate2, shift3, scale3, gate3 = m.reshape(11, width)
    y = x[0].numpy()
    h = norm(y) * (1 + scale1) + shift1
    q, k, v = np.split(h @ p["attn.qkv.weight"].T + p["attn.qkv.bias"], 3, axis=-1)
    y = y + gate1 * (attend(q, k, v) @ p["attn.proj.weight"].T + p["attn.proj.bias"])
    (wq, wk, wv), (bq, bk, bv) = np.split(p["cttn.in_proj_weight"], 3), np.split(p["cttn.in_proj_bias"], 3)
    keys = norm(seen[0].numpy()) * (1 + scale_c) + shift_c
    k, v = np.vstack([keys @ wk.T + bk, p["cttn.bias_k"][0]]), np.vstack([keys @ wv.T + bv, p["cttn.bias_v"][0]])
    q = (norm(y) * (1 + scale2) + shift2) @ wq.T + bq
    y = y + gate2 * (attend(q, k, v) @ p["cttn.out_proj.weight"].T + p["cttn.out_proj.bias"])
    h = (norm(y) * (1 + scale3) + shift3) @ p["mlp.fc1.weight"].T + p["mlp.fc1.bias"]
    h = 0.5 * h * (1 + np.tanh(np.sqrt(2 / np.pi) * (h + 0.044715 * h**3)))
    y = y + gate3 * (h @ p["mlp.fc2.weight"].T + p["mlp.fc2.bias"])
    np.testing.assert_allclose(block(x, seen, condition)[0].numpy(), y, atol=1e-10)


def test_a_new_block_changes_nothing_and_embeddings_begin_with_cosines() -> None:
    x, seen, condition = torch.randn(2, 4, 24), torch.randn(2, 8, 24), torch.randn(2, 24)
    torch.testing.assert_close(Block(24, 2)(x, seen, condition), x)
    embedder = NumberEmbedder(256)
    embedder.mlp = torch.nn.Identity()
    waves = 3.5 * 10000 ** (-np.arange(128) / 128)
    np.testing.assert_allclose(embedder(torch.tensor([3.5]))[0], [*np.cos(waves), *np.sin(waves)], atol=1e-5)
    assert MotionEmbedder(25)(torch.zeros(3, 3)).shape == (3, 25)


def test_every_input_of_the_network_counts_and_rows_are_apart() -> None:
    network = randomised(CDiT(TINY))
    generator = torch.Generator().manual_seed(2)
    inputs = [
        torch.randn(2, 4, 8, 8, generator=generator),
        torch.tensor([3.0, 700.0]),
        torch.randn(2, 3, generator=generator),
        torch.randn(2, 4, 4, 8, 8, generator=generator),
        torch.tensor([1 / 128, 2 / 128]),
    ]
    out = network(*inputs)
    assert out.shape == (2, 8, 8, 8)
    torch.testing.assert_close(network(*(value[1:] for value in inputs))[0], out[1])
    for index, value in enumerate(inputs):
        changed = [*inputs]
        changed[index] = value + 1
        assert (network(*changed) - out).abs().max() > 1e-3
    swapped = [*inputs[:3], inputs[3].flip(1), inputs[4]]  # context frames are told apart by their place
    assert (network(*swapped) - out).abs().max() > 1e-3


def test_standing_still_is_not_zero() -> None:
    np.testing.assert_allclose(normalise_steps(np.zeros((1, 3)), 0.25), [[-1 / 3, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(motions(action.to_trajectory([STOP, STOP]), 0.25), [[-1 / 3, 0, 0]] * 2, atol=1e-12)
    still = motions(action.to_trajectory([STOP, STOP]), 0.25, rollout_convention=True)
    np.testing.assert_allclose(still, [[-1 / 3, 0, 0], [0, 0, 0]], atol=1e-12)  # only the first step carries the offset


def test_each_step_is_seen_from_where_it_begins() -> None:
    plan = action.to_trajectory([TURN_LEFT, FORWARD, TURN_RIGHT, FORWARD])
    turn, ahead = np.radians(22.5), 2 * (0.2 / 0.25 + 2.5) / 7.5 - 1
    expected = [[-1 / 3, 0, turn], [ahead, 0, 0], [-1 / 3, 0, -turn], [ahead, 0, 0]]
    np.testing.assert_allclose(motions(plan, 0.25), expected, atol=1e-12)
    rollout = motions(plan, 0.25, rollout_convention=True)  # in the frame of the start: the second step goes left too
    np.testing.assert_allclose(rollout[1], [0.2 / 0.25 * np.cos(turn) * 2 / 7.5, 0.2 / 0.25 * np.sin(turn) / 4, 0])
    np.testing.assert_allclose(rollout[:, 2], motions(plan, 0.25)[:, 2], atol=1e-12)


@given(st.lists(st.sampled_from([FORWARD, TURN_LEFT, TURN_RIGHT, STOP]), min_size=1, max_size=20), st.floats(0.05, 2))
def test_steps_make_up_the_trajectory(plan: list[int], spacing: float) -> None:
    trajectory = action.to_trajectory(plan)
    pose = np.zeros(3)
    for x, y, turn in motions(trajectory, spacing):
        forward, left = spacing * ((x + 1) * 7.5 / 2 - 2.5), spacing * (y + 1) * 4 - spacing * 4
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        pose = pose + np.array([cos * forward - sin * left, sin * forward + cos * left, turn])
    np.testing.assert_allclose(pose, trajectory[-1], atol=1e-9)


def test_sampling_is_its_formula() -> None:
    """Ancestral sampling on respaced betas, the variance between the posterior's and beta, in NumPy."""
    steps, seed = 7, 11

    def predict(latents, time):
        return torch.cat([0.3 * latents + time[:, None, None, None] / 1000, torch.tanh(latents)], dim=1)

    generator = torch.Generator().manual_seed(seed)
    noises = [torch.randn(1, 2, 3, 3, generator=generator).double().numpy() for _ in range(steps)]
    alphas = np.cumprod(1 - np.linspace(1e-4, 0.02, 1000))
    times = np.round(np.linspace(0, 999, steps)).astype(int)
    bars = np.concatenate([[1], alphas[times]])
    x = noises[0]
    for i in reversed(range(steps)):
        beta, before, now = 1 - bars[i + 1] / bars[i], bars[i], bars[i + 1]
        noise, weight = 0.3 * x + times[i] / 1000, np.tanh(x)
        clean = (x - np.sqrt(1 - now) * noise) / np.sqrt(now)
        mean = (np.sqrt(before) * beta * clean + np.sqrt(1 - beta) * (1 - before) * x) / (1 - now)
        if i:
            low, high = np.log((1 - before) / (1 - now) * beta), np.log(beta)
            part = (weight + 1) / 2
            mean = mean + np.exp(0.5 * (part * high + (1 - part) * low)) * noises[steps - i]
        x = mean
    found = sample(predict, (1, 2, 3, 3), [torch.Generator().manual_seed(seed)], steps, torch.device("cpu"))
    np.testing.assert_allclose(found.numpy(), x, rtol=2e-3, atol=2e-3)
    assert scheduler(250).timesteps[[0, -1]].tolist() == [999, 0]


def test_it_sees_the_middle_in_4_to_3_and_leaves_the_rest_black() -> None:
    assert rows_seen(480, 480) == slice(60, 420)
    image = np.zeros((1, 480, 480, 3), np.uint8)
    image[:, 60:420, :240] = (255, 128, 0)
    image[:, :60] = image[:, 420:] = 77
    pixels = to_network(image, 224)
    assert pixels.shape == (1, 3, 224, 224)
    torch.testing.assert_close(pixels[0, :, 100, 50], torch.tensor([1.0, 128 / 127.5 - 1, -1.0]))
    torch.testing.assert_close(pixels[0, :, 0, 200], -torch.ones(3))
    back = to_frames(pixels, 480, 480)
    assert (back[:, :60] == 0).all() and (back[:, 420:] == 0).all()
    assert np.abs(back[:, 60:420].astype(int) - image[:, 60:420]).mean() < 1


def test_frames_follow_actions_and_seeds_whatever_the_batch(model: NWM) -> None:
    plans = [[FORWARD, TURN_LEFT, FORWARD], [TURN_LEFT], [FORWARD, TURN_LEFT, FORWARD]]
    given, seeds = observations(3), np.array([5, 6, 2**64 - 1], np.uint64)
    frames = model.rollout(given, controls(*plans), seeds)
    assert frames.shape == (3, 4, 480, 480, 3) and frames.dtype == np.uint8
    np.testing.assert_array_equal(frames[:, 0], given.image)
    assert not frames[1, 2:].any()  # padding
    for row, plan in enumerate(plans):
        alone = model.rollout(Conditioning(given.image[row : row + 1]), controls(plan), seeds[row : row + 1])
        difference = np.abs(alone[0].astype(int) - frames[row, : len(plan) + 1])
        assert difference.max() <= 1  # sums of another order
    same = np.repeat(given.image[:1], 3, axis=0)
    changed = controls([FORWARD] * 2, [TURN_LEFT] * 2, [FORWARD] * 2), np.array([5, 5, 6], np.uint64)
    other = model.rollout(Conditioning(same), *changed)
    assert (other[0, 1] != other[1, 1]).any() and (other[0, 1] != other[2, 1]).any()
    assert (other[0, 1] != other[0, 2]).any()


def test_nan_is_no_picture(weights: Path) -> None:
    model = NWM(weights=str(weights), steps=4, device="cpu")
    next(model._network.parameters()).data.fill_(float("nan"))
    with pytest.raises(ContractError, match="NaN in float32") as breach:
        model.rollout(observations(1), controls([FORWARD]), np.zeros(1, np.uint64))
    assert breach.value.kind == "nan"


def test_history_is_the_context_where_there_is_one(model: NWM) -> None:
    given, plan, seeds = observations(1), controls([FORWARD]), np.array([1], np.uint64)
    repeated = model.rollout(given, plan, seeds)
    past = observations(5, seed=1).image

    def with_past(*views, apart=1):
        images, lengths = np.stack([*views, given.image[0]])[None], np.full((1, len(views)), apart)
        actions = np.full((1, len(views), apart), FORWARD, np.int8)
        history = History(images, np.zeros((1, len(views) + 1, 3)), actions, lengths, np.array([len(views) + 1]))
        return model.rollout(replace(given, history=history), plan, seeds)

    np.testing.assert_array_equal(with_past(*[given.image[0]] * 3), repeated)
    assert (with_past(*past[:3]) != repeated).any()
    assert (with_past(*past[2::-1]) != with_past(*past[:3])).any()  # in order
    np.testing.assert_array_equal(with_past(*past[2:]), with_past(*past))  # the last three count
    np.testing.assert_array_equal(with_past(past[0]), with_past(past[0], past[0], past[0]))
    twos = with_past(past[0], past[0], given.image[0])  # of frames 3 actions apart, 3 and 2 ago and 1 and 0 ago
    np.testing.assert_array_equal(with_past(*past[1::-1], apart=3), twos)


def test_context_is_taken_at_the_spacing_of_its_own_frames() -> None:
    lengths = np.array([[1, 1, 1], [3, 3, 3], [2, 2, 2], [9, 9, 9], [0, 0, 0], [0, 3, 1], [5, 1, 2]])
    assert nearest_frames(lengths, 4).tolist() == [
        [0, 1, 2, 3], [2, 2, 3, 3], [1, 2, 2, 3], [3, 3, 3, 3], [0, 0, 0, 0], [0, 2, 2, 3], [1, 2, 2, 3],
    ]  # fmt: skip


def test_the_loop_hands_it_what_was_seen(model: NWM, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each decision's context is the latest front views, oldest first."""
    assert model.accepts.needs == ("history",) and model.accepts.history == 4
    contexts, latents = [], model._first_context
    monkeypatch.setattr(model, "_first_context", lambda given: contexts.append(latents(given)) or contexts[-1].clone())

    class Ahead(wiw.Policy):
        def propose(self, situations, candidates, horizon):
            return [[Proposal([FORWARD])] for _ in situations]

        def score(self, situations, proposals, rollouts):
            return [np.zeros(1) for _ in situations]

    agent = wiw.Agent(Ahead(), model, candidates=1, horizon=1)
    panoramas = np.random.default_rng(0).integers(0, 256, (6, 576, 1024, 3), np.uint8)
    for decision, panorama in enumerate(panoramas):
        seen = Observation(panorama, panorama[:480, :480], np.array([0.2 * decision, 0, 0]))
        agent.decide(seen, Goal("x"), Key(0, 0, decision))
    now = [context[0, -1] for context in contexts]
    assert len(now) == 6 and (now[0] - now[1]).abs().max() > 0.1
    for decision, context in enumerate(contexts):
        for place, k in enumerate(range(decision - 3, decision + 1)):
            torch.testing.assert_close(context[0, place], now[max(0, k)])


def test_conventions_and_spacing_steer(model: NWM, weights: Path) -> None:
    given, plan, seeds = observations(1), controls([FORWARD, FORWARD]), np.array([1], np.uint64)
    frames = model.rollout(given, plan, seeds)
    options = [{"rollout_convention": True}, {"spacing": 0.5}, {"precision": "bfloat16"}]
    for option in options:
        other = NWM(weights=str(weights), steps=4, device="cpu", **option)
        assert (other.rollout(given, plan, seeds)[0, 2] != frames[0, 2]).any(), option
    said = model.describe()
    assert len(said.pop("digest")) == 40 and said.pop("diffusers") and said.pop("torch") and said.pop("transformers")
    assert {**said, "weights": ""} == {
        "name": "NWM", "weights": "", "vae": None, "file": "0100000.pth.tar", "revision": None, "vae_revision": None,
        "steps": 4, "spacing": 0.25, "rollout_convention": False, "device": "cpu", "precision": "float32", "batch": 8,
    }  # fmt: skip


def test_safetensors_load_too_and_fingerprints_tell_weights_apart(model: NWM, weights: Path, tmp_path: Path) -> None:
    from safetensors.torch import save_file

    state = torch.load(weights / "0100000.pth.tar", weights_only=False)["ema"]
    save_file(state, tmp_path / "same.safetensors")
    again = NWM(weights=str(tmp_path / "same.safetensors"), vae=str(weights / "vae"), steps=4, device="cpu")
    given, plan, seeds = observations(1), controls([FORWARD]), np.array([1], np.uint64)
    difference = again.rollout(given, plan, seeds).astype(int) - model.rollout(given, plan, seeds)
    assert np.abs(difference).max() <= 1  # sums of another order
    save_file({**state, "pos_embed": state["pos_embed"] + 1}, tmp_path / "same.safetensors")
    changed = NWM(weights=str(tmp_path / "same.safetensors"), vae=str(weights / "vae"), steps=4, device="cpu")
    assert changed.fingerprint() != again.fingerprint() == model.fingerprint()
    assert pickle.loads(pickle.dumps(again)).describe() == changed.describe()  # loads the file as it is now


def test_weights_that_do_not_fit_are_named(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vae, file = str(weights / "vae"), tmp_path / "x.pth.tar"
    state = randomised(CDiT(TINY)).state_dict()

    def refused(checkpoint: object, match: str) -> None:
        torch.save(checkpoint, file)
        with pytest.raises(WeightsError, match=match):
            NWM(weights=str(file), vae=vae, device="cpu")

    refused({"model": state}, "key 'ema', found model")
    refused({"ema": {"weight": torch.zeros(1)}}, "not weights of a CDiT: expected 'pos_embed'; it has weight")
    refused({"ema": {n: v for n, v in state.items() if "bias_k" not in n}}, r"2 missing: blocks.0.cttn.bias_k")
    refused({"ema": {**state, "extra": torch.zeros(1)}}, "1 unknown: extra")
    refused({"ema": {**state, "t_embedder.mlp.2.bias": torch.zeros(3)}}, r"mlp.2.bias \(3,\) for \(24,\)")
    refused({"ema": state, "hook": Path("x")}, "without running code from it")
    file.write_bytes(b"not a checkpoint")
    with pytest.raises(WeightsError, match=r"x\.pth\.tar"):
        NWM(weights=str(file), vae=vae, device="cpu")
    damaged = tmp_path / "x.safetensors"
    damaged.write_bytes(b"nothing")
    with pytest.raises(WeightsError, match=r"x\.safetensors is damaged"):
        NWM(weights=str(damaged), vae=vae, device="cpu")
    from safetensors.torch import load_file, save_file

    partial = shutil.copytree(weights / "vae", tmp_path / "vae") / "diffusion_pytorch_model.safetensors"
    save_file({n: v for n, v in load_file(partial).items() if n != "decoder.conv_in.bias"}, partial)
    with pytest.raises(WeightsError, match=r"lacks 1 parameters: decoder\.conv_in\.bias"):
        NWM(weights=str(weights), vae=str(partial.parent), device="cpu")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(WeightsError, match="hub cannot be reached"):
        NWM(weights="nobody/nothing", vae=vae, device="cpu")
    with pytest.raises(WeightsError, match="no AutoencoderKL in"):
        NWM(weights=str(weights), vae=str(tmp_path / "nowhere"), device="cpu")
    with pytest.raises(ArgumentError, match="steps"):
        NWM(weights=str(weights), vae=vae, steps=1)
    with pytest.raises(ArgumentError, match="revision: 'v2' is a revision of a hub repository"):
        NWM(weights=str(weights), vae=vae, revision="v2", device="cpu")
    with pytest.raises(ArgumentError, match="vae_revision: 'v2' is a revision of a hub repository"):
        NWM(weights=str(weights), vae=vae, vae_revision="v2", device="cpu")
    with pytest.raises(ArgumentError, match="precision"):
        NWM(weights=str(weights), vae=vae, device="cpu", precision="int8")
    with pytest.raises(ArgumentError, match="got 'tpu9'"):
        NWM(weights=str(weights), vae=vae, device="tpu9")


def test_an_episode_is_decided_with_it(model: NWM, two_rooms: str) -> None:
    from wiw.tasks.imagenav import ImageNav

    agent = wiw.Agent("matcher", model, horizon=3, execute=1)
    task = ImageNav(scenes=two_rooms, decisions=2)
    log = wiw.evaluate(task.environment(), agent, episodes=1, progress=False)
    assert [episode["status"] for episode in log.episodes] == ["done"]
    assert sum(decision["calls"]["frames"] for decision in log.decisions) > 0
