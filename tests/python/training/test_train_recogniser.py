# SPDX-License-Identifier: Apache-2.0
"""The recogniser's training: on made-up looks whose truth is known, and on two apartments from the command line."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw.cli.app import main
from wiw.datasets.ar import EpisodeRules
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError
from wiw.perception.glimpses import SIDE, Glimpses
from wiw.training.glimpse_sets import (
    NEAR,
    PERFECT,
    START,
    WARPED,
    GlimpseSetRules,
    GlimpseSets,
    _stretch,
    collect_hard_sets,
    join_glimpse_sets,
    merge_glimpse_sets,
    reshape_furniture,
    split_in_half,
)

pytestmark = pytest.mark.usefixtures("one_torch_thread")

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

NAMES = ("bars", "dots", "plain")
KINDS = (START, PERFECT, PERFECT, PERFECT, WARPED, WARPED, WARPED)


def draw_texture(label: int, rng: Any, hidden: bool, wrong: bool) -> Any:
    """A view [64, 64, 3] of a texture; hidden: as good as nothing is seen of it; wrong: all red, of another texture."""
    shown = (label + 1 + rng.integers(2)) % 3 if wrong else label
    rows, columns = np.indices((SIDE, SIDE)) // 4
    pattern = ((columns % 2), ((rows % 2) * (columns % 2)), np.zeros_like(rows))[shown]
    contrast = 0 if hidden and not wrong else 60
    grey = 110 + contrast * pattern[..., None] + rng.normal(0, 12, (SIDE, SIDE, 3)) + rng.uniform(-20, 20)
    return np.clip(grey * ([1.6, 0.3, 0.3] if wrong else [1, 1, 1]), 0, 255).astype(np.uint8)


def made_up(sets: int, seed: int) -> GlimpseSets:
    """Looks of which 60 % show nothing; of the warped ones every other is red, which no other is, and misleads."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, sets)
    images = np.array(
        [
            [draw_texture(label, rng, rng.random() < 0.6, kind == WARPED and rng.random() < 0.5)] * 2
            for label in labels
            for kind in KINDS
        ]
    )
    count = sets * len(KINDS)
    boxes = np.tile(np.array([0.2, 0.2, 0.8, 0.8], np.float32), (count, 2, 1))
    kinds = np.tile(KINDS, sets)
    scalars = np.column_stack([np.zeros((count, 4)), kinds == START, np.zeros((count, 4))]).astype(np.float32)
    return GlimpseSets(Glimpses(images, boxes, scalars), np.repeat(np.arange(sets), len(KINDS)), kinds, labels)


@pytest.fixture(scope="module")
def lesson() -> Any:
    from wiw.training.recogniser import Recipe, calibrate, train

    recipe = Recipe(
        epochs=7, batch=24, width=8, seed=3, recolor=0, transplant=0, degrade=0, swap=0
    )  # here colour tells what misleads
    network, used = train(made_up(240, 0), NAMES, recipe)
    assert used == recipe
    calibration, held_out = split_in_half(made_up(500, 1))
    return calibrate(network, NAMES, calibration, held_out, {"sets": 240}), held_out


def test_views_together_tell_more_than_one(lesson: Any) -> None:
    accuracy = lesson[0].card["accuracy"]
    # 40 % of looks tell; the rest is a guess of three: 60 % at most with one, 1 - 0.6^4 * 2/3 = 91 % with four
    assert 0.45 < accuracy["start"] < 0.72
    assert accuracy["start"] + 0.08 < accuracy["start + 1 perfect"] < accuracy["start + 3 perfect"]
    assert accuracy["start + 3 perfect"] > 0.82


def test_views_that_mislead_are_not_trusted(lesson: Any) -> None:
    accuracy = lesson[0].card["accuracy"]
    assert accuracy["start + 3 warped"] > accuracy["start"] + 0.06  # half of them help
    looks = lesson[1].glimpses
    red = looks.images[..., 0].mean(axis=(1, 2, 3)) > 1.5 * looks.images[..., 1].mean(axis=(1, 2, 3))
    from wiw.perception.recognition_network import to_network_input

    with torch.inference_mode():
        shown = to_network_input(torch.from_numpy(looks.images), torch.from_numpy(looks.boxes))
        weights = lesson[0].network.encode_glimpses(shown, torch.from_numpy(looks.scalars))[1].numpy()
    blocks = looks.images[:, 0, ..., 1].reshape(-1, SIDE // 4, 4, SIDE // 4, 4).mean(axis=(2, 4))
    telling = ~red & (blocks.std(axis=(1, 2)) > 15)
    assert weights[red].mean() < 0.7 * weights[telling].mean()


def test_calibration_lowers_the_error_of_confidence(lesson: Any) -> None:
    from wiw.training.recogniser import calibrate

    recogniser, held_out = lesson
    assert recogniser.card["calibration_error"]["after"] < 0.08
    rng = np.random.default_rng(9)  # where every fourth thing is another than it seems, the network is too sure
    odd = rng.random(len(held_out)) < 0.25
    strange = replace(held_out, labels=np.where(odd, (held_out.labels + 1) % 3, held_out.labels))
    modest = calibrate(recogniser.network, NAMES, *split_in_half(strange), {})
    assert modest.temperature > 1.3 * recogniser.temperature
    assert modest.card["calibration_error"]["after"] < 0.7 * modest.card["calibration_error"]["before"]


def test_the_same_lesson_gives_the_same_network_stopped_or_not(tmp_path: Path) -> None:
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.recogniser import Recipe, train

    looks = made_up(40, 5)
    once, again, other = (
        train(looks, NAMES, Recipe(epochs=2, batch=10, width=4, seed=seed))[0].state_dict() for seed in (1, 1, 2)
    )
    assert all(torch.equal(once[name], again[name]) for name in once)
    assert not torch.equal(once["logits.weight"], other["logits.weight"])
    checkpoint = Checkpoint(tmp_path / "kept", {}, seconds=0)

    def cut(step: int, steps: int, loss: float) -> None:
        if step == 4:
            raise KeyboardInterrupt

    recipe = Recipe(epochs=2, batch=10, width=4, seed=1)
    with pytest.raises(KeyboardInterrupt):
        train(looks, NAMES, recipe, on_step=cut, checkpoint=checkpoint)
    assert checkpoint.load().step == 3
    resumed = train(looks, NAMES, recipe, checkpoint=checkpoint)[0].state_dict()
    assert all(torch.equal(once[name], resumed[name]) for name in once)
    hurried = train(looks, NAMES, Recipe(epochs=500, batch=10, width=4, seed=1), minutes=0.5 / 60)[1]
    assert 1 <= hurried.epochs < 500
    with pytest.raises(ArgumentError, match="epochs"):
        Recipe(epochs=0)


def test_looks_are_counted_through(lesson: Any) -> None:
    from wiw.training.recogniser import select_rows

    looks = merge_glimpse_sets([made_up(2, 0), made_up(1, 1)])
    assert looks.owners.tolist() == [0] * 7 + [1] * 7 + [2] * 7
    assert select_rows(looks, WARPED, 2).tolist() == [0, 4, 5, 7, 11, 12, 14, 18, 19]
    assert select_rows(looks, START, 0).tolist() == [0, 7, 14]
    first, second = split_in_half(looks)
    assert (len(first), len(second), second.owners.tolist()) == (1, 2, [0] * 7 + [1] * 7)
    np.testing.assert_array_equal(second.glimpses.boxes, looks.glimpses.boxes[7:])
    with pytest.raises(ArgumentError, match="none"):
        merge_glimpse_sets([])
    with pytest.raises(ArgumentError, match="two glimpse sets"):
        split_in_half(first)


def test_training_goes_on_from_a_network() -> None:
    from wiw.training.recogniser import Recipe, train

    looks, recipe = made_up(40, 5), Recipe(epochs=1, batch=10, width=4, rate=0.0)
    first = train(looks, NAMES, recipe)[0]
    again = train(looks, NAMES, replace(recipe, seed=1), start=first)[0]
    assert torch.equal(first.logits.weight, again.logits.weight)
    assert not torch.equal(first.logits.weight, train(looks, NAMES, replace(recipe, seed=1))[0].logits.weight)
    with pytest.raises(ArgumentError, match="expected a start of 3 categories, width 8 and extents True, got 3, 4 and"):
        train(looks, NAMES, replace(recipe, width=8), start=first)
    with pytest.raises(ArgumentError, match="3 categories, width 4 and extents False, got 3, 4 and True"):
        train(looks, NAMES, replace(recipe, extents=False), start=first)


def test_sizes_are_those_of_things_on_the_floor() -> None:
    from wiw.perception.recognition_network import estimate_sizes

    distance, width, height = np.array([1.2, 3.0, 5.0]), np.array([0.5, 2.0, 1.2]), np.array([0.4, 0.9, 2.1])
    angles = [2 * np.arctan(width / 2 / distance), np.zeros(3), np.arctan((height - 1) / distance)]
    scalars = np.column_stack([*angles, -np.arctan(1 / distance), np.ones(3), np.zeros((3, 4))]).astype(np.float32)
    expected = np.column_stack([np.log(distance), np.log(width), height])
    np.testing.assert_allclose(estimate_sizes(torch.from_numpy(scalars)).numpy(), expected, rtol=1e-4, atol=1e-4)
    above = torch.tensor([[0.2, 0.2, 0.3, 0.1, 1.0], [0.0, 0.0, 1.5, -1.57, 0.0]])  # no floor below; right below
    above = torch.nn.functional.pad(above, (0, 4))
    assert estimate_sizes(above).isfinite().all()


def test_extents_vary_by_set_and_are_sometimes_unknown() -> None:
    from wiw.training.recogniser import Recipe, _augment

    looks = made_up(60, 3)
    looks.glimpses.scalars[looks.kinds == START, 5:] = [1.0, 0.5, 0.2, 0.9]
    rows, recipe = np.flatnonzero(looks.kinds == START), Recipe(resize=1.25, unmeasured=0.5)
    again = np.repeat(rows, 2), np.repeat(np.arange(60), 2)
    found = _augment(looks, *again, recipe, np.random.default_rng(0))[1].numpy()[:, 5:].reshape(60, 2, 4)
    known = found[:, :, 0] > 0
    assert (known[:, 0] == known[:, 1]).all() and 15 < known[:, 0].sum() < 45
    assert not found[~known].any()
    factors = found[known[:, 0]] / [1.0, 0.5, 0.2, 0.9]
    assert factors.min() > 0.75 and factors.max() < 1.32 and np.ptp(factors[:, 0, 0]) > 0.2
    assert np.abs(factors[:, 0] / factors[:, 1] - 1).max() < 0.09, "views of one object agree but for noise"
    assert np.abs(factors[..., 2] / factors[..., 3] - 1).max() < 0.09, "both heights grow alike"


def test_extents_are_learned_where_pictures_say_nothing() -> None:
    from wiw.training.recogniser import Recipe, compute_set_logits, select_rows, train

    def grey(seed: int) -> GlimpseSets:
        looks = made_up(120, seed)
        looks.glimpses.images[:] = 110
        lengths = np.array([0.3, 1.0, 3.0])[looks.labels][looks.owners]
        looks.glimpses.scalars[looks.kinds == START, 5:] = np.column_stack(
            [lengths, lengths / 2, 0 * lengths, lengths]
        )[looks.kinds == START]
        return looks

    recipe, held_out = Recipe(epochs=20, batch=24, width=8), grey(1)
    network = train(grey(0), NAMES, recipe)[0]
    found = compute_set_logits(network, held_out, select_rows(held_out, START, 0)).argmax(axis=1)
    assert (found == held_out.labels).mean() > 0.8


def test_pictures_of_a_share_of_glimpses_are_of_something_else() -> None:
    from wiw.training.recogniser import Recipe, _augment

    looks = made_up(60, 3)
    looks.glimpses.images[:] = looks.labels[looks.owners][:, None, None, None, None] * 80
    rows = np.flatnonzero(looks.kinds == START)
    still = {"recolor": 0.0, "transplant": 0.0, "degrade": 0.0}
    order = np.arange(60)
    shown = [_augment(looks, rows, order, Recipe(swap=swap, **still), np.random.default_rng(0))[0] for swap in (0, 1)]
    grey = np.array([[image[:3].mean().item() for image in images] for images in shown])
    means = [grey[0, looks.labels == label].mean() for label in range(3)]
    assert means[0] < means[1] < means[2]
    nearest = np.abs(grey[1][:, None] - means).argmin(axis=1)
    assert 0.2 < (nearest == looks.labels).mean() < 0.7, "by chance alone"


def test_batches_are_pairs_of_categories_that_are_confused() -> None:
    from wiw.training.recogniser import Recipe, _Trainer

    looks = made_up(90, 2)
    trainer = _Trainer(looks, NAMES, Recipe(batch=60, width=4))
    trainer._confusion = np.array([[0.1, 0.9, 0.0], [0.9, 0.1, 0.0], [0.5, 0.5, 0.0]])
    first, second = looks.labels[trainer._draw_sets(np.random.default_rng(0))].reshape(2, 30)
    assert {(a, b) for a, b in zip(first, second, strict=True)} == {(0, 1), (1, 0), (2, 0), (2, 1)}
    before = trainer._confusion.copy()
    trainer.train_step(1e-3)
    assert not np.array_equal(trainer._confusion, before)
    np.testing.assert_allclose(trainer._confusion.sum(axis=1), 1, atol=1e-6)


def test_glimpses_of_a_set_get_the_same_colours_and_boxes_others_inside() -> None:
    from wiw.training.recogniser import _recolor

    grey = torch.full((4, 2, 3, 8, 8), 0.5)
    boxes = torch.full((4, 2, 8, 8), -1.0)
    boxes[..., 2:6, 2:6] = 1
    found = _recolor(grey, boxes, np.array([0, 0, 1, 1]), 1.0, np.random.default_rng(0))
    assert torch.equal(found[0], found[1]) and torch.equal(found[2], found[3])
    assert not torch.allclose(found[0], found[2])
    assert len(found[0, 0, 0].unique()) == 2 and found[0, 0, :, 3, 3].tolist() != found[0, 0, :, 0, 0].tolist()
    assert found.min() >= 0 and found.max() <= 1


def test_boxes_keep_their_content_where_surroundings_change() -> None:
    from wiw.training.recogniser import _transplant

    colours = torch.arange(6.0)[:, None, None, None, None].expand(6, 2, 3, 8, 8) / 6
    boxes = torch.full((6, 2, 8, 8), -1.0)
    boxes[..., 2:6, 2:6] = 1
    found = _transplant(colours, boxes, 1.0, np.random.default_rng(0))
    assert torch.equal(found[..., 2:6, 2:6], colours[..., 2:6, 2:6])
    assert sorted(found[:, 0, 0, 0, 0].tolist()) == colours[:, 0, 0, 0, 0].tolist()
    assert not torch.equal(found[:, 0, 0, 0, 0], colours[:, 0, 0, 0, 0])
    assert torch.equal(_transplant(colours, boxes, 0.0, np.random.default_rng(0)), colours)


def test_reshaped_furniture_keeps_to_its_place_and_all_is_back_afterwards(two_rooms: str) -> None:
    place = world(two_rooms, "cpu")
    labels = np.array([-1, *(0 if thing["category"] == "table" else -1 for thing in place.scene.instances)])
    table = int(np.flatnonzero(labels == 0)[0])
    bounds = np.asarray(place.scene.instances[table - 1]["bounds"], float)
    home = np.asarray(place.scene.instances[table - 1]["T_world_instance"], float)
    pivot = bounds.mean(axis=0) * [1, 0, 1] + bounds[0] * [0, 1, 0]
    factors = np.array([[1.2, 0.8, 1.1]])
    moved = _stretch(home[None], factors, pivot[None])[0]
    local = np.linalg.solve(home[:3, :3], pivot - home[:3, 3])
    np.testing.assert_allclose(moved[:3, :3] @ local + moved[:3, 3], pivot)
    np.testing.assert_allclose(np.linalg.norm(moved[:3, :3], axis=0), factors[0], atol=1e-6)

    poses = np.stack([camera_pose(np.array([-1.2, 0.0, -1.2]), 0.0)])
    before = place.renderer.panorama(poses, (144, 256))
    with reshape_furniture(place, labels, 5, 1.5):
        within = place.renderer.panorama(poses, (144, 256))
    after = place.renderer.panorama(poses, (144, 256))
    sizes = [(shown["instance"] == table).sum() for shown in (before, within)]
    assert sizes[0] != sizes[1] > 0
    for output, pixels in before.items():
        np.testing.assert_array_equal(after[output], pixels, output)
    with reshape_furniture(place, labels, 5, 1.0):
        np.testing.assert_array_equal(place.renderer.panorama(poses, (144, 256))["color"], before["color"])
    with pytest.raises(ArgumentError, match="reshape: expected a factor of 1 or more"):
        GlimpseSetRules(reshape=0.5)


def test_hard_sets_begin_with_the_hard_look_and_end_with_a_better_one(two_rooms: str) -> None:
    rules = EpisodeRules(hidden=0.75, gain=1.2, small=0.6, tiny=1.0, survey=80)  # two bare rooms hide little
    found = collect_hard_sets(world(two_rooms, "cpu"), 1, ("chest", "picture", "shelf", "table"), 3, rules)
    assert len(found) == 3
    for number in range(3):
        own = found.owners == number
        kinds = found.kinds[own]
        assert kinds[0] == START and np.count_nonzero(kinds == START) == 1
        area = np.prod(found.glimpses.scalars[own][:, :2], axis=1)
        best = np.flatnonzero(kinds == NEAR)[-1]
        assert area[best] > area[0], "the last real look is from the best view"
    rest = join_glimpse_sets([])
    assert len(rest) == 0 and len(join_glimpse_sets([rest, found, rest])) == 3


@pytest.mark.nightly
def test_the_command_trains_on_apartments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from wiw.perception.recogniser import Recogniser
    from wiw.training.recogniser import Recipe

    monkeypatch.setattr("wiw.training.recogniser.Recipe", partial(Recipe, batch=24))
    names = ["bed", "chair", "plant", "shower", "television", "toilet"]
    out, cache = tmp_path / "weights.safetensors", tmp_path / "looks"
    command = ["train", "recogniser", "--scenes", "apartments:train:2", "--val", "apartments:val:1", "--places", "10"]
    options = ["--out", str(out), "--cache", str(cache), "--workers", "1", "--categories", *names]
    assert main([*command, *options, "--epochs", "20", "--minutes", "None"]) == 0
    assert "calibration error" in capsys.readouterr().out
    card = Recogniser.load(out).card
    assert card["accuracy"]["start"] > 2.5 / len(names)
    assert card["accuracy"]["start + 3 perfect"] > 2.5 / len(names)
    assert out.stat().st_size < 2 * 2**20
    assert card["scenes"] == "apartments:train:2" and 0 < card["hard_sets"] <= 10
    assert set(card["accuracy_hard"]) == set(card["accuracy"])

    made = sorted(cache.iterdir())  # the second time nothing is looked at anew, but what was damaged
    assert [file.suffix for file in made] == [".npz"] * 6, "of three scenes, as they come and with a hard first look"
    whole = [file.read_bytes() for file in made]
    made[0].write_bytes(whole[0][:1000])
    before = made[2].stat().st_mtime_ns
    assert main([*command, *options, "--epochs", "1"]) == 2
    assert f"{out} exists, and there is no checkpoint" in capsys.readouterr().err
    options[1] = str(tmp_path / "others.safetensors")
    assert main([*command, *options, "--epochs", "1"]) == 0
    assert np.load(made[0])["images"].tobytes() == np.load(_written(tmp_path, whole[0]))["images"].tobytes()
    assert made[2].stat().st_mtime_ns == before


def _written(folder: Path, content: bytes) -> Path:
    file = folder / "copy.npz"
    file.write_bytes(content)
    return file


def test_the_command_refuses_what_cannot_end_well(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["train", "recogniser", "--out", str(tmp_path / "no" / "x")]) == 2
    assert "existing folder" in capsys.readouterr().err
    overlapping = ["--scenes", "apartments:train:3", "--val", "apartments:train:1", "--out", str(tmp_path / "x")]
    assert main(["train", "recogniser", *overlapping]) == 2
    assert "apartments:train/0 in both" in capsys.readouterr().err
    edited = ["--scenes", "apartments:train/0?remove:sofa_1", "--val", "apartments:train:1"]
    assert main(["train", "recogniser", *edited, "--out", str(tmp_path / "x")]) == 2
    assert "apartments:train/0 in both" in capsys.readouterr().err
    (tmp_path / "house.obj").touch()
    by_two_paths = ["--scenes", "house.obj", "--val", str(tmp_path / "house.obj"), "--out", "x"]
    monkeypatch.chdir(tmp_path)
    assert main(["train", "recogniser", *by_two_paths]) == 2
    assert "house.obj in both" in capsys.readouterr().err
