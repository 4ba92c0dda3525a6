# SPDX-License-Identifier: Apache-2.0
"""Observations draw what somebody looks at, and then just what would have been drawn at once."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import weakref

import numpy as np
import pytest

import wiw
from wiw._core import planner
from wiw.action import FORWARD, STOP, TURN_LEFT
from wiw.errors import ArgumentError
from wiw.loop.scheduler import run_episodes
from wiw.runs.rows import decision_row
from wiw.tasks.imagenav import ImageNav
from wiw.types import Key, Observation

NAMES = ("panorama", "front", "depth")


@pytest.fixture
def env(two_rooms):
    task = ImageNav(scenes=two_rooms)
    env = task.environment(depth=True)
    env.begin(task.episode(0))
    return env


def drawn(observation):
    return {name for name in NAMES if name in vars(observation)}


def test_pictures_of_a_place_stay_those_of_that_place(env):
    seen = env.observation
    twin = env._core.observe(list(NAMES))
    assert drawn(seen) == {"panorama", "depth"}
    env.run([FORWARD, TURN_LEFT])
    for name in NAMES:
        np.testing.assert_array_equal(getattr(seen, name), twin[name])
    assert drawn(seen) == set(NAMES) and seen.front is seen.front
    assert (env.observation.front != seen.front).any()


def test_the_last_observation_is_drawn_only_if_somebody_looks(env):
    segment = env.run([FORWARD, STOP])
    assert segment.terminated and not drawn(segment.observation)
    twin = env._core.observe(list(NAMES))
    np.testing.assert_array_equal(segment.observation.depth, twin["depth"])
    assert drawn(segment.observation) == {"panorama", "depth"}, "one look, one picture"
    for name, image in segment.observation.as_dict().items():
        np.testing.assert_array_equal(image, twin.get(name, image))


def test_without_depth_there_is_none(two_rooms):
    task = ImageNav(scenes=two_rooms)
    env = task.environment()
    assert env.begin(task.episode(0)).depth is None
    assert env.run([STOP]).observation.depth is None and Observation(*[np.zeros(3)] * 3).depth is None


@pytest.mark.parametrize(
    "duplicate", [copy.copy, copy.deepcopy, dataclasses.replace, lambda o: pickle.loads(pickle.dumps(o))]
)
def test_copies_are_drawn(env, duplicate):
    other = duplicate(env.observation)
    assert drawn(other) == set(NAMES) and "_outlook" not in vars(other)
    for name in NAMES:
        np.testing.assert_array_equal(getattr(other, name), getattr(env.observation, name))
    with pytest.raises(AttributeError, match="no attribute 'simulator'"):
        _ = env.observation.simulator


def test_an_observation_hands_out_no_simulator(env):
    outlook = vars(env.observation)["_outlook"]
    assert [name for name in dir(outlook) if not name.startswith("_")] == ["draw"] and not hasattr(outlook, "__dict__")
    with pytest.raises(TypeError):
        type(outlook)()


def test_a_policy_that_reads_panoramas_costs_no_front_views(env):
    decision = wiw.Agent("matcher", "warp").decide(env.observation, env.goal, Key(0, 0))
    assert decision.observation is env.observation and drawn(env.observation) == {"panorama", "depth"}


def test_pictures_are_kept_without_front_views(two_rooms):
    task, seen, pictures = ImageNav(scenes=two_rooms, decisions=2), [], []

    class Sink:
        def decision(self, record):
            pictures.append(dict(decision_row("none", record, with_images=True).images))
            seen.append(drawn(record.decision.observation))

        def episode(self, result):
            assert result.status == "done", result.error

    run_episodes(task, wiw.Agent("matcher"), [(0, task.episode(0))], seed=0, live=1, sink=Sink())
    assert [set(each) for each in pictures] == [{"panorama", "goal"}, {"panorama"}]
    assert seen == [{"panorama", "depth"}] * 2


def test_what_was_observed_goes_before_the_next_is(two_rooms):
    """At most one decision of all live episodes is held while others are carried out."""
    task, held, most = ImageNav(scenes=two_rooms, decisions=2), [], []

    class Sink:
        def decision(self, record):
            held.append(weakref.ref(record.decision))
            most.append(sum(one() is not None for one in held))

        def episode(self, result):
            assert result.status == "done", result.error

    agent = wiw.Agent("matcher", candidates=1, horizon=2)
    run_episodes(task, agent, list(enumerate(task.episodes(4))), seed=0, live=4, sink=Sink())
    assert len(most) == 8 and max(most) <= 2


def test_planner_takes_panoramas_wherever_they_lie():
    rng = np.random.default_rng(0)
    panoramas = rng.integers(0, 256, (3, 32, 64, 3), np.uint8)
    distances = rng.random((3, 32, 64), np.float32)
    plans = [[np.array([TURN_LEFT, FORWARD, FORWARD], np.int8), np.array([FORWARD], np.int8)]] * 3
    batch, maker = planner.Batch.build(plans), planner.ViewMaker("panorama", (16, 32))
    scattered, apart = [panoramas[0].copy(), panoramas[1], panoramas[2][::-1, :][::-1, :]], list(distances.copy())
    np.testing.assert_array_equal(batch.observations(scattered, maker), batch.observations(panoramas, maker))
    np.testing.assert_array_equal(batch.depths(apart, maker), batch.depths(distances, maker))
    frames = [
        np.repeat(batch.observations(panoramas, maker)[part.rows, None], part.steps + 1, 1) for part in batch.parts
    ]
    np.testing.assert_array_equal(batch.views(scattered, frames, maker), batch.views(panoramas, frames, maker))
    np.testing.assert_array_equal(
        batch.ends([1, 4], scattered, frames, maker), batch.ends([1, 4], panoramas, frames, maker)
    )
    flipped = [one[:, ::-1] for one in panoramas]
    np.testing.assert_array_equal(
        batch.observations(flipped, maker), batch.observations(np.ascontiguousarray(panoramas[:, :, ::-1]), maker)
    )
    for wrong in (
        [panoramas[0], panoramas[1][:16], panoramas[2]],
        [*panoramas[:2], distances[2]],
        [*panoramas[:2], None],
        panoramas[:2],
        panoramas.astype(np.float32),
    ):
        with pytest.raises(ArgumentError, match=r"panoramas uint8 \[episodes, H, W, 3\]|one panorama an episode"):
            batch.observations(wrong, maker)
    with pytest.raises(ArgumentError, match=r"distances float32 \[episodes, H, W\]"):
        batch.depths(panoramas, maker)
