# SPDX-License-Identifier: Apache-2.0
from html.parser import HTMLParser

import numpy as np
import pytest
from fakes import LineAgent, LineTask

from wiw.analysis.summary import summarise
from wiw.report.episodes import read_stories
from wiw.report.maps import frame_of_picture, frame_of_points, start_and_goal, trail
from wiw.report.page import render, sentence
from wiw.report.plans import glyphs
from wiw.report.story import Album
from wiw.studies.evaluate import run_arms
from wiw.types import Episode

EVIL = "<script>alert(1)</script>"


class Page(HTMLParser):
    """Tags with attributes, text, and whether tags close in order."""

    VOID = ("meta", "img", "br", "link", "path", "circle", "rect", "use", "image", "polyline", "text", "source")

    def __init__(self, html):
        super().__init__()
        self.tags, self.texts, self.open = [], [], []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    arms = {name: LineAgent(drive) for name, drive in (("none", 0.4), ("copy", 0.5), ("warp", 0.8), ("oracle", 1.0))}
    task = LineTask(broken=("0001",))
    return run_arms(task, arms, 6, out=tmp_path_factory.mktemp("report") / "run", progress=False)


@pytest.fixture(scope="module")
def page(log):
    return Page(render(log))


def test_the_page_is_whole_and_needs_nothing_else(page):
    assert page.open == []
    for tag, attributes in page.tags:
        for name in ("src", "href"):
            target = attributes.get(name, "data:")
            assert target.startswith(("data:image/", "#", "data:")), (tag, target)
    assert not any(tag == "link" for tag, _ in page.tags)
    (policy,) = [a["content"] for tag, a in page.tags if tag == "meta" and "http-equiv" in a]
    assert policy.startswith("default-src 'none'")


def test_the_page_shows_every_arm_decision_and_failure(log, page):
    text = " ".join(page.texts)
    shown, _ = read_stories(log.store, log.arms, Album())
    assert [story.index for story in shown] == [5, 0]  # first the one that a model wins
    steps = sum(len(attempt.steps) for story in shown for attempt in story.attempts)
    classes = [attributes.get("class", "") for _, attributes in page.tags]
    assert classes.count("step") == steps and classes.count("attempt") == 8
    assert sum("chosen" in name for name in classes) == steps
    assert "no such scene" in text and "ceiling, the true future" in text and "floor, predicts" in text
    assert f"{log.numbers()['warp'].estimates['success'].value:.1f}" in text


def test_a_task_that_says_nothing_of_itself_is_spoken_of_plainly(page):
    text = " ".join(page.texts)
    assert "percent of episodes that succeeded." in text and "succeeded, %" in text
    assert "not succeeded after" in text and "reached" not in text


def test_pictures_are_kept_small_and_inside(page):
    pictures = [attributes["href"] for tag, attributes in page.tags if tag == "image"]
    assert all(picture.startswith("data:image/webp;base64,") for picture in pictures)
    assert len(pictures) == len(set(pictures))  # what two arms or two decisions have in common is there once
    shown = [attributes for tag, attributes in page.tags if "picture" in attributes.get("class", "").split()]
    assert len(shown) > 4 * len(pictures) > 20 and all(attributes["aria-label"] for attributes in shown)
    identifiers = {attributes["id"] for tag, attributes in page.tags if tag == "symbol"}
    uses = {attributes["href"][1:] for tag, attributes in page.tags if tag == "use" and "href" in attributes}
    assert uses == identifiers


def test_text_from_a_run_is_escaped(tmp_path):
    class Evil(LineTask):
        def episodes(self, count):
            return [
                Episode(
                    e.episode_id,
                    EVIL,
                    *[getattr(e, n) for n in ("start_position", "start_yaw", "goal_position", "goal_yaw", "geodesic")],
                )
                for e in super().episodes(count)
            ]

    log = run_arms(
        Evil(broken=("0001",)), {"none": LineAgent(), EVIL: LineAgent()}, 2, out=tmp_path / "run", progress=False
    )
    html = render(log) + log._repr_html_()
    assert EVIL not in html and "&lt;script&gt;alert(1)" in html
    assert sum(tag == "script" for tag, _ in Page(render(log)).tags) == 1


def test_a_run_without_an_ended_episode_still_has_a_page(tmp_path):
    log = run_arms(LineTask(broken=("0000",)), {"none": LineAgent()}, 1, out=tmp_path / "run", progress=False)
    assert "Infrastructure errors" in render(log)


def summary(wins, n=40, saved=0.0):
    outcomes = [
        {
            "arm": arm,
            "episode": i,
            "scene": f"s{i % 8}",
            "status": "done",
            "metrics": {"success": float(arm == "warp" and i < wins), "actions": 9.0 - saved * (arm == "warp") + i % 2},
        }
        for arm in ("none", "warp")
        for i in range(n)
    ]
    return summarise(["none", "warp"], outcomes, n)


def test_the_sentence_claims_no_more_than_the_interval_bears():
    assert "the interval includes 0" in sentence(summary(1))
    assert "includes 0" not in sentence(summary(30)) and "75.0 points more" in sentence(summary(30))
    assert "primitives" not in sentence(summary(1))
    assert "It took 2.0 fewer primitives" in sentence(summary(1, saved=2.0))
    assert sentence(summarise(["none"], [], 3)) == ""


def test_maps_put_world_points_in_their_place():
    frame = frame_of_picture((1100, 600), [[50.0, 0.0, 550.0], [0.0, 50.0, 300.0]])
    episode = Episode("0", "s", (0.0, 0.0, 0.0), 0.0, (2.0, 0.0, -4.0), np.pi / 2, 4.5)
    start, goal = start_and_goal(frame, episode)
    assert (start.x, start.y, start.heading_deg) == (550, 300, 0)
    assert (goal.x, goal.y, goal.heading_deg) == (650, 100, -90)  # -Z is up in the picture, a left turn goes left
    row = {
        "path": [[0, 0, 0], [0, 0, 0], [0, 0, -0.2]],
        "before_x": 0,
        "before_y": 0,
        "before_z": 0,
        "before_yaw": 0.0,
        "after_x": 0,
        "after_y": 0,
        "after_z": -0.2,
        "after_yaw": 0.3,
    }
    way = trail(frame, "warp", [row])
    assert way.points == "550.0,300.0 550.0,290.0" and len(way.stops) == 2
    bare = frame_of_points(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 3.0]]))
    assert bare.metre == 60 and (round(bare.width), round(bare.height)) == (156, 276)


def test_glyphs_name_every_primitive():
    assert glyphs([1, 2, 3]) == "↑↖↗" and glyphs([99]) == "(99)"
