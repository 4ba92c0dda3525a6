# SPDX-License-Identifier: Apache-2.0
"""Beliefs of policies: pictures that they draw, and how pages show beliefs and judgements."""

from __future__ import annotations

import re
import sqlite3
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from browser import COMMAND, WHY, Browser
from fakes import LineTask, SizeReader
from PIL import Image, ImageDraw
from test_aeqa import Records, episode, make_task  # noqa: F401 - a fixture
from test_explorer import make_explorer, plain_colors  # noqa: F401 - a fixture

import wiw
from wiw.errors import ContractError
from wiw.experiments.ground_truth import TrueScores
from wiw.loop.observers import Observer, ScoringBatch
from wiw.loop.scheduler import run_episodes
from wiw.mapping import drawing
from wiw.mapping.drawing import DrawnThing, Plan, draw_map
from wiw.mapping.occupancy import OccupancyGrid
from wiw.report.beliefs import list_beliefs, list_expected, read_verdict
from wiw.report.site import write_view
from wiw.runs.rows import decode_jpeg
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import run_arms
from wiw.types import Decision, Episode

BLOCK = np.stack(np.meshgrid(np.linspace(1.4, 1.8, 9), np.linspace(-0.2, 0.2, 9)), axis=-1).reshape(-1, 2)
"""Points of a thing right ahead of the start."""


def make_grid() -> OccupancyGrid:
    """Return a square of free floor, 4 m wide, around the start, with its left quarter occupied."""
    grid = OccupancyGrid()
    grid.free[44:84, 44:84] = True
    grid.occupied[44:84, 74:84] = True
    grid.visits = [np.array([-1.0, 0.0])]
    return grid


def is_color(image: np.ndarray, color: tuple[int, int, int], tolerance: int = 3) -> np.ndarray:
    """Return which pixels of a map, without its legend, have a colour, bool [H, W]."""
    return (np.abs(image[: -drawing.LEGEND_HEIGHT].astype(int) - color) <= tolerance).all(axis=2)


def find(image: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Return the mean place (x, y) of the pixels of a colour, from the middle of the map, in metres."""
    found = is_color(image, color)
    assert found.any(), color
    rows, columns = np.nonzero(found)
    height, width = found.shape
    return np.array([columns.mean() - width / 2, rows.mean() - height / 2]) / drawing.PIXELS_PER_METRE


# -- a picture of a map ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("up", "thing", "obstacle"),
    [(0.0, (0, -1.6), (-1.5, 0)), (np.pi / 2, (1.6, 0), (0, -1.5)), (np.pi, (0, 1.6), (1.5, 0))],
)
def test_a_map_is_turned_to_what_is_up(up, thing, obstacle):
    purple = (120, 20, 160)
    image = draw_map(make_grid(), [DrawnThing(BLOCK, "", purple)], np.zeros(3), up=up)
    assert find(image, purple) == pytest.approx(thing, abs=0.05)
    assert find(image, drawing.OCCUPIED) == pytest.approx(obstacle, abs=0.05)


def test_a_map_shows_where_the_agent_was_and_where_plans_lead():
    plans = [Plan(np.array([[0.0, 0.0], [1.5, 0.0]]), chosen=True), Plan(np.array([[0.0, 0.0], [0.0, -1.5]]))]
    image = draw_map(make_grid(), [], np.zeros(3), plans=plans)
    assert find(image, drawing.PLAN)[1] < -0.5 and find(image, drawing.OTHER_PLAN)[0] > 0.5
    assert find(image, drawing.PATH)[1] > 0.2
    assert find(image, drawing.UNKNOWN) == pytest.approx((0, 0), abs=0.1)


def test_labels_of_a_map_never_overlap(monkeypatch):
    """Thirty things in one place have room for a few names; that of what the belief rests on is among them."""
    boxes, texts, write = [], [], ImageDraw.ImageDraw.text

    def record(self: Any, place: Any, text: str, *rest: Any, **options: Any) -> None:
        if options.get("stroke_width"):
            texts.append(text)
            font = rest[1] if len(rest) > 1 else options["font"]
            boxes.append(self.textbbox(place, text, font=font))
        write(self, place, text, *rest, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", record)
    rng = np.random.default_rng(0)
    things = [
        DrawnThing(BLOCK + rng.uniform(-0.3, 0.3, 2), f"kitchen cabinet {i}", (200, 100, 50), focus=i == 17)
        for i in range(30)
    ]
    grid = make_grid()
    draw_map(grid, things, np.zeros(3), rooms={1: "kitchen 1 (97 %)"})
    assert "kitchen cabinet 17" in texts and 3 < len(texts) < 30
    for i, one in enumerate(boxes):
        for other in boxes[:i]:
            assert one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]


def test_a_large_place_is_drawn_smaller():
    grid = OccupancyGrid(free=np.ones((600, 128), bool), occupied=np.zeros((600, 128), bool))
    grid.walls = np.zeros((600, 128), bool)
    assert max(draw_map(grid, [], np.zeros(3)).shape[:2]) <= drawing.LONGEST_SIDE + drawing.LEGEND_HEIGHT


# -- when policies draw ------------------------------------------------------------------------------------------------


class Sketcher(SizeReader):
    """Draws the number of its decision, and notes for which it was asked to draw."""

    def __init__(self, name: str = "sketch", **options: Any) -> None:
        super().__init__(**options)
        self.name, self.drawn = name, list[tuple[int, int, float]]()

    def answer(self, situations: Any, proposals: Any, rollouts: Any) -> list[Any]:
        return [None] * len(situations)

    def draw(self, situation: Any, decision: Any, north: float) -> dict[str, np.ndarray]:
        assert decision.key == situation.key and decision.chosen is not None
        self.drawn.append((situation.key.episode, situation.key.decision, north))
        return {self.name: np.full((20, 30, 3), 10 * situation.key.decision, np.uint8)}


def run_line(policy: Any, pictured: tuple[int, ...] = (), reviser: Any = None, **parts: Any) -> Records:
    task, sink = LineTask(), Records()
    agent = wiw.Agent(policy, reviser=reviser, **parts, **task.defaults)
    run_episodes(task, agent, list(enumerate(task.episodes(3))), seed=0, live=3, sink=sink, pictured=pictured)
    return sink


def test_policies_draw_in_pictured_episodes_only():
    plain, policy = Sketcher(), Sketcher()
    without, some = run_line(plain), run_line(policy, pictured=(1,))
    assert plain.drawn == []
    decisions = [decision for index, decision, _ in policy.drawn if index == 1]
    assert len(decisions) == len(policy.drawn) > 1 and decisions == list(range(len(decisions)))
    assert [result.metrics for result in without.results] == [result.metrics for result in some.results]


class Telltale(Observer):
    """Adds to each decision what nobody under test may know."""

    def watch(self, batch: ScoringBatch) -> None:
        return

    def annotate(self, decision: Decision) -> Decision:
        return replace(decision, note="the truth")


def test_policies_draw_without_what_observers_find_out():
    shown = []

    class Curious(Sketcher):
        def draw(self, situation: Any, decision: Any, north: float) -> dict[str, np.ndarray]:
            shown.append(decision.note)
            return super().draw(situation, decision, north)

    sink = run_line(Curious(), pictured=(0,), model="copy", observers=[Telltale()])
    pictured = [record.decision for record in sink.decisions if record.episode == 0]
    assert len(pictured) > 1 and shown == [""] * len(pictured)
    assert [each.note for each in pictured] == ["the truth"] * len(pictured)
    assert all(each.pictures for each in pictured)


def test_what_is_up_is_north_of_the_scene():
    class Turned(LineTask):
        def environment(self, depth: bool = False) -> Any:
            env = super().environment(depth)
            truth = env.truth
            env.truth = lambda: replace(truth(), yaw=0.75)
            return env

    policy, task = Sketcher(), Turned()
    agent = wiw.Agent(policy, **task.defaults)
    run_episodes(task, agent, [(0, task.episodes(1)[0])], seed=0, sink=Records(), pictured=(0,))
    assert {north for _, _, north in policy.drawn} == {-0.75}


def test_pictures_are_in_the_store_of_pictured_episodes(tmp_path):
    agents = {"none": wiw.Agent(Sketcher("floor_plan"), **LineTask().defaults)}
    run_arms(LineTask(), agents, 3, out=tmp_path / "run", progress=False, keep_images=1)
    rows = sqlite3.connect(store_path(tmp_path / "run")).execute(
        "SELECT episode, decision, jpeg FROM image WHERE name = 'believed/floor_plan' ORDER BY decision"
    )
    found = rows.fetchall()
    assert {index for index, _, _ in found} == {0} and len(found) > 1
    assert [int(decode_jpeg(jpeg).mean().round()) for _, _, jpeg in found] == [10 * number for _, number, _ in found]


def test_proposer_and_reviser_both_draw():
    proposer, reviser = Sketcher("plans"), Sketcher("scores")
    run_line(proposer, pictured=(0,), reviser=reviser)
    assert proposer.drawn == reviser.drawn != []


def test_wrapped_policies_draw():
    inner = Sketcher()
    assert TrueScores(inner).draw.__func__ is not wiw.policies.base.Policy.draw
    situation = type("S", (), {"key": wiw.types.Key(0, 0, 2)})()
    decision = type("D", (), {"key": wiw.types.Key(0, 0, 2), "chosen": 0})()
    assert TrueScores(inner).draw(situation, decision, 0.0)["sketch"].max() == 20


@pytest.mark.parametrize(
    ("pictures", "wrong"),
    [
        ([np.zeros((4, 4, 3), np.uint8)], "expected a mapping from names to images, got list"),
        ({"../map": np.zeros((4, 4, 3), np.uint8)}, "expected names of letters, digits and underscores, got '../map'"),
        ({"map": np.zeros((4, 4, 3))}, r"expected 'map' as uint8 \[H, W, 3\], got float64 \[4, 4, 3\]"),
        ({"map": np.zeros((4, 4), np.uint8)}, r"got uint8 \[4, 4\]"),
    ],
)
def test_what_is_no_picture_breaks_the_contract(pictures, wrong):
    policy = Sketcher()
    policy.draw = lambda situation, decision, north: pictures  # type: ignore[method-assign]
    with pytest.raises(ContractError, match="Sketcher.draw: .*" + wrong):
        run_line(policy, pictured=(0,))


# -- what pages say ----------------------------------------------------------------------------------------------------


def rows_of(*answers: tuple[str, float]) -> list[dict[str, Any]]:
    return [{"answer": {"label": label, "confidence": sure, "final": sure > 0.8}} for label, sure in answers]


def test_beliefs_know_how_long_they_last_and_whether_they_are_right():
    rows = rows_of(("", 0.0), ("red", 0.1), ("red", 0.4), ("Blues", 0.7), ("blue", 0.9))
    found = list_beliefs(rows, ("blue", "navy"))
    assert [each.lasts for each in found if each] == [1, 2, 0, 1, 1]
    assert [each.right for each in found if each] == [False, False, False, True, True]
    assert [each.final for each in found if each] == [False, False, False, False, True]
    assert found[4] is not None and found[4].text == "blue, 90 %, given as the answer"
    assert found[0] is not None and found[0].text == "nothing, 0 %"
    assert list_beliefs([{"answer": None}], ()) == [None]


def test_expected_answers_are_the_questions_or_the_category():
    start = (0.0, 0.0, 0.0)
    question = {"question": {"answer": "blue", "extra_answers": ["navy"]}, "category": "x"}
    for info, expected in ((question, ("blue", "navy")), ({"category": "chair"}, ("chair",)), ({}, ())):
        assert list_expected(Episode("0", "s", start, 0.0, start, 0.0, 1.0, info)) == expected


def test_verdicts_name_judge_and_model():
    judgement = {"mark": 4, "judge": "llm", "model": "qwen", "approximate": True, "reply": "four"}
    verdict = read_verdict({"answer": "navy", "expected": "blue", "judgement": judgement})
    assert verdict is not None and verdict.judge == "llm (qwen)" and verdict.reply == "four"
    assert verdict.text == "answered “navy”, approximate mark 4 of 5"
    silent = read_verdict({"answer": "", "judgement": {"mark": 1, "judge": "rules"}})
    assert silent is not None and silent.text == "no answer, mark 1 of 5" and read_verdict({}) is None


# -- an episode of question answering ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def log(episode, tmp_path_factory):  # noqa: F811
    """A short episode of the explorer, with an answer that the page must not take for markup."""
    info = {**episode.info, "question": {**episode.info["question"], "extra_answers": ["<b>navy</b>"]}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wiw.policies.explorer.policy.name_color", lambda pixels, category: ("blue", 0.8))
        task = make_task(replace(episode, info=info), actions=45)
        agents = {"none": wiw.Agent(make_explorer(), **task.defaults)}
        out = tmp_path_factory.mktemp("beliefs") / "run"
        yield run_arms(task, agents, 1, out=out, progress=False, keep_images="all")


def test_an_explorers_pictures_show_its_map(log):
    pictures = [log.store.images("none", 0, row["decision"]) for row in log.store.decisions("none", 0)]
    maps = [decode_jpeg(each["believed/map"]) for each in pictures]
    known = [float((np.abs(each.astype(int) - drawing.UNKNOWN).max(axis=2) > 6).sum()) for each in maps]
    assert len(maps) > 2 and known[-1] > known[0] > 0.05 * maps[0][..., 0].size
    path = [int(is_color(each, drawing.PATH, 20).sum()) for each in maps]  # JPEG blurs colours of small things
    assert path[0] > 10 and path[-1] > path[0]
    assert all(decode_jpeg(each["believed/views"]).shape[1] == 2 * 336 + 6 for each in pictures)


def test_pictures_change_no_decision_of_an_explorer(episode):  # noqa: F811
    def decide(pictured: tuple[int, ...]) -> list[Any]:
        sink, task = Records(), make_task(episode, actions=45)
        agent = wiw.Agent(make_explorer(), **task.defaults)
        run_episodes(task, agent, [(0, episode)], seed=0, sink=sink, pictured=pictured)
        return [(answer.text, answer.confidence) for answer in sink.answers] + [sink.results[0].metrics]

    assert decide(()) == decide((0,))


def test_an_episode_page_says_what_was_believed_when(log, tmp_path):
    site = write_view(log, tmp_path / "view")
    html = (tmp_path / "view/episodes/0000.html").read_text()
    decisions = log.store.decisions("none", 0)
    assert "<q>blue</q> or <q>&lt;b&gt;navy&lt;/b&gt;</q>" in html and "<b>navy" not in html
    (outcome,) = log.store.outcomes()
    mark = outcome["details"]["judgement"]["mark"]
    assert f"Mark {mark} of 5 by judge rules" in html
    assert html.count('<span class="belief') == len(decisions)
    for row in decisions:
        label = row["answer"]["label"]
        assert f'title="Decision {row["decision"] + 1}: {label}, {100 * row["answer"]["confidence"]:.0f} %' in html
    assert html.count("<figcaption>believed: map") == html.count("<figcaption>believed: views") == len(decisions)
    names = {file.name for file in (tmp_path / "view/images").iterdir()}
    assert sum("-believed-" in name for name in names) == 2 * len(decisions)
    width, _ = Image.open(tmp_path / "view/images/0-0-0-believed-1.webp").size
    assert width == 2 * 336 + 6  # as it was drawn, so that its letters can be read
    shown = outcome["details"]["answer"] or "no answer"
    assert re.search(rf'<span class="end (success|failure)"[^>]*>{shown}</span>', site.index.read_text())


def test_a_report_shows_maps_and_beliefs(log):
    html = log.report().read_text()
    decisions = log.store.decisions("none", 0)
    assert html.count("<figcaption>believed: map") == len(decisions) and "believed: views" not in html
    assert html.count('<span class="belief') == len(decisions) and "by judge rules" in html


@pytest.mark.parametrize("width", [1300, 390])
def test_beliefs_stay_within_the_page(log, tmp_path, width):
    if COMMAND is None:
        pytest.skip(WHY)
    write_view(log, tmp_path / "view")
    browser = Browser(tmp_path / "profile")
    try:
        browser.resize(width, 900)
        browser.open((tmp_path / "view/episodes/0000.html").as_uri())
        assert browser.ask("document.documentElement.scrollWidth") <= width
        shown = "[...document.querySelectorAll('.step-page:not([hidden]) .believed img')]"
        browser.ask(f"Promise.all({shown}.map(i => i.decode()))")
        assert browser.ask(f"{shown}.map(i => i.getBoundingClientRect().right <= innerWidth)") == [True, True]
        assert browser.ask(f"{shown}.every(i => i.getBoundingClientRect().width <= i.naturalWidth + 3)")
        tops = browser.ask(
            "[...document.querySelectorAll('.belief')].map(b => Math.round(b.getBoundingClientRect().top))"
        )
        assert len(set(tops)) == 1 and browser.complaints() == []
    finally:
        browser.close()
