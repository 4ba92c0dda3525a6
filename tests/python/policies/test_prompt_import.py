# SPDX-License-Identifier: Apache-2.0
"""Prompts of a user's own copy of the paper become templates: the words of the source, in this project's slots."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import yaml
from jinja2 import meta
from locations import ROOT

import wiw
from wiw.cli import main
from wiw.errors import FileError, PromptError
from wiw.policies.vlm.prompt_import.latex import convert_latex
from wiw.policies.vlm.prompt_import.sources import name_template, read_source
from wiw.policies.vlm.prompts.templates import FOLDER, SETS, Prompts, get_slots, list_tasks
from wiw.vlm.template_worker import ENVIRONMENT

BOX = "\\begin{tcolorbox}[\n  breakable,\n  title=%s,\n  colback=red!5\n]\n%s\n\\end{tcolorbox}\n"
PLANNER = r"""
Look at \{\texttt{obs\_key}\} % a remark
and plan \texttt{<\{look\_ahead\_action\_num\}>} moves.

\textbf{Rules:}
\begin{enumerate}
  \item First \{this is a brace\} --- ``quoted''.
  \item Second:
  \begin{itemize}
    \item nested \textbf{bold}
  \end{itemize}
\end{enumerate}
"""
RENDERED = """Look at front view and plan <5> moves.

**Rules:**
1. First {this is a brace} — "quoted".
2. Second:
   - nested **bold**"""
HANDS = "Range [0, \\{\\}], again [0, \\{\\}], turns [0, \\{\\}] of \\{\\} degrees.\n\n\\{\\}"


def write_paper(folder: Path, *boxes: tuple[str, str]) -> Path:
    file = folder / "main.tex"
    file.write_text("\\section{Prompts}\n" + "\n".join(BOX % box for box in boxes))
    return file


def write_checkout(root: Path) -> Path:
    """Write what a checkout of the published code has, in other words."""
    slots = "See {obs_key}, plan <{look_ahead_action_num}>."
    texts = {
        "task/ar_answerer": "Name it.",
        "aux/ar_answerer": "More views.",
        "task/ar_planner": slots,
        "aux/ar_planner": "More plans.",
        "task/ignav_planner": slots,
        "task/ignav_evaluator": "Plan <{look_ahead_action_num}>.",
        "aux/ignav_evaluator_N_action": "Imagined plans.",
        "task/ignav_answerer": "Arrived?",
        "high_level/aeqa_highlevel_planner": (
            "Query **{question}** in {obs_key}, `{{view: {{1: x}}}}` {detected_objs}\n\n"
            "### Output Format:\n{{\n 'A': 1\n}}\n\n### Tips:\n- Walk."
        ),
        "aux/aeqa_highlevel_planner": "Outcomes:",
        "task/aeqa_planner": "Do {high_level_plan} in {obs_key}, up to {look_ahead_action_num}.",
    }
    for name, text in texts.items():
        file = root / f"downstream/lm/prompts/{name}.txt"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    variables = root / "manip/system_prompts.py"
    variables.parent.mkdir()
    variables.write_text(
        "raise SystemExit('a checkout is read, not run')\n"
        f"eb_manipulation_system_prompt = '''{HANDS.replace(chr(92), '')}'''\n"
        "genex_revise_manipulation_auxiliary_prompt = '''Simulated:'''\n"
    )
    return root


def test_a_box_of_latex_becomes_a_template_and_the_rest_is_completed(tmp_path: Path) -> None:
    source = write_paper(tmp_path, ("AR Planner Prompt", PLANNER), ("AR Reader Prompt", "Which?"), ("Notes", "None."))
    done = wiw.import_prompts(source, tmp_path / "own")
    assert done.imported["ar/planner"] == f"{source}:8"
    assert source.read_text().splitlines()[7].startswith("Look at")
    own, minimal, default = Prompts(tmp_path / "own"), Prompts("minimal"), Prompts()
    slots = get_slots("ar")
    assert own.render("ar", "planner", **slots) == RENDERED
    assert own.render("ar", "output", **slots) == default.render("ar", "output", **slots)
    for name in ("planner", "chooser"):
        assert own.render("imagenav", name, **slots) == minimal.render("imagenav", name, **slots)
    arm = get_slots("manipulation")
    assert own.render("manipulation", "examples", **arm) == default.render("manipulation", "examples", **arm)
    card = yaml.safe_load((tmp_path / "own/prompts.yaml").read_text())
    assert card["digest"] == done.digest == own.digest != minimal.digest
    assert {*card["imported"], *card["completed"]} == {
        f"{file.parent.name}/{file.stem}" for file in FOLDER.glob("*/*.j2")
    }


def test_a_checkout_is_read_and_not_run(tmp_path: Path) -> None:
    done = wiw.import_prompts(write_checkout(tmp_path / "code"), tmp_path / "own")
    assert len(done.imported) == 11 and done.unused == ("task/ignav_answerer.txt",)
    own = Prompts(tmp_path / "own")
    question = get_slots("aeqa")
    planner = own.render("aeqa", "planner", **question)
    assert planner.startswith("Query **What color is the sofa?** in front view, `{view: {1: x}}` {'front': {1: 'sofa'}")
    assert "Output Format" not in planner and planner.endswith("### Tips:\n- Walk.")
    walk = own.render("aeqa", "low_level_planner", **question)
    assert walk.startswith("Do {'Action Plan': 'Go to the sofa.', 'Chosen Landmark': 1} in front view, up to 4.")
    assert '"times": <1 to 4>' in walk
    arm = own.render("manipulation", "planner", **get_slots("manipulation"))
    assert arm == "Range [0, 100], again [0, 100], turns [0, 120] of 3 degrees."
    both = own.render("imagenav", "planner_imagined", **get_slots("imagenav"))
    assert both == "Plan <5>.\n\nImagined plans."


@pytest.mark.parametrize(
    ("title", "body", "said"),
    [
        ("AR Planner Prompt", r"\{obs\_key\}", "lacks look_ahead_action_num"),
        ("AR Planner Prompt", r"\{room\}", "unknown slot 'room' in the prompt for ar/planner; expected obs_key"),
        ("AR Answerer Prompt", r"What is \weird{it}?", r"main\.tex:7: unknown command \\weird"),
        ("AR Answerer Prompt", r"\begin{tabular}", "unknown environment 'tabular'"),
        ("AR Answerer Prompt", r"\textbf{What", "a brace or a list is not closed"),
        ("AR Answerer Prompt", r"\item x", r"\\item outside a list"),
        ("AR Answerer Prompt", "% nothing", "the prompt for ar/answerer is empty"),
        ("Manipulation Planner Prompt", HANDS + r"\{\}", "expected 5 slots {} in the prompt .* found more"),
        ("Manipulation Planner Prompt", r"\{\}", r"lacks \{\}, \{\}, \{\}, \{\}"),
        ("Cooking Prompt", "Boil.", "no prompts found; expected LaTeX with boxes such as title=AR Planner Prompt"),
    ],
)
def test_what_cannot_be_imported_is_named_and_nothing_is_written(
    tmp_path: Path, title: str, body: str, said: str
) -> None:
    with pytest.raises(PromptError, match=said):
        wiw.import_prompts(write_paper(tmp_path, (title, body)), tmp_path / "own")
    assert not (tmp_path / "own").exists()


def test_a_box_in_a_comment_is_passed_over(tmp_path: Path) -> None:
    source = write_paper(tmp_path, ("AR Answerer Prompt", r"What is it, to 100\%?"))
    old = "\n".join(f"% {line}" for line in source.read_text().replace("What is it", "And this").splitlines())
    source.write_text(f"{old}\n{source.read_text()}")
    found, _ = read_source(source)
    assert [prompt.text for prompt in found.values()] == ["What is it, to 100%?"]


def test_folders_that_will_not_do_are_refused(tmp_path: Path) -> None:
    source = write_paper(tmp_path, ("AR Answerer Prompt", "What?"))
    with pytest.raises(FileError, match="expected a new or empty folder"):
        wiw.import_prompts(source, tmp_path)
    with pytest.raises(PromptError, match="no such file or folder"):
        wiw.import_prompts(tmp_path / "none", tmp_path / "own")
    (tmp_path / "copy.tex").write_text(source.read_text())
    with pytest.raises(PromptError, match="a second prompt for ar/answerer"):
        wiw.import_prompts(tmp_path, tmp_path / "own")


def test_braces_of_a_source_begin_nothing_of_jinja(tmp_path: Path) -> None:
    text = r"\{\{\{\{ 1 + 1 \}\}\}\} \{\% if \%\} \{\# note \#\} \{\{ obs \}\}"
    wiw.import_prompts(write_paper(tmp_path, ("AR Answerer Prompt", text)), tmp_path / "own")
    shown = Prompts(tmp_path / "own").render("ar", "answerer", **get_slots("ar"))
    assert shown == "{{ 1 + 1 }} {% if %} {# note #} { obs }"


@pytest.mark.parametrize("task", list_tasks())
def test_the_minimal_set_answers_every_question_and_gives_no_advice(task: str) -> None:
    minimal, default = Prompts("minimal"), Prompts()
    slots, longer = get_slots(task), 0
    own = {file.stem for file in (SETS["minimal"][0] / task).glob("*.j2")}
    assert own <= {file.stem for file in (FOLDER / task).glob("*.j2")}
    for name in sorted(own):
        text, advised = (each.render(task, name, **slots) for each in (minimal, default))
        longer += len(advised) > len(text)
        for word in ("prefer", "should", "must", "towards", "hint", "do not", "rule"):
            assert word not in text.lower(), f"{task}/{name} advises: {word}"
    assert longer == len(own) and minimal.digest != default.digest


def test_a_slot_of_the_default_set_is_one_of_the_minimal_set() -> None:
    """What is shown and asked stays the same, so that an ablation changes the advice alone."""
    for file in SETS["minimal"][0].glob("*/*.j2"):
        name = f"{file.parent.name}/{file.name}"
        minimal, default = (find_slots(path) for path in (file, FOLDER / name))
        assert minimal == default or file.stem == "examples", name


def find_slots(template: Path) -> set[str]:
    return meta.find_undeclared_variables(ENVIRONMENT.parse(template.read_text()))


def test_a_run_records_the_digest(two_rooms: str, tmp_path: Path) -> None:
    arguments = ["run", "imagenav", "--policy", "vlm", "--vlm", "mock", "--prompts", "minimal", "--scenes", two_rooms]
    arguments += ["--episodes", "1", "--task-option", "decisions=1", "--no-report", "--keep-images", "0"]
    assert main([*arguments, "--out", str(tmp_path / "run")]) == 0
    built = wiw.load_run(tmp_path / "run").store.info["built"]["none"]
    assert built["policy"]["prompts"] == Prompts("minimal").digest


def test_the_command_imports_and_the_list_names_the_sets(
    two_rooms: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_paper(tmp_path, ("AR Answerer Prompt", "What is it?"))
    assert main(["prompts", "import", str(source), "--out", str(tmp_path / "own")]) == 0
    assert f"digest  {Prompts(tmp_path / 'own').digest}" in capsys.readouterr().out
    assert main(["list", "prompts"]) == 0
    assert {"default", "minimal", Prompts("minimal").digest} <= set(re.findall(r"\w+", capsys.readouterr().out))
    arguments = ["run", "imagenav", "--policy", "vlm", "--vlm", "mock", "--scenes", two_rooms, "--episodes", "1"]
    assert main([*arguments, "--prompts", str(tmp_path / "none"), "--out", str(tmp_path / "run")]) == 2
    assert "expected one of the sets default, minimal" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("title", "name"),
    [
        ("AR Planner Additional Prompt (with WM Rollouts)", "ar/planner_imagined"),
        ("A-EQA Low-Level Planner Prompt", "aeqa/low_level_planner"),
        ("A-EQA High-Level Planner Prompt", "aeqa/planner"),
        ("ImageNav Planner Prompt (with WM Rollouts)", "imagenav/planner_imagined"),
        ("Architecture", None),
        ("Cooking Prompt", None),
        ("ImageNav Answerer Prompt", None),
        ("AR Low-Level Planner Prompt", None),
    ],
)
def test_titles_name_templates(title: str, name: str | None) -> None:
    assert name_template(title) == name


@pytest.mark.parametrize(
    "options",
    [
        "title=AR Planner Prompt",
        "title={AR Planner Prompt}, overlay={\\node[left] at (0, 0) {a]};}",
        "\n  breakable, % a remark ]\n  borderline west={2pt}{0pt}{red},\n  title=AR Planner Prompt\n",
    ],
)
def test_a_box_keeps_all_of_its_text(options: str, tmp_path: Path) -> None:
    body = "Plan {obs_key}.\n[\n  1,\n  2\n]\nThe end."
    box = f"\\begin{{tcolorbox}}[{options}]\n{body}\n\\end{{tcolorbox}}\n"
    (tmp_path / "paper.tex").write_text(box + BOX % ("AR Answerer Prompt", "Answer.\n]\nNow."))
    found, unused = read_source(tmp_path / "paper.tex")
    assert {name: prompt.text for name, prompt in found.items()} == {
        "ar/planner": "Plan obs_key. [ 1, 2 ] The end.",
        "ar/answerer": "Answer. ] Now.",
    }
    assert not unused and found["ar/planner"].place.endswith(f"paper.tex:{2 + options.count(chr(10))}")


def test_unknown_tex_is_never_dropped() -> None:
    with pytest.raises(PromptError, match="here: expected an argument in braces"):
        convert_latex(r"\textbf x", lambda _: "here")
    with pytest.raises(PromptError, match=r"here: unknown command \\\[; replace it"):
        convert_latex(r"\[ x \]", lambda _: "here")


@pytest.mark.parametrize(
    ("tex", "text"),
    [
        (r"0.2\,m, 5\;s, a\ b\- c\@.", "0.2 m, 5 s, a b c."),
        (r"\$5 \& 50\% \#1 a\_b \{c\}", "$5 & 50% #1 a_b {c}"),
        ("one \\\\% a remark\ntwo% another\n three", "one\ntwothree"),
    ],
)
def test_what_stands_behind_a_backslash_is_read_as_latex_does(tex: str, text: str) -> None:
    assert convert_latex(tex, lambda _: "here") == text


@pytest.fixture(scope="module")
def paper() -> Path:
    """The paper's LaTeX source, where this machine has it."""
    for place in (os.environ.get("WIW_PAPER"), ROOT.parent / "shared/paper"):
        if place and list(Path(place).glob("*.tex")):
            return Path(place)
    pytest.skip("needs the paper's LaTeX source, which is not part of this project: set WIW_PAPER to its folder")


def test_the_papers_own_prompts_are_imported_word_by_word(paper: Path, tmp_path: Path) -> None:
    done = wiw.import_prompts(paper, tmp_path / "own")
    assert len(done.imported) == 11 and not done.unused
    own = Prompts(tmp_path / "own")
    for name, place in done.imported.items():
        file, _, line = place.rpartition(":")
        body = "\n".join(Path(file).read_text().splitlines()[int(line) - 1 :]).partition("\\end{tcolorbox}")[0]
        task, _, question = name.partition("/")
        slots = {**get_slots(task), "obs_key": "0", "question": "0", "detected_objs": 0}  # no words of ours
        shown = own.render(task, question, **slots).partition("\nActions:\n")[0]
        shown = re.sub(r"\{'Action Plan'.*?\}", "", shown)  # the value of a slot
        expected, found = list_words(drop_commands(body)), list_words(shown)
        assert is_subsequence([word for word in found if word in set(expected)], expected), name
        share = len([word for word in expected if word in set(found)]) / len(expected)
        assert share > (0.85 if name == "aeqa/planner" else 0.95), name  # less the form of the answer, and slots' names


def drop_commands(tex: str) -> str:
    """Return LaTeX without its commands, by other means than the importer's."""
    return re.sub(r"\\(?:begin|end)\{\w+\}(?:\[.*?\])?|\\[A-Za-z]+", " ", tex.replace("\\_", "_"))


def list_words(text: str) -> list[str]:
    return re.findall(r"[A-Za-z_]{3,}", text)


def is_subsequence(part: list[str], whole: list[str]) -> bool:
    rest = iter(whole)
    return all(word in rest for word in part)
