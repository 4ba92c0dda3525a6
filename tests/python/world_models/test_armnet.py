# SPDX-License-Identifier: Apache-2.0
"""armnet: what it knows of the arm against the renderer, its composition, its contract with the loop, and its file."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from locations import ROOT

import wiw
from wiw.errors import DependencyError, WeightsError
from wiw.physics import Sphere, place
from wiw.tabletop.base import make_action
from wiw.tabletop.workbench import TABLE, Thing, Workbench
from wiw.tasks.manipulation import TABLETOP_TASKS
from wiw.types import Conditioning, Control

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from safetensors import safe_open  # noqa: E402
from safetensors.torch import save as packed  # noqa: E402

from wiw.training.plays import EVENTS  # noqa: E402
from wiw.world_models.armnet.body import render_arm, render_bare_table  # noqa: E402
from wiw.world_models.armnet.model import BUILT_IN, SIZE, ArmNet  # noqa: E402
from wiw.world_models.armnet.motion import motion  # noqa: E402
from wiw.world_models.armnet.network import (  # noqa: E402
    FRONT,
    WINDOW,
    Arm,
    Mixture,
    Network,
    build_sources,
    carry_canvas,
    clear_arm,
    compose_view,
    compute_shading,
    find_unoccluded_arm,
)
from wiw.world_models.armnet.weights import load, save  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SMALL = (8, 8, 8)
PLAN = np.array(
    [make_action(0.15, -0.1, 0.2, 1.0), make_action(0.2, 0.1, 0.1, 0.0, 0.3), make_action(0.1, 0.15, 0.25, 0.0)]
)


def make_untrained(seed: int = 0) -> ArmNet:
    torch.manual_seed(seed)
    return ArmNet.of(Network(SMALL))


def control(poses: Any, length: int | None = None, shared: int = 0) -> Control:
    count = len(poses) - 1
    views = np.tile(np.eye(4), (count, 1, 1))
    actions = np.full(count, int(wiw.action.NULL), np.int8)
    return Control(actions, np.zeros((count, 3)), views, ids=poses, length=length or count, shared=shared)


def rollout(model: ArmNet, images: Any, controls: list[Control]) -> Any:
    return model.rollout(Conditioning(images), controls, np.zeros(len(controls), np.uint64))


def image(view: Any) -> Any:
    return torch.from_numpy(np.array(view)).permute(2, 0, 1)[None].float() / 255


def arm_of(sight: Any) -> Arm:
    return Arm(image(sight.color), torch.from_numpy(sight.arm.astype(np.float32))[None, None])


@pytest.fixture(scope="module")
def table() -> Workbench:
    """Cups, with the arm as it waits."""
    return TABLETOP_TASKS["stack_cups"].create_setup(4, 1).build_workbench()


# -- what is known of the arm ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spot", [(0.1, -0.2, 0.02), (0.3, 0.2, 0.1), (0.15, 0.0, 0.25)])
def test_finger_tips_are_where_a_marker_at_their_place_is_seen(spot: tuple[float, float, float]) -> None:
    x, y, height = spot
    at = (x, y, TABLE + height)
    marker = Thing("marker", ((Sphere(0.02), np.eye(4)),), (1.0, 0.0, 1.0), has_body=False)
    seen = Workbench([(marker, place(*at))]).render_view("front", FRONT, ("color", "depth"), arm=False)
    pink = (seen["color"].astype(int) @ [1, -2, 1]) > 150
    rows, columns = np.argwhere(pink).mean(axis=0) + 0.5 - (WINDOW[0].start, WINDOW[1].start)
    pose = np.array([[*at, np.pi, 0, 0, 1.0]])
    found = motion(pose, pose).after[0].numpy()
    assert np.abs(found[:2] - (columns, rows)).max() < 0.4
    assert abs(np.median(seen["depth"][pink]) + 0.015 - found[2]) < 0.01


def test_the_arm_is_drawn_as_it_is_seen_and_moves_nothing_else(table: Workbench) -> None:
    bench = table.fork()
    poses = np.stack([bench.pose, *PLAN])
    for pose, sight in zip(poses, render_arm(poses, FRONT), strict=True):
        bench.move_to(pose)
        seen = bench.render_view("front", FRONT, ("color",))["color"]
        np.testing.assert_allclose(sight.pose, bench.pose, atol=1e-3)
        assert sight.arm.mean() > 0.03
        off = np.abs(seen.astype(int) - sight.color).max(axis=-1)
        assert np.mean(off[sight.arm] < 8) > 0.9  # the rest: cups before it
    assert (
        render_bare_table(FRONT).color == render_bare_table(FRONT).color[:, ::-1]
    ).mean() > 0.6  # nobody stands before the table
    assert not render_bare_table(FRONT).arm.any()


def test_a_pose_that_cannot_be_reached_is_gone_to_as_far_as_the_arm_does() -> None:
    deep = np.array([*PLAN[0, :2], TABLE - 0.3, np.pi, 0, 0, 1.0 + 1e-9])
    _, after = render_arm(np.stack([PLAN[0], deep]), FRONT)
    assert after.pose[2] > TABLE - 0.01


def test_without_things_that_move_the_next_view_is_known(table: Workbench) -> None:
    """What is seen, with the arm's shadow taken away and the new one laid on, and the arm: within noise the truth."""
    bench = table.fork()
    here = bench.pose
    before = bench.render_view("front", FRONT)["color"]
    bench.move_to(PLAN[0])
    after = bench.render_view("front", FRONT)["color"]
    bare = image(render_bare_table(FRONT).color)
    old, new = (arm_of(sight) for sight in render_arm(np.stack([here, PLAN[0]]), FRONT))
    canvas = clear_arm(image(before), old, find_unoccluded_arm(image(before), old), bare, bare)
    still = torch.where(new.mask > 0.5, new.color, canvas * compute_shading(new.color, bare, new.mask))
    gap = (still - image(after)).abs().amax(1)
    copied = (image(before) - image(after)).abs().amax(1)
    assert (gap > 0.1).float().mean() < 0.1 * (copied > 0.1).float().mean()


def test_the_canvas_is_the_table_without_the_arm(table: Workbench) -> None:
    bench = table.fork()
    bench.move_to(PLAN[0])
    seen, clear = (image(bench.render_view("front", FRONT, arm=arm)["color"]) for arm in (True, False))
    *_, sight = render_arm(np.stack([PLAN[0]]), FRONT)
    bare = image(render_bare_table(FRONT).color)
    canvas = clear_arm(seen, arm_of(sight), find_unoccluded_arm(seen, arm_of(sight)), bare, bare)
    assert (canvas - clear).abs().mean() < 0.15 * (seen - clear).abs().mean()


# -- composition -------------------------------------------------------------------------------------------------------


def test_what_is_carried_goes_along_and_grows_as_it_comes_near() -> None:
    here, there = (np.array([[x, 0.0, TABLE + 0.1, np.pi, 0, 0, 0]]) for x in (0.1, 0.25))
    way = motion(here, there)
    canvas = torch.zeros(1, 1, 64, 120)
    x, y = way.before[0, :2].round().int().tolist()
    canvas[..., y - 3 : y + 3, x - 3 : x + 3] = 1
    moved = carry_canvas(canvas, way)[0, 0]
    rows, columns = torch.nonzero(moved > 0.5).float().mean(0) + 0.5
    assert abs(columns - way.after[0, 0]) < 1 and abs(rows - way.after[0, 1]) < 1
    assert moved.sum() > 1.1 * canvas.sum()
    still = motion(there, there)
    torch.testing.assert_close(carry_canvas(canvas, still), canvas, atol=1e-4, rtol=0)
    large = torch.nn.functional.interpolate(canvas, scale_factor=3)
    small = torch.nn.functional.avg_pool2d(carry_canvas(large, way, scale=3.0), 3)
    torch.testing.assert_close(small[0, 0], moved, atol=0.35, rtol=0)
    aside = carry_canvas(canvas, still, torch.full((1, 2, 64, 120), 2.0))
    torch.testing.assert_close(aside[..., :-2, :-2], canvas[..., 2:, 2:], atol=1e-4, rtol=0)


@pytest.mark.parametrize("part", range(4))
def test_each_part_of_a_mixture_is_what_it_says(part: int) -> None:
    torch.manual_seed(0)
    canvas, paint, color = (torch.rand(1, 3, 64, 120) for _ in range(3))
    bare = torch.full((1, 3, 64, 120), 0.6)
    arm = Arm(color, torch.zeros(1, 1, 64, 120))
    shares = torch.zeros(1, 4, 64, 120)
    shares[:, part] = 1
    way = motion(PLAN[:1], PLAN[1:2])
    mixture = Mixture(shares, paint, torch.zeros(1, 2, 64, 120))
    made = compose_view(shares, build_sources(mixture, canvas, arm, way, bare))
    dark = compute_shading(color, bare, arm.mask)
    expected = [canvas * dark, carry_canvas(canvas, way) * dark, color, paint][part].clamp(0, 1)
    torch.testing.assert_close(made, expected)


def test_a_network_shares_out_every_pixel() -> None:
    torch.manual_seed(0)
    network = Network(SMALL)
    canvas, color = torch.rand(2, 3, 64, 120), torch.rand(2, 3, 64, 120)
    mask = (torch.rand(2, 1, 64, 120) > 0.5).float()
    found = network(canvas, Arm(color, mask), mask, motion(PLAN[:2], PLAN[1:]), torch.rand(1, 3, 64, 120))
    torch.testing.assert_close(found.shares.sum(1), torch.ones(2, 64, 120))
    assert (found.shares[:, 2:3][mask > 0.5] > 0.6).all() and (found.shares[:, :1][mask < 0.5] > 0.6).all()
    assert found.flow.abs().max() < 2


# -- in the loop -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def front(table: Workbench) -> Any:
    return table.render_view("front", SIZE)["color"]


def test_rows_do_not_depend_on_each_other(table: Workbench, front: Any) -> None:
    model, here = make_untrained(), table.pose
    plans = [np.stack([here, *PLAN]), np.stack([here, *PLAN[::-1]])]
    controls = [control(plans[0]), control(plans[1]), control(plans[0], length=2, shared=1)]
    together = rollout(model, np.stack([front] * 3), controls)
    assert together.shape == (3, 4, *SIZE, 3) and together.dtype == np.uint8
    np.testing.assert_array_equal(together[0, 0], front)
    np.testing.assert_array_equal(rollout(model, front[None], controls[1:2])[0], together[1])
    np.testing.assert_array_equal(together[2, 2], together[0, 2])
    assert np.abs(together[0, 1].astype(int) - together[1, 1]).mean() > 0.5


def test_it_says_what_it_is(tmp_path: Path, table: Workbench, front: Any) -> None:
    one, other = make_untrained(0), make_untrained(1)
    assert one.fingerprint() == make_untrained(0).fingerprint() != other.fingerprint()
    assert (one.accepts.space, one.accepts.view, one.accepts.frames) == ("pose7", "perspective", 0)
    assert one.accepts.causal and not one.accepts.needs and json.dumps(one.describe())
    save(tmp_path / "w.safetensors", one._network, {})
    again = ArmNet(tmp_path / "w.safetensors")
    copied = pickle.loads(pickle.dumps(again))
    plan = [control(np.stack([table.pose, PLAN[0]]))]
    np.testing.assert_array_equal(rollout(copied, front[None], plan), rollout(again, front[None], plan))


# -- the file ----------------------------------------------------------------------------------------------------------


def test_a_saved_network_is_loaded_again(tmp_path: Path) -> None:
    file, network = tmp_path / "w.safetensors", Network((4, 8, 12))
    save(file, network, {"psnr": 3.5})
    loaded, card = load(file)
    assert (loaded.widths, card) == ((4, 8, 12), {"psnr": 3.5})
    for name, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value.half().float())
    content = file.read_bytes()
    (tmp_path / "warpnet").write_bytes(content.replace(b"wiw-armnet-1", b"wiw-warpne-1"))
    with pytest.raises(WeightsError, match="wiw-armnet-1") as error:
        ArmNet(tmp_path / "warpnet")
    assert error.value.kind == "unfit"
    with pytest.raises(WeightsError, match="wiw train armnet"):
        ArmNet(tmp_path / "none")


def test_damaged_weights_are_told(tmp_path: Path) -> None:
    file, network = tmp_path / "w.safetensors", Network((4, 8, 12))
    save(file, network, {})
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(WeightsError, match="differ from what was written: it is damaged") as error:
        load(file)
    assert error.value.kind == "unfit"
    network.last.weight.data[0, 0, 0, 0] = float("nan")
    save(file, network, {})
    with pytest.raises(WeightsError, match="are not finite") as error:
        load(file)
    assert error.value.kind == "unfit"
    save(file, Network((4, 8, 12)), {})
    with safe_open(file, "pt") as held:
        values, metadata = {name: held.get_tensor(name) for name in held.keys()}, held.metadata()  # noqa: SIM118
    del metadata["digest"]
    file.write_bytes(packed(values, metadata))
    assert load(file)[0].widths == (4, 8, 12), "as files were before they had one"


def test_without_torch_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wiw.world_models.base.importlib.util.find_spec", lambda name: None)
    with pytest.raises(DependencyError, match=r"pip install 'wiw\[torch\]'"):
        wiw.world_model("armnet")


def test_torch_is_not_loaded_before_it_is_needed() -> None:
    code = "import sys, wiw.world_models.armnet.model; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


# -- as it comes with wiw ----------------------------------------------------------------------------------------------


def test_the_weights_that_come_with_it_know_what_is_carried() -> None:
    """A cup that is taken by its wall and lifted: nearer to the truth than one who leaves it on the table."""
    setup = TABLETOP_TASKS["stack_cups"].create_setup(11, 1)
    bench = setup.build_workbench()
    plan = TABLETOP_TASKS["stack_cups"].plan_expert(bench.get_poses(setup.objects), setup.target)[:3]
    ids = np.concatenate([bench.pose[None], plan])
    seen = bench.render_view("front", SIZE)["color"]
    made = rollout(wiw.world_model("armnet"), seen[None], [control(ids)])[0, -1]
    truth = bench.render_fronts_after(plan, SIZE)[-1]
    bare = image(render_bare_table(SIZE).color)
    first, *_, last = (arm_of(sight) for sight in render_arm(ids, SIZE))
    canvas = clear_arm(image(seen), first, find_unoccluded_arm(image(seen), first), bare, bare)
    still = torch.where(last.mask > 0.5, last.color, canvas * compute_shading(last.color, bare, last.mask))
    changed = (still - image(truth)).abs().amax(1) > 0.06
    wrong, alone = ((view - image(truth)).abs().mean(1)[changed].mean() for view in (image(made), still))
    assert wrong < 0.9 * alone
    assert BUILT_IN.stat().st_size < 3 * 2**20


def test_its_card_has_the_recipe_and_what_it_is_worth() -> None:
    card = wiw.world_model("armnet").card
    changed, psnr = card["held_out"]["changed"], card["held_out"]["psnr"]
    assert set(changed) == set(psnr) == {"copy", "arm", "armnet"}
    assert all(changed["armnet"][k] < 0.7 * changed["arm"][k] and psnr["armnet"][k] > psnr["arm"][k] for k in "1235")
    assert card["plays"] > 0 and card["recipe"]["epochs"] >= 1


def test_the_readme_tells_the_figures_of_the_weights() -> None:
    held_out = ArmNet().card["held_out"]
    lines = (BUILT_IN.parent / "README.md").read_text().splitlines()
    for name, row in (("copy", "`copy`"), ("arm", "the arm alone"), ("armnet", "`armnet`")):
        told = next(line for line in lines if line.startswith(f"| {row}") and "/" in line).split("|")[2:-1]
        made = [f"{held_out['changed'][name][k]:.1f} / {held_out['psnr'][name][k]:.1f}" for k in ("1", "2", "3", "5")]
        assert [each.strip() for each in told] == made
    assert any(f"{held_out['plays']} plays at tables that it never saw" in line for line in lines)


def test_the_results_tell_its_figures_by_event() -> None:
    events = ArmNet().card["held_out"]["events"]
    lines = (ROOT / "docs" / "results.md").read_text().splitlines()
    rows = (
        "stays where it is",
        "lights up lime: the first push",
        "lights up amber: the second",
        "lights up red: the third, or later",
        "is carried",
        "is let go",
        "is pushed",
    )
    for event, row in zip(EVENTS, rows, strict=True):
        one_pose, free_running = (events[mode][event] for mode in ("one_pose", "free_running"))
        made = [str(one_pose["count"])]
        for figures in (one_pose, free_running):
            right = f" / {100 * figures['right']:.0f} %" if "right" in figures else ""
            made += [f"{figures['arm']:.1f}", f"{figures['armnet']:.1f} / {figures['sharpness']:.2f}{right}"]
        told = next(line for line in lines if line.startswith(f"| {row} |")).split("|")[2:-1]
        assert [each.strip() for each in told] == made
