# SPDX-License-Identifier: Apache-2.0
"""Sources of the paper's prompts: in boxes of its LaTeX source, or in files of its published code."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from wiw.errors import PromptError
from wiw.policies.vlm.prompt_import.latex import convert_latex

FILES: dict[str, tuple[str, ...]] = {
    "ar/answerer": ("task/ar_answerer",),
    "ar/answerer_imagined": ("aux/ar_answerer",),
    "ar/planner": ("task/ar_planner",),
    "ar/planner_imagined": ("aux/ar_planner",),
    "imagenav/planner": ("task/ignav_planner",),
    "imagenav/planner_imagined": ("task/ignav_evaluator", "aux/ignav_evaluator_N_action"),
    "aeqa/planner": ("high_level/aeqa_highlevel_planner",),
    "aeqa/low_level_planner": ("task/aeqa_planner",),
    "aeqa/planner_imagined": ("aux/aeqa_highlevel_planner",),
}
"""Text files below `PROMPT_FOLDER` of a checkout, joined in this order."""
PROMPT_FOLDER = "lm/prompts"
VARIABLES = {
    "manipulation/planner": "eb_manipulation_system_prompt",
    "manipulation/planner_imagined": "genex_revise_manipulation_auxiliary_prompt",
}
"""Variables of `VARIABLE_FILE` of a checkout."""
VARIABLE_FILE = "system_prompts.py"
TASKS = {"AR": "ar", "ImageNav": "imagenav", "A-EQA": "aeqa", "Manipulation": "manipulation"}
"""First words of a box's title."""
ROLES = {"answerer": "answerer", "low-level planner": "low_level_planner", "planner": "planner"}
"""Further words of it, the first that fits."""
_BRACED = r"\{(?:[^{}\\]|\\.|\{(?:[^{}\\]|\\.|\{[^{}]*\})*\})*\}"
_OPTIONS = rf"\[(?:%[^\n]*\n|[^][{{}}\\%]|\\.|{_BRACED}|\[[^][]*\])*\]"
"""Up to the bracket that closes them: others are in braces, in brackets or in remarks."""
_BOX = re.compile(rf"\\begin\{{tcolorbox\}}(?P<options>{_OPTIONS})(?P<body>.*?)\\end\{{tcolorbox\}}", re.DOTALL)
_COMMENT = re.compile(r"(?<!\\)%.*")
_TITLE = re.compile(r"(?<![a-z])title\s*=\s*(?:\{(?P<braced>[^}]*)\}|(?P<bare>[^,\]\n]*))")
_ANSWER_FORM = re.compile(
    r"^[#* ]*Output Format:?[*\s]*\n.*?(?=^(?:#+ |\*\*)[^\n]*:[*\s]*$)", re.DOTALL | re.MULTILINE | re.IGNORECASE
)
"""The section on how to write the answer, up to the next heading."""


@dataclass(frozen=True)
class FoundPrompt:
    """A prompt of the source, with slots as Python's."""

    text: str
    place: str
    """File, and line where it begins."""


def read_source(source: Path) -> tuple[dict[str, FoundPrompt], list[str]]:
    """Return the prompts of a source by the names of templates, and the titles of those that are not used.

    Raises:
        PromptError: no prompts are there, or they cannot be read.
    """
    if not source.exists():
        raise PromptError(f"{source}: no such file or folder")
    found, unused = _read_checkout(source) if source.is_dir() else ({}, [])
    if not found:
        files = sorted(source.rglob("*.tex")) if source.is_dir() else [source]
        for file in files:
            own, titles = _read_latex(file)
            _require_new(found, own)
            found |= own
            unused += titles
    if not found:
        raise PromptError(
            f"{source}: no prompts found; expected LaTeX with boxes such as title=AR Planner Prompt, or a checkout "
            f"with {PROMPT_FOLDER}/task/ar_planner.txt"
        )
    return {name: _drop_answer_form(prompt) for name, prompt in found.items()}, unused


def _drop_answer_form(prompt: FoundPrompt) -> FoundPrompt:
    """Leave out how the answer is to be written: the template `output` says it in the form that is read here."""
    return FoundPrompt(_ANSWER_FORM.sub("", prompt.text), prompt.place)


# -- LaTeX -------------------------------------------------------------------------------------------------------------


def _read_latex(file: Path) -> tuple[dict[str, FoundPrompt], list[str]]:
    text = _COMMENT.sub(lambda match: match[0].replace("{tcolorbox}", "{commented}"), _read_text(file))
    found: dict[str, FoundPrompt] = {}
    unused = []
    for box in _BOX.finditer(text):
        title = _TITLE.search(box["options"])
        words = " ".join((title["braced"] or title["bare"] or "").split()) if title else ""
        name = name_template(words)
        if name is None:
            unused += [words] if "prompt" in words.lower() else []
            continue
        start = box.start("body") + len(box["body"]) - len(box["body"].lstrip())

        def place(offset: int, start: int = start) -> str:
            return f"{file}:{text.count(chr(10), 0, start + offset) + 1}"

        prompt = FoundPrompt(convert_latex(box["body"].strip(), place), place(0))
        _require_new(found, {name: prompt})
        found[name] = prompt
    return found, unused


def name_template(title: str) -> str | None:
    """Return the template that a box's title is of; None for a title of something else."""
    words = title.lower()
    task = next((task for first, task in TASKS.items() if words.startswith(f"{first.lower()} ")), None)
    role = next((role for name, role in ROLES.items() if name in words), None)
    if task is None or role is None or "prompt" not in words:
        return None
    template = f"{task}/{role}{'_imagined' if 'rollouts' in words else ''}"
    return template if template in FILES or template in VARIABLES else None


def _require_new(found: Mapping[str, FoundPrompt], own: Mapping[str, FoundPrompt]) -> None:
    for name in own.keys() & found.keys():
        raise PromptError(
            f"{own[name].place}: a second prompt for {name}; the first is at {found[name].place}; give only one of the "
            "files"
        )


# -- a checkout --------------------------------------------------------------------------------------------------------


def _read_checkout(root: Path) -> tuple[dict[str, FoundPrompt], list[str]]:
    folders = [path for path in [root, *sorted(root.rglob("prompts"))] if (path / "task/ar_planner.txt").is_file()]
    if not folders:
        return {}, []
    folder = folders[0]
    found = {name: _join_files([folder / f"{part}.txt" for part in parts]) for name, parts in FILES.items()}
    known = {f"{part}.txt" for parts in FILES.values() for part in parts}
    unused = sorted({path.relative_to(folder).as_posix() for path in folder.rglob("*.txt")} - known)
    for file in sorted(root.rglob(VARIABLE_FILE)):
        found |= _read_variables(file)
    return found, unused


def _join_files(files: list[Path]) -> FoundPrompt:
    return FoundPrompt("\n\n".join(_read_text(file).strip() for file in files), str(files[0]))


def _read_variables(file: Path) -> dict[str, FoundPrompt]:
    """Return the prompts that a Python file assigns as plain strings; none of it is run."""
    try:
        tree = ast.parse(_read_text(file))
    except SyntaxError as error:
        raise PromptError(f"{file}: {error}") from error
    texts = {
        target.id: (node.value.value, node.lineno)
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        for target in node.targets
        if isinstance(target, ast.Name) and isinstance(node.value.value, str)
    }
    return {
        name: FoundPrompt(texts[variable][0], f"{file}:{texts[variable][1]}")
        for name, variable in VARIABLES.items()
        if variable in texts
    }


def _read_text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise PromptError(f"{file}: {type(error).__name__}: {error}") from error
