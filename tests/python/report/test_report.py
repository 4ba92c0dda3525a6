# SPDX-License-Identifier: Apache-2.0
import json
import re
import sqlite3
from contextlib import closing
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from fakes import LineAgent, LineTask, PictureTask
from matplotlib.axes import Axes

from wiw.analysis.intervals import wilson
from wiw.analysis.summary import summarise
from wiw.errors import ArgumentError
from wiw.report.episodes import read_stories
from wiw.report.maps import frame_of_picture, frame_of_points, start_and_goal, trail
from wiw.report.page import SCALES, _gather_findings, _render_page, render, sentence
from wiw.report.plans import format_glyphs
from wiw.report.plots import (
    BLAME_COLORS,
    PALETTE,
    _choose_text_color,
    arm_colors,
    arm_markers,
    success_by_arm,
    success_by_distance,
)
from wiw.report.story import Album
from wiw.report.templating import environment
from wiw.runs.pictures import choose_pictured_episodes
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import run_arms
from wiw.studies.run_log import load_run
from wiw.types import Episode, Wording

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
    assert "no such scene" in text and "reference, the true future" in text and "floor, predicts" in text
    assert f"{log.numbers()['warp'].estimates['success'].value:.1f}" in text


def test_a_goal_whose_place_is_not_known_is_not_drawn(tmp_path):
    log = run_arms(PictureTask(), {"none": LineAgent()}, 2, out=tmp_path / "run", progress=False)
    log.report(tmp_path / "report" / "page.html")
    log.view(tmp_path / "view")
    for folder in ("report", "view"):
        text = "".join(page.read_text() for page in (tmp_path / folder).rglob("*.html"))
        assert "<polyline" in text and 'class="start"' in text and 'class="goal"' not in text
        assert not re.search(r"""["' ,(]nan["' ,)]""", text)


def test_the_headline_is_of_world_models_alone(log):
    lines = [line for line in log.numbers().arms if line.name in ("none", "copy", "oracle")]
    assert sentence(replace(log.numbers(), arms=tuple(lines))) == ""


def test_a_task_that_says_nothing_of_itself_is_spoken_of_plainly(page):
    text = " ".join(page.texts)
    assert "percent of episodes that succeeded." in text and "success rate, %" in text
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


def count_stories(file):
    return sum(tag == "article" for tag, _ in Page(file.read_text(encoding="utf-8")).tags)


def test_a_report_shows_as_many_episodes_as_asked_the_most_telling_first(log, tmp_path):
    assert count_stories(log.report(tmp_path / "two.html")) == 2
    one = log.report(tmp_path / "one.html", episodes=1)
    assert count_stories(one) == 1
    assert f'id="episode-{choose_pictured_episodes(log.store)[0]}"' in one.read_text(encoding="utf-8")
    assert count_stories(log.report(tmp_path / "none.html", episodes=0)) == 0


def test_a_report_of_limited_size_shrinks_pictures_and_then_leaves_out_episodes(log, tmp_path):
    findings = _gather_findings(log)
    sizes = {
        (episodes, scale): len(_render_page(log, findings, episodes, scale, "").encode())
        for episodes, scale in ((2, 1.0), (2, SCALES[-1]), (1, 1.0), (1, SCALES[-1]), (0, 1.0))
    }
    shrunk = log.report(tmp_path / "shrunk.html", max_mb=(sizes[2, 1.0] - 1) / 1e6)
    assert count_stories(shrunk) == 2
    assert sizes[2, SCALES[-1]] <= shrunk.stat().st_size < sizes[2, 1.0]
    fewer = log.report(tmp_path / "fewer.html", max_mb=(sizes[2, SCALES[-1]] - 1) / 1e6)
    assert count_stories(fewer) == 1
    assert fewer.stat().st_size == sizes[1, 1.0] < sizes[2, SCALES[-1]], (
        "one episode fits with its pictures as they are"
    )
    bare = log.report(tmp_path / "bare.html", max_mb=(sizes[1, SCALES[-1]] - 1) / 1e6)
    assert count_stories(bare) == 0
    with pytest.raises(ArgumentError, match="tables and plots alone take"):
        log.report(tmp_path / "no.html", max_mb=(sizes[0, 1.0] - 1) / 1e6)
    with pytest.raises(ArgumentError, match="expected max_mb above 0, got -1"):
        log.report(tmp_path / "no.html", max_mb=-1)
    with pytest.raises(ArgumentError, match="episodes of at least 0"):
        log.report(tmp_path / "no.html", episodes=-1)
    assert not (tmp_path / "no.html").exists()


def test_shrunk_pictures_are_shown_as_large_as_others(log):
    pages = [Page(render(log, 1, scale)) for scale in (1.0, SCALES[-1])]
    strips, small = (
        [tuple(map(int, a["viewbox"].split()[2:])) for _, a in page.tags if a.get("class") == "picture"]
        for page in pages
    )
    assert len(strips) == len(small) > 0
    assert all(
        abs(a - b) <= 2 for one, other in zip(strips, small, strict=True) for a, b in zip(one, other, strict=True)
    )


def test_the_title_names_task_and_folder_once(log):
    text = render(log, 0)
    assert "<title>line · run</title>" in text or "<title>run</title>" in text


def test_plots_carry_no_metadata_and_numbers_on_bars_can_be_read(page):
    assert not any(tag.startswith(("rdf:", "metadata")) for tag, _ in page.tags)
    assert _choose_text_color("#ffffff") == "black" and _choose_text_color("#000000") == "white"
    assert _choose_text_color(BLAME_COLORS["beyond"]) == "black", "3.2 : 1 in white"


def test_counts_of_one_are_singular():
    count = environment().filters["counted"]
    assert [count("consultations", 1), count("rows", 3)] == ["1 consultation", "3 rows"]


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


def test_an_arm_with_errors_alone_is_left_out_of_the_plot_of_ranks(tmp_path):
    arms = {name: LineAgent() for name in ("none", "warp", "oracle")}
    with closing(run_arms(LineTask(), arms, 2, out=tmp_path / "run", progress=False)):
        pass
    ranked = {"scores": [0.25, 0.5], "rank": 0.5, "regret": 0.1, "best": False, "psnr": [21.5] * 2, "ssim": [0.7] * 2}
    with closing(sqlite3.connect(store_path(tmp_path / "run"))) as store, store:
        store.execute("UPDATE decision SET fidelity = ?", (json.dumps(ranked),))
        store.execute(
            "UPDATE outcome SET status = 'error', metrics = '{}', error = 'RuntimeError: lost', kind = 'environment' "
            "WHERE arm = 'warp'"
        )
    with closing(load_run(tmp_path / "run")) as log:
        figures = {title: str(drawing) for title, _, drawing in _gather_findings(log)["plots"]}
    assert ">oracle<" in figures["Rank agreement and success"] and "warp" not in figures["Rank agreement and success"]


def list_ways(arms, length):
    """Return 30 ended episodes, the i-th with a path of `length(i)` metres, the same of each arm."""
    rows = [
        {"geodesic": length(i), "scene": f"s{i % 10}", "metrics": {"success": float(i % 3 == 0)}} for i in range(30)
    ]
    return dict.fromkeys(arms, rows)


def list_single(arms):
    """Return an ended episode of each arm."""
    return [{"arm": arm, "episode": 0, "scene": "s", "status": "done", "metrics": {"success": 1.0}} for arm in arms]


@pytest.mark.parametrize("name", ["a$^$b", "$b$", "_mine", "__"])
def test_plots_show_names_of_arms_as_they_are(name):
    assert f">{name}<" in success_by_arm(summarise(["none", name], list_single(["none", name]), 1))
    drawn = str(success_by_distance(list_ways(["none", name], lambda i: 3.0 + i), Wording()))
    assert f">{name}<" in drawn.replace("> ", ">")


def test_equally_long_paths_are_one_bin_with_the_arms_beside_each_other():
    drawn = success_by_distance(list_ways(["none", "warp"], lambda i: 4.0), Wording())
    uneven = success_by_distance(list_ways(["none", "warp"], lambda i: 4.0 + (i >= 15)), Wording())
    marker = re.compile(r'<use [^>]*x="([\d.]+)"[^>]*style="fill: #(?:8b9099|4c78a8)')
    assert [len(set(marker.findall(each))) for each in (drawn, uneven)] == [4, 6]  # of which two in the legend


def test_rates_by_distance_have_intervals_over_scenes(monkeypatch):
    """Episodes of a scene that all end alike say little more than one of them."""
    drawn = []
    monkeypatch.setattr(Axes, "errorbar", lambda self, x, y, yerr, **style: drawn.append((y, np.array(yerr))))
    rows = [
        {
            "geodesic": 4.0,
            "scene": f"apartments:val/{i // 10}?state:floor_lamp_{i}=off",
            "metrics": {"success": float(i < 20)},
        }
        for i in range(40)
    ]
    success_by_distance({"none": rows}, Wording())
    ((rate,), ((below,), (above,))) = drawn[0]
    low, high = wilson(0.5, 40)
    assert rate == 50 and below > 1.5 * (50 - 100 * low) and above > 1.5 * (100 * high - 50)


def test_arms_of_one_colour_have_different_markers():
    arms = ["none", "oracle", *(f"arm {number}" for number in range(3 * len(PALETTE)))]
    colors, markers = arm_colors(arms), arm_markers(arms)
    assert len({(colors[arm], markers[arm]) for arm in arms}) == len(arms)
    assert markers["arm 0"] == markers["oracle"] == "o"


def test_plots_of_many_arms_have_room_for_their_names():
    names = ["none", *(f"error-blur@{number}" for number in range(40))]
    beside = success_by_arm(summarise(names, list_single(names), 1))
    above = success_by_distance(list_ways(names, lambda i: 3.0 + i), Wording())
    few = success_by_arm(summarise(names[:3], list_single(names[:3]), 1))
    heights = [float(re.search(r'height="([\d.]+)pt"', each)[1]) for each in (beside, above, few)]
    assert heights[0] > 41 * 12 and heights[1] > 20 * 12 + 150 and heights[2] == pytest.approx(3.1 * 72)


@pytest.mark.filterwarnings("error::UserWarning")
def test_a_long_name_without_a_place_to_break_leaves_room_for_the_plot():
    names = ["none", "m" * 200]
    beside = success_by_arm(summarise(names, list_single(names), 1))
    above = success_by_distance(list_ways(names, lambda i: 3.0 + i), Wording())
    assert beside.count("m" * 28 + "<") >= 7 and above.count("m" * 30 + "<") >= 6


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
    assert "no evidence of a difference" in sentence(summary(1))
    assert "no evidence" not in sentence(summary(30)) and "75.0 points more" in sentence(summary(30))
    assert "primitives" not in sentence(summary(1))
    assert "It took 2.0 fewer primitives" in sentence(summary(1, saved=2.0))
    assert sentence(summarise(["none"], [], 3)) == ""
    assert "in 100.0 % of 1 episode," in sentence(summarise(["none", "warp"], list_single(["none", "warp"]), 1))


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
    assert format_glyphs([1, 2, 3]) == "↑↖↗" and format_glyphs([99]) == "(99)"
