# SPDX-License-Identifier: Apache-2.0
"""The recogniser's looks, its sums and its file; calibration against formulas."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wiw.errors import ArgumentError, DependencyError, FileError
from wiw.panorama import directions
from wiw.perception.calibration import calibration_error, fit_temperature, softmax
from wiw.perception.glimpses import (
    CAMERA_HEIGHT,
    CLOSE_FILL,
    EXTENT,
    SHORTEST,
    SIDE,
    STEP,
    WIDE_FACTOR,
    Glimpses,
    extract_glimpses,
    join_glimpses,
    measure_extent,
)

NAMES = ("chair", "bed", "plant")


def spot(yaw: float, pitch: float, radius: float, size: tuple[int, int] = (288, 512)) -> Any:
    """The mask of a disc on the sphere, degrees."""
    y, p = np.radians([yaw, pitch])
    middle = np.array([-np.sin(y) * np.cos(p), np.sin(p), -np.cos(y) * np.cos(p)])
    return directions(size) @ middle > np.cos(np.radians(radius))


def look_at(masks: Any) -> tuple[Glimpses, Any]:
    masks = np.stack(masks)
    panoramas = np.where(masks[..., None], [0, 200, 0], [40, 40, 40]).astype(np.uint8)
    return extract_glimpses(panoramas, masks, np.arange(len(masks)) == 0)


def noise(count: int, seed: int) -> Glimpses:
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (count, 2, SIDE, SIDE, 3), np.uint8)
    boxes = np.sort(rng.random((count, 2, 2, 2)), axis=2).reshape(count, 2, 4)
    return Glimpses(images, boxes.astype(np.float32), rng.random((count, 9)).astype(np.float32))


# -- looks -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("yaw", "pitch", "radius"), [(0, 0, 8), (179.8, -20, 8), (-100, 30, 15), (60, -70, 6)])
def test_the_box_fills_the_close_view_and_is_where_the_thing_is(yaw: float, pitch: float, radius: float) -> None:
    found, frames = look_at([spot(yaw, pitch, radius)])
    assert frames.tolist() == [0]
    for view, fill in enumerate((CLOSE_FILL, CLOSE_FILL / WIDE_FACTOR)):
        left, top, right, bottom = found.boxes[0, view]
        assert fill / STEP**2 - 0.03 < max(right - left, bottom - top) < fill + 0.03
        assert abs((left + right) / 2 - 0.5) < 0.05
        assert abs((top + bottom) / 2 - 0.5) < 0.08
        green = found.images[0, view, ..., 1] > 120
        rows, columns = np.flatnonzero(green.any(axis=1)), np.flatnonzero(green.any(axis=0))
        drawn = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]) / SIDE
        np.testing.assert_allclose(found.boxes[0, view], drawn, atol=2.5 / SIDE)


def test_scalars_are_angles() -> None:
    (found, _) = look_at([spot(30, -20, 6), spot(30, -20, 6)])
    width, height, top, bottom = np.degrees(found.scalars[0, :4])
    assert (width, height) == (pytest.approx(12, abs=1.2), pytest.approx(12, abs=1.2))
    assert (top, bottom) == (pytest.approx(-14, abs=1), pytest.approx(-26, abs=1))
    assert found.scalars[:, 4].tolist() == [1, 0]


@settings(max_examples=25)
@given(st.integers(0, 511), st.integers(0, 287), st.integers(1, 511), st.integers(1, 287))
def test_any_box_can_be_looked_at(left: int, top: int, width: int, height: int) -> None:
    mask = np.zeros((288, 512), bool)
    mask[top : top + height, (left + np.arange(width)) % 512] = True
    found, _ = look_at([mask])
    assert ((found.boxes >= 0) & (found.boxes <= 1)).all()
    assert (found.boxes[..., 2:] > found.boxes[..., :2]).all()


def test_frames_without_the_target_give_no_look() -> None:
    empty = np.zeros((288, 512), bool)
    found, frames = look_at([empty, spot(0, 0, 5), empty])
    assert (len(found), frames.tolist()) == (1, [1])
    assert len(look_at([empty])[0]) == 0
    with pytest.raises(ArgumentError, match="masks"):
        extract_glimpses(np.zeros((2, 8, 16, 3), np.uint8), np.zeros((1, 8, 16), bool), np.ones(2, bool))
    with pytest.raises(ArgumentError, match="flag"):
        extract_glimpses(np.zeros((2, 8, 16, 3), np.uint8), np.zeros((2, 8, 16), bool), np.ones(3, bool))
    with pytest.raises(ArgumentError, match=r"expected depth \(8, 16\) or None per panorama \[2\], got \(8, 8\)"):
        extract_glimpses(
            np.zeros((2, 8, 16, 3), np.uint8),
            np.zeros((2, 8, 16), bool),
            np.ones(2, bool),
            [None, np.ones((8, 8), np.float32)],
        )
    with pytest.raises(ArgumentError, match="boxes"):
        Glimpses(found.images, found.boxes[:0], found.scalars)
    with pytest.raises(ArgumentError, match="NaN"):
        Glimpses(found.images, found.boxes * np.nan, found.scalars)


# -- extents -----------------------------------------------------------------------------------------------------------


def see_box(
    lengths: tuple[float, float, float], middle: tuple[float, float], bottom: float, turn: float
) -> tuple[Any, Any]:
    """Mask and depth of a box: width, depth and height in metres, turned by degrees, `bottom` above the floor."""
    rays = directions((288, 512)).astype(np.float64)
    cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    rotation = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    centre = np.array([middle[0], bottom + lengths[2] / 2 - CAMERA_HEIGHT, middle[1]])
    half = np.array([lengths[0], lengths[2], lengths[1]]) / 2
    with np.errstate(divide="ignore"):
        ways = ((np.array([-1.0, 1.0])[:, None, None, None] * half) - rotation.T @ -centre) / (rays @ rotation)
    near, far = ways.min(axis=0).max(axis=-1), ways.max(axis=0).min(axis=-1)
    mask = (near < far) & (near > 0)
    return mask, np.where(mask, near, 9.0).astype(np.float32)


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.floats(0.3, 2.0), st.floats(0.3, 2.0), st.floats(0.3, 2.0)),
    st.floats(0, 0.9),
    st.floats(0, 360),
    st.floats(0, 360),
    st.floats(2.0, 4.0),
)
def test_extents_are_those_of_the_visible_part_of_a_box(
    lengths: tuple[float, float, float], bottom: float, turn: float, bearing: float, away: float
) -> None:
    middle = (away * np.sin(np.radians(bearing)), away * np.cos(np.radians(bearing)))
    longest, across, low, high = measure_extent(*see_box(lengths, middle, bottom, turn))
    diagonal = np.hypot(*lengths[:2])
    assert SHORTEST <= across <= longest <= diagonal + 0.02
    assert longest > 0.6 * min(lengths[:2]), "the whole of the nearer side is in sight"
    assert bottom - 0.02 <= low < high <= bottom + lengths[2] + 0.02
    assert high - low > 0.6 * lengths[2]


def test_extents_of_a_board_are_its_width_and_heights() -> None:
    mask, depth = see_box((1.2, 0.002, 0.7), (0.0, -3.0), 0.6, 0.0)
    longest, across, low, high = measure_extent(mask, depth)
    assert longest == pytest.approx(0.94 * 1.2, abs=0.04)
    assert across < 0.02
    assert (low, high) == (pytest.approx(0.62, abs=0.02), pytest.approx(1.28, abs=0.02))


def test_extents_are_unknown_without_depth() -> None:
    mask, depth = see_box((0.5, 0.5, 0.5), (0.0, -2.0), 0.0, 20.0)
    panorama = np.zeros((2, *mask.shape, 3), np.uint8)
    found, _ = extract_glimpses(panorama, np.stack([mask, mask]), np.array([True, False]), [depth, None])
    np.testing.assert_allclose(found.scalars[0, EXTENT], measure_extent(mask, depth), rtol=1e-6)
    assert not found.scalars[1, EXTENT].any()
    holes = np.where(np.arange(512) % 2, depth, 0).astype(np.float32)
    np.testing.assert_allclose(measure_extent(mask, holes), measure_extent(mask, depth), atol=0.04)
    for unknown in (np.zeros_like(depth), np.full_like(depth, np.nan)):
        assert not measure_extent(mask, unknown).any()


# -- calibration -------------------------------------------------------------------------------------------------------


@given(st.floats(0.3, 4), st.integers(0, 5))
@settings(max_examples=10)
def test_the_temperature_is_found_again(temperature: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    logits = rng.normal(0, 2, (20000, 4))
    labels = (softmax(logits).cumsum(axis=1) > rng.random((20000, 1))).argmax(axis=1)  # drawn from them at 1
    assert fit_temperature(temperature * logits, labels) == pytest.approx(temperature, rel=0.06)


def test_calibration_error_is_the_gap_between_confidence_and_accuracy() -> None:
    probabilities = np.array([[0.9, 0.1]] * 10 + [[0.35, 0.65]] * 10)
    labels = np.array([0] * 6 + [1] * 4 + [1] * 8 + [0] * 2)
    assert calibration_error(probabilities, labels) == pytest.approx((0.3 + 0.15) / 2)
    assert calibration_error(np.array([[1.0, 0.0], [0.0, 1.0]]), [0, 1]) == 0
    for labels in ([], [0, 2], [0]):
        with pytest.raises(ArgumentError, match="calibration"):
            calibration_error(np.ones((2, 2)), labels)


# -- the network and its file ------------------------------------------------------------------------------------------

torch = pytest.importorskip("torch", reason="needs wiw[torch]")


def untrained(width: int = 8, extents: bool = False) -> Any:
    from wiw.perception.recogniser import Recogniser
    from wiw.perception.recognition_network import Network

    torch.manual_seed(1)
    network = Network(len(NAMES), width, extents)
    torch.nn.init.normal_(network.weight.weight)
    return Recogniser(network, NAMES, 1.3, {"accuracy": 0.5})


def test_sets_are_independent_of_each_other_and_of_the_order_of_looks() -> None:
    recogniser = untrained()
    sets = [noise(3, 0), noise(0, 1), noise(1, 2), noise(5, 3)]
    together = recogniser(sets)
    np.testing.assert_allclose(together.sum(axis=1), 1)
    np.testing.assert_array_equal(together[1], 1 / 3)  # nothing was seen
    for looks, row in zip(sets, together, strict=True):
        np.testing.assert_array_equal(recogniser([looks])[0], row)
        backwards = looks[np.arange(len(looks))[::-1]]
        np.testing.assert_allclose(recogniser([backwards])[0], row, rtol=1e-4)
    assert recogniser([]).shape == (0, 3)


def test_looks_are_added_with_their_weights() -> None:
    recogniser = untrained()
    looks = noise(4, 5)
    from wiw.perception.recognition_network import to_network_input

    with torch.inference_mode():
        stacked = to_network_input(torch.from_numpy(looks.images), torch.from_numpy(looks.boxes))
        logits, weights = (
            part.double().numpy()
            for part in recogniser.network.encode_glimpses(stacked, torch.from_numpy(looks.scalars))
        )
        independence = float(torch.sigmoid(recogniser.network.independence))
    expected = (weights[:, None] * logits).sum(axis=0) / weights.sum() ** (1 - independence)
    np.testing.assert_allclose(recogniser([looks])[0], softmax(expected, 1.3), rtol=1e-4)
    assert np.ptp(weights) > 0.01


def test_extents_reach_the_network_where_they_are_known() -> None:
    from wiw.perception.recognition_network import encode_extents

    scalars = torch.zeros(2, 9)
    scalars[0, EXTENT] = torch.tensor([1.5, 0.5, 0.1, 0.8])
    expected = [[1.0, np.log(1.5), np.log(0.5), 0.1, 0.8], [0.0] * 5]
    np.testing.assert_allclose(encode_extents(scalars).numpy(), expected, rtol=1e-6)
    looks = noise(1, 4)
    other = Glimpses(looks.images, looks.boxes, looks.scalars.copy())
    other.scalars[:, EXTENT] = [0.3, 0.3, 0.0, 0.4]
    told, by_pictures = untrained(extents=True), untrained()
    assert np.abs(told([looks]) - told([other])).max() > 1e-4
    np.testing.assert_array_equal(by_pictures([looks]), by_pictures([other]))


def test_the_box_is_drawn_where_it_is() -> None:
    from wiw.perception.recognition_network import to_network_input

    boxes = np.array([[[0.25, 0.5, 0.75, 0.625], [0.1, 0.1, 0.102, 0.9]]], np.float32)
    drawn = to_network_input(torch.zeros(1, 2, SIDE, SIDE, 3, dtype=torch.uint8), torch.from_numpy(boxes))[0].numpy()
    filled = (drawn[[3, 7]] + 1) / 2
    assert filled[0, 32:40, 16:48].min() == 1
    assert filled.reshape(2, -1).sum(axis=1) == pytest.approx([8 * 32, 0.002 * 0.8 * SIDE**2], rel=1e-3)
    assert (drawn[[0, 1, 2, 4, 5, 6]] == -1).all()


def test_the_shipped_size_is_small() -> None:
    from wiw.perception.recognition_network import Network

    assert 100_000 < sum(value.numel() for value in Network(26).parameters()) < 600_000


@pytest.mark.parametrize("extents", [False, True])
def test_a_saved_recogniser_answers_exactly_as_before(tmp_path: Path, extents: bool) -> None:
    from wiw.perception.recogniser import Recogniser

    recogniser, sets = untrained(extents=extents), [noise(3, 0), noise(2, 7)]
    recogniser.save(tmp_path / "weights.safetensors")
    again = Recogniser.load(tmp_path / "weights.safetensors")
    np.testing.assert_array_equal(again(sets), recogniser(sets))
    assert (again.categories, again.temperature, again.card) == (NAMES, 1.3, {"accuracy": 0.5})
    assert [file.name for file in tmp_path.iterdir()] == ["weights.safetensors"]
    with pytest.raises(FileError, match="cannot be written"):
        recogniser.save(tmp_path / "weights.safetensors" / "again")


def test_choices_are_a_part_of_the_categories() -> None:
    recogniser, sets = untrained(), [noise(2, 0)]
    whole, part = recogniser(sets)[0], recogniser(sets, ("plant", "chair"))[0]
    np.testing.assert_allclose(part, whole[[2, 0]] / whole[[2, 0]].sum())
    with pytest.raises(ArgumentError, match=r"does not know otter, zebra; it was trained on chair, bed, plant"):
        recogniser(sets, ("zebra", "bed", "otter"))
    with pytest.raises(ArgumentError, match="empty list"):
        recogniser(sets, ())


def test_foreign_and_damaged_files_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    from wiw.perception.recogniser import FORMAT, Recogniser

    file = tmp_path / "weights.safetensors"
    with pytest.raises(FileError, match="wiw train recogniser"):
        Recogniser.load(file)
    untrained().save(file)
    whole = file.read_bytes()
    for damaged in (b"", b"text", whole[:50], whole[:-1], b"\xff" * 8 + whole[8:]):
        file.write_bytes(damaged)
        with pytest.raises(FileError, match=r"weights\.safetensors"):
            Recogniser.load(file)
    header = {"categories": ["a", "b"], "width": 8, "temperature": 1.0, "card": {}}
    for metadata, message in (
        (None, "something else"),
        ({"format": "wiw-recogniser-0"}, "another version"),
        ({"format": FORMAT}, "cannot be read"),
        ({"format": FORMAT, "header": "[1]"}, "expected an object"),
        ({"format": FORMAT, "header": json.dumps(header)}, "do not form a recogniser"),
        ({"format": FORMAT, "header": "{}"}, "do not form a recogniser"),
    ):
        save_file({"x": torch.zeros(1)}, file, metadata)
        with pytest.raises(FileError, match=message):
            Recogniser.load(file)


def test_a_recogniser_needs_as_many_names_as_logits() -> None:
    from wiw.perception.recogniser import Recogniser
    from wiw.perception.recognition_network import Network

    for names, temperature in ((NAMES[:2], 1), (("a", "b", "b"), 1), (NAMES, 0), (NAMES, float("nan"))):
        with pytest.raises(ArgumentError, match="Recogniser"):
            Recogniser(Network(3, 8), names, temperature)


def test_without_torch_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from wiw.perception.recogniser import Recogniser

    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(DependencyError, match=r"pip install 'wiw\[torch\]'"):
        Recogniser.load(tmp_path / "weights.safetensors")


def test_importing_it_imports_no_torch() -> None:
    probe = "import wiw.perception.recogniser, sys; raise SystemExit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", probe], check=True)


def test_joining_nothing_gives_nothing() -> None:
    assert len(join_glimpses([])) == 0
    parts = [noise(2, 0), noise(1, 1)]
    assert len(join_glimpses(parts)) == 3
    np.testing.assert_array_equal(join_glimpses(parts).images[2], parts[1].images[0])
