# SPDX-License-Identifier: Apache-2.0
"""Active Recognition: what is pointed out, when an episode ends, and which answer counts."""

from __future__ import annotations

import dataclasses
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import SizeReader, agent_for
from gymnasium.utils.env_checker import check_env
from locations import PYTHON_TESTS

import wiw
from recognition_file import CHOICES, a_file
from wiw.action import FORWARD, STOP, TURN_LEFT
from wiw.cli import main
from wiw.datasets import ar
from wiw.datasets.worlds import world
from wiw.envs.pointing import Pointing
from wiw.errors import ArgumentError, ContractError
from wiw.loop.scheduler import run_episodes
from wiw.report.story import Attempt
from wiw.runs.rows import decode_jpeg
from wiw.tasks.ar import AR
from wiw.types import Answer, Observation


def answer(label: str, confidence: float) -> Answer:
    rest = (1 - confidence) / (len(CHOICES) - 1)
    return Answer(CHOICES, np.array([confidence if label == choice else rest for choice in CHOICES]))


@pytest.fixture
def file(tmp_path: Path, two_rooms: str) -> Path:
    return a_file(tmp_path, two_rooms)


def test_gymnasium_accepts_it(file: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box.*(high|low).*infinity.*")
        warnings.filterwarnings("ignore", message=".*spec.*")
        warnings.filterwarnings("ignore", message=".*not an image.*|.*flatten.*")
        check_env(wiw.make("AR-v0", episode_file=file), skip_render_check=True)


def test_the_target_is_what_the_renderer_says(file: Path, two_rooms: str) -> None:
    env = wiw.make("AR-v0", episode_file=file)
    env.reset(options={"episode": 0})
    name, place = env.state.episode.info["target"], world(two_rooms)
    pose = env.fork().T_world_camera
    ids = place.renderer.panorama(pose[None], outputs=("instance",))["instance"][0]
    front = place.renderer.perspective(pose[None], (480, 480), 90.0, outputs=("instance",))["instance"][0]
    target = env.observation.target
    np.testing.assert_array_equal(target.mask, ids == name)
    rows, columns = np.nonzero(ids == name)
    assert target.panorama_box == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    assert (target.front_box is None) == (not (front == name).any())


def test_the_box_follows_a_turn_and_goes_across_the_seam(file: Path) -> None:
    env = wiw.make("AR-v0", episode_file=file, decisions=16)
    env.reset(options={"episode": 0})
    masks, boxes = [env.observation.target.mask], []
    for _ in range(16):
        shown, *_ = env.step(TURN_LEFT)
        target = env.observation.target
        masks.append(target.mask)
        boxes.append(target.panorama_box)
        assert (target.front_box is None) == (shown["front_box"] == -1).all()
        np.testing.assert_array_equal(shown["panorama_box"], np.array(target.panorama_box, np.float32))
    np.testing.assert_array_equal(masks[0], masks[16])
    assert sum(left > right for left, _, right, _ in boxes) > 0
    widths = [(right - left) % 1024 for left, _, right, _ in boxes]
    assert max(widths) - min(widths) <= 2


def test_ids_reach_neither_policies_nor_world_models_and_boxes_no_world_model(file: Path) -> None:
    seen: list[Any] = []

    class Spy(SizeReader):
        def answer(self, situations, proposals, rollouts):
            seen.append(situations[0])
            return super().answer(situations, proposals, rollouts)

    class Watcher(wiw.WorldModel):
        accepts = wiw.accepts(control="trajectory", view="panorama")

        def rollout(self, observations, controls, seeds):
            seen.append(observations)
            return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, axis=1)

    task = AR(episode_file=file)
    agent = agent_for(task, wiw.Agent(Spy(), Watcher()))
    run_episodes(task, agent, list(enumerate(task.episodes(1))), seed=0, sink=Sink())
    observations, situation = seen[0], seen[1]
    env = task.environment()
    plain = env.begin(task.episode(0)).panorama
    np.testing.assert_array_equal(observations.image[0], plain)  # no box
    values = [getattr(situation.observation, f.name) for f in dataclasses.fields(Observation)]
    values += [getattr(situation.observation.target, f.name) for f in dataclasses.fields(situation.observation.target)]
    assert not any(isinstance(value, np.ndarray) and value.dtype.kind in "ui" and value.ndim == 2 for value in values)
    assert {f.name for f in dataclasses.fields(situation.observation.target)} == {"mask", "panorama_box", "front_box"}
    assert set(env.begin(task.episode(0)).as_dict()) == {
        "panorama",
        "front",
        "odometry",
        "panorama_box",
        "front_box",
    }
    assert situation.goal.text is None
    assert situation.goal.choices == CHOICES


class Sink:
    def __init__(self) -> None:
        self.decisions, self.results = [], []

    def decision(self, record: Any) -> None:
        self.decisions.append(record)

    def episode(self, result: Any) -> None:
        self.results.append(result)

    def record_restart(self, episodes: Any) -> None:
        raise AssertionError(episodes)

    def record_lost(self, spent: Any) -> None:
        raise AssertionError(spent)


@pytest.mark.parametrize(("execute", "carried_out"), [("primitive", 1), ("sequence", 2)])
def test_the_budget_ends_an_episode_after_the_last_answer(file: Path, execute: str, carried_out: int) -> None:
    task, sink = AR(episode_file=file, execute=execute, decisions=4), Sink()
    agent = agent_for(task, wiw.Agent(SizeReader(0.5, (TURN_LEFT, TURN_LEFT))))
    run_episodes(task, agent, list(enumerate(task.episodes(1))), seed=0, sink=sink)
    assert [len(record.executed) for record in sink.decisions] == [carried_out] * 3 + [0]
    metrics = sink.results[0].metrics
    assert (metrics["decisions"], metrics["actions"]) == (4, 3 * carried_out)
    assert metrics["confidence"] == pytest.approx(0.5)
    assert metrics["visible_start"] == pytest.approx(metrics["visible_end"])


def test_a_sure_answer_ends_an_episode_before_anything_is_carried_out(file: Path) -> None:
    env = wiw.make("AR-v0", episode_file=file)
    env.begin(env.task.episode(0))
    assert not env.run([FORWARD], answer("table", 0.95)).terminated  # above it, not at it
    segment = env.run([FORWARD], answer("table", 0.96))
    assert segment.terminated
    assert len(segment.executed) == 0
    result = env.result()
    assert (result["success"], result["actions"]) == (1, 1)
    assert (CHOICES[int(result["category"])], CHOICES[int(result["predicted"])]) == ("table", "table")


@pytest.mark.parametrize(("preset", "right"), [("paper", [False, True, False]), ("official", [False, True, True])])
def test_the_last_answer_counts_or_the_surest(file: Path, preset: str, right: list[bool]) -> None:
    task = AR(episode_file=file, preset=preset, decisions=3)
    env = task.environment()
    env.begin(task.episode(0))
    env.run([TURN_LEFT], answer("shelf", 0.5))
    env.run([TURN_LEFT], answer("table", 0.9))
    assert env.run([TURN_LEFT], answer("chest", 0.6)).truncated
    assert env.result()["success"] == right[-1]
    assert env.details() == {"right_after": right}


@pytest.mark.parametrize(("lost", "ended"), [("continue", False), ("stop", True)])
def test_a_lost_target_ends_an_episode_where_the_rules_say_so(
    tmp_path: Path, two_rooms: str, lost: str, ended: bool
) -> None:
    path = a_file(tmp_path, two_rooms, start=(-0.6, 0.0, 1.1), yaw=-np.pi / 2, target="chest")  # through the door
    task = AR(episode_file=path, lost=lost, decisions=20)
    env = task.environment()
    env.begin(task.episode(0))
    segment = env.run([TURN_LEFT] * 8 + [FORWARD] * 12, answer("chest", 0.5))
    assert env.observation.target.panorama_box is None
    assert segment.terminated is ended


def test_the_goal_is_on_the_floor(file: Path) -> None:
    task = AR(episode_file=file)
    episode = task.episode(0)
    place = task.open_world(episode)
    goal = task.find_goal_position(place, episode)
    np.testing.assert_allclose(goal, place.ground.put_down(goal), atol=1e-6)


def test_an_answer_is_a_step_of_gymnasiums_too(file: Path) -> None:
    env = wiw.make("AR-v0", episode_file=file)
    for choice, reward in ((CHOICES.index("table"), 1.0), (CHOICES.index("chest"), 0.0)):
        env.reset(options={"episode": 0})
        env.step(FORWARD)
        _, got, terminated, _, info = env.step(STOP + 1 + choice)
        assert (got, terminated) == (reward, True)
        assert (info["result"]["success"], info["result"]["actions"]) == (reward, 1)
    with pytest.raises(ArgumentError, match="1 to 8"):
        env.step(9)


def test_many_at_a_time_are_as_one_by_one(file: Path) -> None:
    many = wiw.make_vec("AR-v0", 2, episode_file=file, depth=False)
    one = wiw.make("AR-v0", depth=False, episode_file=file)
    shown, _ = many.reset(options={"episode": [0, 0]})
    alone, _ = one.reset(options={"episode": 0})
    assert many.observation_space.contains(shown)
    for name, value in alone.items():
        np.testing.assert_array_equal(shown[name][1], value)
    shown, rewards, terminated, _, _ = many.step(np.array([TURN_LEFT, STOP + 1 + CHOICES.index("table")]))
    alone, *_ = one.step(TURN_LEFT)
    assert terminated.tolist() == [False, True]
    assert rewards.tolist() == [0, 1]
    for name, value in alone.items():
        np.testing.assert_array_equal(shown[name][0], value)


def test_an_agent_that_gives_no_answer_is_told_so(file: Path) -> None:
    task = AR(episode_file=file)
    for model, reviser in ((None, "heuristic"), ("copy", "matcher")):
        agent = agent_for(task, wiw.Agent("heuristic", model, reviser))
        with pytest.raises(ContractError, match=r"gives no answer, .* one of 4 choices.*reviser="):
            run_episodes(task, agent, list(enumerate(task.episodes(1))), seed=0, sink=Sink())
    env = task.environment()
    shown, info = env.reset(options={"episode": 0})
    with pytest.raises(ArgumentError, match=r"run\(plan, answer\)"):
        env.run([FORWARD])
    with pytest.raises(ArgumentError, match=r"env\.observation"):
        wiw.Agent(SizeReader()).decide(shown, env.goal, info["key"])


def test_a_single_primitive_is_carried_out_at_any_horizon(two_rooms: str) -> None:
    for execute, expected in (("primitive", 1), ("sequence", 0)):
        task = AR(two_rooms, execute=execute)
        assert agent_for(task, wiw.Agent(SizeReader(), horizon=6)).config.execute == expected


def test_the_official_box_is_around_the_largest_piece_and_larger() -> None:
    ids = np.zeros((576, 1024), np.uint32)
    ids[100:140, 1000:] = ids[100:140, :16] = 7  # 40 x 40 across the seam
    ids[200:204, 500:504] = 7
    front = np.zeros((480, 480), np.uint32)
    assert Pointing().target(ids, front, 7).panorama_box == (1000, 100, 504, 204)
    official = Pointing(1.15, "largest", "stop").target(ids, front, 7)
    np.testing.assert_allclose(official.panorama_box, (1000 - 3, 100 - 3, 16 + 3, 140 + 3))
    assert official.front_box is None


def test_confidence_is_a_probability(two_rooms: str) -> None:
    with pytest.raises(ArgumentError, match=r"confidence: expected a probability from 0 to 1, got 1\.5"):
        AR(two_rooms, confidence=1.5)


def test_a_scene_without_any_of_the_categories_says_what_it_has(two_rooms: str) -> None:
    with pytest.raises(ArgumentError, match=r"has no object of the categories bathtub.*categories=\["):
        AR(two_rooms).episodes(1)
    assert tuple(sorted(ar.CATEGORIES)) == ar.CATEGORIES


def test_the_store_keeps_answers_and_pictures_with_the_box(file: Path, tmp_path: Path) -> None:
    log = wiw.evaluate(AR(episode_file=file), wiw.Agent(SizeReader(0.5)), 1, out=tmp_path / "run", keep_images=1)
    (episode,) = log.episodes
    assert episode["status"] == "done"
    decisions = log.decisions
    assert [row["answer"]["confidence"] for row in decisions] == pytest.approx([0.5] * 10)
    assert [len(row["executed"]) for row in decisions] == [1] * 9 + [0]
    picture = decode_jpeg(log.store.images("none", 0, 0)["panorama"]).astype(int)
    assert ((picture[..., 0] > 150) & (picture[..., 1:].max(axis=-1) < 110)).sum() > 100


def test_the_command_line_names_the_categories(file: Path, tmp_path: Path) -> None:
    policy = f"{PYTHON_TESTS / 'fakes.py'}:SizeReader"
    command = ["run", "ar", "--episode-file", str(file), "--episodes", "1", "--policy", policy, "--no-report"]
    assert main([*command, "--task-option", "categories=coffee table, table", "--out", str(tmp_path / "run")]) == 0
    log = wiw.load_run(tmp_path / "run")
    assert log.store.config["task"]["categories"] == ["coffee table", "table"]
    assert log.decisions[0]["answer"]["label"] in ("coffee table", "table")
    assert main(["resume", str(tmp_path / "run"), "--no-report"]) == 0
    assert main([*command, "--task-option", "categories=table, table", "--out", str(tmp_path / "b")]) == 2


def without_tags(page: str) -> str:
    return re.sub(r"<style>.*?</style>|<script>.*?</script>|<[^>]*>", " ", page, flags=re.DOTALL)


def test_the_report_speaks_of_answers(file: Path, tmp_path: Path) -> None:
    task = AR(episode_file=file, decisions=2)
    log = wiw.evaluate(task, wiw.Agent(SizeReader(0.5)), 1, out=tmp_path / "run", keep_images=1)
    page = log.report().read_text()
    assert "The boxed thing: table" in page
    assert "Answer: table, 50 %" in page
    assert "recognised in 2 decisions" in page
    assert "success rate, %" in page and "SR within N decisions" in page
    shown = (log.view().read_text(), *(file.read_text() for file in log.view().parent.glob("episodes/*.html")))
    assert len(shown) == 2 and not any(
        re.search("the goal|reached", without_tags(text), re.I) for text in [page, *shown]
    )
    outcome = {"status": "done", "metrics": {"success": 0.0, "predicted": 2.0}}
    missed = Attempt("none", outcome, (), None, task.wording, CHOICES)
    assert missed.text == "answered shelf after 0 decisions"
