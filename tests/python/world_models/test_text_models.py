# SPDX-License-Identifier: Apache-2.0
"""World models that are told plans in words: whose words, which frame shows which action, LoRA, panoramas."""

from __future__ import annotations

import json
import pickle
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import wiw
from wiw import action
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.cli import main
from wiw.errors import ArgumentError, FileError, WeightsError
from wiw.types import Conditioning, Control
from wiw.world_models.clips import Alignment, frames_after_actions
from wiw.world_models.plan_text import make_template, read_words, write_prompt

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")

import torch
from safetensors.torch import save_file

SHORT = {"prompt": "Do [{actions}]", "separator": ", ", "forward": "'f {metres}'", "turn_left": "'l {degrees}'"}


@pytest.fixture
def made(world_model_options):
    """A world model with tiny weights and the options of the test."""
    return lambda name, **options: wiw.world_model(name, **{**world_model_options(name), **options})


def make_control(model, actions, words: bool = True) -> Control:
    plan = action.pad(actions, model.accepts.frames - 1)
    views = action.to_trajectory(plan), action.to_viewpoints(plan)
    text = action.to_text(actions, model.accepts.template) if words else ""
    return Control(plan, *views, text, length=len(actions))


def rollout(model, actions=(FORWARD, TURN_LEFT), seed: int = 7):
    image = np.random.default_rng(0).integers(0, 256, (1, *model.accepts.size, 3), np.uint8)
    return model.rollout(Conditioning(image), [make_control(model, actions)], np.array([seed], np.uint64))


# -- which frame shows which action ------------------------------------------------------------------------------------


@pytest.mark.parametrize("clip", [14, 25, 33])
def test_a_fixed_pace_is_what_sampling_a_clip_to_fourteen_frames_gives(clip: int) -> None:
    """`linspace(0, T - 1, 14)`, rounded down: action 5 is frame 9 of 25 and frame 12 of 33."""
    alignment = Alignment.parse(f"frames_per_action={Fraction(clip - 1, 13)}", clip)
    wanted = np.linspace(0, clip - 1, 14).astype(int)
    for length in (1, 5, 13):
        np.testing.assert_array_equal(alignment.choose_frames(length), wanted)
    assert alignment.frames == 14
    assert {25: 9, 33: 12}.get(clip, 5) == wanted[5]


def test_even_is_the_whole_plan_whatever_its_length() -> None:
    alignment = Alignment.parse("even", 25)
    np.testing.assert_array_equal(alignment.choose_frames(5), frames_after_actions(5, 25, 25))
    assert alignment.choose_frames(5)[5] == 24 and alignment.frames == 25


@pytest.mark.parametrize("text", ["evenly", "frames_per_action=", "frames_per_action=0", "frames_per_action=-1"])
def test_an_alignment_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ArgumentError, match="alignment: expected even, or frames_per_action=N"):
        Alignment.parse(text, 25)
    with pytest.raises(ArgumentError, match="from 0 to 24"):
        Alignment.parse("frames_per_action=25", 25)


def test_frames_and_prompt_of_a_fixed_pace(made) -> None:
    model = made("ltx", frames=17, alignment="frames_per_action=3", template=SHORT)
    assert model.accepts.frames == 6  # 16 / 3 actions, rounded down, and the observation
    asked: list[str] = []
    shades = np.linspace(0, 1, 17, dtype=np.float32)
    model.generate = lambda images, controls, generators: (
        asked.append(model.write_prompt(controls[0])),
        np.broadcast_to(shades[None, :, None, None, None], (len(images), 17, *model.size, 3)),
    )[1]
    frames = rollout(model, [FORWARD, TURN_LEFT])
    np.testing.assert_array_equal(frames[0, 1:, 0, 0, 0], np.rint(shades[[3, 6, 9, 12, 15]] * 255))
    assert asked == ["Do ['f 0.2', 'l 22.5', 'f 0.2', 'f 0.2', 'f 0.2']"], "padded to what the clip shows"


def test_an_instruction_for_a_gripper_is_kept_at_a_fixed_pace() -> None:
    told = Control.of_poses(12, "Move the gripper to the red cup and close it.")
    assert write_prompt(told, None, Alignment.parse("frames_per_action=2", 25)) == told.text


def test_the_loop_cuts_plans_longer_than_a_fixed_pace_shows(made, two_rooms) -> None:
    model = made("ltx", alignment="frames_per_action=4")  # 9 frames: two actions
    env = wiw.make("ImageNav-v0", scenes=two_rooms, seed=0)
    observation, info = env.reset(options={"episode": 0})
    decision = wiw.Agent("matcher", model, candidates=1, horizon=3).decide(observation, env.goal, key=info["key"])
    assert len(decision.rollouts[0].frames) == 3


# -- whose words -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ltx", "hunyuan", "wan2.2-5b", "cosmos-predict2"])
def test_words_reach_the_pipeline(name, made, tmp_path: Path) -> None:
    (tmp_path / "words.yaml").write_text(json.dumps(SHORT))
    away = {"negative_prompt": "fog"} | ({"negative_guidance": 2.0} if name == "hunyuan" else {})
    model = made(name, template=tmp_path / "words.yaml", **away)
    pipeline, asked = model.pipeline, {}

    def listening(**given):
        asked.update(given)
        return pipeline(**given)

    model.pipeline = listening
    listening.transformer = pipeline.transformer
    rollout(model)
    first = {key: value if isinstance(value, str) else value[0] for key, value in asked.items() if "prompt" in key}
    assert first["prompt"] == "Do ['f 0.2', 'l 22.5']" and first["negative_prompt"] == "fog"
    assert model.describe()["template"] == SHORT, "the record has the words, not the file's name"
    model.pipeline = pipeline
    assert pickle.loads(pickle.dumps(model)).describe() == model.describe()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("walk on", "actions"),
        ({"prompt": "{actions}", "jump": "x"}, "got 'jump'"),
        ({"prompt": "{actions}", "forward": 3}, "expected forward as text"),
        ({"prompt": "{actions}", "merge_runs": "yes"}, "expected merge_runs as text"),
    ],
)
def test_words_that_will_not_do_are_refused(words, said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        make_template(read_words(words))


def test_a_file_of_words_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"none\.yaml"):
        read_words(tmp_path / "none.yaml")
    (tmp_path / "list.yaml").write_text("- 1")
    with pytest.raises(FileError, match="got list"):
        read_words(tmp_path / "list.yaml")


def test_hunyuan_says_when_a_negative_prompt_would_do_nothing(made) -> None:
    for options in ({"negative_prompt": "fog"}, {"negative_guidance": 2.0}):
        with pytest.raises(ArgumentError, match="expected a negative_prompt and negative_guidance above 1, or neither"):
            made("hunyuan", **options)


# -- panoramas ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ltx", "wan2.1"])
def test_panoramas_in_words(name, made) -> None:
    model = made(name, view="panorama", size=(64, 128))
    assert (model.accepts.view, model.accepts.control, model.accepts.size) == ("panorama", "text", (64, 128))
    assert rollout(model).shape == (1, model.frames, 64, 128, 3)


def test_a_panorama_has_the_papers_size_unless_told_otherwise(made, world_model_options) -> None:
    options = {key: value for key, value in world_model_options("wan2.1").items() if key != "size"}
    assert wiw.world_model("wan2.1", view="panorama", **options).size == (576, 1024)
    assert wiw.world_model("wan2.1", **options).size == (480, 480)
    with pytest.raises(ArgumentError, match="expected view perspective, panorama, got 'cube'"):
        made("ltx", view="cube")


def test_a_decision_with_a_panoramic_text_model(made, two_rooms) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms, seed=0)
    observation, info = env.reset(options={"episode": 0})
    agent = wiw.Agent("matcher", made("wan2.2-5b", view="panorama", size=(64, 128)), candidates=2, horizon=2)
    assert agent.decide(observation, env.goal, key=info["key"]).rollouts[0].view == "panorama"


# -- LoRA --------------------------------------------------------------------------------------------------------------

WAN = {  # of a diffusers layer, in the names of Wan's own repository
    "blocks.0.attn1.to_q": "blocks.0.self_attn.q",
    "blocks.0.attn2.to_out.0": "blocks.0.cross_attn.o",
    "blocks.1.ffn.net.0.proj": "blocks.1.ffn.0",
}
LTX = ("transformer_blocks.0.attn1.to_q", "transformer_blocks.1.ff.net.2")


def make_lora(model, layers, place: str = "transformer") -> dict[str, torch.Tensor]:
    """Return a random LoRA of some layers, by diffusers' names without the denoiser's."""
    modules, draws = dict(getattr(model.pipeline, place).named_modules()), torch.Generator().manual_seed(3)
    found = {}
    for layer in layers:
        outward, inward = modules[layer].weight.shape
        found[f"{layer}.lora_A.weight"] = torch.randn(2, inward, generator=draws)
        found[f"{layer}.lora_B.weight"] = torch.randn(outward, 2, generator=draws)
    return found


def rename(lora, prefix: str, layers=None, end: str = "weight") -> dict[str, torch.Tensor]:
    found = {}
    for name, value in lora.items():
        layer, side = name.split(".lora_")
        found[f"{prefix}{(layers or {}).get(layer, layer)}.lora_{side.replace('weight', end)}"] = value
    return found


def weights_of(model, layer: str, place: str = "transformer"):
    """Return the effective weight of a layer: its own, and B A of the LoRA in it."""
    module = dict(getattr(model.pipeline, place).named_modules())[layer]
    base = module.base_layer.weight
    return base + module.scaling["lora"] * module.lora_B["lora"].weight @ module.lora_A["lora"].weight


@pytest.mark.parametrize(
    ("name", "layers", "layout"),
    [
        ("wan2.2-5b", WAN, lambda lora: rename(lora, "transformer.")),
        ("wan2.1", WAN, lambda lora: rename(lora, "", WAN, "default.weight")),
        ("wan2.2-5b", WAN, lambda lora: rename(lora, "pipe.dit.", WAN, "default.weight")),
        ("wan2.2-5b", WAN, lambda lora: rename(lora, "diffusion_model.", WAN)),
        ("ltx", LTX, lambda lora: rename(lora, "diffusion_model.")),
        ("ltx", LTX, lambda lora: rename(lora, "transformer.")),
        ("cosmos-predict2", ("transformer_blocks.0.attn1.to_q",), lambda lora: rename(lora, "transformer.")),
        ("hunyuan", ("transformer_blocks.0.attn.to_q",), lambda lora: rename(lora, "transformer.")),
    ],
)
def test_a_lora_changes_exactly_its_layers(name, layers, layout, made, tmp_path: Path) -> None:
    plain = made(name)
    lora = make_lora(plain, layers)
    save_file(layout(lora), tmp_path / "lora.safetensors")
    model = made(name, lora=tmp_path / "lora.safetensors")
    base = dict(plain.pipeline.transformer.named_modules())
    for layer in layers:
        expected = base[layer].weight + lora[f"{layer}.lora_B.weight"] @ lora[f"{layer}.lora_A.weight"]
        torch.testing.assert_close(weights_of(model, layer), expected)
    adapted = [each for each, module in model.pipeline.transformer.named_modules() if hasattr(module, "base_layer")]
    assert sorted(adapted) == sorted(layers)
    assert model.fingerprint() != plain.fingerprint()


def test_a_lora_changes_the_frames_and_survives_pickling(made, tmp_path: Path) -> None:
    plain = made("wan2.2-5b")
    save_file(rename(make_lora(plain, WAN), "transformer."), tmp_path / "lora.safetensors")
    model = made("wan2.2-5b", lora=tmp_path)
    assert (rollout(model) != rollout(plain)).any()
    assert pickle.loads(pickle.dumps(model)).fingerprint() == model.fingerprint()


def test_a_moved_lora_is_the_same_and_a_changed_one_is_not(made, tmp_path: Path) -> None:
    lora, prints = make_lora(made("ltx"), LTX), []
    for folder, scale in (("a", 1.0), ("b", 1.0), ("c", 2.0)):
        (tmp_path / folder).mkdir()
        content = {name: scale * value for name, value in rename(lora, "transformer.").items()}
        save_file(content, tmp_path / folder / "own.safetensors")
        prints.append(made("ltx", lora=str(tmp_path / folder)).fingerprint())
    assert prints[0] == prints[1] != prints[2]


def test_rank_and_alpha_of_the_file_hold(made, tmp_path: Path) -> None:
    lora = make_lora(made("ltx"), LTX)
    said = {"transformer.r": 2, "transformer.lora_alpha": 6, "transformer.target_modules": list(LTX)}
    file = tmp_path / "lora.safetensors"
    save_file(rename(lora, "transformer."), file, {"format": "pt", "lora_adapter_metadata": json.dumps(said)})
    model = made("ltx", lora=file)
    base = dict(model.pipeline.transformer.named_modules())[LTX[0]].base_layer.weight
    expected = base + 3 * lora[f"{LTX[0]}.lora_B.weight"] @ lora[f"{LTX[0]}.lora_A.weight"]
    torch.testing.assert_close(weights_of(model, LTX[0]), expected)


def test_each_expert_has_its_own_lora(made, tmp_path: Path) -> None:
    plain = made("wan2.2-a14b")
    first = make_lora(plain, list(WAN)[:1])
    second = {name: -value for name, value in make_lora(plain, list(WAN)[:1], "transformer_2").items()}
    save_file(rename(first, "", WAN, "default.weight"), tmp_path / "high.safetensors")
    save_file(rename(second, "", WAN, "default.weight"), tmp_path / "low.safetensors")
    together = {**rename(first, "transformer."), **rename(second, "transformer_2.")}
    save_file(together, tmp_path / "both.safetensors")
    apart = made("wan2.2-a14b", lora=tmp_path / "high.safetensors", lora_2=tmp_path / "low.safetensors")
    joint = made("wan2.2-a14b", lora=tmp_path / "both.safetensors", lora_2=tmp_path / "both.safetensors")
    layer = next(iter(WAN))
    for place, lora in (("transformer", first), ("transformer_2", second)):
        base = dict(getattr(plain.pipeline, place).named_modules())[layer].weight
        expected = base + lora[f"{layer}.lora_B.weight"] @ lora[f"{layer}.lora_A.weight"]
        for model in (apart, joint):
            torch.testing.assert_close(weights_of(model, layer, place), expected)
    np.testing.assert_array_equal(rollout(apart), rollout(joint))


def write_damaged(lora, kind: str) -> dict[str, torch.Tensor]:
    tensors = rename(lora, "transformer.")
    a, b = (f"transformer.{LTX[0]}.lora_{side}.weight" for side in "AB")
    if kind == "none of them":
        return {f"transformer.other.{name}": value for name, value in lora.items()}
    if kind == "some":
        return {**tensors, **{f"transformer.blocks.9.to_q.lora_{side}.weight": torch.ones(2, 2) for side in "AB"}}
    if kind == "side":
        return {name: value for name, value in tensors.items() if name != b}
    if kind == "size":
        return {**tensors, a: torch.ones(2, 5)}
    if kind == "kind":
        return {**tensors, f"transformer.{LTX[0]}.dora_scale": torch.ones(2)}
    return {name.replace("transformer.", "transformer_2.", 1): value for name, value in tensors.items()}


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("none of them", "the LoRA matches no layer: other.transformer_blocks"),
        ("some", r"1 of 3 layers of the LoRA are not in the network: blocks\.9\.to_q"),
        ("side", r"1 of 2 layers of the LoRA lack one side or differ in size .*blocks\.0\.attn1\.to_q"),
        ("size", r"1 of 2 layers of the LoRA lack one side or differ in size .*blocks\.0\.attn1\.to_q"),
        ("kind", "expected names that end with lora_A.weight or lora_B.weight, got .*dora_scale"),
    ],
)
def test_a_lora_that_does_not_fit_is_refused_by_name(kind: str, said: str, made, tmp_path: Path) -> None:
    file = tmp_path / "lora.safetensors"
    save_file(write_damaged(make_lora(made("ltx"), LTX), kind), file)
    with pytest.raises(WeightsError, match=said):
        made("ltx", lora=file)


def test_a_lora_of_wans_names_that_leaves_some_over_is_refused(made, tmp_path: Path) -> None:
    lora = rename(make_lora(made("wan2.1"), WAN), "", WAN, "default.weight")
    lora |= {f"blocks.7.self_attn.q.lora_{side}.default.weight": torch.ones(2, 2) for side in "AB"}
    save_file(lora, tmp_path / "lora.safetensors")
    with pytest.raises(WeightsError, match=r"1 of 4 layers .* not in the network: blocks\.7\.attn1\.to_q"):
        made("wan2.1", lora=tmp_path / "lora.safetensors")


def test_a_file_that_is_no_lora_is_named(made, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"expected the \.safetensors file of a LoRA, or a folder with one, found"):
        made("ltx", lora=tmp_path)
    (tmp_path / "lora.safetensors").write_bytes(b"nothing")
    with pytest.raises(WeightsError, match=r"lora\.safetensors is damaged"):
        made("ltx", lora=tmp_path)


# -- the blind placebo -------------------------------------------------------------------------------------------------


class Listener(wiw.WorldModel):
    """Remembers the prompts that it was asked with."""

    accepts = wiw.accepts(control="text", view="perspective", size=(32, 32), frames=6)

    def __init__(self) -> None:
        self._heard: list[str] = []

    def rollout(self, observations, controls, seeds):
        self._heard += [control.text for control in controls]
        return np.repeat(observations.image[:, None], 6, 1)


def test_the_blind_placebo_tells_a_text_model_nothing(two_rooms, tmp_path: Path) -> None:
    model = Listener()
    wiw.evaluate(
        wiw.make("ImageNav-v0", scenes=two_rooms, seed=0, decisions=1),
        wiw.Agent("matcher", model),
        episodes=1,
        arms={"told": model, "placebo-blind": "placebo-blind"},
        out=tmp_path,
        progress=False,
    )
    log = wiw.load_run(tmp_path)
    assert log.store.info["built"]["placebo-blind"]["placebo"] == "blind"
    rows = {decision["arm"]: decision["calls"]["rows"] for decision in log.decisions}
    assert rows["told"] == rows["placebo-blind"] > 0, "the same compute"
    assert model._heard[: rows["told"]] != [""] * rows["told"]
    assert model._heard[rows["told"] :] == [""] * rows["told"]


def test_the_blind_placebo_is_for_text_models() -> None:
    from wiw.experiments.placebos import BlindPlacebo

    with pytest.raises(ArgumentError, match="expected one with control 'text', got 'trajectory'"):
        BlindPlacebo(wiw.world_model("warp"))


def test_a_run_with_a_blind_placebo_of_another_model_is_refused_before_it_begins(tmp_path: Path, capsys) -> None:
    arguments = ["run", "imagenav", "--arms", "none,placebo-blind", "--episodes", "1", "--out", str(tmp_path / "run")]
    assert main(arguments) == 2
    assert "expected one with control 'text', got 'trajectory'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("words", [True, False])
def test_a_model_with_a_fixed_pace_stays_blind(words: bool, made) -> None:
    model = made("ltx", alignment="frames_per_action=2")
    assert bool(model.write_prompt(make_control(model, [FORWARD, TURN_RIGHT], words))) is words
