# SPDX-License-Identifier: Apache-2.0
"""Colour words of pixels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw import scenes
from wiw.datasets.questions import grammar
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, WeightsError
from wiw.perception.colors import (
    COLORS,
    FEATURES,
    GREY_CHROMA,
    HUES,
    PARAMETERS,
    QUANTILES,
    ColorNamer,
    compute_features,
    name_color,
    to_oklab,
)


def lit(color: tuple[int, int, int], rng: np.random.Generator) -> Any:
    """Pixels of one colour in light and shade."""
    shade = rng.uniform(0.7, 1.05, (200, 1))
    return np.clip(np.array(color) * shade + rng.normal(0, 2, (200, 3)), 0, 255).astype(np.uint8)


def test_the_colors_are_those_that_things_of_apartments_can_have() -> None:
    edits = [edit.partition("=")[2] for edit in scenes.possible_edits("apartments:val/3") if edit.startswith("color:")]
    assert sorted(set(edits)) == sorted(scenes.COLORS)
    assert grammar.COLORS is COLORS is scenes.COLORS


def test_oklab_of_known_colors() -> None:
    found = to_oklab(np.array([[255, 255, 255], [0, 0, 0], [128, 128, 128]], np.uint8))
    np.testing.assert_allclose(found[0], [1, 0, 0], atol=1e-3)
    np.testing.assert_allclose(found[1], [0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(found[2, 1:], [0, 0], atol=1e-3)
    red, blue = to_oklab(np.array([[255, 0, 0], [0, 0, 255]], np.uint8))
    assert red[1] > 0.2 and blue[2] < -0.3


@pytest.mark.parametrize(
    ("color", "name"),
    [
        ((60, 80, 200), "blue"),
        ((60, 150, 60), "green"),
        ((190, 40, 40), "red"),
        ((25, 25, 26), "black"),
        ((130, 70, 170), "purple"),
        ((230, 228, 225), "white"),
        ((110, 70, 40), "brown"),
    ],
)
def test_plain_colors_are_named(color: tuple[int, int, int], name: str) -> None:
    pixels = lit(color, np.random.default_rng(0))
    found, confidence = name_color(pixels)
    assert found == name and 0.3 < confidence <= 1
    assert name_color(pixels[::-1]) == (found, pytest.approx(confidence))  # a set of pixels has no order


def test_few_pixels_and_none() -> None:
    assert name_color(np.zeros((0, 3), np.uint8)) == ("", 0.0)
    assert name_color(np.array([[60, 80, 200]], np.uint8))[0] == "blue"


@pytest.mark.parametrize("pixels", [np.zeros((2, 4), np.uint8), np.zeros((2, 3)), np.zeros(3, np.uint8), [[1, 2, 3]]])
def test_other_arrays_are_refused(pixels: Any) -> None:
    with pytest.raises(ArgumentError, match="expected pixels uint8"):
        name_color(pixels)


def test_features_do_not_depend_on_other_sets() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 40, 3), np.uint8)
    found = compute_features(pixels)
    assert found.shape == (5, FEATURES) and np.isfinite(found).all()
    np.testing.assert_array_equal(found[3], compute_features(pixels[3:4])[0])


def describe_plainly(pixels: np.ndarray) -> np.ndarray:
    """Compute the features of one set of pixels [n, 3] as they are defined."""
    lab = to_oklab(pixels[None])[0]
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    weight = chroma / (chroma + GREY_CHROMA)
    shares = np.zeros((HUES, len(pixels)))
    for pixel, angle in enumerate(np.arctan2(lab[:, 2], lab[:, 1])):
        sector = angle / (2 * np.pi) % 1.0 * HUES
        shares[int(sector) % HUES, pixel] = weight[pixel] * (1 - sector % 1.0)
        shares[(int(sector) + 1) % HUES, pixel] = weight[pixel] * (sector % 1.0)
    quantiles = np.quantile(lab, QUANTILES, axis=0).ravel()
    return np.concatenate([quantiles, shares.mean(axis=1), [chroma.mean(), chroma.std(), chroma.max()]])


@pytest.mark.parametrize("count", [1, 2, 3, 11, 21, 63, 144, 145, 256])
def test_features_are_those_defined(count: int) -> None:
    pixels = np.random.default_rng(count).integers(0, 256, (2, count, 3), np.uint8)
    pixels[1] = pixels[1, :1] // 64 * 64  # all of one colour, often grey
    expected = np.stack([describe_plainly(each) for each in pixels])
    np.testing.assert_array_equal(compute_features(pixels), expected)


def test_parameters_are_stored_and_checked(tmp_path: Path) -> None:
    namer = ColorNamer.load(PARAMETERS)
    namer.save(tmp_path / "again.json")
    again = ColorNamer.load(tmp_path / "again.json")
    np.testing.assert_array_equal(again.hidden, namer.hidden)
    values = json.loads(PARAMETERS.read_text())
    for wrong in ("{", json.dumps({**values, "shift": [0.0]}), json.dumps({**values, "colors": ["blue"]}), "[]", "{}"):
        (tmp_path / "wrong.json").write_text(wrong)
        with pytest.raises(WeightsError, match="expected parameters for colour naming") as error:
            ColorNamer.load(tmp_path / "wrong.json")
        assert error.value.kind == "unfit"
    with pytest.raises(WeightsError) as error:
        ColorNamer.load(tmp_path / "none.json")
    assert error.value.kind == "missing"


def test_things_of_an_apartment_are_named() -> None:
    pytest.importorskip("torch", reason="needs wiw[torch]")
    from wiw.training.color_naming import evaluate
    from wiw.training.labelled_views import ViewRules, record_views

    views = record_views(world("apartments:val/0"), 1, ViewRules(places=6))
    found = evaluate(ColorNamer.load(PARAMETERS), views)
    assert found["things"] > 50
    assert found["accuracy"] > 0.6 and set(found["by_color"]) <= set(COLORS)
