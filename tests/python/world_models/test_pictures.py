# SPDX-License-Identifier: Apache-2.0
"""Frames that are pictures of another place by chance, and frames whose colours are exchanged by mistake."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from wiw.errors import ContractError
from wiw.types import Control
from wiw.world_models.pictures import check_pictures, sample

ENDS_ONLY, ALL_FRAMES = 3, 0
"""Frames that another row answers: all but the last, or none."""


def make_control(shared: int) -> Control:
    return Control(np.ones(4, np.int8), np.zeros((4, 3)), np.zeros((4, 4, 4)), length=4, shared=shared)


def draw(warmth: float, detail: float, seed: int) -> NDArray[np.uint8]:
    """Bright on top, and red on the left: a room with a lit ceiling, and a warm or a cold wall on one side."""
    down, across = np.linspace(1, -1, 48)[:, None], np.linspace(1, -1, 96)[None, :]
    grey = 128 + 40 * down + detail * np.random.default_rng(seed).normal(0, 1, (48, 96))
    tint = warmth * across
    return np.clip(np.stack([grey + tint, grey + 0 * tint, grey - tint], axis=-1), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shared", [ALL_FRAMES, ENDS_ONLY])
def test_exchanged_colours_are_found_in_ends_too(shared: int) -> None:
    seen = draw(40, 5, 0)
    frames = np.stack([seen, *[seen[..., ::-1]] * 4])[None]
    with pytest.raises(ContractError, match="after frame 0, red and blue are swapped"):
        check_pictures("model", sample(seen[None]), frames, [make_control(shared)])


def test_the_end_of_a_plan_may_be_a_room_in_other_colours() -> None:
    seen, end = draw(40, 18, 0), draw(-40, 18, 1)  # as bright above, and cold where the other is warm
    frames = np.stack([seen, seen, seen, seen, end])[None]
    check_pictures("model", sample(seen[None]), frames, [make_control(ENDS_ONLY)])
    frames[0, 1:] = end  # at once, after one action
    with pytest.raises(ContractError, match="after frame 0"):
        check_pictures("model", sample(seen[None]), frames, [make_control(ALL_FRAMES)])


def test_frames_may_be_black_where_nothing_is_known_but_not_from_everywhere() -> None:
    seen, other = draw(40, 5, 0), draw(40, 5, 1)
    behind_a_wall = np.stack([seen, *[np.zeros_like(seen)] * 4])
    for shared in (ALL_FRAMES, ENDS_ONLY):
        check_pictures("model", sample(seen[None]), behind_a_wall[None], [make_control(shared)])
    twice = np.stack([behind_a_wall] * 2)
    check_pictures("model", sample(twice[:, 0]), twice, [make_control(ALL_FRAMES)] * 2)  # the same view
    twice[1] = other
    check_pictures("model", sample(twice[:, 0]), twice, [make_control(ALL_FRAMES)] * 2)
    twice[1, 1:] = 0
    with pytest.raises(ContractError, match=r"after frame 0, no value is above 1: .*All is black, as after NaN"):
        check_pictures("model", sample(twice[:, 0]), twice, [make_control(ALL_FRAMES)] * 2)
    ones = behind_a_wall.copy()
    ones[1:] = 1
    with pytest.raises(ContractError, match="after frame 0, no value is above 1"):  # as floats of a whole are cast
        check_pictures("model", sample(seen[None]), ones[None], [make_control(ENDS_ONLY)])
