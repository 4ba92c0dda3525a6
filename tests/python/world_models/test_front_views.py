# SPDX-License-Identifier: Apache-2.0
"""Models that are asked for front views in place of panoramas draw what the front camera sees."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from fakes import agent_for

import wiw
from wiw.action import FORWARD, TURN_LEFT, to_trajectory, to_viewpoints
from wiw.errors import ArgumentError
from wiw.types import Conditioning, Control
from wiw.world_models.base import check_rollout
from wiw.world_models.warp import Warp

SIZE = (96, 96)


def imagine(scene: str, model: Any) -> tuple[list[Any], Any]:
    """Return the rollouts of a decision, and the environment that it was taken in."""
    env = wiw.make("ImageNav-v0", scenes=scene, seed=1)
    _, info = env.reset(options={"episode": 0})
    agent = agent_for(env.unwrapped.task, wiw.Agent("heuristic", model, "matcher", candidates=3, horizon=4))
    decision = agent.decide(env.unwrapped.observation, env.unwrapped.goal, info["key"], simulator=env.unwrapped.fork())
    assert decision.rollouts is not None
    return list(zip(decision.proposals, decision.rollouts, strict=True)), env


def test_front_views_are_those_of_the_front_camera(two_rooms: str) -> None:
    errors = {}
    for name in ("oracle", "warp"):
        model = wiw.world_model(name, view="perspective", size=SIZE)
        assert model.accepts.view == "perspective" and model.accepts.size == SIZE
        plans, env = imagine(two_rooms, model)
        plan, rollout = next((p, r) for p, r in plans if not r.real[-1])
        assert rollout.view == "front" and rollout.frames.shape[1:3] == (384, 384)
        before = env.unwrapped.observation.front
        env.unwrapped.run(plan.actions)
        seen, same, drawn = (
            cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA).astype(float)
            for image in (env.unwrapped.observation.front, before, rollout.frames[-1])
        )
        errors[name] = float(np.abs(drawn - seen).mean())
        assert errors[name] < 0.5 * float(np.abs(same - seen).mean()), "better than nothing moving"
    assert errors["oracle"] < 6 and errors["oracle"] <= errors["warp"]


def test_manifests_name_view_and_size_only_where_they_are_chosen() -> None:
    for name in ("oracle", "warp"):
        plain, small = wiw.world_model(name), wiw.world_model(name, size=(64, 128))
        assert plain.describe().keys() & {"view", "size"} == set() and plain.accepts.size == (576, 1024)
        assert small.describe()["size"] == (64, 128) and small.accepts.size == (64, 128)
    with pytest.raises(ArgumentError, match="expected front views"):
        wiw.world_model("oracle", space="pose7", view="panorama")


def test_a_front_view_of_what_lies_behind_is_black_and_keeps_the_contract() -> None:
    plan = np.array([FORWARD, *[TURN_LEFT] * 6], np.int8)
    behind = Control(plan, to_trajectory(plan), to_viewpoints(plan), length=len(plan), shared=len(plan) - 1)
    image = np.random.default_rng(0).integers(60, 200, (1, *SIZE, 3), np.uint8)
    seen = Conditioning(image, depth=np.full((1, *SIZE), 2, np.float32))
    frames = check_rollout(Warp("perspective", SIZE), seen, [behind], np.zeros(1, np.uint64))
    assert not frames[0, -1].any()


def test_a_chosen_size_or_view_draws_no_random_numbers_either() -> None:
    for options in ({"view": "perspective"}, {"size": (64, 128)}):
        for name in ("oracle", "warp"):
            assert not wiw.world_model(name, **options).accepts.seeded
