# SPDX-License-Identifier: Apache-2.0
"""`wiw.check_model` finds each way of breaking the contract, and says so; a model that keeps it is left in peace."""

from __future__ import annotations

import re
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import wiw
from wiw.cli import main
from wiw.errors import ArgumentError, RegistryError
from wiw.serving.background import serve_in_background
from wiw.studies.model_check import CHECKS, examine_model
from wiw.types import Conditioning
from wiw.world_models.warp import Warp

DECLARED = {"control": "trajectory", "size": (48, 96), "best_batch": 4}


class Honest(wiw.WorldModel):
    """Darkens the image by where the plan leads, with noise of the row's own seed."""

    accepts = wiw.accepts(**DECLARED, causal=True)

    def rollout(self, observations, controls, seeds):
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        for row, (control, seed) in enumerate(zip(controls, seeds, strict=True)):
            noise = np.random.default_rng(int(seed)).integers(0, 20, len(control.actions)).astype(np.uint8)
            shade = (20 * np.abs(control.trajectory).sum(1)).astype(np.uint8) + noise
            frames[row, 1:] = frames[row, 1:] // 2 + shade[:, None, None, None]
        return frames


def spoilt(spoil, **declared):
    """An honest model whose answer is spoilt; `spoil(frames, observations, controls, seeds)`."""

    class Spoilt(Honest):
        accepts = wiw.accepts(**{**DECLARED, **declared})

        def rollout(self, observations, controls, seeds):
            frames = super().rollout(observations, controls, seeds)
            answer = spoil(frames, observations, controls, seeds)
            return frames if answer is None else answer

    return Spoilt


def dark(frames, *_):
    frames[:, 0] = 0


def shift(frames, *_):
    return np.concatenate([frames[:, 1:], frames[:, -1:]], 1)


def by_chance(frames, *_):
    frames[:, 1:] += np.random.default_rng().integers(0, 99, frames[:, 1:].shape).astype(np.uint8)


def by_the_batch(frames, observations, controls, seeds):
    frames[:, 1:] += np.uint8(10 * len(frames))


def from_the_first_seed(frames, observations, controls, seeds):
    frames[:, 1:] += np.random.default_rng(int(seeds[0])).integers(0, 99, frames[0, 1:].shape).astype(np.uint8)


def nearly(frames, *_):
    frames[:, 1:] += np.uint8(len(frames))


def looking_ahead(frames, observations, controls, seeds):
    for row, control in enumerate(controls):
        frames[row, 1:] += np.uint8(20 * np.abs(control.trajectory[-1]).sum())


def overwriting(frames, observations, controls, seeds):
    observations.image[:] = 0


def moving_the_plan(frames, observations, controls, seeds):
    controls[0].viewpoints[:] = 0


def forgetting(frames, observations, controls, seeds):
    observations.history.images[:, :-1] = 0


def counting_padding(frames, observations, controls, seeds):
    frames[:, 1:] += np.uint8(30 * observations.history.actions.shape[2])


def needing_a_past(frames, observations, controls, seeds):
    for images, valid in zip(observations.history.images, observations.history.valid, strict=True):
        images[valid][-2].mean()


PAST = {"needs": ("history",), "history": 3}


def reusing():
    memory = np.zeros((4, 5, *DECLARED["size"], 3), np.uint8)

    def spoil(frames, *_):
        answer = memory[: len(frames), : frames.shape[1]]
        answer[:] = frames
        return answer

    return spoil


def rewriting():
    """Writes to the answer before when it is asked again, as one who hands out a buffer before it is filled."""
    answers = []

    def spoil(frames, *_):
        for answer in answers:
            answer[:, 1:] = 0
        answers[:] = [frames]

    return spoil


def cast_without_scale(frames, *_):
    return (frames / 255).astype(np.uint8)


def cast_after_frame_0(frames, *_):
    frames[:, 1:] = (frames[:, 1:] / 255).astype(np.uint8)


def wrapped(frames, *_):
    frames[:, 1:] += np.uint8(150)


def bgr(frames, *_):
    return frames[..., ::-1].copy()


def bgr_after_frame_0(frames, *_):
    frames[:, 1:] = frames[:, 1:, ..., ::-1].copy()


def mirrored(frames, *_):
    return frames[..., ::-1, :].copy()


def mirrored_after_frame_0(frames, *_):
    frames[:, 1:] = frames[:, 1:, :, ::-1].copy()


def upside_down_after_frame_0(frames, *_):
    frames[:, 1:] = frames[:, 1:, ::-1].copy()


def inverted(frames, *_):
    return 255 - frames


def noise(frames, *_):
    return np.random.default_rng(0).integers(0, 255, frames.shape, np.uint8)


def encoded_again(frames, *_):
    small = frames[:, :, ::4, ::4].repeat(4, 2).repeat(4, 3)
    return np.clip(small * 0.9 + 5, 0, 255).astype(np.uint8)


def raising(frames, *_):
    raise RuntimeError("CUDA error: no kernel image")


def raising_elsewhere(frames, *_):
    return np.stack([])


BROKEN = {
    "raised": (raising, {}, r"`rollout` raised RuntimeError: CUDA error: no kernel image \(test_model_check\.py, line"),
    "raised, in a library": (
        raising_elsewhere,
        {},
        r"ValueError: .*\(test_model_check\.py, line \d+: return np\.stack",
    ),
    "shape": (
        lambda frames, *_: frames[:, :, :40],
        {},
        r"expected uint8 \(1, 5, 48, 96, 3\).*got uint8 \(1, 5, 40",
    ),
    "dtype": (lambda frames, *_: frames / np.float32(255), {}, "got float32"),
    "nan": (lambda frames, *_: frames * np.float32("nan"), {}, "with NaN"),
    "type": (lambda frames, *_: frames.tolist(), {}, "got list"),
    "frames": (lambda frames, *_: frames[:, 1:], {}, r"actions \+ 1.*got uint8 \(1, 4"),
    "frame 0": (dark, {}, "frame 0 is not the observation: it is a different image"),
    "frame 0, mirrored": (mirrored, {}, "frame 0 is not the observation: it is mirrored"),
    "frame 0, inverted": (inverted, {}, "frame 0 is not the observation: it is inverted"),
    "frame 0, noise": (noise, {}, "frame 0 is not the observation: it is a different image"),
    "channels": (bgr, {}, r"frame 0 is not the observation: red and blue are swapped \(BGR\)"),
    "channels, after frame 0": (bgr_after_frame_0, {}, r"after frame 0, red and blue are swapped \(BGR\)"),
    "scale": (cast_without_scale, {}, r"floats from 0 to 1 were cast to uint8 without scaling; give np\.rint"),
    "scale, after frame 0": (cast_after_frame_0, {}, "after frame 0, no value is above 1"),
    "pictures, wrapped": (wrapped, {}, r"Values wrap around: at .*% of positions .*np\.clip"),
    "pictures, mirrored": (mirrored_after_frame_0, {}, "After frame 0, frames are mirrored"),
    "pictures, upside down": (upside_down_after_frame_0, {}, "After frame 0, frames are upside down"),
    "frame 0, shifted": (shift, {}, "Frame k is what follows action k"),
    "random": (by_chance, {}, "In two calls with the same seeds, 6 of 6 rows differ"),
    "batch": (by_the_batch, {}, "alone, 2 of 2 rows differ from the same rows in a batch of 4"),
    "batch, seeds": (from_the_first_seed, {}, "its own seed, not the whole batch's from the first one"),
    "causal": (looking_ahead, {"causal": True}, "It declares causal=True, but frames before"),
    "inputs": (overwriting, {}, "It modifies its inputs: observations.image"),
    "inputs, plan": (moving_the_plan, {}, r"It modifies its inputs: control\.viewpoints"),
    "inputs, history": (forgetting, PAST, r"It modifies its inputs: observations\.history\.images"),
    "batch, history": (counting_padding, PAST, "alone, 1 of 2 rows differ"),
    "raised, young": (needing_a_past, PAST, "IndexError"),
    "memory": (reusing(), {}, "An answer uses the memory of an earlier one"),
    "memory, written to": (rewriting(), {}, "An answer was written to after it was returned"),
    "needs": (dark, {"needs": ("simulator",)}, "needs the simulator, which only the oracle is given"),
    "needs, vocabulary": (
        dark,
        {"control": "action", "vocabulary": {"forward": 0}},
        "expected a vocabulary with forward, turn_left, turn_right, got one with forward; add turn_left, turn_right",
    ),
    "needs, null": (
        dark,
        {"control": "action", "vocabulary": {1: 0, 2: 1, 3: 2}, "null_first": True},
        "expected a vocabulary with null, forward, .*; add null to accepts",
    ),
    "needs, poses": (dark, {"space": "pose7"}, "gripper poses do not move the camera"),
}


def recalling(frames, observations, controls, seeds):
    """Adds where the agent was before, as far as that is known."""
    history = observations.history
    for row, valid in enumerate(history.valid):
        assert (history.images[row, -1] == observations.image[row]).all()
        shade = 40 * np.abs(history.poses[row, valid]).sum() + history.images[row, valid, 0, 0].sum()
        frames[row, 1:] += np.uint8(int(shade) % 256)


def found(model, scene, **options):
    return {finding.kind: finding for finding in wiw.check_model(model, scene, **options)}


@pytest.mark.parametrize("name", BROKEN)
def test_each_breach_is_found_and_told(name, two_rooms):
    spoil, declared, text = BROKEN[name]
    findings = found(spoilt(spoil, **declared), two_rooms)
    kind = name.partition(",")[0]
    assert findings[kind].serious, findings
    assert re.search(text, str(findings[kind])), str(findings[kind])
    assert set(findings) - {kind, "frame 0"} <= ({"history"} if declared is PAST else set())


@pytest.mark.parametrize(
    "declared", [{}, {"frames": 5}, {"frames": 14}, {"frames": 2}, {"best_batch": 1}, {"needs": ("depth",)}]
)
def test_an_honest_model_is_left_in_peace(declared, two_rooms):
    assert found(spoilt(lambda *_: None, **declared), two_rooms) == {}
    assert found(Honest, two_rooms) == {}


@pytest.mark.parametrize("declared", [{}, {"frames": 3}, {"best_batch": 1}, {"history": 1}, {"history": 9}])
def test_an_honest_model_with_a_memory_is_left_in_peace(declared, two_rooms):
    assert found(spoilt(recalling, **{**PAST, **declared}), two_rooms) == {}


def test_a_past_that_is_not_looked_at_is_noted(two_rooms):
    findings = found(spoilt(lambda *_: None, **PAST), two_rooms)
    assert set(findings) == {"history"} and not findings["history"].serious
    assert "Past observations make no difference" in str(findings["history"])


GRIPPER = {"control": "action", "space": "pose7", "view": "perspective", "size": (48, 48), "best_batch": 4}


class Arm(wiw.WorldModel):
    """Darkens the image by where the gripper goes."""

    accepts = wiw.accepts(**GRIPPER, causal=True)

    def rollout(self, observations, controls, seeds):
        frames = np.repeat(observations.image[:, None], len(controls[0].ids), 1)
        for row, control in enumerate(controls):
            way = np.abs(control.ids[1:, :3] - control.ids[0, :3]).sum(1) + self.later(control.ids)
            if observations.history is not None:
                past = observations.history.poses[row]
                np.testing.assert_array_equal(past[-1], control.ids[0])
                way += 10 * np.abs(past[0] - past[-1]).sum()
            frames[row, 1:] = frames[row, 1:] // 2 + (50 * way).astype(np.uint8)[:, None, None, None]
        return frames

    def later(self, poses):
        return 0


class Foreseeing(Arm):
    def later(self, poses):
        return poses[-1, :3] @ (1, 2, 1)


@pytest.mark.parametrize(
    "declared", [{}, {"frames": 5}, {"frames": 14}, {"best_batch": 1}, {"needs": ("depth",)}, PAST]
)
def test_models_of_grippers_are_asked_about_poses(declared):
    class Asked(Arm):
        accepts = wiw.accepts(**{**GRIPPER, "causal": True, **declared})

    assert found(Asked, "nowhere") == {}
    if declared in ({}, PAST):
        findings = found(type("Ahead", (Foreseeing,), {"accepts": Asked.accepts}), "nowhere")
        assert set(findings) == {"causal"} and "frames before a changed action change too" in str(findings["causal"])


def test_a_gripper_that_is_not_looked_at_is_noted(monkeypatch):
    from wiw.studies import model_check

    class Blind(Arm):
        def rollout(self, observations, controls, seeds):
            return np.repeat(observations.image[:, None], len(controls[0].ids), 1)

    monkeypatch.setattr(model_check, "LONG_RUN", 0.0)
    findings = found(Blind, "nowhere")
    assert set(findings) == {"plan", "slow"} and not any(finding.serious for finding in findings.values())
    assert "200 episodes of manipulation requests about 3000 of them" in str(findings["slow"])


def test_what_is_good_to_know_breaks_nothing(two_rooms, monkeypatch):
    from wiw.studies import model_check

    findings = found(spoilt(nearly), two_rooms)
    assert not findings["batch"].serious and "a CPU adds in a different order" in str(findings["batch"])
    assert "GPU" not in str(findings["batch"])
    still = found(
        spoilt(lambda frames, observations, *_: np.repeat(observations.image[:, None], frames.shape[1], 1)), two_rooms
    )
    assert not still["plan"].serious and "('trajectory')" in str(still["plan"])
    monkeypatch.setattr(model_check, "LONG_RUN", 0.0)
    slow = found(Honest, two_rooms)
    assert not slow["slow"].serious and "about 6000 of them" in str(slow["slow"])


def test_identity_is_looked_at_too(two_rooms):
    class Odd(Honest):
        accepts = wiw.accepts(**DECLARED, cacheable=True)

        def describe(self):
            return {"weights": object()}

    findings = found(Odd, two_rooms)
    assert "does not return JSON" in str(findings["describe"]) and "declares cacheable=True but no version" in str(
        findings["version"]
    )


def test_what_cannot_be_made(two_rooms):
    class Unmade(Honest):
        def __init__(self):
            raise OSError("no weights")

    assert "It cannot be built: OSError: no weights (test_model_check.py" in str(found(Unmade, two_rooms)["raised"])
    with pytest.raises(RegistryError, match="Did you mean warp"):
        wiw.check_model("wrap", two_rooms)
    with pytest.raises(ArgumentError, match="no world model"):
        wiw.check_model("none", two_rooms)


def test_a_model_that_hangs_does_not_hang_the_check(two_rooms):
    ended = threading.Event()
    try:
        findings = found(spoilt(lambda *_: ended.wait(60)), two_rooms, deadline=0.3)
    finally:
        ended.set()
    assert findings["deadline"].serious and "No answer in 0.3 s" in str(findings["deadline"])
    assert set(findings) == {"deadline"}
    with pytest.raises(ArgumentError, match="seconds above 0"):
        wiw.check_model(Honest, two_rooms, deadline=0)


def test_a_function_and_a_served_model_are_checked_as_any(two_rooms):
    def rollout(observations, controls, seeds):
        return Honest().rollout(observations, controls, seeds)

    assert found(rollout, two_rooms, accepts=Honest.accepts) == {}
    with serve_in_background(Honest) as server:
        assert found(f"remote:{server.address}", two_rooms) == {}
    with serve_in_background(Arm) as server:
        assert found(f"remote:{server.address}", "nowhere") == {}
    with serve_in_background(spoilt(by_chance)) as server:
        assert set(found(f"remote:{server.address}", two_rooms)) == {"random"}
    with serve_in_background(spoilt(lambda frames, *_: frames[:, 1:])) as server:
        assert set(found(f"remote:{server.address}", two_rooms)) == {"frames"}


def test_the_command_says_it_and_ends_accordingly(tmp_path: Path, two_rooms, capsys):
    file = tmp_path / "mine.py"
    text = """
import numpy as np
import wiw


class Mine(wiw.WorldModel):
    accepts = wiw.accepts(control="image", size=(48, 96), best_batch=2)
    first = {first}

    def rollout(self, observations, controls, seeds):
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        frames[:, 0] += self.first
        return frames
"""
    for first, code, said in ((0, 0, "keeps its contract"), (60, 1, "frame 0 is not the observation")):
        file.write_text(text.format(first=first))
        assert main(["check-model", f"{file}:Mine", "--scenes", two_rooms]) == code
        assert said in capsys.readouterr().out.casefold()
    assert main(["check-model", f"{file}:Its"]) == 2
    assert "cannot be loaded" in capsys.readouterr().err


def test_everything_that_is_looked_at_is_listed_with_its_result_and_a_time(two_rooms, capsys):
    checks = {check.name: check for check in examine_model(spoilt(lambda *_: None, causal=True), two_rooms)}
    assert list(checks) == list(CHECKS)
    skipped = {"history": "skipped", "size": "skipped"}
    assert {name: check.result for name, check in checks.items() if check.result != "passed"} == skipped
    assert re.fullmatch(r"[\d.e-]+ s a rollout of 4 actions, 4 at a time", checks["speed"].detail)
    checks = {check.name: check for check in examine_model(spoilt(bgr), two_rooms)}
    assert checks["pictures"].result == "wrong" and checks["construction"].result == "passed"
    assert checks["random"].result == checks["speed"].result == "skipped"
    checks = {check.name: check for check in examine_model(spoilt(by_chance, causal=True), two_rooms)}
    assert checks["random"].result == "wrong" and checks["causal"].skipped.startswith("every comparison would fail")
    assert main(["check-model", "copy", "--scenes", two_rooms]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    expected = ["skipped" if name == "history" else "passed" for name in CHECKS]
    assert [line.split()[0] for line in lines] == expected and last == "copy keeps its contract"
    assert "Frame 0 is the observation" in lines[2] and "s a rollout of 4 actions" in lines[-1]


def test_a_frame_0_that_was_encoded_again_is_good_to_know(two_rooms):
    findings = found(spoilt(encoded_again), two_rooms)
    assert set(findings) == {"frame 0"} and not findings["frame 0"].serious
    assert "only nearly" in str(findings["frame 0"])


class Backwards(Warp):
    """Warps as told, and shows the last frame first."""

    accepts = replace(Warp.accepts, causal=False)

    def rollout(self, observations, controls, seeds):
        whole = [replace(control, shared=0) for control in controls]
        frames = super().rollout(observations, whole, seeds)
        frames[:, 1:] = frames[:, :0:-1].copy()
        return frames


class WrongSide(Warp):
    """Turns to the left where it is told to turn to the right."""

    def rollout(self, observations, controls, seeds):
        turned = Conditioning(observations.image[:, :, ::-1].copy(), depth=observations.depth[:, :, ::-1].copy())
        frames = super().rollout(turned, controls, seeds)[..., ::-1, :].copy()
        frames[:, 0] = observations.image
        return frames


@pytest.mark.parametrize(("model", "said"), [(Backwards, "Time runs backwards"), (WrongSide, "Left and right are")])
def test_frames_are_held_against_what_is_truly_seen(model, said, two_rooms):
    findings = found(model, two_rooms)
    assert set(findings) == {"plan"} and findings["plan"].serious and said in str(findings["plan"])


def test_networks_left_in_training_mode_are_named(two_rooms):
    torch = pytest.importorskip("torch")

    class Networked(Honest):
        def __init__(self, training):
            layers = [torch.nn.Conv2d(3, 3, 1), torch.nn.BatchNorm2d(3), torch.nn.Dropout(0.1)]
            self._parts = {"encoder": torch.nn.Sequential(*layers).train(training)}

    assert found(Networked(False), two_rooms) == {}
    finding = found(Networked(True), two_rooms)["training"]
    assert finding.serious and "Networked._parts['encoder'] is in training mode, with BatchNorm2d, Dropout" in str(
        finding
    )
