# SPDX-License-Identifier: Apache-2.0
"""Drawings, checked by their pixels."""

import numpy as np
import pytest

from wiw import annotate
from wiw.errors import ArgumentError

GREEN = (0, 200, 0)


def canvas(height=60, width=100, value=128):
    return np.full((height, width, 3), value, np.uint8)


def is_color(image, color):
    return (image == np.array(color, np.uint8)).all(-1)


def test_a_box_is_an_outline_inside_its_edges():
    image = canvas()
    drawn = is_color(annotate.box(image, (20, 10, 50, 40), color=GREEN, thickness=3), GREEN)
    expected = np.zeros((60, 100), bool)
    expected[10:40, 20:50] = True
    expected[13:37, 23:47] = False
    assert np.array_equal(drawn, expected)
    assert (image == 128).all()  # the input is left alone


def test_a_box_across_the_seam_is_open_there():
    drawn = is_color(annotate.box(canvas(), (90, 10, 15, 40), color=GREEN, thickness=2), GREEN)
    assert drawn[10:12, 90:].all()
    assert drawn[10:12, :15].all()
    assert drawn[10:40, 90:92].all()
    assert drawn[10:40, 13:15].all()
    assert not drawn[12:38, 92:].any()
    assert not drawn[12:38, :13].any()
    assert not drawn[:, 15:90].any()


def test_a_line_outside_hides_nothing_of_a_small_box_and_stays_in_the_image():
    drawn = is_color(annotate.box(canvas(), (20, 10, 22, 12), color=GREEN, thickness=2, outside=True), GREEN)
    expected = np.zeros((60, 100), bool)
    expected[8:14, 18:24] = True
    expected[10:12, 20:22] = False
    assert np.array_equal(drawn, expected)
    drawn = is_color(annotate.box(canvas(), (99, 0, 3, 60), color=GREEN, thickness=2, outside=True), GREEN)
    assert drawn[30, 97:99].all() and not drawn[30, 99]
    assert drawn[30, 3:5].all() and not drawn[30, :3].any()


def test_a_label_sits_on_a_plate_and_stays_in_the_image():
    drawn = annotate.box(canvas(), (80, 2, 99, 40), "door", color=GREEN)
    plain = annotate.box(canvas(), (80, 2, 99, 40), color=GREEN)
    changed = (drawn != plain).any(-1)
    assert changed.any()
    rows, columns = np.nonzero(changed)
    assert rows.max() < 20
    assert columns.min() > 40
    assert is_color(drawn[:12, columns.min() : columns.min() + 2], GREEN).all()


def test_a_mark_covers_its_disc_only():
    drawn = annotate.mark(canvas(), (30.5, 20.5), color=GREEN, radius=6)
    y, x = np.mgrid[:60, :100]
    distance = np.hypot(x - 30, y - 20)
    assert is_color(drawn, GREEN)[distance < 3].all()
    assert (drawn[distance > 8] == 128).all()
    assert (drawn[(distance > 4.8) & (distance < 5.5)].min(-1) > 128).any()  # the light rim


def test_axes_are_red_green_and_blue():
    drawn = annotate.axes(canvas(200, 200), (100, 100), [(180, 100), (100, 20), (40, 160)], thickness=3).astype(int)
    assert drawn[100, 140, 0] > drawn[100, 140, 1] + 100
    assert drawn[60, 100, 1] > drawn[60, 100, 0] + 80
    assert drawn[130, 70, 2] > drawn[130, 70, 0] + 100


@pytest.mark.parametrize(("columns", "rows"), [(None, 1), (2, 3), (7, 1)])
def test_a_strip_holds_every_frame_unchanged_under_its_title(columns, rows):
    frames = np.random.default_rng(0).integers(0, 256, (5, 40, 120, 3), dtype=np.uint8)
    titles = [f"Imagined action {k}" for k in range(5)]
    sheet = annotate.strip(frames, titles, columns=columns, bar=20, gap=4)
    across = min(columns or 5, 5)
    assert sheet.shape == (rows * 60 + (rows - 1) * 4, across * 124 - 4, 3)
    for k in range(5):
        y, x = k // across * 64, k % across * 124
        assert np.array_equal(sheet[y + 20 : y + 60, x : x + 120], frames[k])
        bar = sheet[y : y + 20, x : x + 120]
        assert (bar[0] == bar[0, 0]).all()
        assert (bar.min(-1) > 150).sum() > 50  # light letters on the dark bar
    if across * rows > 5:
        assert (sheet[-60:, -120:] == 255).all()


def test_long_titles_stay_over_their_own_frame_and_other_scripts_do_not_break_them():
    frames = np.zeros((2, 20, 60, 3), np.uint8)
    sheet = annotate.strip(frames, ["x" * 300, ""], bar=18)
    alone = annotate.strip(frames[:1], ["x" * 300], bar=18)
    assert np.array_equal(sheet[:, :60], alone)
    assert (sheet[:18, 64:] == sheet[0, 64]).all()
    assert np.array_equal(annotate.strip(frames[:1], ["\u00e9"]), annotate.strip(frames[:1], ["?"]))


def test_errors_say_what_was_expected():
    with pytest.raises(ArgumentError, match=r"image \[H, W, 3\]"):
        annotate.box(canvas()[..., 0], (0, 0, 1, 1))
    with pytest.raises(ArgumentError, match="titles"):
        annotate.strip(np.zeros((2, 8, 8, 3), np.uint8), ["one"])
    with pytest.raises(ArgumentError, match="at least one frame"):
        annotate.strip(np.zeros((0, 8, 8, 3), np.uint8), [])
    with pytest.raises(ArgumentError, match="finite"):
        annotate.mark(canvas(), (float("nan"), 3))
    with pytest.raises(ArgumentError, match="thickness"):
        annotate.box(canvas(), (0, 0, 5, 5), thickness=0)


@pytest.mark.parametrize("side", [1, -1])
def test_a_label_stands_off_its_mark_on_a_line(side):
    drawn = annotate.mark(canvas(), (50.5, 30.5), "1", radius=3, gap=side * 12)
    changed = (drawn != 128).any(-1)
    assert changed[30, 50 + side * 4 : 50 + side * 20 : side].all()
    beside = changed[:, 50 + side * 5 : 50 + side * 14 : side]
    assert beside.any(0).all() and beside.sum(0).max() <= 3
    assert not changed[:, 50 - side * 5 :: -side].any()
