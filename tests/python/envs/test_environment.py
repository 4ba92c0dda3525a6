# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import wiw.datasets.imagenav
import wiw.tasks.navigation
from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT
from wiw.datasets import episodes as episode_files
from wiw.datasets.cameras import camera_pose
from wiw.datasets.imagenav import ideal_primitives
from wiw.errors import ArgumentError
from wiw.tasks.imagenav import ImageNav
from wiw.types import Episode


@pytest.fixture
def env(two_rooms: str):
    return wiw.make("ImageNav-v0", scenes=two_rooms, seed=3)


def start_at(env, position, yaw, goal=(3.0, 0.0, 1.0)):
    episode = Episode("t", env.task.scenes, position, yaw, goal, 0.0, 5.0)
    env.begin(episode)
    return env


def test_gymnasium_accepts_it(env) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box.*(high|low).*infinity.*")
        warnings.filterwarnings("ignore", message=".*spec.*")
        warnings.filterwarnings("ignore", message=".*not an image.*|.*flatten.*")
        check_env(env, skip_render_check=True)


def test_observations_have_the_documented_shapes(two_rooms: str) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms, seed=3).task.environment(depth=True)
    observation, info = env.reset(options={"episode": 0})
    assert {k: (v.shape, v.dtype) for k, v in observation.items()} == {
        "panorama": ((576, 1024, 3), np.uint8),
        "front": ((480, 480, 3), np.uint8),
        "odometry": ((3,), np.float64),
        "depth": ((576, 1024), np.float32),
    }
    assert env.observation_space.contains(observation)
    assert info["key"] == wiw.types.Key(3, 0)
    assert env.goal.image.shape == (480, 480, 3)


def test_forward_is_twenty_centimetres_and_sixteen_turns_are_a_circle(env) -> None:
    start_at(env, (-2.0, 0.0, 0.5), 0.3)
    before = env.truth()
    env.run([FORWARD])
    moved = env.truth().position - before.position
    np.testing.assert_allclose(np.linalg.norm(moved), 0.2, atol=1e-5)
    np.testing.assert_allclose(moved[[0, 2]], [-0.2 * np.sin(0.3), -0.2 * np.cos(0.3)], atol=1e-5)
    env.run([TURN_LEFT] * 16)
    assert env.truth().yaw == before.yaw


def test_odometry_is_the_way_since_the_start(env) -> None:
    start_at(env, (-2.0, 0.0, 0.5), 1.1)
    segment = env.run([FORWARD, TURN_LEFT, TURN_LEFT, FORWARD])
    expected = wiw.action.to_trajectory([FORWARD, TURN_LEFT, TURN_LEFT, FORWARD])[-1]
    np.testing.assert_allclose(segment.observation.odometry, expected, atol=1e-4)


@pytest.mark.parametrize("motion", ["refuse", "slide"])
def test_walls_stop_or_deflect(two_rooms: str, motion: str) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms, motion=motion)
    start_at(env, (-2.0, 0.0, 1.0), np.pi + 0.6)
    env.run([FORWARD] * 12)
    position = env.truth().position
    assert position[2] < 2.0
    path = np.stack(env.state.positions)
    refused = (np.linalg.norm(np.diff(path, axis=0), axis=1) == 0).any()
    assert refused == (motion == "refuse")


def test_success_is_entering_the_sphere_and_ends_the_segment(env) -> None:
    start_at(env, (2.0, 0.0, 1.0), -np.pi / 2, goal=(3.0, 0.0, 1.0))
    segment = env.run([FORWARD] * 10)
    assert segment.terminated
    assert len(segment.executed) == 3  # 1.0 m away: after 0.6 m the agent is within 0.5 m
    result = env.result()
    assert result["success"] == 1 and result["actions"] == 3
    np.testing.assert_allclose(result["travelled"], 0.6, atol=1e-5)


def test_official_rules_look_only_where_a_decision_is_due(two_rooms: str) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms, preset="official")
    start_at(env, (1.0, 0.0, 1.0), -np.pi / 2, goal=(1.6, 0.0, 1.0))
    assert not env.run([FORWARD] * 7).terminated  # passes through the sphere and out of it again
    assert env.task.rules.decisions == 21


@pytest.mark.parametrize("plan", [[STOP], [TURN_LEFT, STOP], [TURN_LEFT, STOP, FORWARD]])
def test_official_rules_look_where_the_agent_stops(two_rooms: str, plan: list[int]) -> None:
    """A stop ends the episode, so that no decision follows: it counts wherever in its plan it stands."""
    env = wiw.make("ImageNav-v0", scenes=two_rooms, preset="official")
    start_at(env, (1.6, 0.0, 1.0), -np.pi / 2, goal=(1.6, 0.0, 1.0))
    assert env.run(plan).terminated and env.result()["success"] == 1


def test_official_rules_carry_out_all_but_two_of_the_chosen_plan(two_rooms: str) -> None:
    class Short(wiw.Policy):
        def propose(self, situations, candidates, horizon):
            return [[wiw.types.Proposal([TURN_LEFT] * self.length)] for _ in situations]

    policy = Short()
    for preset, carried_out in (
        ("official", {1: 1, 2: 1, 3: 1, 4: 2, 5: 3}),
        ("paper", {1: 1, 2: 2, 3: 3, 4: 3, 5: 3}),
    ):
        env = wiw.make("ImageNav-v0", scenes=two_rooms, preset=preset)
        agent = wiw.Agent(policy, **env.task.defaults)
        observation, info = env.reset(options={"episode": 0})
        for policy.length, expected in carried_out.items():
            assert agent.decide(observation, env.goal, info["key"]).execute == expected
    assert env.task.budget == 60


def test_the_budget_truncates(env) -> None:
    start_at(env, (-2.0, 0.0, 0.5), 0.0)
    for _ in range(20):
        segment = env.run([TURN_LEFT, TURN_RIGHT])
    assert segment.truncated and not segment.terminated


def test_stop_ends_the_episode(env) -> None:
    env.reset(options={"episode": 0})
    _, reward, terminated, _, info = env.step(STOP)
    assert terminated and reward == 0 and info["result"]["success"] == 0


def test_what_follows_a_stop_in_a_plan_is_worth_nothing(env) -> None:
    start_at(env, (1.0, 0.0, 1.0), -np.pi / 2)
    guide = env.guide()
    assert guide.evaluate_plan([STOP, *[FORWARD] * 4]) == guide.evaluate_plan([STOP])
    assert guide.evaluate_plan([FORWARD] * 4) > guide.evaluate_plan([STOP])


def test_a_fork_moves_alone(env) -> None:
    env.reset(options={"episode": 0})
    before = env.truth().position
    fork = env.fork()
    fork.step(int(TURN_LEFT))
    fork.step(int(FORWARD))
    np.testing.assert_array_equal(env.truth().position, before)


def test_using_it_before_reset_says_so(env) -> None:
    for use in (env.truth, env.instances):
        with pytest.raises(ArgumentError, match="reset"):
            use()
    with pytest.raises(ArgumentError, match="unknown option"):
        wiw.make("ImageNav-v0", raduis=1.0)


def test_episodes_are_out_of_sight_and_within_reach(two_rooms: str) -> None:
    task = wiw.make("ImageNav-v0", scenes=two_rooms, seed=5).task
    episodes = task.episodes(6)
    assert episodes == task.episodes(6) and len({e.episode_id for e in episodes}) == 6
    assert task.episodes(3) == episodes[:3]
    for episode in episodes:
        assert 2 <= episode.geodesic <= 8
        assert episode.info["ideal_primitives"] <= 42
        assert np.sign(episode.start_position[0]) != np.sign(episode.goal_position[0])  # in different rooms


def test_episodes_of_one_scene_are_each_made_once(two_rooms: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    make = wiw.datasets.imagenav._episode
    monkeypatch.setattr(
        wiw.datasets.imagenav, "_episode", lambda world, index, *rest: made.append(index) or make(world, index, *rest)
    )
    episodes = ImageNav(scenes=Path(two_rooms), per_scene=2).episodes(6)
    assert made == list(range(6))
    assert episodes == ImageNav(scenes=two_rooms, per_scene=6).episodes(6)


def test_the_renderer_is_part_of_what_a_task_is(two_rooms: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ImageNav(scenes=two_rooms, backend="cpu").describe()["backend"] == "cpu"
    assert ImageNav(scenes=two_rooms).describe()["backend"] in ("cpu", "gpu")
    monkeypatch.setattr(wiw.tasks.navigation, "resolve_backend", {"auto": "gpu"}.get)
    assert ImageNav(scenes=two_rooms).describe()["backend"] == "gpu"


def test_ideal_primitives_of_a_bend() -> None:
    path = np.array([[0.0, 0, 0], [0, 0, -1], [-1, 0, -1]])
    assert ideal_primitives(path, 0.0) == 10 + 4
    assert ideal_primitives(path, np.pi) == 8 + 10 + 4


def test_camera_pose_looks_where_yaw_says() -> None:
    pose = camera_pose(np.zeros(3), np.pi / 2)
    np.testing.assert_allclose(-pose[:3, 2], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], [0, 1, 0])


def test_no_privileged_truth_reaches_policies_or_models(two_rooms: str) -> None:
    """Moving the whole episode elsewhere must not change a bit of what policy and model see, but for the pixels."""
    seen = []

    class Spy(wiw.Policy):
        needs = ("depth",)

        def propose(self, situations, candidates, horizon):
            for s in situations:
                seen.append((s.observation.odometry.copy(), s.key, s.goal.task, s.goal.text))
                names = {f.name for f in dataclasses.fields(s.observation)} | {
                    f.name for f in dataclasses.fields(s.goal)
                }
                assert names == {
                    *(
                        "panorama",
                        "front",
                        "odometry",
                        "depth",
                        "target",
                        "task",
                        "image",
                        "text",
                        "budget",
                        "free_turns",
                        "choices",
                        "question",
                    )
                }
                assert s.observation.target is None and s.goal.choices == ()
            return [[wiw.types.Proposal([TURN_LEFT, FORWARD])] for _ in situations]

        def score(self, situations, proposals, rollouts):
            return [np.zeros(len(plans)) for plans in proposals]

    class SpyModel(wiw.WorldModel):
        accepts = wiw.accepts(control="trajectory", needs=("depth",))

        def rollout(self, observations, controls, seeds):
            assert observations.simulators is None
            return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)

    records = []
    for start, goal in (((-2.0, 0.0, 0.5), (3.0, 0.0, 1.0)), ((2.5, 0.0, 0.5), (-3.0, 0.0, 1.0))):
        seen.clear()
        env = start_at(wiw.make("ImageNav-v0", scenes=two_rooms).task.environment(depth=True), start, 0.4, goal)
        agent = wiw.Agent(Spy(), SpyModel())
        decision = agent.decide(env._observe(), env.goal, wiw.types.Key(0, 0))
        env.run(decision.actions)
        records.append([np.concatenate([np.ravel(x[0]) for x in seen]), seen[0][1:]])
    np.testing.assert_array_equal(records[0][0], records[1][0])
    assert records[0][1] == records[1][1]


def test_every_step_names_the_next_decision(two_rooms: str) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms, decisions=3)
    _, info = env.reset(options={"episode": 2})
    keys = [info["key"]]
    for _ in range(3):
        keys.append(env.step(TURN_LEFT)[-1]["key"])
    assert [(key.episode, key.decision) for key in keys] == [(2, 0), (2, 1), (2, 2), (2, 3)]


def test_a_loop_by_hand_is_the_loop_of_evaluate(two_rooms: str, tmp_path: Path) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms, decisions=4)
    agent = wiw.Agent("matcher", "copy")
    observation, info = env.reset(options={"episode": 0})
    key, executed, over = info["key"], [], False
    while not over:
        decision = agent.decide(observation, env.unwrapped.goal, key=key)
        segment = env.unwrapped.run(decision.actions[: decision.execute])
        executed.append(segment.executed.tolist())
        observation, key, over = segment.observation, segment.key, segment.terminated or segment.truncated
    log = wiw.evaluate(env, wiw.Agent("matcher", "copy"), episodes=1, out=tmp_path / "run", progress=False)
    assert [row["executed"] for row in log.decisions] == executed


def test_episodes_are_counted_round(two_rooms: str, tmp_path: Path) -> None:
    task = ImageNav(scenes=two_rooms)
    file = tmp_path / "three.json"
    episode_files.save(file, task.episodes(3), "imagenav")
    env = wiw.make("ImageNav-v0", episode_file=file)
    assert env.unwrapped.task.episode_count == 3 and task.episode_count is None
    episodes = [env.reset(seed=seed)[1]["key"].episode for seed in range(8)]
    assert set(episodes) <= {0, 1, 2} and len(set(episodes)) > 1
    env.reset(options={"episode": 2})
    assert env.reset()[1]["key"].episode == 0
    with pytest.raises(ArgumentError, match="at least 0"):
        env.reset(options={"episode": -1})


@pytest.mark.parametrize("number", ["three", 2.7, True, [1], -1])
def test_an_episode_is_named_by_a_whole_number(env, number) -> None:
    with pytest.raises(ArgumentError, match="a whole number of at least 0, got"):
        env.reset(options={"episode": number})


@pytest.mark.parametrize("use", [lambda env: env.step(FORWARD), lambda env: env.run([FORWARD])])
def test_nothing_happens_after_the_end(env, use) -> None:
    env.reset(options={"episode": 0})
    env.step(STOP)
    ended = env.result()
    with pytest.raises(ArgumentError, match=r"the episode has ended; call reset\(\)"):
        use(env)
    assert env.result() == ended and env.state.ended
    env.begin(env.task.episode(0))
    for _ in range(env.task.decisions):
        assert not env.run([TURN_LEFT]).terminated
    with pytest.raises(ArgumentError, match="ended"):
        use(env)
    assert env.state.decisions == env.task.decisions


@pytest.mark.parametrize("plan", [[FORWARD, 0], [FORWARD, 9], [1.7], [[1, 2], [1, 2]], ["forward"]])
def test_a_plan_of_something_else_moves_and_counts_nothing(env, plan) -> None:
    env.reset(options={"episode": 0})
    with pytest.raises(ArgumentError, match=r"expected primitives \[K\] from 1 to 4"):
        env.run(plan)
    assert env.result()["actions"] == 0 and env.state.decisions == 0


def test_any_episode_of_many_scenes_is_had_without_those_before(tmp_path: Path, two_rooms: str, monkeypatch) -> None:
    """A seed may draw the last of a thousand scenes: none but that one is opened."""
    scenes = [str(tmp_path / f"{number}{Path(two_rooms).suffix}") for number in range(1000)]
    for scene in scenes:
        Path(scene).symlink_to(two_rooms)
    monkeypatch.setattr(wiw.tasks.navigation, "resolve", lambda spec: scenes)
    monkeypatch.setattr(wiw.tasks.imagenav, "resolve", lambda spec: scenes)
    opened: list[str] = []
    world = wiw.tasks.navigation.world
    monkeypatch.setattr(wiw.tasks.navigation, "world", lambda scene, *rest: opened.append(scene) or world(scene, *rest))
    task, other = ImageNav(scenes=two_rooms, per_scene=2), ImageNav(scenes=two_rooms, per_scene=2)
    last = task.episode(1999)
    assert last.scene == scenes[-1] and last.episode_id == "1999" and opened == scenes[-1:]
    assert task.drawn_count == 2000
    opened.clear()
    assert task.episode(3) == other.episodes(4)[3] and set(opened) == set(scenes[:2])
    with pytest.raises(ArgumentError, match="2001 episodes were requested, but there are only 2000"):
        task.episode(2000)
    with pytest.raises(ArgumentError, match="there are only 2000"):
        other.episodes(5000)
    assert set(opened) == set(scenes[:2])  # refused before any is made


def test_a_seed_draws_few_of_the_episodes_that_depend_on_those_before(two_rooms: str) -> None:
    assert wiw.make("AR-v0", scenes="apartments:val").task.drawn_count == 20
    assert wiw.make("ImageNav-v0", scenes=two_rooms).task.drawn_count == 64


def test_a_class_that_makes_its_own_episodes_is_asked_for_them(two_rooms: str) -> None:
    class Turned(ImageNav):
        def generate_episodes(self, place, first, before):
            made = super().generate_episodes(place, first, before)
            return [dataclasses.replace(each, start_yaw=float(len(before))) for each in made]

    assert Turned(scenes=two_rooms, per_scene=1).episode(2).start_yaw == 2


def test_the_number_of_decisions_does_not_shrink_with_a_longer_horizon(two_rooms: str) -> None:
    task = ImageNav(scenes=two_rooms, decisions=4)
    env = task.environment()
    env.begin(task.episode(0))
    for decision in range(4):
        segment = env.run([int(TURN_LEFT)] * 9)
        assert len(segment.executed) == 9 and segment.truncated == (decision == 3)
