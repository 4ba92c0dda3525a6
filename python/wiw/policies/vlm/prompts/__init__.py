# SPDX-License-Identifier: Apache-2.0
"""Prompt templates: one folder per task, one Jinja file per question, with the paper's slots; a user's own may replace
them.

Slots of all tasks: `look_ahead_action_num` (actions of a plan) and `plan_num` (number of plans requested). Navigation
and recognition: `obs_key` (the observation in words) and `actions` (name to meaning). Manipulation: `position_bins`,
`rotation_bins` and `rotation_degrees` (as `wiw.action.PoseGrid`), `table_height` (Z of its top), `colours` (names),
`instruction`, `objects` (index to [X, Y, Z]), `gripper` (its pose) and `executed` (actions so far).
"""

from __future__ import annotations

from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError, PromptError

FOLDER = Path(__file__).parent
SLOTS: dict[str, Any] = {
    "obs_key": "front view",
    "look_ahead_action_num": 5,
    "plan_num": 1,
    "actions": {"forward": "go straight for 0.20 m"},
}
"""Every slot of navigation and recognition, with a value to test templates with."""
ARM_SLOTS: dict[str, Any] = {
    "look_ahead_action_num": 5,
    "plan_num": 1,
    "position_bins": 100,
    "rotation_bins": 120,
    "rotation_degrees": 3,
    "table_height": 15,
    "colours": ["red", "lime"],
    "instruction": "push the red button",
    "objects": {1: [50, 50, 15]},
    "gripper": [50, 50, 40, 0, 60, 60, 1],
    "executed": [[50, 50, 40, 0, 60, 60, 1]],
}
"""Every slot of manipulation, likewise."""


def list_tasks() -> list[str]:
    """Return the tasks with shipped prompts."""
    return sorted(path.name for path in FOLDER.iterdir() if any(path.glob("*.j2")))


class Prompts:
    """Templates of all tasks: a user's where there are any, else those shipped with the package.

    Args:
        folder: with templates as `<task>/<name>.j2`, named like the shipped ones; None means the shipped ones.

    Raises:
        PromptError: no such folder, no templates in it, a template under an unknown name, with an unknown slot, or one
            that cannot be read.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = None if folder is None else Path(folder).expanduser()
        self._templates = {
            path.relative_to(FOLDER).as_posix(): _parse_template(path) for path in _list_templates(FOLDER)
        }
        if self.folder is not None:
            self._templates |= self._load_own(self.folder)

    def __reduce__(self) -> Any:
        return Prompts, (self.folder,)

    def render(self, task: str, name: str, **slots: Any) -> str:
        """Return a prompt with its slots filled.

        Raises:
            ArgumentError: a task without prompts.
        """
        template = self._templates.get(f"{task}/{name}.j2")
        if template is None:
            raise ArgumentError(f"policy vlm: no prompt '{name}' for task '{task}'; there are some for {list_tasks()}")
        return str(template[1].render(**slots)).strip()

    @cached_property
    def digest(self) -> str:
        """Digest of all templates, as hexadecimal digits."""
        parts = [f"{name}\0{source}\0" for name, (source, _) in sorted(self._templates.items())]
        return blake2b("".join(parts).encode(), digest_size=8).hexdigest()

    def _load_own(self, folder: Path) -> dict[str, Any]:
        found = {path.relative_to(folder).as_posix(): path for path in _list_templates(folder)}
        if not found:
            raise PromptError(f"{folder}: expected templates such as {folder / 'ar/planner.j2'}, found none")
        for name, path in found.items():
            if name not in self._templates:
                raise PromptError(f"{path}: no prompt has this name; there are {', '.join(sorted(self._templates))}")
        return {name: _parse_template(path) for name, path in found.items()}


def _list_templates(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*.j2"))


def _parse_template(path: Path) -> tuple[str, Any]:
    """Return source and template; rendered once, so that its errors show before the first question."""
    from jinja2 import StrictUndefined, TemplateError, meta
    from jinja2.sandbox import SandboxedEnvironment

    slots = ARM_SLOTS if path.parent.name == "manipulation" else SLOTS
    environment = SandboxedEnvironment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    try:
        source = path.read_text(encoding="utf-8")
        unknown = sorted(meta.find_undeclared_variables(environment.parse(source)) - set(slots))
        if unknown:
            raise PromptError(f"{path}: unknown slot '{unknown[0]}'; the slots are {', '.join(slots)}")
        template = environment.from_string(source)
        template.render(**slots)
    except (OSError, UnicodeDecodeError, TemplateError, TypeError, ValueError, ArithmeticError, LookupError) as error:
        raise PromptError(f"{path}: {type(error).__name__}: {error}") from error
    return source, template
