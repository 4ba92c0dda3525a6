# SPDX-License-Identifier: Apache-2.0
"""A user's prompt templates: whatever they do ends soon, in a prompt or in an error that names the file."""

from __future__ import annotations

import itertools
import pickle
from pathlib import Path

import pytest

from wiw.errors import PromptError
from wiw.policies.vlm.prompts.templates import FOLDER, SETS, SLOTS, Prompts, get_slots, list_tasks

LOOP = "{% for a in range(99999) %}"


def own_prompt(folder: Path, source: str) -> Path:
    file = folder / "imagenav/planner.j2"
    file.parent.mkdir(exist_ok=True)
    file.write_text(source)
    return file


@pytest.fixture
def less_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wiw.vlm.template_worker.SECONDS", 0.5)


@pytest.mark.usefixtures("less_time")
@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("{{ 'x' * 10 ** 9 }}", "MemoryError"),
        ("{{ ('x' * 10 ** 9) | length }}", "MemoryError"),
        ("{{ '%1000000000d' | format(1) }}", "MemoryError"),
        ("{{ 9 ** (9 ** 9) }}", "at most 0.5 s to fill"),
        (LOOP * 3 + "{% endfor %}" * 3, "at most 0.5 s to fill"),
        (LOOP + "{{ 'walk ' * 9 }}{% endfor %}", "at most 1048576 characters"),
        ("{% macro again() %}{{ again() }}{% endmacro %}{{ again() }}", "(RecursionError|recursion)"),
        ("{{ " + "(" * 5000 + ")" * 5000 + " }}", "(RecursionError|recursion)"),
        ("{% raw %}", "a raw block does not end"),
        ("Walk!{% raw %}", "a raw block does not end"),
        ("Walk!{#", "(a comment block does not end|Missing end of comment)"),
    ],
)
def test_a_template_that_takes_too_much_or_does_not_end_is_refused(tmp_path: Path, source: str, said: str) -> None:
    own_prompt(tmp_path, source)
    with pytest.raises(PromptError, match=rf"(?s)imagenav/planner\.j2: .*{said}"):
        Prompts(tmp_path)


@pytest.mark.usefixtures("less_time")
def test_a_template_may_be_too_much_for_one_situation_and_not_for_the_next(tmp_path: Path) -> None:
    own_prompt(tmp_path, "{{ 'x' * plan_num }}{% for a in range(plan_num) %}" + LOOP + "{% endfor %}{% endfor %}")
    own = Prompts(tmp_path)
    assert own.render("imagenav", "planner", **{**SLOTS, "plan_num": 2}) == "xx"
    for plan_num, said in ((2000, "at most 0.5 s"), (2 << 20, "at most 1048576 characters")):
        with pytest.raises(PromptError, match=said):
            own.render("imagenav", "planner", **{**SLOTS, "plan_num": plan_num})
    again = pickle.loads(pickle.dumps(own))
    assert own.render("imagenav", "planner", **SLOTS) == again.render("imagenav", "planner", **SLOTS) == "x"
    assert own.digest == again.digest


def test_raw_and_comment_blocks_that_end_are_fine(tmp_path: Path) -> None:
    own_prompt(tmp_path, "{# a note #}{% raw %}{{ braces }}{% endraw %} {{ plan_num }}")
    assert Prompts(tmp_path).render("imagenav", "planner", **SLOTS) == "{{ braces }} 1"


@pytest.mark.parametrize("task", list_tasks())
def test_shipped_templates_say_the_same_as_a_users(tmp_path: Path, task: str) -> None:
    slots = get_slots(task)
    (tmp_path / task).mkdir()
    for file in (FOLDER / task).glob("*.j2"):
        (tmp_path / task / file.name).write_text(file.read_text())
    own, shipped = Prompts(tmp_path), Prompts()
    for file in (FOLDER / task).glob("*.j2"):
        text = own.render(task, file.stem, **slots)
        assert text == shipped.render(task, file.stem, **slots) and text
    assert own.digest == shipped.digest


IMAGINED = (("ar", "planner_imagined"), ("imagenav", "planner_imagined"), ("imagenav", "chooser"))
"""Prompts that come with the frames of plans."""


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize(("task", "question"), IMAGINED)
def test_prompts_say_how_frames_are_shown(name: str, task: str, question: str) -> None:
    for shown, captions in itertools.product(("strip", "frames"), (True, False)):
        text = Prompts(name).render(task, question, **{**SLOTS, "shown": shown, "captions": captions})
        assert ("row of" in text) == (shown == "strip") and ("one picture a frame" in text) == (shown == "frames")
        assert ("number and name of the action" in text) == captions
        assert ("in the order of the plan's actions." in text) == (not captions)


@pytest.mark.parametrize("name", SETS)
def test_prompts_say_whether_views_are_centred_on_the_target(name: str) -> None:
    for shown, centred in itertools.product(("strip", "frames"), (True, False)):
        text = Prompts(name).render("ar", "answerer_imagined", **{**SLOTS, "shown": shown, "centred": centred})
        assert ("front view" in text) == (not centred) and "boxed in red" in text
        assert name == "minimal" or ("centred on the same thing" in text) == centred
        assert ("row of" in text or "belongs to one plan" in text) == (shown == "strip")


def test_prompts_describe_strips_of_panoramic_models_where_nothing_else_is_asked_for() -> None:
    said = {
        ("ar", "planner_imagined"): "one picture a plan, a row of frames, each with the number and name of the action "
        "that leads to it in a bar at its top.\n",
        ("imagenav", "chooser"): "a picture with a row of frames, each with the number and name of the action that "
        "leads to it in a bar at its top. Imagined frames",
        ("ar", "answerer_imagined"): "each picture is a row of views that a model predicts for places near by, all "
        "centred on the same thing and boxed in red.\n",
    }
    for (task, question), words in said.items():
        assert words in Prompts().render(task, question, **SLOTS)


def test_a_users_template_may_use_the_slots_of_what_is_shown_or_leave_them(tmp_path: Path) -> None:
    own_prompt(tmp_path, "Walk {{ look_ahead_action_num }}!")
    (tmp_path / "imagenav/chooser.j2").write_text("{{ shown }}, {{ captions }}, {{ centred }}")
    own, slots = Prompts(tmp_path), {**SLOTS, "captions": False}
    assert own.render("imagenav", "planner", **slots) == "Walk 5!"
    assert own.render("imagenav", "chooser", **slots) == "strip, False, True"
