# SPDX-License-Identifier: Apache-2.0
"""warpnet: its geometry against the compiled warp, its contract with the loop, and its file."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import wiw
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, to_trajectory
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, DependencyError, WeightsError
from wiw.reproject import pose
from wiw.reproject import warp as true_warp
from wiw.types import Conditioning, Control

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.world_models.warpnet.model import BUILT_IN, WarpNet, shrink_panorama, to_network, turn_panorama  # noqa: E402
from wiw.world_models.warpnet.network import Network, enlarge_panorama, rays, warp  # noqa: E402
from wiw.world_models.warpnet.weights import load, save  # noqa: E402

SIZE = (96, 192)


def test_a_smaller_size_shows_the_same_and_is_part_of_its_identity() -> None:
    usual, small = WarpNet(), WarpNet(size=(144, 256))
    assert (usual.accepts.size, small.accepts.size) == ((576, 1024), (144, 256))
    assert "size" not in usual.describe()
    assert small.describe() == usual.describe() | {"size": [144, 256]}
    blurred = cv2.GaussianBlur(noise(1)[0], (0, 0), 5)
    large = cv2.resize(blurred, (1024, 576))[None]
    plan = control([FORWARD, TURN_LEFT, FORWARD])
    seen = rollout(usual, large, [plan])[0]
    imagined = rollout(small, shrink_panorama(large[0], (144, 256))[None], [plan])[0]
    for own, other in zip(imagined, seen, strict=True):
        assert np.abs(own - shrink_panorama(other, (144, 256)).astype(float)).mean() < 2


@pytest.mark.parametrize("size", [(16, 32), (144,), (72, 142)])
def test_a_size_below_the_networks_is_refused(size: Any) -> None:
    with pytest.raises(ArgumentError, match=r"at least \(72, 144\)"):
        WarpNet(size=size)


def untrained(seed: int = 0) -> WarpNet:
    torch.manual_seed(seed)
    return WarpNet.of(Network(16, (8, 8, 8)))


def control(actions: list[int], shared: int = 0, length: int | None = None) -> Control:
    trajectory = to_trajectory(actions)
    views = np.tile(np.eye(4), (len(actions), 1, 1))
    return Control(np.array(actions, np.int8), trajectory, views, length=length or len(actions), shared=shared)


def noise(rows: int, seed: int = 0) -> Any:
    small = np.random.default_rng(seed).integers(0, 256, (rows, 12, 32, 3), np.uint8)
    return small.repeat(6, axis=1).repeat(4, axis=2)


def rollout(model: WarpNet, images: Any, controls: list[Control]) -> Any:
    return model.rollout(Conditioning(images), controls, np.zeros(len(controls), np.uint64))


# -- geometry ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room(two_rooms: str) -> Any:
    """What is seen from two places of a room, 0.6 m apart, and how far away it is; there is no ceiling."""
    poses = np.stack([camera_pose(np.array([-2.4, 0, z]), 0.0) for z in (1.2, 0.6)])
    return world(two_rooms).renderer.panorama(poses, SIZE)


def logarithm(depth: Any) -> Any:
    return torch.from_numpy(np.log(np.where(depth > 0, depth, 20)))[:, None]


def test_with_the_true_distances_the_warp_is_the_compiled_one(room: Any) -> None:
    color, depth = room["color"], room["depth"]
    made = warp(to_network(color[:1]), logarithm(depth[1:]), torch.tensor([0.6]))
    image = ((made[0].permute(1, 2, 0) + 1) * 127.5).numpy()
    found = true_warp(color[:1], depth[:1], pose(forward=0.6)[None, None], outputs=("color", "hole"))
    seen = ~found["hole"][0, 0] & (depth[1] > 0)
    gap = np.abs(image - found["color"][0, 0]).max(axis=-1)[seen]
    assert seen.mean() > 0.6
    assert np.median(gap) < 2
    assert np.mean(gap < 8) > 0.95  # the rest: edges of things
    still = np.abs(color[0].astype(float) - color[1])[seen].mean()
    assert np.abs(image - color[1])[seen].mean() < still / 4


def test_left_and_right_are_alike(room: Any) -> None:
    color, log_distance = to_network(room["color"][:1]), logarithm(room["depth"][1:])
    ahead = torch.tensor([0.6])
    mirrored = warp(color.flip(3), log_distance.flip(3), ahead)
    torch.testing.assert_close(mirrored.flip(3), warp(color, log_distance, ahead), atol=2e-4, rtol=0)


def test_who_stays_sees_the_same_and_the_far_does_not_move() -> None:
    image, distance = to_network(noise(1)), torch.zeros(1, 1, 72, 128)
    torch.testing.assert_close(warp(image, distance, torch.zeros(1)), image, atol=1e-3, rtol=0)
    assert (warp(image, distance + 3, torch.tensor([0.5])) - image).abs().mean() < 0.2
    assert (warp(image, distance, torch.tensor([0.5])) - image).abs().mean() > 0.3


def test_rays_are_those_of_the_conventions() -> None:
    expected = wiw.panorama.directions(SIZE)
    np.testing.assert_allclose(rays(*SIZE).permute(1, 2, 0).numpy(), expected, atol=1e-6)


@given(st.sampled_from([(8, 16), (16, 32), (24, 48)]), st.integers(0, 1023), st.integers(0, 5))
@settings(max_examples=10)
def test_enlarging_knows_no_seam(size: tuple[int, int], columns: int, seed: int) -> None:
    small = torch.from_numpy(np.random.default_rng(seed).random((1, 2, *size), np.float32))
    step = 1024 // size[1] if 1024 % size[1] == 0 else 64
    turn = columns // step
    large = enlarge_panorama(small, 48, 1024)
    assert large.shape == (1, 2, 48, 1024)
    by = turn * size[1] // 16 if 1024 % size[1] else turn
    torch.testing.assert_close(enlarge_panorama(small.roll(by, 3), 48, 1024), large.roll(by * 1024 // size[1], 3))
    torch.testing.assert_close(large.mean((2, 3)), small.mean((2, 3)), atol=0.05, rtol=0)


# -- in the loop -------------------------------------------------------------------------------------------------------


def test_turns_are_rolls_wherever_they_come_in_a_plan() -> None:
    image = noise(1)
    frames = rollout(untrained(), image, [control([TURN_LEFT, FORWARD, TURN_RIGHT, TURN_RIGHT])])[0]
    np.testing.assert_array_equal(frames[1], np.roll(image[0], 128 // 16, axis=1))
    np.testing.assert_array_equal(frames[1], wiw.panorama.rotate(image[0], 22.5))
    assert np.abs(frames[2].astype(int) - frames[1]).mean() > 1
    np.testing.assert_array_equal(frames[4], np.roll(frames[2], -2 * 128 // 16, axis=1))


def test_a_plan_is_one_jump() -> None:
    """Three strides are one of three lengths, and a turn before walking is one of the panorama."""
    image, model = noise(1), untrained()
    np.testing.assert_array_equal(
        rollout(model, image, [control([FORWARD] * 3)])[0, 3], model.imagine_move(image[0], 3 * 0.2, 0.0)
    )
    turning = rollout(model, image, [control([TURN_LEFT, FORWARD])])[0, 2]
    straight = rollout(model, turn_panorama(image[0], np.pi / 8)[None], [control([FORWARD])])[0, 1]
    np.testing.assert_array_equal(turning, straight)


def test_rows_do_not_depend_on_each_other() -> None:
    images, model = noise(3, 1), untrained()
    controls = [
        control(plan) for plan in ([FORWARD] * 3, [TURN_LEFT, FORWARD, FORWARD], [FORWARD, TURN_RIGHT, FORWARD])
    ]
    together = rollout(model, images, controls)
    for row in range(3):
        np.testing.assert_array_equal(rollout(model, images[row : row + 1], controls[row : row + 1])[0], together[row])
    half = rollout(model, images[:1], [control([FORWARD] * 3, shared=1, length=2)])
    np.testing.assert_array_equal(half[0, 2], together[0, 2])


def test_it_says_what_it_is(tmp_path: Path) -> None:
    one, other = untrained(0), untrained(1)
    assert one.fingerprint() == untrained(0).fingerprint() != other.fingerprint()
    assert one.accepts.causal and one.accepts.view == "panorama" and not one.accepts.needs
    assert json.dumps(one.describe())
    save(tmp_path / "w.safetensors", one._network, {})
    again = WarpNet(tmp_path / "w.safetensors")
    copied = pickle.loads(pickle.dumps(again))
    image = noise(1)
    np.testing.assert_array_equal(copied.imagine_move(image[0], 0.5, 0.1), again.imagine_move(image[0], 0.5, 0.1))


# -- the file ----------------------------------------------------------------------------------------------------------


def test_a_saved_network_is_loaded_again(tmp_path: Path) -> None:
    file, network = tmp_path / "w.safetensors", Network(24, (4, 8, 12))
    save(file, network, {"psnr": 3.5})
    loaded, card = load(file)
    assert (loaded.height, loaded.widths, card) == (24, (4, 8, 12), {"psnr": 3.5})
    for name, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value.half().float())
    with pytest.raises(wiw.errors.FileError, match="cannot be written"):
        save(file / "w", network, {})


def test_what_is_no_weights_is_refused(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    good = tmp_path / "good"
    save(good, Network(8, (4, 4, 4)), {})
    content = good.read_bytes()
    cases = {
        "cut": (content[: len(content) // 2], "unfit"),
        "text": (b"no weights at all", "unfit"),
        "newer": (content.replace(b"wiw-warpnet-1", b"wiw-warpnet-9"), "revision"),
        "other": (content.replace(b"wiw-warpnet-1", b"wiw-recogniser"[:13]), "unfit"),
        "wider": (content.replace(b"[4, 4, 4]", b"[4, 4, 8]"), "unfit"),
    }
    for name, (data, kind) in cases.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(WeightsError, match=name) as error:
            WarpNet(tmp_path / name)
        assert error.value.kind == kind, name
    with pytest.raises(WeightsError, match="wiw train warpnet") as error:
        WarpNet(tmp_path / "none")
    assert error.value.kind == "missing"
    save_file({"a": torch.zeros(1)}, tmp_path / "bare")
    with pytest.raises(WeightsError, match="bare"):
        WarpNet(tmp_path / "bare")


def test_without_torch_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wiw.world_models.base.importlib.util.find_spec", lambda name: None)
    with pytest.raises(DependencyError, match=r"pip install 'wiw\[torch\]'"):
        wiw.world_model("warpnet")


def test_torch_is_not_loaded_before_it_is_needed() -> None:
    code = "import sys, wiw.world_models.warpnet.model; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


# -- as it comes with wiw ----------------------------------------------------------------------------------------------


def test_the_weights_that_come_with_it_beat_the_floor(two_rooms: str) -> None:
    """In a bare room unlike any apartment."""
    model = wiw.world_model("warpnet")
    poses = np.stack([camera_pose(np.array([-2.4, 0, z]), 0.0) for z in (1.4, 0.8)])
    before, after = world(two_rooms).renderer.panorama(poses, outputs=("color",))["color"]
    made = model.imagine_move(before, 0.6, 0.0)
    floor = wiw.metrics.psnr(before, after, weights="latitude")
    assert wiw.metrics.psnr(made, after, weights="latitude") > floor + 1.5
    assert BUILT_IN.stat().st_size < 4 * 2**20


def test_its_card_has_the_recipe_and_what_it_is_worth() -> None:
    card = wiw.world_model("warpnet").card
    psnr, ssim = card["held_out"]["psnr"], card["held_out"]["ssim"]
    assert set(psnr) == set(ssim) == {"copy", "warpnet", "warp"}
    assert set(psnr["copy"]) == {"1", "3", "5", "8"}
    assert psnr["warpnet"]["3"] > psnr["copy"]["3"] + 3
    assert psnr["warp"]["3"] > psnr["warpnet"]["3"]
    assert card["scenes"].startswith("apartments:train")
    assert card["val"].startswith("apartments:val")
    assert card["recipe"]["epochs"] >= 1


def test_constants_made_for_a_rollout_serve_training_too() -> None:
    from wiw.world_models.warpnet.network import plain_room, rays

    for made in (rays, plain_room):
        made.cache_clear()
        with torch.inference_mode():
            made(4, 8)
        weight = torch.ones(1, requires_grad=True)
        (made(4, 8) * weight).sum().backward()
        assert weight.grad is not None and torch.isfinite(weight.grad).all()


def test_the_demo_leaves_it_out_where_torch_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from wiw.cli.demo import PARTS, _can_run, _choose_arms

    names = PARTS[0].arms
    assert _choose_arms(names) == list(names)
    assert not capsys.readouterr().out
    monkeypatch.setattr("wiw.world_models.base.importlib.util.find_spec", lambda name: None)
    assert _choose_arms(names) == ["none", "copy", "warp", "oracle"]
    assert "warpnet is skipped: torch" in capsys.readouterr().out
    assert [part.task for part in PARTS if _can_run(part)] == ["imagenav", "manipulation"]
    assert "aeqa with policy explorer is skipped: torch, safetensors not installed" in capsys.readouterr().out
