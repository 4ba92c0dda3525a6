# SPDX-License-Identifier: Apache-2.0
"""World models that draw in several sizes are asked for the one that the reviser of their frames needs."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fakes import LineAgent, LineTask

import wiw
from wiw import benchmark
from wiw.action import FORWARD, TURN_LEFT
from wiw.errors import ArgumentError, RemoteError, StoreError
from wiw.experiments.fidelity import FidelityObserver
from wiw.isolation.models import IsolatedModel
from wiw.loop.attempts import Attempted
from wiw.loop.clock import Clock
from wiw.loop.imagination import ModelInput, Request
from wiw.loop.plan_space import plan_space
from wiw.loop.rollout_cache import Cached, RolloutCache
from wiw.policies.base import FrameSpec, Policy
from wiw.policies.matcher.policy import SOURCE, Matcher
from wiw.runs.merge import merge
from wiw.runs.store import RunStore
from wiw.runs.store_file import store_path
from wiw.serving.background import serve_in_background
from wiw.studies.model_check import examine_model
from wiw.tasks.imagenav import ImageNav
from wiw.types import Conditioning, Control, Key, Proposal
from wiw.wire.rows import pack_row, unpack_row
from wiw.world_models.copy import Copy
from wiw.world_models.oracle import Oracle
from wiw.world_models.remote.declaration import declaration, parse_declaration
from wiw.world_models.remote.limits import check_row
from wiw.world_models.remote.model import Remote
from wiw.world_models.warp import Warp

PLANS = ([FORWARD] * 3, [TURN_LEFT, FORWARD, TURN_LEFT], [FORWARD, TURN_LEFT, FORWARD])
RANGE = wiw.accepts("image", size=(96, 192), smallest=(24, 48))


class Shrinking(Copy):
    """Repeats the observation, in any size; notes the sizes that it is asked for."""

    accepts = RANGE

    def __init__(self):
        self._asked = []

    def rollout(self, observations, controls, seeds):
        self._asked.append(observations.image.shape[1:3])
        return np.array(super().rollout(observations, controls, seeds))


class Stubborn(Copy):
    """Declares a range of sizes, and answers in one."""

    accepts = RANGE

    def rollout(self, observations, controls, seeds):
        large = np.stack([cv2.resize(image, RANGE.size[::-1]) for image in observations.image])
        return np.repeat(large[:, None], 1 + len(controls[0].actions), 1)


class Reader(Policy):
    """Proposes fixed plans and prefers bright futures; looks at small panoramas."""

    frames = FrameSpec("panorama", (16, 32), source_size=(40, 80))

    def propose(self, situations, candidates, horizon):
        return [[Proposal(plan[:horizon]) for plan in PLANS[:candidates]] for _ in situations]

    def score(self, situations, proposals, rollouts):
        return [np.array([float(one.frames.mean()) for one in rows]) for rows in rollouts]


class Viewer(Reader):
    """Says nothing of the sizes that it needs."""

    frames = FrameSpec("panorama", (16, 32))


@pytest.fixture(scope="module")
def moments(two_rooms):
    """Two episodes' first moments, with depth and a simulator."""
    task = ImageNav(scenes=two_rooms)
    envs = [task.environment(depth=True) for _ in range(2)]
    observations = [env.begin(task.episode(index)) for index, env in enumerate(envs)]
    return [ModelInput(seen, env.fork()) for seen, env in zip(observations, envs, strict=True)]


def imagine(model, moments, frames):
    keys, plans = [Key(0, index) for index in range(len(moments))], [Proposal(np.array(plan)) for plan in PLANS]
    observations = [own.observation for own in moments]
    space, origins = plan_space("discrete"), [range(len(plans))] * len(keys)
    request = Request(space, keys, observations, moments, [plans] * len(keys), origins, frames, Clock())
    return space.imagine(Attempted(model), request)


def decide(agent, moments):
    first = moments[0]
    goal = wiw.types.Goal("look", image=np.zeros((48, 48, 3), np.uint8))
    return agent.decide(first.observation, goal, Key(0, 0), simulator=first.simulator)


@pytest.mark.parametrize(
    ("asked", "size"),
    [(None, (96, 192)), ((40, 80), (40, 80)), ((8, 80), (24, 80)), ((500, 500), (96, 192)), ((1, 1), (24, 48))],
)
def test_the_nearest_size_of_the_range_is_asked_for(asked, size):
    assert RANGE.fit_size(asked) == size and RANGE.takes_size(size)
    fitted = RANGE.at_size(asked)
    assert fitted.size == size and not fitted.is_scalable and fitted == replace(RANGE, size=size, smallest=None)
    fixed = wiw.accepts("image", size=(30, 40))
    assert fixed.fit_size(asked) == (30, 40) and not fixed.takes_size((30, 39)) and fixed.at_size(asked) == fixed


@pytest.mark.parametrize(
    "declared",
    [
        *({"smallest": smallest} for smallest in ((0, 10), (97, 10), (10,), 10, (9.5, 9))),
        {"smallest": (9, 9), "view": "perspective"},
    ],
)
def test_a_range_that_is_none_is_refused(declared):
    with pytest.raises(ArgumentError, match="smallest"):
        wiw.accepts("image", size=(96, 192), **declared)


@pytest.mark.parametrize(
    ("policy", "reviser", "numbers", "size"),
    [
        (Reader, None, {}, (40, 80)),
        (Viewer, None, {}, (96, 192)),
        (Viewer, Reader, {}, (40, 80)),
        (Viewer, Reader, {"depth": 2, "width": 1}, (96, 192)),
        (Reader, Matcher, {"depth": 2, "width": 1}, (96, 192)),  # what is enough for both, up to the model's largest
    ],
    ids=["reader", "viewer", "proposer", "deeper", "both"],
)
def test_the_loop_asks_for_what_is_enough_for_all_who_look(moments, policy, reviser, numbers, size):
    model = Shrinking()
    chosen = None if reviser is None else reviser()
    agent = wiw.Agent(policy(), model, chosen, candidates=2, horizon=2, **numbers)
    decision = decide(agent, moments)
    assert set(model._asked) == {size} and agent.describe()["model_size"] == size
    shown = agent.reviser.frames.size
    assert all(one.frames.shape[1:3] == shown for one in decision.rollouts)


def test_a_size_that_the_user_names_and_a_model_of_one_size_stay(moments):
    for model in (Warp(size=(72, 128)), Oracle(size=(72, 128))):
        agent = wiw.Agent(Reader(), model)
        assert agent.model.accepts.at_size(agent.parts.frames.source_size).size == (72, 128)
        assert "model_size" not in agent.describe() and agent.describe()["model"]["size"] == (72, 128)
    assert wiw.Agent("matcher", "warp").describe()["model_size"] == SOURCE
    assert wiw.Agent("matcher", "none").describe().keys() & {"model_size"} == set()


@pytest.mark.parametrize("make", [Warp, Oracle], ids=["warp", "oracle"])
def test_smaller_frames_are_those_of_a_model_of_that_size(moments, make):
    size = (72, 128)
    asked = imagine(make(), moments, FrameSpec("panorama", (36, 64), source_size=size))
    fixed = imagine(make(size=size), moments, FrameSpec("panorama", (36, 64)))
    full = imagine(make(), moments, FrameSpec("panorama", (36, 64)))
    assert asked.source_size == size and fixed.source_size is None and full.source_size == (576, 1024)
    for own, twin, large in zip(asked.rollouts, fixed.rollouts, full.rollouts, strict=True):
        for one, other, fine in zip(own, twin, large, strict=True):
            np.testing.assert_array_equal(one.frames, other.frames)
            off = np.abs(one.frames.astype(int) - fine.frames)
            assert off.mean() < 4, "the same views, with fewer rays"
    assert any((one.frames != fine.frames).any() for one, fine in zip(asked.rollouts[0], full.rollouts[0], strict=True))


def test_true_futures_are_drawn_in_the_size_of_those_that_they_are_compared_with(moments):
    agent = wiw.Agent(Reader(), "oracle", observers=[FidelityObserver()])
    decision = decide(agent, moments)
    for imagined, true in zip(decision.rollouts, decision.fidelity.rollouts, strict=True):
        np.testing.assert_array_equal(imagined.frames, true.frames)


def test_the_cache_tells_sizes_apart(moments, tmp_path):
    cached = Cached(Warp(), RolloutCache(tmp_path))
    for size, rows in ((SOURCE, 0), ((72, 128), 0), (SOURCE, 1)):
        before = cached.spent.get("cached_rows", 0)
        asked = imagine(cached, moments[:1], FrameSpec("panorama", (36, 64), source_size=size))
        twin = imagine(Warp(), moments[:1], FrameSpec("panorama", (36, 64), source_size=size))
        for one, other in zip(asked.rollouts[0], twin.rollouts[0], strict=True):
            np.testing.assert_array_equal(one.frames, other.frames)
        assert (cached.spent.get("cached_rows", 0) > before) == bool(rows)


def conditioning(size):
    rng = np.random.default_rng(0)
    return Conditioning(rng.integers(0, 256, (2, *size, 3), np.uint8), depth=np.full((2, *size), 2, np.float32))


def controls(length=2):
    poses = np.tile(np.eye(4), (length, 1, 1))
    poses[:, 2, 3] = -0.2 * np.arange(1, length + 1)
    return [Control(np.full(length, FORWARD, np.int8), np.zeros((length, 3)), poses, length=length)] * 2


def test_a_served_model_draws_in_its_range_of_sizes():
    assert parse_declaration(declaration(Warp.accepts)) == Warp.accepts
    seeds = np.zeros(2, np.uint64)
    with serve_in_background(Warp()) as server:
        client = Remote(server.address)
        try:
            assert client.accepts.smallest == Warp.accepts.smallest
            for size in ((36, 64), (48, 80)):
                asked = conditioning(size), controls(), seeds
                np.testing.assert_array_equal(client.rollout(*asked), Warp().rollout(*asked))
        finally:
            client.close()


@pytest.mark.parametrize("size", [(8, 64), (600, 1024), (36, 2048)])
def test_rows_of_other_sizes_are_refused_by_the_server(size):
    row = unpack_row(pack_row(conditioning(size), 0, controls()[0], 0))
    with pytest.raises(RemoteError, match=r"row\.image: expected \(16, 32\) to \(576, 1024\) pixels"):
        check_row(row, Warp.accepts)
    crooked = replace(row, image=np.zeros((36, 64, 3), np.uint8))
    with pytest.raises(RemoteError, match=r"row\.depth: expected \(36, 64\) pixels"):
        check_row(crooked, Warp.accepts)


def test_a_model_in_a_process_of_its_own_and_its_check(two_rooms):
    name = f"{Path(__file__)}:Shrinking"
    model = wiw.world_model(name)
    assert isinstance(model, IsolatedModel) and model.accepts == RANGE
    for size in ((24, 48), (33, 60)):
        asked = conditioning(size), controls(), np.zeros(2, np.uint64)
        np.testing.assert_array_equal(model.rollout(*asked), Shrinking().rollout(*asked))
    model.close()
    checks = {each.name: each for each in examine_model(Stubborn, two_rooms)}
    (finding,) = checks["size"].findings
    assert finding.kind == "shape" and "(24, 48, 3)" in finding.text.replace("6, 5, ", "")
    assert {each.name: each for each in examine_model(Shrinking, two_rooms)}["size"].result == "passed"
    assert {each.name: each for each in examine_model("copy", two_rooms, space="pose7")}["size"].skipped


@pytest.fixture
def old_run(tmp_path):
    """A run that was made before versions of the benchmark were recorded."""
    folder = tmp_path / "old"
    wiw.evaluate(LineTask().environment(), LineAgent(), episodes=2, out=folder, progress=False)
    with sqlite3.connect(store_path(folder)) as store:
        store.execute("UPDATE run SET info = json_remove(info, '$.benchmark')")
    return folder


def test_runs_of_another_version_can_be_read_and_not_mixed(old_run, tmp_path):
    new = tmp_path / "new"
    wiw.evaluate(LineTask().environment(), LineAgent(), episodes=2, out=new, progress=False)
    with RunStore.read(new) as store:
        assert store.benchmark == benchmark.VERSION and store.info["benchmark"] == benchmark.VERSION
    log = wiw.load_run(old_run)
    assert log.store.benchmark == 1 and len(log.episodes) == 2
    refused = rf"version 1 of the benchmark.*version {benchmark.VERSION}"
    with pytest.raises(StoreError, match=refused):
        RunStore.resume(old_run)
    with pytest.raises(StoreError, match=refused):
        wiw.verify(old_run)
    with pytest.raises(StoreError, match=f"benchmark is 1 in the first and {benchmark.VERSION} in the second"):
        wiw.compare(old_run, new)
    with pytest.raises(StoreError, match=f"benchmark: 1 and {benchmark.VERSION}"):
        merge([old_run, new], tmp_path / "merged")
