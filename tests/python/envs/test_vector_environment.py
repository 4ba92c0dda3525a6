# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import wiw
from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT
from wiw.datasets import episodes as episode_files
from wiw.errors import ArgumentError
from wiw.tasks.imagenav import ImageNav
from wiw.types import Episode, Key

PLACES = 3


def make(scenes: str, places: int = PLACES, depth: bool = True, **rules):
    return wiw.make_vec("ImageNav-v0", places, depth=depth, scenes=scenes, seed=3, **rules)


def walk(steps: int, places: int = PLACES) -> np.ndarray:
    """Forward, left or right for each step and place."""
    return np.random.default_rng(0).integers(int(FORWARD), int(STOP), (steps, places))


def test_it_sees_what_single_environments_see(two_rooms: str) -> None:
    vector = make(two_rooms)
    singles = [vector.task.environment(depth=True) for _ in range(PLACES)]
    observations, infos = vector.reset()
    expected = [env.reset(options={"episode": i})[0] for i, env in enumerate(singles)]
    assert list(infos["key"]) == [Key(3, i) for i in range(PLACES)]
    for actions in walk(12):
        assert vector.observation_space.contains(observations)
        for i in range(PLACES):
            assert expected[i].keys() == observations.keys()
            for name, values in expected[i].items():
                np.testing.assert_array_equal(values, observations[name][i])
                assert values.dtype == observations[name].dtype
        observations, rewards, terminated, truncated, infos = vector.step(actions)
        stepped = [env.step(int(action)) for env, action in zip(singles, actions, strict=True)]
        expected = [step[0] for step in stepped]
        assert [(s[1], s[2], s[3]) for s in stepped] == list(zip(rewards, terminated, truncated, strict=True))
        if terminated.any():
            break
        assert infos["key"].tolist() == [step[4]["key"] for step in stepped]
        np.testing.assert_array_equal(vector.truth(1).position, singles[1].truth().position)
        np.testing.assert_array_equal(vector.render()[2], singles[2].render())
    for goal, env in zip(vector.goals, singles, strict=True):
        np.testing.assert_array_equal(goal.image, env.goal.image)


def test_an_episode_that_ends_starts_over_at_the_next_step(two_rooms: str) -> None:
    vector = make(two_rooms, decisions=2)  # 6 primitives
    assert vector.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    vector.reset()
    turn, stop = int(TURN_LEFT), int(STOP)
    observations, rewards, terminated, truncated, infos = vector.step([turn, stop, turn])
    assert terminated.tolist() == [False, True, False] and not truncated.any() and not rewards.any()
    assert infos["_result"].tolist() == [False, True, False] and infos["result"]["success"][1] == 0
    before = vector.goals

    observations, rewards, terminated, truncated, infos = vector.step([turn, stop, turn])
    assert not terminated.any() and "result" not in infos  # the stop was ignored
    assert infos["key"].tolist() == [Key(3, 0, 2), Key(3, PLACES), Key(3, 2, 2)]
    alone, _ = vector.task.environment(depth=True).reset(options={"episode": PLACES})
    for name, values in alone.items():
        np.testing.assert_array_equal(values, observations[name][1])
    assert [now is then for now, then in zip(vector.goals, before, strict=True)] == [True, False, True]

    ends = []
    for step in range(3, 12):
        _, _, terminated, truncated, infos = vector.step([turn] * PLACES)
        ends += [(step, int(place)) for place in np.flatnonzero(truncated)]
        if truncated.any():
            assert not terminated.any() and infos["_result"].tolist() == truncated.tolist()
    # Six primitives an episode and one step to start over; place 1 began its second episode at step 2.
    assert ends == [(6, 0), (6, 2), (8, 1)]


def test_reaching_the_goal_is_rewarded(two_rooms: str) -> None:
    vector = make(two_rooms, places=2)
    near = Episode("t", two_rooms, (2.0, 0.0, 1.0), -np.pi / 2, (3.0, 0.0, 1.0), 0.0, 1.0)
    vector.task.episode = lambda index: near
    vector.reset()
    for _ in range(3):  # 1 m away: after 0.6 m the agent is within 0.5 m
        _, rewards, terminated, _, infos = vector.step([FORWARD, TURN_LEFT])
    assert rewards.tolist() == [1.0, 0.0] and terminated.tolist() == [True, False]
    assert infos["result"]["success"][0] == 1 and vector.result(0)["actions"] == 3


def test_episodes_can_be_named_or_drawn(two_rooms: str) -> None:
    vector = make(two_rooms, depth=False)
    observations, infos = vector.reset(options={"episode": [4, 0, 2]})
    assert [key.episode for key in infos["key"]] == [4, 0, 2] and "depth" not in observations
    drawn = [[key.episode for key in vector.reset(seed=seed)[1]["key"]] for seed in (7, 7, 8)]
    assert drawn[0] == drawn[1] != drawn[2]


def test_after_the_last_episode_the_next_is_one_that_nobody_has_begun(two_rooms: str, tmp_path: Path) -> None:
    file = tmp_path / "four.json"
    episode_files.save(file, ImageNav(scenes=two_rooms, seed=3).episodes(4), "imagenav")
    vector = wiw.make_vec("ImageNav-v0", PLACES, depth=False, episode_file=file)
    _, infos = vector.reset(options={"episode": [3, 4, 5]})
    assert [key.episode for key in infos["key"]] == [3, 0, 1]
    vector.step([int(STOP), int(TURN_LEFT), int(TURN_LEFT)])
    *_, infos = vector.step([int(TURN_LEFT)] * PLACES)
    assert infos["key"][0].episode == 2


def test_what_has_been_in_sight_is_that_of_every_place(two_rooms: str) -> None:
    vector, alone = make(two_rooms, places=2, depth=False), make(two_rooms).task.environment()
    vector.reset(), alone.reset(options={"episode": 1})
    for actions in ([FORWARD, TURN_LEFT], [TURN_RIGHT, FORWARD]):
        vector.step(np.array(actions, int))
        alone.step(int(actions[1]))
    assert vector._states[1].observed == alone.state.observed == [0, 1, 2]


def test_no_privileged_truth_in_observations_and_infos(two_rooms: str) -> None:
    """Other starts and goals must not change a bit of what is handed out, but for the pixels."""
    seen = []
    for start, goal in (((-2.0, 0.0, 0.5), (3.0, 0.0, 1.0)), ((2.5, 0.0, 0.5), (-3.0, 0.0, 1.0))):
        vector = make(two_rooms, places=2)
        episode = Episode("t", two_rooms, start, 0.4, goal, 0.0, 5.0)
        vector.task.episode = lambda index, episode=episode: episode
        observations, infos = vector.reset()
        handed = [(observations["odometry"].tobytes(), repr(infos))]
        for actions in ([TURN_LEFT, TURN_RIGHT], [FORWARD, TURN_LEFT], [TURN_RIGHT, TURN_RIGHT]):
            observations, *outcome, infos = vector.step(actions)
            handed.append((observations["odometry"].tobytes(), repr((outcome, infos))))
        assert set(observations) == {"panorama", "front", "odometry", "depth"}
        seen.append((handed, vector.truth(0).position))
    assert seen[0][0] == seen[1][0]
    assert not np.array_equal(seen[0][1], seen[1][1])


def test_a_fork_moves_alone(two_rooms: str) -> None:
    vector = make(two_rooms)
    vector.reset()
    before = vector.truth(1).position
    vector.fork(1).step(int(wiw.action.FORWARD))
    np.testing.assert_array_equal(vector.truth(1).position, before)


def test_wrong_use_says_what_was_expected(two_rooms: str) -> None:
    vector = make(two_rooms)
    for use in (lambda: vector.step([1] * PLACES), vector.render, lambda: vector.truth(0), lambda: vector.goals):
        with pytest.raises(ArgumentError, match="reset"):
            use()
    vector.reset()
    for actions in ([1, 1], [1, 1, 5], [1, 1, 0], [1.0, 1.0, 1.0]):
        with pytest.raises(ArgumentError, match="expected 3 actions from 1 to 4"):
            vector.step(actions)
    with pytest.raises(ArgumentError, match="expected 3 episodes, got 1"):
        vector.reset(options={"episode": [1]})
    for episodes in (3, [[1, 2, 3]], "abc"):
        with pytest.raises(ArgumentError, match="expected a list of 3 episodes, one for each place"):
            vector.reset(options={"episode": episodes})
    with pytest.raises(ArgumentError, match=r"whole number of at least 0, got 1\.5"):
        vector.reset(options={"episode": [0, 1, 1.5]})
    with pytest.raises(ArgumentError, match="num_envs"):
        make(two_rooms, places=0)


def test_the_core_takes_whole_primitives_only(two_rooms: str) -> None:
    vector = make(two_rooms, 2, depth=False)
    vector.reset()
    core = vector._core
    before = core[0].T_world_camera
    for wrong in ([258, 258], [2.9, 2.0], [-1, 1], [2**40, 1], [1], [[1, 2]], "12"):
        with pytest.raises(ArgumentError):
            core.step(wrong)
        with pytest.raises(ArgumentError):
            core[0].camera_poses_after([wrong, wrong] if wrong == [1] else wrong)
    np.testing.assert_array_equal(core[0].T_world_camera, before)
    for ids in ([2, 3], np.array([2, 3], np.uint8), np.array([2, 3])):
        assert core[0].camera_poses_after(ids).shape == (2, 4, 4)
        assert core.step(ids).tolist() == [True, True]
    assert core[0].camera_poses_after([]).shape == (0, 4, 4)
