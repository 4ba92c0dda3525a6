# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import re
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from html.parser import HTMLParser
from urllib.parse import unquote

import numpy as np
import pytest
from browser import COMMAND, WHY, Browser
from fakes import LineAgent, LineTask
from locations import PYTHON_TESTS
from PIL import Image

from wiw.cli import main
from wiw.errors import ArgumentError, FileError, StoreError
from wiw.report.site import PictureFolder, write_view
from wiw.runs.rows import decode_jpeg, encode_jpeg
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import run_arms
from wiw.studies.run_log import load_run
from wiw.types import Episode

EVIL = """<img src=x onerror="document.title='owned'">'"/../&"""
HOSTILE = (
    EVIL + """</title></textarea></style></script><script>window.owned=1</script><img src=x onerror="window.owned=1">"""
)
ARMS = ("none", "warp", EVIL)


TRUTH = {"scores": [0.25, 0.5], "rank": None, "regret": 0.25, "best": False, "psnr": [None, 21.34], "ssim": [None, 0.7]}


class EvilTask(LineTask):
    """Scenes and errors with names that try to become part of the page."""

    def episodes(self, count):
        names = ("start_position", "start_yaw", "goal_position", "goal_yaw", "geodesic")
        plain = super().episodes(count)
        return [Episode(e.episode_id, f"{EVIL}{i % 3}", *[getattr(e, n) for n in names]) for i, e in enumerate(plain)]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Nine episodes of three arms, two of them errors; all have pictures, one decision has its true future."""
    arms = dict(zip(ARMS, (LineAgent(0.4), LineAgent(0.9), LineAgent(0.6)), strict=True))
    out = tmp_path_factory.mktemp("view") / "run"
    log = run_arms(EvilTask(broken=("0004", "0007")), arms, 9, out=out, progress=False, keep_images="all")
    strip = np.concatenate([np.full((160, 160, 3), 40 * k, np.uint8) for k in range(5)], axis=1)
    with sqlite3.connect(store_path(out)) as store:
        store.execute("INSERT INTO image VALUES ('warp', 0, 0, 'true/1', ?)", (encode_jpeg(strip),))
        store.execute(
            "UPDATE decision SET fidelity = ? WHERE arm = 'warp' AND episode = 0 AND decision = 0", (json.dumps(TRUTH),)
        )
    return log


@pytest.fixture(scope="module")
def site(log):
    return write_view(log, log.path / "view")


class Page(HTMLParser):
    def __init__(self, html):
        super().__init__()
        self.tags = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))


def pages(site):
    return [site.index, *sorted((site.index.parent / "episodes").iterdir())]


def test_every_address_is_a_file_beside_and_every_picture_is_shown(log, site):
    shown = set()
    for file in pages(site):
        for tag, attributes in Page(file.read_text()).tags:
            address = attributes.get("src") or attributes.get("href")
            if address and not address.startswith("#"):
                target = (file.parent / unquote(address)).resolve()
                assert target.is_file() and target.is_relative_to(site.index.parent), (tag, address)
                shown |= {target} if "images" in address else set()
    assert shown == set((site.index.parent / "images").iterdir()) and len(shown) == site.pictures
    decisions = len(log.decisions)
    assert site.pictures == 3 * decisions + 7 + 1  # panorama and two strips each; goals of 7 episodes; one true strip
    assert all(Image.open(file).size[0] > 20 for file in shown)


def test_a_plan_says_how_true_its_imagination_was(site):
    html = (site.index.parent / "episodes" / "0000.html").read_text()
    assert html.count('class="best"') == 1 and html.count('class="true"') == 1
    assert "<small>true score 0.250</small>" in html and ">true score 0.500 · PSNR 21.3 dB · SSIM 0.70</small>" in html
    assert html.count("regret 0.250 · propose") == 1 and "rank agreement" not in html


def test_names_from_the_run_stay_text(log, site):
    for file in pages(site):
        html = file.read_text()
        assert 'onerror="document' not in html and "<img src=x" not in html
        assert [tag for tag, _ in Page(html).tags].count("script") == 1
    assert all(re.fullmatch(r"[\w.-]+", file.name) for file in (site.index.parent / "images").iterdir())
    assert {p.name for p in site.index.parent.iterdir()} == {"index.html", "episodes", "images"}


@pytest.mark.parametrize("categories", [(), ("chair",)])
def test_what_was_not_measured_is_left_out(tmp_path, categories):
    log = run_arms(LineTask(), {"none": LineAgent(0.0)}, 2, out=tmp_path / "run", progress=False, keep_images="all")
    nothing = json.dumps({"success": 0, "decisions": 1, "distance_to_goal": None, "predicted": None})
    with sqlite3.connect(store_path(log.path)) as store:
        store.execute("UPDATE outcome SET metrics = ?", (nothing,))
        config = "json_set(config, '$.task.categories', json(?))"
        store.execute(f"UPDATE run SET config = {config}", (json.dumps(categories),))
    log = load_run(log.path)
    made = [write_view(log, tmp_path / "view").index.parent / "episodes" / "0000.html", log.report()]
    said = f"{'no answer' if categories else 'not succeeded'} after {len(log.store.decisions('none', 0))} decisions"
    assert all(re.search(rf"{said}\s*<", file.read_text()) for file in made)


def test_a_view_is_replaced_and_nothing_else_is(log, tmp_path, capsys):
    assert main(["view", str(log.path), "--out", str(tmp_path / "v")]) == 0
    assert main(["view", str(log.path), "--out", str(tmp_path / "v")]) == 0
    assert "9 episodes" in capsys.readouterr().out and [p.name for p in tmp_path.iterdir()] == ["v"]
    (tmp_path / "v" / "thesis.tex").write_text("mine")
    with pytest.raises(FileError, match="is not empty"):
        log.view(tmp_path / "v")
    assert (tmp_path / "v" / "thesis.tex").exists()


def test_a_picture_that_cannot_be_made_is_told(tmp_path):
    with ThreadPoolExecutor(2) as pool:
        album = PictureFolder(tmp_path / "images", pool)
        assert [album.draw(name, lambda name=name: name.encode()).source for name in "ab"] == [
            "../images/a.webp",
            "../images/b.webp",
        ]
        album.finish()
        assert (tmp_path / "images/b.webp").read_bytes() == b"b" and (album.count, album.size) == (2, 2)
        album.draw("c", lambda: decode_jpeg(b"no picture"))
        with pytest.raises(StoreError, match="not a JPEG"):
            album.finish()


def test_a_run_that_goes_on_shows_what_has_ended(tmp_path):
    log = run_arms(LineTask(), {"none": LineAgent(), "warp": LineAgent()}, 3, out=tmp_path / "run", progress=False)
    with sqlite3.connect(store_path(tmp_path / "run")) as store:
        store.execute("DELETE FROM outcome WHERE episode = 2 OR arm = 'warp'")
    site = write_view(log, tmp_path / "v")
    assert site.episodes == 2 and not (tmp_path / "v/episodes/0002.html").exists()
    assert site.index.read_text().count('class="end open"') == 4  # two of warp's and both of the last episode's


def test_keeping_pictures_of_every_episode_is_asked_by_name(log, tmp_path):
    assert sorted(log.store.info["pictures"]) == list(range(9))
    with pytest.raises(ArgumentError, match="keep_images of at least 0, got -1"):
        run_arms(LineTask(), {"none": LineAgent()}, 1, out=tmp_path / "run", progress=False, keep_images=-1)
    task = f"{PYTHON_TESTS / 'fakes.py'}:line_task"
    command = ["run", task, "--policy", "heuristic", "--episodes", "3", "--no-report", "--out", str(tmp_path / "c")]
    assert main([*command, "--keep-images", "all"]) == 0
    pictures = sqlite3.connect(store_path(tmp_path / "c")).execute("SELECT count(DISTINCT episode) FROM image")
    assert pictures.fetchone() == (3,)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if COMMAND is None:
        pytest.skip(WHY)
    page = Browser(tmp_path_factory.mktemp("profile"))
    yield page
    page.close()


def choose(browser, **values):
    for name, value in values.items():
        browser.ask(
            f"form.elements[{json.dumps(name)}].value = {json.dumps(value)}; form.dispatchEvent(new Event('input'))"
        )


def listed(browser):
    return browser.ask(
        "[...document.querySelectorAll('.list tbody tr')].map((r, i) => r.hidden ? -1 : i).filter(i => i >= 0)"
    )


def states(log, arm):
    ended = {row["episode"]: row for row in log.episodes if row["arm"] == arm}
    return [
        "error" if ended[i]["status"] == "error" else "success" if ended[i]["metrics"]["success"] else "failure"
        for i in range(9)
    ]


def test_filters_find_episodes_in_a_browser(log, site, browser):
    browser.open(site.index.as_uri())
    none, warp = states(log, "none"), states(log, "warp")
    assert {"success", "error"} <= set(warp) and "failure" in none
    assert listed(browser) == list(range(9))
    choose(browser, arm="1", state="success")
    assert listed(browser) == [i for i in range(9) if warp[i] == "success"]
    choose(browser, arm="", state="error")
    assert listed(browser) == [4, 7]
    choose(browser, state="", won="1", lost="0")
    better = [i for i in range(9) if (warp[i], none[i]) == ("success", "failure")]
    assert better and listed(browser) == better
    choose(browser, won="", lost="", scene="2")
    assert listed(browser) == [2, 5, 8]
    assert browser.ask("document.getElementById('count').textContent") == "3 of 9"
    assert browser.ask("location.hash") == "#scene=2"
    browser.open("about:blank")
    browser.open(site.index.as_uri() + "#scene=2&arm=0&state=success")
    assert listed(browser) == [i for i in (2, 5, 8) if none[i] == "success"]
    assert browser.ask("document.title") == "line · run" and browser.complaints() == []


LOADED = """Promise.all([...document.querySelectorAll('img')].filter((i) => i.checkVisibility())
    .map((i) => i.decode().then(() => i.naturalWidth)))"""
VISIBLE = "[...document.querySelectorAll('.step-page')].filter((i) => i.checkVisibility()).length"


def test_every_decision_opens_with_its_pictures_in_a_browser(log, site, browser, tmp_path):
    browser.open((site.index.parent / "episodes" / "0000.html").as_uri())
    for arm in range(3):
        browser.ask(f"document.querySelectorAll('.tabs button')[{arm}].click()")
        for step in range(len(log.store.decisions(ARMS[arm], 0))):
            browser.ask(f"document.querySelectorAll('.attempt-page')[{arm}].querySelectorAll('.chip')[{step}].click()")
            widths = browser.ask(LOADED)
            assert len(widths) == 4 + (arm == 1 and step == 0) and min(widths) > 20
            assert browser.ask(VISIBLE) == 1 and browser.ask("location.hash") == f"#{arm}.{step + 1}"
    browser.ask("dispatchEvent(new KeyboardEvent('keydown', {key: '2'}))")
    browser.ask("show(1, 0); dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}))")
    assert browser.ask("location.hash") == "#1.2" and browser.ask(VISIBLE) == 1
    assert browser.ask("document.title").startswith("Episode 0") and browser.complaints() == []
    (tmp_path / "page.png").write_bytes(browser.screenshot())
    pixels = np.asarray(Image.open(tmp_path / "page.png").convert("RGB"))
    assert pixels.shape[1] == 1300 and len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50


def test_a_failed_episode_shows_its_error_in_a_browser(site, browser):
    browser.open((site.index.parent / "episodes" / "0004.html").as_uri())
    text = browser.ask("document.body.innerText")
    assert "no such scene" in text and EVIL in text
    assert browser.ask("document.querySelectorAll('img').length") == 0


def test_a_hostile_run_runs_no_script_in_a_browser(tmp_path, browser):
    """Whatever text a run holds, of names, notes, questions, replies and errors, is markup that would call `owned`."""
    arms = {EVIL: LineAgent(0.4), "b": LineAgent(0.9)}
    log = run_arms(EvilTask(broken=("0001",)), arms, 3, out=tmp_path / "run", progress=False, keep_images="all")
    exchange = dict.fromkeys(("purpose", "model", "problem", "instead"), HOSTILE)
    exchange |= {"said": [{"call": HOSTILE, "text": HOSTILE, "finish": HOSTILE}], "result": {"by": HOSTILE}}
    details = dict.fromkeys(("question", "answer", "given", "believed", "category", HOSTILE), HOSTILE)
    with sqlite3.connect(store_path(tmp_path / "run")) as store:
        proposals = json.dumps([{"actions": [1], "prior": 0.5, "note": HOSTILE}] * 2)
        store.execute("UPDATE decision SET note = ?, proposals = ?", (HOSTILE, proposals))
        store.execute("UPDATE decision SET exchanges = ?", (json.dumps([exchange]),))
        store.execute("UPDATE outcome SET error = ?, details = ?", (HOSTILE, json.dumps(details)))
        store.execute("UPDATE episode SET info = ?", (json.dumps(details),))
    made = [write_view(log, tmp_path / "view").index, log.report(tmp_path / "report.html")]
    for file in (*pages(write_view(log, tmp_path / "again")), *made):
        browser.open(file.as_uri())
        assert browser.ask("typeof window.owned") == "undefined" and browser.ask("document.title") != "owned", file
        assert browser.ask("document.querySelectorAll('script').length") == 1, file
        assert "owned" in browser.ask("document.body.innerText"), "the text is shown"
    can_run = "document.body.innerHTML = document.body.innerText; new Promise(done => setTimeout(done, 200))"
    browser.ask(can_run)
    assert browser.ask("typeof window.owned") == "number", "the text would run if it were markup"
