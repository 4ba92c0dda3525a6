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
from wiw.errors import ArgumentError
from wiw.perception.glimpses import SIDE, Glimpses
from wiw.training.glimpse_sets import PERFECT, START, WARPED, GlimpseSets, merge_glimpse_sets, split_in_half

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
    scalars = np.column_stack([np.zeros((count, 4)), kinds == START]).astype(np.float32)
    return GlimpseSets(Glimpses(images, boxes, scalars), np.repeat(np.arange(sets), len(KINDS)), kinds, labels)


@pytest.fixture(scope="module")
def lesson() -> Any:
    from wiw.training.recogniser import Recipe, calibrate, train

    recipe = Recipe(epochs=12, batch=24, width=8, seed=3)
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


def test_the_same_lesson_gives_the_same_network() -> None:
    from wiw.training.recogniser import Recipe, train

    looks = made_up(40, 5)
    once, again, other = (
        train(looks, NAMES, Recipe(epochs=2, batch=10, width=4, seed=seed))[0].state_dict() for seed in (1, 1, 2)
    )
    assert all(torch.equal(once[name], again[name]) for name in once)
    assert not torch.equal(once["logits.weight"], other["logits.weight"])
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
    assert card["scenes"] == "apartments:train:2"

    made = sorted(cache.iterdir())  # the second time nothing is looked at anew, but what was damaged
    assert [file.suffix for file in made] == [".npz"] * 3
    whole = [file.read_bytes() for file in made]
    made[0].write_bytes(whole[0][:1000])
    before = made[2].stat().st_mtime_ns
    assert main([*command, *options, "--epochs", "1"]) == 0
    assert np.load(made[0])["images"].tobytes() == np.load(_written(tmp_path, whole[0]))["images"].tobytes()
    assert made[2].stat().st_mtime_ns == before


def _written(folder: Path, content: bytes) -> Path:
    file = folder / "copy.npz"
    file.write_bytes(content)
    return file


def test_the_command_refuses_what_cannot_end_well(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "recogniser", "--out", str(tmp_path / "no" / "x")]) == 2
    assert "folder that exists" in capsys.readouterr().err
    overlapping = ["--scenes", "apartments:train:3", "--val", "apartments:train:1", "--out", str(tmp_path / "x")]
    assert main(["train", "recogniser", *overlapping]) == 2
    assert "apartments:train/0 in both" in capsys.readouterr().err
