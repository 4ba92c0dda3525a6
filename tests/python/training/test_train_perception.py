# SPDX-License-Identifier: Apache-2.0
"""The labeller's training: on made-up views whose truth is known, on views of an apartment, and by the command."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from wiw.cli.app import main
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError
from wiw.perception.colors import COLORS, ColorNamer
from wiw.perception.scene_labels import CATEGORIES, STATES

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.perception import labelling_network  # noqa: E402
from wiw.perception.labelling_network import CHANNELS, COLOR_CHANNELS, FOCAL, PIXELS, InputSize  # noqa: E402
from wiw.perception.learned_labeller import LearnedLabeller  # noqa: E402
from wiw.scenes import possible_edits  # noqa: E402
from wiw.training import color_naming  # noqa: E402
from wiw.training.checkpoint import Checkpoint  # noqa: E402
from wiw.training.labelled_views import (  # noqa: E402
    CANDIDATES,
    CLOSE,
    COLOR_SAMPLES,
    FIELDS,
    SIZE,
    LabelledViews,
    ViewRules,
    _choose_close_places,
    change_states,
    merge_views,
    read_instances,
    record_views,
)
from wiw.training.perception import Recipe, evaluate, find_possible_states, train  # noqa: E402
from wiw.training.view_batches import (  # noqa: E402
    Batch,
    ViewTensors,
    _blur,
    compose_input,
    compute_sampling_weights,
    compute_tangents,
    count_pairs,
    degrade_views,
    sample_batch,
)

pytestmark = pytest.mark.usefixtures("one_torch_thread")

CELLS, FIELD = (32, 48), float(np.degrees(2 * np.arctan(24 / FOCAL)))
"""Views of so many cells, which the network takes as they are."""
WALL, FLOOR, LAMP = (CATEGORIES.index(name) for name in ("wall", "floor", "table lamp"))
ON, OFF = STATES.index("on"), STATES.index("off")
SMALL = (8, 8, 12, 16)


def made_up(count: int, seed: int) -> LabelledViews:
    """Grey walls over grey floors, in which nothing but the height tells them apart, and a lamp that is on or off."""
    rng = np.random.default_rng(seed)
    images = rng.normal(120, 6, (count, PIXELS * CELLS[0], PIXELS * CELLS[1], 3))
    category = np.full((count, *CELLS), WALL, np.uint8)
    category[:, category.shape[1] // 2 :] = FLOOR
    state = np.zeros_like(category)
    pixels, color = [], []
    for view in range(count):
        top, left = 4 * rng.integers(1, 10), 4 * rng.integers(1, 18)
        lit = bool(rng.integers(2))
        shade = np.array([230, 60, 60]) if rng.integers(2) else np.array([60, 60, 230])
        images[view, top : top + 20, left : left + 20] = shade * (1.0 if lit else 0.5)
        place = (view, slice(top // 2, top // 2 + 10), slice(left // 2, left // 2 + 10))
        category[place], state[place] = LAMP, ON if lit else OFF
        pixels.append(np.clip(shade * rng.uniform(0.4, 1.0, (COLOR_SAMPLES, 1)), 0, 255))
        color.append(COLORS.index("red" if shade[0] > 100 else "blue"))
    return LabelledViews(
        np.clip(images, 0, 255).astype(np.uint8),
        np.where(category == LAMP, 1.5, 3.0).astype(np.float16),
        category,
        state,
        np.full(count, FIELD, np.float32),
        np.array(pixels).astype(np.uint8),
        np.array(color, np.uint8),
        np.full(count, LAMP, np.uint8),
    )


def tensors(count: int, seed: int) -> ViewTensors:
    return ViewTensors.of(made_up(count, seed), "cpu")


@pytest.fixture(scope="module")
def lesson() -> Any:
    views = made_up(96, 0)
    network, recipe = train(ViewTensors.of(views, "cpu"), Recipe(epochs=10, widths=SMALL, bfloat16=False, imagined=0.3))
    assert recipe.epochs == 10
    return network, find_possible_states(views)


def test_a_short_training_is_worth_something(lesson: Any) -> None:
    network, states = lesson
    assert states == {"table lamp": ["on", "off"]}
    found = evaluate(network, states, made_up(12, 1), 0)
    plain = found["plain"]
    assert set(plain["iou"]) == {"wall", "floor", "table lamp"} and found["views"] == 12
    assert plain["pixel_accuracy"] > 0.9 and plain["iou"]["table lamp"] > 0.6
    assert plain["iou"]["floor"] > 0.8  # told from the wall by the direction alone
    assert plain["state_accuracy"] > 0.8 and set(plain["states"]["table lamp"]) == {"on", "off"}
    assert 0.6 < found["degraded"]["pixel_accuracy"] <= plain["pixel_accuracy"]


def test_wrong_labels_are_measured_as_wrong(lesson: Any) -> None:
    network, states = lesson
    views = made_up(6, 1)
    swapped = views.category.copy()
    swapped[views.category == WALL], swapped[views.category == FLOOR] = FLOOR, WALL
    found = evaluate(network, states, replace(views, category=swapped, state=views.state), 0)["plain"]
    assert found["iou"]["wall"] < 0.1 and found["iou"]["floor"] < 0.1
    flipped = np.where(views.state == ON, OFF, np.where(views.state == OFF, ON, 0)).astype(np.uint8)
    assert evaluate(network, states, replace(views, state=flipped), 0)["plain"]["state_accuracy"] < 0.2


class InterruptionError(Exception):
    pass


def test_an_interrupted_training_ends_with_the_same_weights(tmp_path: Path) -> None:
    views, recipe = tensors(16, 0), Recipe(epochs=2, widths=SMALL, bfloat16=False)
    whole, _ = train(views, recipe)

    def stop(step: int, steps: int, loss: float) -> None:
        if step == 5:
            raise InterruptionError

    def checkpoint() -> Checkpoint:
        return Checkpoint(tmp_path / "checkpoint", {"of": "these"}, seconds=0)

    with pytest.raises(InterruptionError):
        train(views, recipe, None, stop, checkpoint())
    steps: list[int] = []
    resumed, _ = train(views, recipe, None, lambda step, *_: steps.append(step), checkpoint())
    assert steps == [5, 6, 7, 8]
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_degraded_views_keep_their_labels() -> None:
    rng, random = np.random.default_rng(0), torch.Generator().manual_seed(0)
    blocks = torch.from_numpy(rng.integers(0, 2, (20, 8, 12)).astype(np.uint8))
    labels = blocks.repeat_interleave(4, dim=1).repeat_interleave(4, dim=2)[..., None].expand(-1, -1, -1, 2)
    images = 200.0 * blocks.repeat_interleave(8, dim=1).repeat_interleave(8, dim=2)[:, None].expand(-1, 3, -1, -1)
    shown, found = degrade_views(images, labels, rng, random)
    assert shown.shape == images.shape and found.shape == labels.shape and found.dtype == torch.uint8
    moved = (found != labels).float().mean(dim=(1, 2, 3))
    agree = ((shown[:, :, 1::2, 1::2].mean(dim=1) > 100) == found[..., 0]).float().mean(dim=(1, 2))
    assert moved.max() > 0.05 and agree.mean() > 0.9
    assert agree.mean() > 1 - moved.mean()  # labels move with what they label


def test_degraded_views_are_a_function_of_both_sources_of_chance() -> None:
    images, labels = torch.full((4, 3, 64, 96), 90.0), torch.zeros((4, 32, 48, 2), dtype=torch.uint8)

    def degrade(seed: int, pixels: int) -> Any:
        random = torch.Generator().manual_seed(pixels)
        return degrade_views(images.clone(), labels, np.random.default_rng(seed), random)[0]

    assert torch.equal(degrade(0, 0), degrade(0, 0))
    assert not torch.equal(degrade(0, 0), degrade(0, 1)) and not torch.equal(degrade(0, 0), degrade(1, 0))


def test_blurs_are_those_of_opencv() -> None:
    images = np.random.default_rng(0).uniform(0, 255, (3, 40, 60, 3)).astype(np.float32)
    deviations = np.array([0.5, 1.4, 3.2])
    blurred = _blur(torch.from_numpy(images).permute(0, 3, 1, 2), deviations).permute(0, 2, 3, 1).numpy()
    for image, deviation, found in zip(images, deviations, blurred, strict=True):
        expected = cv2.GaussianBlur(image, (21, 21), deviation, borderType=cv2.BORDER_REFLECT_101)
        np.testing.assert_allclose(found, expected, atol=0.02)


def test_inputs_are_those_of_the_labeller() -> None:
    """Tensors of the training and arrays of the labeller give the network the same views."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (3, PIXELS * CELLS[0], PIXELS * CELLS[1], 3)).astype(np.uint8)
    depth = np.where(rng.random((3, *CELLS)) < 0.3, 0, rng.uniform(0.3, 9, (3, *CELLS))).astype(np.float32)
    hfov_deg = np.float32([90.0, 98.5, 110.0])
    focal = SIZE[1] / (2 * np.tan(np.radians(hfov_deg.astype(np.float64)) / 2))
    directions = [labelling_network.compute_tangents(SIZE, InputSize(*CELLS, float(each))) for each in focal]
    expected = labelling_network.to_network_input(images, np.stack(directions), depth)
    tangents = compute_tangents(torch.from_numpy(hfov_deg), CELLS)
    found = compose_input(torch.from_numpy(images).permute(0, 3, 1, 2).float(), tangents, torch.from_numpy(depth))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_frequencies_are_counted() -> None:
    views = made_up(5, 0)
    pairs = count_pairs(torch.from_numpy(views.category), torch.from_numpy(views.state), len(STATES))
    assert pairs.sum() == views.category.size and pairs[LAMP, ON] == (views.state == ON).sum()
    assert pairs[WALL, 0] == (views.category == WALL).sum()
    category = views.category.copy()
    category[1] = WALL
    shares = compute_sampling_weights(torch.from_numpy(category))
    assert shares.sum() == pytest.approx(1) and shares[0] / shares[1] == pytest.approx(3)


def sample(views: ViewTensors, count: int, imagined: float, coarse: bool = False) -> Batch:
    weights = compute_sampling_weights(views.category)
    return sample_batch(views, count, imagined, weights, np.random.default_rng(0), coarse=coarse)


@pytest.mark.parametrize("coarse", [False, True])
def test_batches_are_aligned(coarse: bool) -> None:
    batch = sample(tensors(8, 0), 3, 0.0, coarse)
    cells = (16, 32) if coarse else CELLS
    assert batch.shown.shape == (6 if coarse else 3, CHANNELS, *cells)
    assert batch.category.shape == (len(batch.shown), *cells) == batch.state.shape
    colors, rest = batch.shown[:, :COLOR_CHANNELS], batch.shown[:, COLOR_CHANNELS:]
    lamp = batch.category.numpy() == LAMP
    for pixel in range(PIXELS**2):
        colored = np.ptp(colors[:, 3 * pixel : 3 * pixel + 3].numpy(), axis=1) > 0.3
        assert (colored == lamp).mean() > 0.96
    assert ((rest[:, 2].exp().numpy() < 2) == lamp).mean() > 0.96 and (rest[:, 4] == 1).all()
    assert torch.allclose(rest[:, 3], rest[:, 2].exp() * rest[:, 1], atol=0.01)
    assert ((batch.state.numpy() > 0) == lamp).all()
    assert (rest[:, 1, 0] > 0).all() and (rest[:, 1, -1] < 0).all()  # up and down


def test_views_like_imagined_ones_have_no_depth() -> None:
    batch = sample(tensors(8, 0), 8, 1.0)
    assert (batch.shown[:, COLOR_CHANNELS + 2 :] == 0).all()


def test_views_that_are_taken_are_copies() -> None:
    views, before = tensors(4, 0), tensors(4, 0)
    taken = views.take(np.array([2, 2, 0]), "cpu")
    for name in ("images", "depth", "category", "state", "hfov_deg"):
        assert torch.equal(getattr(taken, name), getattr(before, name)[[2, 2, 0]])
        getattr(taken, name).zero_()
        assert torch.equal(getattr(views, name), getattr(before, name))


def test_views_stay_in_main_memory_where_a_gpu_has_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    views, asked = made_up(2, 0), []
    size = ViewTensors.of(views, "cpu").count_bytes()
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: asked.append(device) or (2 * size - 1, 0))
    assert ViewTensors.of(views, "cuda:1").images.device.type == "cpu" and asked == ["cuda:1"]


def test_apartments_are_recorded_in_other_states_too() -> None:
    changed = change_states("apartments:train/3", 0)
    assert changed is not None and changed == change_states("apartments:train/3", 0)
    edits = changed.partition("?")[2].split("&")
    assert len(edits) > 3 and set(edits) <= set(possible_edits("apartments:train/3"))
    assert all(edit.startswith("state:") for edit in edits)
    assert len({edit.partition("=")[0] for edit in edits}) == len(edits)  # each thing in one state
    assert change_states("apartments:train/3", 1) != changed
    assert change_states("house.glb", 0) is None


def test_changed_states_can_all_be_had_together() -> None:
    """In apartment 179 the doors of two washing machines open into the same space."""
    changed = change_states("apartments:train/179", 0)
    assert changed is not None and possible_edits(changed)
    edits = changed.partition("?")[2].split("&")
    assert "state:washing_machine_1=open" in edits and "state:washing_machine_2=open" not in edits
    with pytest.raises(ArgumentError, match="its door would hit 'washing machine 1'"):
        possible_edits(f"{changed}&state:washing_machine_2=open")


def test_recipes_are_checked() -> None:
    with pytest.raises(ArgumentError, match="Recipe: epochs must be positive, got 0"):
        Recipe(epochs=0)
    with pytest.raises(ArgumentError, match=r"Recipe: widths must be positive, got \(8, 0\)"):
        Recipe(widths=(8, 0))
    for rate in (0.0, float("nan")):
        with pytest.raises(ArgumentError, match="expected a finite learning rate above 0"):
            Recipe(rate=rate)
    with pytest.raises(ArgumentError, match="with walkable floor"):
        merge_views([])


# -- colours -----------------------------------------------------------------------------------------------------------


def test_colors_are_calibrated() -> None:
    namer = color_naming.calibrate(made_up(60, 0), 0, steps=150)
    found = color_naming.evaluate(namer, made_up(40, 1))
    assert found["things"] == 40 and found["accuracy"] > 0.9 and found["structure"] is None
    assert set(found["by_color"]) == {"red", "blue"} and found["by_category"] == {"table lamp": found["accuracy"]}
    views = made_up(4, 2)
    nothing = replace(views, pixels=views.pixels[:0], color=views.color[:0], colored_category=views.color[:0])
    assert color_naming.evaluate(namer, nothing)["accuracy"] is None
    with pytest.raises(ArgumentError, match="objects of known colours"):
        color_naming.calibrate(nothing, 0)


# -- data --------------------------------------------------------------------------------------------------------------


def test_instances_become_labels() -> None:
    def instance(number: int, category: str, **attributes: str) -> dict[str, Any]:
        return {"id": number, "category": category, "attributes": attributes}

    table = read_instances(
        [
            instance(1, "door frame", color="white", state="fixed"),
            instance(2, "curtain", color="green", state="half drawn"),
            instance(3, "dragon", color="green", state="on"),
            instance(4, "television", color="no color", state="on"),
        ]
    )
    assert [CATEGORIES[i] for i in table.category] == ["", "opening", "curtain", "", "television"]
    assert [STATES[i] for i in table.state] == ["", "", "closed", "on", "on"]
    assert [COLORS[i] if i >= 0 else "" for i in table.color] == ["", "", "green", "", ""]


def test_half_of_the_places_are_close_to_things_whose_categories_take_turns() -> None:
    place = world("apartments:train/0")
    candidates = place.navmesh.sample(CANDIDATES, 5)
    things = [each for each in place.scene.instances if each["category"] in ("chair", "cup", "bottle")]
    rows = _choose_close_places(candidates, [*things, *place.scene.instances[:1]], 40, 3)
    assert len(rows) == 40 and (rows == _choose_close_places(candidates, things, 40, 3)).all()
    near = dict.fromkeys(("chair", "cup", "bottle"), 0)
    for point in candidates[rows]:
        found = set()
        for each in things:
            across, _, along = np.mean(each["bounds"], axis=0) - point
            if CLOSE[0] - 1e-4 <= np.hypot(across, along) <= CLOSE[1] + 1e-4:
                found.add(each["category"])
        assert found
        for name in found:
            near[name] += 1
    assert min(near.values()) >= 40 // len({each["category"] for each in things})
    assert len(record_views(place, 0, ViewRules(places=3, close=0.0, views=2))) == 6
    assert not len(_choose_close_places(candidates, [], 40, 3))


def test_recorded_views_show_what_their_labels_say() -> None:
    place, rules = world("apartments:train/0"), ViewRules(places=2, views=2, fields=(105.0, 105.0))
    views = record_views(place, 3, rules)
    again = record_views(place, 3, rules)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(views, name), getattr(again, name))
    assert len(views) == 4 and views.images.shape[1:] == (352, 416, 3) and views.category.shape[1:] == (176, 208)
    names = {CATEGORIES[i] for i in np.unique(views.category)}
    assert {"wall", "floor"} <= names
    middle = views.category[:, :, 104]
    assert (middle[:, 0] != FLOOR).all() and (middle[:, -1] != CATEGORIES.index("ceiling")).all()
    assert views.pixels.shape[1:] == (COLOR_SAMPLES, 3) and len(views.pixels) == len(views.color) > 4

    from wiw._core import core

    key = core.fold_key([3, 0x4C20, 0])
    point = place.ground.put_down(place.navmesh.sample(2, key)).astype(np.float64)[0]
    turn = core.uniform(core.fold_key([key, 1]), 4)[0]
    pose = camera_pose(point, float(2 * np.pi * turn))
    direct = place.renderer.perspective(pose[None], (352, 416), 105.0, outputs=("instance",))["instance"][0]
    table = read_instances(place.scene.instances)
    expected = table.category[direct[1::2, 1::2]]
    assert (expected == views.category[0]).mean() > 0.93  # edges differ by a pixel


def test_the_command_trains_on_apartments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wiw.training.perception.Recipe", partial(Recipe, widths=(16, 24, 32, 48), rate=5e-3))
    monkeypatch.setattr("wiw.training.color_naming.calibrate", partial(color_naming.calibrate, steps=300))
    others = {"apartments:train/0": "apartments:val/1", "apartments:val/0": "apartments:val/3"}
    monkeypatch.setattr("wiw.training.gather.change_states", lambda scene, seed: others[scene])  # need no new light
    out, cache = tmp_path / "weights.safetensors", tmp_path / "looks"
    command = ["train", "perception", "--scenes", "apartments:train:1", "--val", "apartments:val:1", "--places", "2"]
    assert main([*command, "--out", str(out), "--cache", str(cache), "--workers", "1", "--epochs", "4"]) == 0
    printed = capsys.readouterr().out
    assert "pixel accuracy" in printed and "colours of things" in printed and "IoU by category: wall" in printed
    card = LearnedLabeller(out).card
    assert card["scenes"] == "apartments:train:1" and card["views"] == 12 and card["held_out"]["views"] == 12
    assert card["held_out"]["plain"]["pixel_accuracy"] > 0.2 and card["held_out"]["colors"]["accuracy"] > 0.2
    assert out.stat().st_size < 4 * 2**20
    ColorNamer.load(tmp_path / "weights.colors.json")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["looks", "weights.colors.json", "weights.safetensors"]
    assert len(list(cache.iterdir())) == 4
