# SPDX-License-Identifier: Apache-2.0
"""pocket: its geometry, its symmetry, its sampler, and its contract with the loop."""

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

import wiw
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, to_trajectory
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, WeightsError
from wiw.types import Conditioning, Control

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.world_models.pocket.model import BUILT_IN, Pocket, find_places  # noqa: E402
from wiw.world_models.pocket.network import RADII, Denoiser, Estimate, Views, map_displacements  # noqa: E402
from wiw.world_models.pocket.sampler import draw_noise, sample_views  # noqa: E402
from wiw.world_models.pocket.weights import load, save  # noqa: E402
from wiw.world_models.warpnet.model import shrink_panorama  # noqa: E402
from wiw.world_models.warpnet.network import plain_room, warp  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SIZE = (16, 32)
WIDTHS = (8, 8, 8, 8)


def shaken(seed: int = 0) -> Denoiser:
    """A network with no weight at zero, so that all of it takes part."""
    torch.manual_seed(seed)
    network = Denoiser(SIZE[0], (8, 32, 32, 32)).eval()
    with torch.no_grad():
        for value in network.parameters():
            value.add_(0.1 * torch.randn_like(value))
    return network


def untrained(steps: int = 1) -> Pocket:
    model = Pocket.of(shaken())
    model.steps = steps
    return model


def control(actions: list[int], length: int | None = None) -> Control:
    views = np.tile(np.eye(4), (len(actions), 1, 1))
    return Control(np.array(actions, np.int8), to_trajectory(actions), views, length=length or len(actions))


def noise(rows: int, seed: int = 0) -> Any:
    small = np.random.default_rng(seed).integers(0, 256, (rows, 8, 16, 3), np.uint8)
    return small.repeat(4, axis=1).repeat(4, axis=2)


def rollout(model: Pocket, images: Any, controls: list[Control], seeds: list[int] | None = None) -> Any:
    return model.rollout(Conditioning(images), controls, np.array(seeds or range(len(controls)), np.uint64))


# -- geometry ----------------------------------------------------------------------------------------------------------


def test_a_step_to_the_right_is_a_turn_a_step_ahead_and_a_turn_back() -> None:
    torch.manual_seed(0)
    source, log_distance, metres = torch.rand(1, 3, 16, 32), torch.rand(1, 1, 16, 32), torch.tensor([0.4])
    aside = warp(source, log_distance, torch.zeros(1), metres)
    turned = warp(source.roll(-8, 3), log_distance.roll(-8, 3), metres).roll(8, 3)
    torch.testing.assert_close(aside, turned, atol=2e-4, rtol=0)


def test_the_sweep_shows_the_panorama_in_one_room_after_another() -> None:
    source, places = torch.rand(2, 3, *SIZE), torch.tensor([[[0.0, 0.0], [0.3, 0.5]]]).repeat(2, 1, 1)
    sweep = Views.around(source, places).sweep
    assert sweep.shape == (2, 2, len(RADII), 3, *SIZE)
    torch.testing.assert_close(sweep[:, 0], source[:, None].expand(-1, len(RADII), -1, -1, -1), atol=1e-3, rtol=0)
    expected = warp(source[1:], plain_room(*SIZE, RADII[2])[None], torch.tensor([0.5]), torch.tensor([0.3]))
    torch.testing.assert_close(sweep[1, 1, 2], expected[0])


def test_what_lies_ahead_comes_closer_and_what_lies_aside_passes() -> None:
    closer, passing = map_displacements(torch.tensor([[0.0, 2.0]]), 1, 4)[0, :, 0]  # columns at -135, -45, 45, 135
    half = 2 * np.sqrt(0.5)
    torch.testing.assert_close(closer, torch.tensor([-half, half, half, -half], dtype=torch.float32))
    torch.testing.assert_close(passing, torch.tensor([half, half, -half, -half], dtype=torch.float32))


def test_a_blend_takes_each_pixel_from_where_its_weights_say() -> None:
    views = Views.around(torch.rand(1, 3, *SIZE), torch.tensor([[[0.1, 0.4]]]))
    for chosen in range(len(RADII) + 1):
        weights = torch.zeros(1, len(RADII) + 1, *SIZE)
        weights[:, chosen] = 1
        log_distance = plain_room(*SIZE, RADII[1])[None]
        made = views.blend(Estimate(log_distance, weights, torch.full((1, 3, *SIZE), 0.25)))
        expected = views.sweep[:, :, 1 if chosen == len(RADII) else chosen] + 0.25
        torch.testing.assert_close(made, expected)


def test_turning_panorama_and_places_together_turns_the_estimate() -> None:
    """Exactly by 16 columns, as wide as a pixel of the coarsest scale."""
    network = shaken()
    source, places = torch.rand(1, 3, *SIZE), torch.tensor([[[0.2, 0.5], [-0.3, 0.1]]])
    noisy, level = torch.randn(1, 2, 3, *SIZE), torch.full((1,), 0.7)
    turned = torch.stack([-places[..., 0], -places[..., 1]], dim=-1)  # by 180 degrees: 16 of 32 columns
    with torch.inference_mode():
        first = network(noisy, level, Views.around(source, places).sweep, places)
        second = network(noisy.roll(16, 4), level, Views.around(source.roll(16, 3), turned).sweep, turned)
    for name in ("log_distance", "weights", "residual"):
        torch.testing.assert_close(getattr(second, name), getattr(first, name).roll(16, 3), atol=1e-3, rtol=1e-3)


def test_each_view_knows_of_the_others_of_its_panorama_and_of_no_other_panorama() -> None:
    network, views = shaken(), Views.around(torch.rand(2, 3, *SIZE), torch.rand(2, 3, 2))
    noisy, levels = torch.randn(2, 3, 3, *SIZE), torch.ones(2)
    changed = noisy.clone()
    changed[0, 2] = 0
    with torch.inference_mode():
        before = network(noisy, levels, views.sweep, views.places).residual.unflatten(0, (2, 3))
        after = network(changed, levels, views.sweep, views.places).residual.unflatten(0, (2, 3))
    differs = (before - after).abs().amax(dim=(2, 3, 4))
    assert (differs[0] > 1e-4).all() and (differs[1] == 0).all()


# -- sampling ----------------------------------------------------------------------------------------------------------


class Oracle:
    """A denoiser that knows the views, and notes what it is shown."""

    def __init__(self, views: Views, truth: Any) -> None:
        self.views, self.truth, self.shown = views, truth, []

    def __call__(self, noisy: Any, levels: Any, sweep: Any, places: Any) -> Estimate:
        self.shown.append((float(levels[0]), noisy))
        weights = torch.zeros(len(places[0]), len(RADII) + 1, *SIZE)
        weights[:, 0] = 1
        residual = (self.truth - sweep[:, :, 0]).flatten(0, 1)
        return Estimate(plain_room(*SIZE).expand(len(weights), -1, -1, -1), weights, residual)


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_a_perfect_denoiser_is_led_along_the_straight_flow_to_the_views(steps: int) -> None:
    views = Views.around(torch.rand(1, 3, *SIZE), torch.rand(1, 2, 2))
    truth, start = torch.rand(1, 2, 3, *SIZE), torch.randn(1, 2, 3, *SIZE)
    oracle = Oracle(views, truth)
    found = views.blend(sample_views(oracle, views, start, steps))
    torch.testing.assert_close(found, truth, atol=1e-5, rtol=0)
    assert [level for level, _ in oracle.shown] == [1 - step / steps for step in range(steps)]
    for level, noisy in oracle.shown:
        torch.testing.assert_close(noisy, torch.lerp(truth, start, level), atol=1e-5, rtol=0)


def test_noise_is_a_function_of_the_rows_own_seed() -> None:
    views = Views.around(torch.rand(2, 3, *SIZE), torch.rand(2, 2, 2))
    both, one = draw_noise(views, [7, 2**63 + 1]), draw_noise(views, [2**63 + 1, 7])
    assert both.shape == (2, 2, 3, *SIZE) and torch.equal(both, one.flip(0)) and not torch.equal(both[0], both[1])


# -- in the loop -------------------------------------------------------------------------------------------------------


def test_places_are_counted_once_and_the_start_not_at_all() -> None:
    path = to_trajectory([TURN_LEFT, FORWARD, TURN_RIGHT, TURN_RIGHT, FORWARD])[:, :2]
    owners, places = find_places(path)
    assert owners.tolist() == [-1, 0, 0, 0, 1]
    np.testing.assert_allclose(places, path[[1, 4]])
    round_turn = [TURN_LEFT] * 8
    back = to_trajectory([FORWARD, FORWARD, *round_turn, FORWARD, FORWARD, *round_turn, FORWARD])[:, :2]
    owners, places = find_places(back)
    assert owners.tolist() == [0, 1, *[1] * 8, 0, -1, *[-1] * 8, 0]
    np.testing.assert_allclose(places, back[:2])
    assert find_places(np.zeros((2, 2)))[1].shape == (0, 2)


def test_turns_are_rolls_and_who_stays_sees_the_same() -> None:
    image = noise(1)
    frames = rollout(untrained(), image, [control([TURN_LEFT, FORWARD, TURN_RIGHT, TURN_RIGHT])])[0]
    np.testing.assert_array_equal(frames[1], np.roll(image[0], 64 // 16, axis=1))
    assert np.abs(frames[2].astype(int) - frames[1]).mean() > 1
    np.testing.assert_array_equal(frames[4], np.roll(frames[2], -2 * 64 // 16, axis=1))


@pytest.mark.parametrize("steps", [1, 3])
def test_rows_depend_on_their_seeds_and_not_on_each_other(steps: int) -> None:
    images, model = noise(3, 1), untrained(steps)
    plans = [[FORWARD] * 3, [TURN_LEFT, FORWARD, FORWARD], [FORWARD, TURN_RIGHT, FORWARD]]
    together = rollout(model, images, [control(plan) for plan in plans])
    for row, plan in enumerate(plans):
        alone = rollout(model, images[row : row + 1], [control(plan)], [row])
        np.testing.assert_array_equal(alone[0], together[row])
    other = rollout(model, images[:1], [control(plans[0])], [99])
    assert np.abs(other[0].astype(int) - together[0]).max() > 0
    padded = rollout(model, images[:1], [control([*plans[0], FORWARD, FORWARD], length=3)], [0])
    np.testing.assert_array_equal(padded[0, :4], together[0])


def test_it_says_what_it_is(tmp_path: Path) -> None:
    file = tmp_path / "w.safetensors"
    save(file, shaken(), {"steps": 3})
    one, other = Pocket(file), Pocket(file, steps=4)
    assert not one.accepts.causal and one.accepts.view == "panorama" and not one.accepts.needs
    assert one.fingerprint() != other.fingerprint() and json.dumps(one.describe())
    assert one.card == {"steps": 3}
    copied, image = pickle.loads(pickle.dumps(other)), noise(1)
    np.testing.assert_array_equal(
        rollout(copied, image, [control([FORWARD])]), rollout(other, image, [control([FORWARD])])
    )
    with pytest.raises(ArgumentError, match="1 step of the sampler or more, got 0"):
        Pocket(file, steps=0)


def test_a_saved_network_is_loaded_again_and_anything_else_refused(tmp_path: Path) -> None:
    file, network = tmp_path / "w.safetensors", Denoiser(32, WIDTHS)
    save(file, network, {"psnr": 3.5})
    loaded, card = load(file)
    assert (loaded.height, loaded.widths, card) == (32, WIDTHS, {"psnr": 3.5})
    for name, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value.half().float())
    file.write_bytes(file.read_bytes().replace(b"wiw-pocket-1", b"wiw-pocket-9"))
    with pytest.raises(WeightsError, match="another version; `wiw train pocket`"):
        Pocket(file)
    with pytest.raises(WeightsError, match="`wiw train pocket` creates one"):
        Pocket(tmp_path / "none")


def test_torch_is_not_loaded_before_it_is_needed() -> None:
    code = "import sys, wiw.world_models.pocket.model; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


# -- size --------------------------------------------------------------------------------------------------------------


def test_a_smaller_size_shows_the_same_and_is_part_of_its_identity() -> None:
    usual, small = Pocket(), Pocket(size=(144, 256))
    assert (usual.accepts.size, small.accepts.size) == ((576, 1024), (144, 256))
    assert "size" not in usual.describe()
    assert small.describe() == usual.describe() | {"size": [144, 256]}
    large = cv2.resize(np.random.default_rng(0).integers(0, 256, (9, 16, 3), np.uint8), (1024, 576))[None]
    plan = [control([FORWARD, TURN_LEFT])]
    expected = rollout(usual, large, plan)[0, 1:]
    found = rollout(small, shrink_panorama(large[0], (144, 256))[None], plan)[0, 1:]
    shrunk = np.stack([shrink_panorama(frame, (144, 256)) for frame in expected])
    assert np.abs(found.astype(int) - shrunk).mean() < 3


@pytest.mark.parametrize("size", [(16, 32), (144,), (100, 100)])
def test_a_size_below_the_networks_is_refused(size: Any) -> None:
    with pytest.raises(ArgumentError, match=r"pocket: expected a size \(height, width\) of at least"):
        Pocket(size=size)


# -- as it comes with wiw ----------------------------------------------------------------------------------------------


def test_the_weights_that_come_with_it_beat_the_floor_and_obey(two_rooms: str) -> None:
    """In a bare room unlike any apartment."""
    poses = np.stack([camera_pose(np.array([-2.4, 0, z]), 0.0) for z in (1.4, 0.8)])
    before, after = world(two_rooms).renderer.panorama(poses, outputs=("color",))["color"]
    places = {"true": [0.6, 0.0, 0.0], "false": [-0.6, 0.0, 0.0]}
    model = wiw.world_model("pocket")
    made = {name: model.imagine_trajectory(before, np.array([place]), 0)[0] for name, place in places.items()}
    psnr = {name: wiw.metrics.psnr(frame, after, weights="latitude") for name, frame in made.items()}
    assert psnr["true"] > wiw.metrics.psnr(before, after, weights="latitude") + 1.5
    assert psnr["true"] > psnr["false"] + 3
    assert BUILT_IN.stat().st_size < 10 * 2**20


def test_its_card_has_the_recipe_and_what_it_is_worth() -> None:
    card = Pocket().card
    for kind in ("mixed", "straight"):
        psnr = card["held_out"][kind]["psnr"]
        assert set(psnr) == {"copy", "rolled", "one room", "pocket"}
        assert all(psnr["pocket"][step] > psnr["copy"][step] + 5 for step in ("1", "3", "5", "8"))
    gap = card["held_out"]["mixed"]["gap"]
    assert set(gap) == {"1", "3", "5", "8"} and np.mean(list(gap.values())) > 3
    assert card["val"].startswith("apartments:val") and card["data"]["part"] == "train"
    assert card["trained_steps"] == 8733 and card["recipe"]["epochs"] == 1


def test_the_readme_tells_the_gap_of_the_card() -> None:
    card = Pocket().card
    gap = [f"{value:.1f}" for value in card["held_out"]["mixed"]["gap"].values()]
    told = " ".join((BUILT_IN.parent / "README.md").read_text().split())
    assert f"they lose {gap[0]}, {gap[1]}, {gap[2]} and {gap[3]} dB after 1, 3, 5 and 8 primitives" in told
    assert f"`{card['val']}`" in told
