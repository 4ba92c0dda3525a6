# SPDX-License-Identifier: Apache-2.0
"""The planner against a slow twin that rolls out every candidate alone, in plain Python.

The mock model turns an image and actions into images by arithmetic on its pixels, so that every frame tells exactly
from which observation and by which actions it was imagined.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wiw import action
from wiw._core import planner
from wiw.errors import ArgumentError

HEIGHT, WIDTH = 4, 16  # one column a turn of 22.5 degrees
MAKER = planner.ViewMaker("panorama", (HEIGHT, WIDTH))

primitives = st.sampled_from([1, 1, 1, 2, 3, 4, 0])
plans = st.lists(primitives, max_size=9)
episodes = st.lists(st.lists(plans, max_size=6), min_size=1, max_size=4)
models = st.builds(
    dict,
    causal=st.booleans(),
    frames=st.sampled_from([0, 2, 4, 14]),
    padding=st.sampled_from(["forward", "repeat", "null"]),
    leading=st.sampled_from(["same_direction", "any", "none"]),
    max_rows=st.sampled_from([0, 1, 3]),
)


def mix(image, *numbers):
    """An image that depends on every pixel's old value and on the numbers."""
    mixed = image.astype(np.int64)
    for number in numbers:
        mixed = (mixed * 31 + 7 * number + 11) % 251
    return mixed.astype(np.uint8)


def imagine(image, actions, causal):
    """Frames 0..K of one row. A model that looks ahead lets the whole plan show in each frame."""
    frames = [image]
    for k in range(1, len(actions) + 1):
        seen = actions[:k] if causal else actions
        frames.append(mix(image, k, len(seen), *(int(a) + 1 for a in seen)))
    return np.stack(frames)


def split(plan, leading):
    """Leading turns as the paper's agent sees them: by turning in place on the spot."""
    rolled, net = [], 0
    for a in plan:
        turn = {2: 1, 3: -1}.get(a, 0)
        reverses = leading == "same_direction" and turn * net < 0
        if leading == "none" or a == 1 or reverses:
            break
        net += turn
        rolled.append(net)
    return rolled, net, plan[len(rolled) :]


def brute_force(panorama, plan, model):
    """What the agent would see, one step after another, with nothing shared and nothing batched."""
    rolled, net, rest = split(plan, model["leading"])
    views = [np.roll(panorama, turns, axis=1) for turns in rolled]
    image = np.roll(panorama, net, axis=1)
    steps = model["frames"] - 1 if model["frames"] else max(len(rest), 1)
    for begin in range(0, len(rest), steps):
        piece = rest[begin : begin + steps]
        padded = piece if not model["frames"] else list(action.pad(piece, steps, model["padding"]))
        frames = imagine(image, padded, model["causal"])
        views += list(frames[1 : len(piece) + 1])
        image = frames[-1]
    return views


def roll_out(batch, panoramas, model):
    """The loop: one call a part. Frames that an earlier row answers are left as noise."""
    observations = batch.observations(panoramas, MAKER)
    rollouts = []
    for part in batch.parts:
        assert model["max_rows"] == 0 or len(part.rows) <= model["max_rows"]
        starts = observations[part.rows] if part.first == 0 else [rollouts[p][i, f] for p, i, f in part.start]
        frames = np.stack([imagine(s, a, model["causal"]) for s, a in zip(starts, part.actions, strict=True)])
        for row, shared in zip(frames, part.shared, strict=True):
            row[1 : shared + 1] = np.random.default_rng(0).integers(0, 256, row[1 : shared + 1].shape)
        rollouts.append(frames)
    return rollouts


def panoramas_of(count):
    return np.random.default_rng(5).integers(0, 251, (count, HEIGHT, WIDTH, 3), dtype=np.uint8)


@settings(max_examples=300, deadline=None)
@given(episodes, models)
def test_every_candidate_sees_what_it_would_see_alone(plans, model):
    panoramas = panoramas_of(len(plans))
    batch = planner.Batch.build(plans, planner.ModelSpec(**model))
    rollouts = roll_out(batch, panoramas, model)
    views = batch.views(panoramas, rollouts, MAKER)
    distinct = batch.distinct_views(panoramas, rollouts, MAKER)
    flat = [(episode, plan) for episode, candidates in enumerate(plans) for plan in candidates]
    assert batch.candidates == len(flat)
    for n, (episode, plan) in enumerate(flat):
        wanted = brute_force(panoramas[episode], plan, model)
        assert batch.lengths[n] == len(wanted) == len(plan)
        assert batch.candidate_episode[n] == episode
        assert batch.real[n].sum() == len(split(plan, model["leading"])[0])
        for k, image in enumerate(wanted):
            np.testing.assert_array_equal(views[n, k], image)
            np.testing.assert_array_equal(distinct[batch.view_index[n, k]], image)
        assert not views[n, len(wanted) :].any()
        assert (batch.view_index[n, len(wanted) :] == -1).all()


@settings(max_examples=200, deadline=None)
@given(episodes, models)
def test_nothing_is_asked_twice(plans, model):
    batch = planner.Batch.build(plans, planner.ModelSpec(**model))
    asked = set()
    rests = {}
    for n, plan in enumerate(itertools.chain.from_iterable(plans)):
        _, net, rest = split(plan, model["leading"])
        if rest:
            rests.setdefault((batch.candidate_episode[n], net % 16), set()).add(tuple(rest))
    for r in range(batch.rows):
        key = (batch.row_episode[r], batch.row_turns[r] % 16)
        owner = list(itertools.chain.from_iterable(plans))[batch.row_owner[r]]
        rest = tuple(split(owner, model["leading"])[2])
        assert rest in rests[key]
        assert (key, rest) not in asked
        if model["causal"]:
            assert not any(len(o) > len(rest) and o[: len(rest)] == rest for o in rests[key])
        asked.add((key, rest))
        assert batch.row_length[r] == len(rest)
        assert batch.row_parent[r] < r
    assert batch.rows <= sum(map(len, rests.values()))


@settings(max_examples=100, deadline=None)
@given(episodes, models)
def test_controls_of_a_part_say_the_same_in_every_form(plans, model):
    batch = planner.Batch.build(plans, planner.ModelSpec(**model))
    for part in batch.parts:
        assert part.actions.shape == (len(part.rows), part.steps)
        np.testing.assert_array_equal(part.trajectories, action.to_trajectory(part.actions))
        np.testing.assert_array_equal(part.viewpoints, action.to_viewpoints(part.actions))
        assert (part.shared <= part.length).all()
        assert (part.length <= part.steps).all()
        if not model["causal"] and not model["frames"]:
            assert (part.length == part.steps).all()  # padding would change what such a model imagines


def test_wrong_arguments_name_the_cure():
    with pytest.raises(ArgumentError, match="frames"):
        planner.ModelSpec(frames=1)
    with pytest.raises(ArgumentError, match="'forward', 'repeat' or 'null'"):
        planner.ModelSpec(padding="zeros")
    with pytest.raises(ArgumentError, match="'any', 'none', 'same_direction'"):
        planner.ModelSpec(leading="all")
    with pytest.raises(ArgumentError, match="unknown action 7"):
        planner.Batch.build([[[1, 7]]])
    with pytest.raises(ArgumentError, match="integers"):
        planner.Batch.build([[[0.5]]])


def test_rollouts_that_do_not_fit_are_refused():
    panoramas = panoramas_of(1)
    batch = planner.Batch.build([[[1, 1], [1, 2]]])
    frames = np.zeros((2, 3, HEIGHT, WIDTH, 3), np.uint8)
    assert batch.views(panoramas, [frames], MAKER).shape == (2, 2, HEIGHT, WIDTH, 3)
    with pytest.raises(ArgumentError, match="2 rows of 3 frames"):
        batch.views(panoramas, [frames[:, :2]], MAKER)
    with pytest.raises(ArgumentError, match="1 parts, got 0"):
        batch.views(panoramas, [], MAKER)
    for wrong in (frames.astype(np.float32), frames.tolist()):
        with pytest.raises(ArgumentError, match="uint8"):
            batch.views(panoramas, [wrong], MAKER)
    with pytest.raises(ArgumentError, match="one panorama an episode"):
        batch.views(panoramas[:0], [frames], MAKER)
    with pytest.raises(ArgumentError, match="one panorama an episode"):
        batch.observations(panoramas[:0], MAKER)
    with pytest.raises(ArgumentError, match=r"\[2, 2, 4, 16, 3\]"):
        batch.views(panoramas, [frames], MAKER, out=np.zeros(3, np.uint8))
    with pytest.raises(ArgumentError, match="panoramic model"):
        batch.views(panoramas, [frames], MAKER, frames="perspective")
    out = np.full((2, 2, HEIGHT, WIDTH, 3), 9, np.uint8)
    assert batch.views(panoramas, [frames], MAKER, out=out) is out
    assert not out.any()


def test_rollouts_may_be_views_of_other_arrays():
    panoramas = panoramas_of(1)
    batch = planner.Batch.build([[[1, 1], [1, 2]]])
    dense = np.random.default_rng(3).integers(0, 256, (2, 3, HEIGHT, WIDTH, 3), dtype=np.uint8)
    padded = np.zeros((2, 6, HEIGHT + 1, WIDTH, 3), np.uint8)
    padded[:, ::2, :HEIGHT] = dense
    reversed_rows = dense[::-1, ::-1].copy()[::-1, ::-1]
    channels_first = np.ascontiguousarray(dense.transpose(0, 1, 4, 2, 3)).transpose(0, 1, 3, 4, 2)
    wanted = batch.views(panoramas, [dense], MAKER)
    for rollout in (padded[:, ::2, :HEIGHT], reversed_rows, channels_first):
        np.testing.assert_array_equal(batch.views(panoramas, [rollout], MAKER), wanted)
    still = np.broadcast_to(dense[:, :1], dense.shape)
    np.testing.assert_array_equal(batch.views(panoramas, [still], MAKER)[:, 1], dense[:, 0])
