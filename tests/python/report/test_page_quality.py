# SPDX-License-Identifier: Apache-2.0
"""Pages on a phone and a desktop, in a browser: nothing wider than the window, readable contrast, headings in order."""

from __future__ import annotations

from itertools import pairwise

import pytest
from aeqa_runs import Ended, color_question, free_question, make_episodes, write_run
from browser import COMMAND, WHY, Browser
from fakes import LineAgent, LineTask

from wiw.report.site import write_view
from wiw.studies.evaluate import run_arms
from wiw.studies.run_log import load_run

pytestmark = pytest.mark.skipif(COMMAND is None, reason=WHY)

OVERFLOWING = """
[...document.querySelectorAll("body *")].filter((element) => {
  const box = element.getBoundingClientRect();
  return box.width > 0 && box.right > screen.width + 1 && !element.closest(".scroll, .timeline, pre, .shared");
}).map((element) => element.outerHTML.slice(0, 120))
"""
LOW_CONTRAST = """
(() => {
  const canvas = Object.assign(document.createElement("canvas"), {width: 1, height: 1});
  const brush = canvas.getContext("2d", {willReadFrequently: true});
  const rgba = (color) => {
    brush.clearRect(0, 0, 1, 1);
    brush.fillStyle = color;
    brush.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = brush.getImageData(0, 0, 1, 1).data;
    return [r, g, b, a / 255];
  };
  const over = (top, under) => [0, 1, 2].map((i) => top[i] * top[3] + under[i] * (1 - top[3])).concat(1);
  const linear = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
  const luminance = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const found = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement, text = walker.currentNode.data.trim();
    if (!text || element.closest("svg, script, style, select, [hidden]") || !element.checkVisibility()) continue;
    const lineage = [];
    for (let e = element; e; e = e.parentElement) lineage.unshift(e);
    let background = [255, 255, 255, 1], opacity = 1;
    for (const e of lineage) {
      const style = getComputedStyle(e);
      background = over(rgba(style.backgroundColor), background);
      opacity *= style.opacity;
    }
    const ink = rgba(getComputedStyle(element).color);
    ink[3] *= opacity;
    const pair = [luminance(over(ink, background)), luminance(background)];
    const ratio = (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05);
    if (ratio < 4.5) found.push(`${ratio.toFixed(2)} ${element.outerHTML.slice(0, 60)}`);
  }
  return [...new Set(found)];
})()
"""
COLLIDING = """
[...document.querySelectorAll(".plots svg")].flatMap((drawing) => {
  const texts = [...drawing.querySelectorAll("text")], frame = drawing.getBoundingClientRect();
  const boxes = texts.map((text) => text.getBoundingClientRect());
  const outside = texts.filter((_, i) => boxes[i].left < frame.left - 2 || boxes[i].right > frame.right + 2);
  const meet = (a, b) => a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 2 && b.top < a.bottom - 2;
  const pairs = texts.filter((_, i) => boxes.some((box, k) => k > i && meet(boxes[i], box)));
  return [...outside, ...pairs].map((text) => text.textContent.trim());
})
"""
OPEN_ALL = "document.querySelectorAll('details').forEach((element) => { element.open = true; }); 0"


@pytest.fixture(scope="module")
def addresses(tmp_path_factory):
    """Report, list and an episode's page of a run with an error, a long arm name and all pictures."""
    arms = {"none": 0.4, "copy": 0.5, "placebo-shuffled:a_model_with_a_long_name": 0.8, "oracle": 1.0}
    log = run_arms(
        LineTask(broken=("0001",)),
        {name: LineAgent(drive) for name, drive in arms.items()},
        6,
        out=tmp_path_factory.mktemp("pages") / "run",
        progress=False,
    )
    site = write_view(log, log.path / "view")
    episode = site.index.parent / "episodes" / "0000.html"
    answers = load_run(write_questions(tmp_path_factory.mktemp("answers") / "run")).report()
    return {
        "report": log.report().as_uri(),
        "list": site.index.as_uri(),
        "episode": episode.as_uri(),
        "answers": answers.as_uri(),
    }


def write_questions(folder):
    """A run of questions with everything that its report can show: categories, twins, approximate marks, five arms."""
    named = [("attribute recognition", "blue"), ("object state recognition", "red"), ("object localization", "white")]
    questions = [color_question(color, category) for category, color in named * 3]
    questions += [color_question("blue", twin="q10"), color_question("red", twin="q9"), free_question("it is night")]
    scenes = [f"apartments:val/{index}" for index in range(10)] + ["apartments:val/9?remove:tv_1", "apartments:val/7"]
    ends = [Ended("blue", 20 + 20 * index, 3.0 + index) for index in range(len(questions))]
    arms = ("none", "copy", "warp", "placebo-shuffled:a_model_with_a_long_name", "oracle")
    return write_run(folder, make_episodes(questions, scenes), dict.fromkeys(arms, ends))


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    page = Browser(tmp_path_factory.mktemp("profile"))
    yield page
    page.close()


PAGES = pytest.mark.parametrize("page", ["report", "list", "episode", "answers"])


@PAGES
def test_a_phone_needs_no_horizontal_scroll(addresses, browser, page):
    browser.resize(390, 844)
    browser.open(addresses[page])
    browser.ask(OPEN_ALL)
    assert browser.ask(OVERFLOWING) == []
    assert browser.ask("document.documentElement.scrollWidth") == 390


@PAGES
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_has_enough_contrast(addresses, browser, page, theme):
    browser.resize(1280, 900)
    browser.open(addresses[page])
    browser.ask(f"document.documentElement.dataset.theme = '{theme}'")
    browser.ask(OPEN_ALL)
    assert browser.ask(LOW_CONTRAST) == []


@PAGES
def test_headings_are_in_order_and_no_header_is_empty(addresses, browser, page):
    browser.open(addresses[page])
    levels = browser.ask(
        "[...document.querySelectorAll('h1, h2, h3, h4')].map((heading) => Number(heading.tagName[1]))"
    )
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    assert browser.ask("[...document.querySelectorAll('th')].filter((cell) => !cell.textContent.trim()).length") == 0
    assert browser.ask("[...document.images].every((image) => image.hasAttribute('alt'))")


def test_tables_of_answers_fit_a_desktop(addresses, browser):
    browser.resize(1280, 900)
    browser.open(addresses["answers"])
    assert browser.ask("document.querySelectorAll('.scroll').length") > 8
    scrolled = "[...document.querySelectorAll('#results .scroll')].filter((e) => e.scrollWidth > e.clientWidth)"
    assert browser.ask(f"{scrolled}.map((e) => e.textContent.trim().slice(0, 60))") == []


@pytest.mark.parametrize("page", ["report", "answers"])
@pytest.mark.parametrize("width", [390, 1280])
def test_texts_of_plots_do_not_collide(addresses, browser, width, page):
    browser.resize(width, 900)
    browser.open(addresses[page])
    assert browser.ask("document.querySelectorAll('.plots svg text').length") > 20
    assert browser.ask(COLLIDING) == []
