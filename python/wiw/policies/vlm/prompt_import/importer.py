# SPDX-License-Identifier: Apache-2.0
"""Import prompts from the user's own copy of the paper: its LaTeX source, or a checkout of its published code.

Neither wording is part of this project, which only knows where each prompt is found and which slots it has. Slots are
mapped to this project's; what a source lacks (such as the format of answers, which this project reads in its own form)
is taken from the built-in set "minimal".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from wiw.errors import PromptError
from wiw.files import atomic_folder
from wiw.policies.vlm.prompt_import.slots import convert_slots
from wiw.policies.vlm.prompt_import.sources import FoundPrompt, read_source
from wiw.policies.vlm.prompts.templates import FOLDER, SETS, Prompts, get_slots

CARD = "prompts.yaml"
"""File in a prompt folder that says where each template came from."""
FROM_DEFAULT = ("manipulation/examples",)
"""Templates that are taken from the set "default": the paper's robot is shown examples, which the set "minimal"
lacks."""


@dataclass(frozen=True)
class ImportedPrompts:
    """A written prompt folder."""

    folder: Path
    digest: str
    """Digest of all templates, as runs record it."""
    imported: Mapping[str, str]
    """Place in the source of each template, by its name."""
    completed: Mapping[str, str] = field(default_factory=dict)
    """Which built-in set each of the other templates is from."""
    unused: tuple[str, ...] = ()
    """Prompts of the source that no task here uses."""


def import_prompts(source: str | Path, out: str | Path) -> ImportedPrompts:
    """Write a prompt folder from a user's own copy of the paper's prompts; `--prompts OUT` uses it.

    Args:
        source: the paper's LaTeX source, a file or a folder; or a checkout of its published code.
        out: folder to write, which must be new or empty.

    Raises:
        PromptError: no prompts in the source, or one that cannot be read, lacks a slot, has an unknown one, or does not
            render; names file and line.
        FileError: `out` is not empty, or cannot be written.
    """
    target = Path(out).expanduser()
    found, unused = read_source(Path(source).expanduser())
    templates = {name: convert_slots(name, prompt) for name, prompt in found.items()}
    completed = _complete(templates)
    with atomic_folder(target) as draft:
        write_templates(draft, {**templates, **{name: text for name, (_, text) in completed.items()}})
        imported = ImportedPrompts(
            target,
            _check_rendering(draft, found),
            {name: prompt.place for name, prompt in sorted(found.items())},
            {name: origin for name, (origin, _) in sorted(completed.items())},
            tuple(unused),
        )
        _write_card(draft, imported)
    return imported


def write_templates(folder: Path, templates: Mapping[str, str]) -> None:
    """Write templates as `<task>/<name>.j2`."""
    for name, text in templates.items():
        path = folder / f"{name}.j2"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def _complete(templates: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return set and text of each template that the source lacks."""
    completed = {}
    for path in sorted(FOLDER.glob("*/*.j2")):
        name = f"{path.parent.name}/{path.stem}"
        if name not in templates:
            minimal = SETS["minimal"][0] / f"{name}.j2"
            origin = "minimal" if minimal.is_file() and name not in FROM_DEFAULT else "default"
            shipped = minimal if origin == "minimal" else path
            completed[name] = (origin, shipped.read_text(encoding="utf-8"))
    return completed


def _check_rendering(folder: Path, found: Mapping[str, FoundPrompt]) -> str:
    """Return the digest of a folder's templates.

    Raises:
        PromptError: one does not render; names the place in the source.
    """
    prompts = Prompts(folder)
    for name, prompt in found.items():
        task, _, question = name.partition("/")
        if not prompts.render(task, question, **get_slots(task)):
            raise PromptError(f"{prompt.place}: the prompt for {name} is empty")
    return prompts.digest


def _write_card(folder: Path, imported: ImportedPrompts) -> None:
    import yaml

    content = {
        "digest": imported.digest,
        "imported": dict(imported.imported),
        "completed": dict(imported.completed),
        "unused": list(imported.unused),
    }
    (folder / CARD).write_text(yaml.safe_dump(content, sort_keys=False, width=120), encoding="utf-8")
