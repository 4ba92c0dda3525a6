# SPDX-License-Identifier: Apache-2.0
"""What is shown of runs whose plans are poses of a gripper: report, view, tables."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from browser import COMMAND, WHY, Browser
from PIL import Image, ImageSequence
from pressing_policy import Pressing
from test_export import contents_of
from test_report import Page

import wiw
from wiw.errors import ArgumentError
from wiw.report.page import render
from wiw.report.site import write_view
from wiw.report.stage import SIDE, Stage, format_signs, read_stage
from wiw.runs.films import film, film_episodes
from wiw.runs.rows import decode_jpeg, select_frames
from wiw.studies.evaluate import evaluate
from wiw.tabletop.workbench import CAMERAS, TABLE
from wiw.tasks.manipulation import Manipulation

ARMS = ("none", "oracle")
PLANS = 2


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """An episode of each of two kinds, two decisions each; all keep pictures, though one is asked for."""
    task = Manipulation("push_buttons,slide_block", actions=4)
    agent = wiw.Agent(Pressing(), candidates=PLANS, horizon=3)
    out = tmp_path_factory.mktemp("poses") / "run"
    return evaluate(task, agent, 2, out=out, arms=ARMS, progress=False, fidelity=True, keep_images=1)


@pytest.fixture(scope="module")
def html(log: Any) -> str:
    return render(log)


def pose(x: float, y: float, z: float, gripper: float = 1.0) -> list[float]:
    return [x, y, z, np.pi, 0, 0, gripper]


HERE = (0.2, 0.0, 1.0)


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        ([pose(0.2, 0.1, 1.0)], "→"),
        ([pose(0.3, 0.0, 1.0)], "↓"),
        ([pose(0.1, -0.1, 1.0)], "↖"),
        ([pose(0.2, 0.0, 0.8, 0.0), pose(0.2, 0.0, 1.0, 0.0), pose(0.2, 0.0, 1.0, 1.0)], "↧● ↥ ·○"),
        ([pose(0.2 + 0.01 * k, 0.0, 1.0, float(k < 30)) for k in range(1, 51)], "↓ ↓● ↓"),
    ],
)
def test_signs_say_where_a_gripper_goes_as_the_camera_sees_it(plan: Any, said: str) -> None:
    assert format_signs(plan, HERE) == said
    assert format_signs(plan, HERE, shut=True)[1:2] in ("○", "") or plan[0][6] == 0


def test_plans_are_drawn_where_the_camera_sees_them() -> None:
    stage = Stage(CAMERAS["front"], TABLE)
    drawing = stage.draw(HERE, [pose(0.2, 0.0, 0.8, 0.0), pose(0.2, 0.2, 0.8, 0.0)])
    (x, y), (u, _) = (map(float, point.split(",")) for point in drawing.points.split()[:2])
    assert x == u == pytest.approx(SIDE / 2) and 0 < y < SIDE
    first, second = drawing.stops
    assert first.place[1] > y and second.place[0] > first.place[0] and first.shut and (second.number, SIDE) == (2, 100)
    assert first.foot[1] > first.place[1] and first.foot[0] == pytest.approx(SIDE / 2)
    long = [pose(0.2, 0.01 * k, 0.8, float(k < 20)) for k in range(50)]
    assert [stop.number for stop in stage.draw(HERE, long).stops] == [21, 50]


def test_many_frames_are_thinned_with_the_last_kept() -> None:
    assert select_frames(5).tolist() == [0, 1, 2, 3, 4]
    kept = select_frames(50)
    assert len(kept) == 20 and kept[-1] == 49 and (np.diff(kept) >= 2).all()


def test_records_say_how_it_ended_and_what_each_kind_shows(log: Any) -> None:
    assert log.store.info["pictures"] == [0, 1]
    for arm in ARMS:
        rows = log.store.decisions(arm, 1)
        assert len(rows) == 2 and all(row["before_distance"] is None for row in rows)
        assert ["end" in log.store.images(arm, 1, row["decision"]) for row in rows] == [False, True]
    assert decode_jpeg(log.store.images("none", 1, 1)["end"]).shape == (480, 480, 3)
    assert read_stage(log.store.info) is not None


def test_films_show_what_truly_happened(log: Any, html: str) -> None:
    for row in log.episodes:
        film = Image.open(io.BytesIO(log.store.film(row["arm"], row["episode"])))
        frames = [np.asarray(frame.convert("RGB"), float) for frame in ImageSequence.Iterator(film)]
        last = max(each["decision"] for each in log.store.decisions(row["arm"], row["episode"]))
        pictures = [log.store.images(row["arm"], row["episode"], at) for at in (0, last)]
        for frame, kept in ((frames[0], pictures[0]["front"]), (frames[-1], pictures[1]["end"])):
            seen = cv2.resize(decode_jpeg(kept), frame.shape[:2], interpolation=cv2.INTER_AREA).astype(float)
            assert np.abs(frame - seen).mean() < 4
        assert 8 < len(frames) < 60 and np.abs(frames[0] - frames[len(frames) // 2]).mean() > 1
    assert html.count('<img class="film moving"') == len(log.episodes)


def test_arms_that_did_the_same_are_filmed_once(log: Any) -> None:
    films = [
        log.store.film("none", 0),
        film(Manipulation().set_table(log.store.episodes()[0]).bench, [pose(*HERE)] * 2),
    ]
    assert films[0] != films[1] and len(films[1]) < len(films[0])
    with pytest.raises(ArgumentError, match="finite pose"):
        film(Manipulation().set_table(log.store.episodes()[0]).bench, [[np.nan] * 7])


def test_failures_that_are_run_again_are_not_filmed() -> None:
    film_episodes(SimpleNamespace(config={"attributes": {}}), SimpleNamespace(build=Manipulation))  # type: ignore[arg-type]


def test_the_report_speaks_of_the_table(log: Any, html: str) -> None:
    page = Page(html)
    text = " ".join(Page(html[html.index("<main") : html.index("<script>")]).texts)
    assert page.open == [] and not re.search(r"panorama|primitive|SPL|metres|\d m\b|radius|goal", text)
    for episode in log.store.episodes():
        assert episode.info["instruction"] in text and episode.kind.replace("_", " ") in text
    assert "Success rate by kind of task" in text and "executed decisions" in text and "Refused" in text


def test_the_report_shows_plans_beside_their_ends(log: Any, html: str) -> None:
    tags = Page(html).tags
    classes = [attributes.get("class") for _, attributes in tags]
    plans, decisions = PLANS * len(log.decisions), len(log.decisions)
    imagined = sum(PLANS for row in log.decisions if row["arm"] == "oracle")
    assert classes.count("plan") == plans and classes.count("pose") + classes.count("pose shut") == sum(
        len(each["actions"]) for row in log.decisions for each in row["proposals"]
    )
    assert classes.count("imagined") == classes.count("true") == imagined
    assert classes.count("tick") == decisions and classes.count("best") >= imagined // PLANS
    shared = {attributes["id"] for tag, attributes in tags if tag == "symbol"}
    used = {attributes["href"][1:] for tag, attributes in tags if tag == "use" and "href" in attributes}
    ends = 2 * len(ARMS)  # two episodes of each; equal pictures are stored once
    assert used == shared and PLANS < len(shared) < decisions + ends + 2 * imagined


def test_exports_hold_poses_and_pictures(log: Any, tmp_path: Path) -> None:
    log.export(csv=tmp_path / "csv")
    with (tmp_path / "csv" / "decisions.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [json.loads(row["executed"]) for row in rows] == [row["executed"] for row in log.decisions]
    pytest.importorskip("rerun")
    log.export(rerun=tmp_path / "run.rrd")
    entities, images = contents_of(tmp_path / "run.rrd")
    assert {"/episode_0001/none/front", "/episode_0001/none/end", "/episode_0000/oracle/planned"} <= entities
    assert not any(entity.endswith("world") or "distance" in entity for entity in entities)
    assert images == sum(len(log.store.images(r["arm"], r["episode"], r["decision"])) for r in log.decisions)


def test_success_is_told_by_kind(log: Any) -> None:
    numbers = log.numbers()
    for kind, found in numbers.kinds.items():
        for arm, estimate in found.items():
            won = [e["metrics"]["success"] for e in log.episodes if (e["arm"], e["task"]) == (arm, kind)]
            assert estimate.value == 100 * np.mean(won) and estimate.n == len(won) == 1
    assert [*numbers.kinds] == ["push_buttons", "slide_block"] and "by kind of task" in str(numbers)


def test_the_view_steps_through_imagined_ways(log: Any, tmp_path: Path) -> None:
    site = write_view(log, tmp_path / "view")
    index, page = site.index.read_text(), (site.index.parent / "episodes" / "0001.html").read_text()
    assert "Path" not in index and "push buttons" in index and " m<" not in index
    assert log.store.episodes()[1].info["instruction"] in index
    assert page.count('type="range" min="1" max="3"') == 2 and "metres" not in page
    if COMMAND is None:
        pytest.skip(WHY)
    browser = Browser(tmp_path / "profile")
    browser.open((site.index.parent / "episodes" / "0001.html").as_uri() + "#1.1")
    place = "getComputedStyle(document.querySelector('.step-page:not([hidden]) .future')).objectPosition"
    assert browser.ask(place) == "100% 50%"
    slider = "document.querySelector('.attempt-page:not([hidden]) .step-page:not([hidden]) .scrub input')"
    browser.ask(f"{slider}.value = 2; {slider}.dispatchEvent(new Event('input'))")
    shown = "document.querySelector('.attempt-page:not([hidden]) .step-page:not([hidden]) .future')"
    assert browser.ask(f"getComputedStyle({shown}).objectPosition") == "50% 50%"
    assert browser.ask("document.querySelectorAll('.pose.lit').length") == PLANS
    widths = browser.ask(
        "Promise.all([...document.images].filter(i => i.checkVisibility())"
        ".map(i => i.decode().then(() => i.naturalWidth / i.naturalHeight)))"
    )
    assert sorted(widths) == [1, *[3] * 2 * PLANS]  # the film, and imagined and true ways of three frames
    assert browser.complaints() == []
    browser.close()
