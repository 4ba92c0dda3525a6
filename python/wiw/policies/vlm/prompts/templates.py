# SPDX-License-Identifier: Apache-2.0
"""Prompt templates: one folder per task, one Jinja file per question, with the paper's slots.

There are sets of them. `default` lies here; `minimal`, in a folder of its own, has slots and schemas and gives no
advice. A user's own folder may replace either (`wiw prompts import` makes one of a copy of the paper).

Slots of all tasks: `look_ahead_action_num` (actions of a plan) and `plan_num` (number of plans requested). Navigation
and recognition: `obs_key` (the observation in words), `actions` (name to meaning), `shown` ("strip" where a plan's
imagined frames are one picture, "frames" where each is a picture of its own), `captions` (whether a bar above each says
what it is) and `centred` (whether imagined views are centred on the target; otherwise they are front views).
Manipulation: `position_bins`, `rotation_bins` and `rotation_degrees` (as `wiw.action.PoseGrid`), `table_height` (Z of
its top), `colours` (names), `instruction`, `objects` (index to [X, Y, Z]), `gripper` (its pose) and `executed` (actions
so far). Question answering: `obs_key`, `question`, `detected_objs` (view to number to name), `history` (plans so far,
in words), `actions`, `action_times` (how often one may be repeated) and `high_level_plan` (what the low-level planner
is to carry out). A template uses those that it needs.

The shipped templates are filled here, a user's in a process with limits on time, memory and length
(`wiw.vlm.template_filler`).
"""

from __future__ import annotations

from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError, PromptError
from wiw.vlm import template_worker
from wiw.vlm.template_filler import TemplateFiller

FOLDER = Path(__file__).parent
DEFAULT = "default"
SETS: dict[str, tuple[Path, str]] = {
    DEFAULT: (FOLDER, "the project's own wording, with advice on how to explore, approach and grasp"),
    "minimal": (FOLDER / "minimal", "slots and schemas of the answers, and no advice"),
}
"""The shipped sets: folder and one line. A template that a set lacks is the default's."""
SLOTS: dict[str, Any] = {
    "obs_key": "front view",
    "look_ahead_action_num": 5,
    "plan_num": 1,
    "actions": {"forward": "go straight for 0.20 m"},
    "shown": "strip",
    "captions": True,
    "centred": True,
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
QUESTION_SLOTS: dict[str, Any] = {
    "obs_key": "front view",
    "question": "What color is the sofa?",
    "detected_objs": {"front": {1: "sofa"}, "left": {}},
    "history": ["after 0 actions: Go through the opening."],
    "look_ahead_action_num": 4,
    "plan_num": 1,
    "actions": {"forward": "go straight for 0.20 m"},
    "action_times": 4,
    "high_level_plan": {"action_plan": "Go to the sofa.", "chosen_view": "front", "chosen_landmark": 1},
}
"""Every slot of question answering, likewise."""


def get_slots(task: str) -> dict[str, Any]:
    """Return every slot of a task's templates, with values to test them with."""
    return {"manipulation": ARM_SLOTS, "aeqa": QUESTION_SLOTS}.get(task, SLOTS)


def list_tasks() -> list[str]:
    """Return the tasks with shipped prompts."""
    return sorted(path.name for path in FOLDER.iterdir() if any(path.glob("*.j2")))


class Prompts:
    """Templates of all tasks: a user's if there are any, else those shipped with the package.

    Args:
        source: name of a shipped set (`SETS`), or a folder with templates as `<task>/<name>.j2`, named like the shipped
            ones; what a folder lacks is the default's.

    Raises:
        PromptError: no such set or folder, no templates in it, a template under an unknown name, with an unknown slot,
            or one that cannot be read.
    """

    def __init__(self, source: str | Path | None = None) -> None:
        self.source: str | Path = DEFAULT if source is None else source
        self._filling = TemplateFiller()
        self._templates = _read_templates(FOLDER)
        self._own: frozenset[str] = frozenset()
        if isinstance(self.source, str) and self.source in SETS:
            self._templates |= _read_templates(SETS[self.source][0])
        else:
            self.source = Path(self.source).expanduser()
            own = self._load_own(self.source)
            self._templates |= own
            self._own = frozenset(own)

    def __reduce__(self) -> Any:
        return Prompts, (self.source,)

    def render(self, task: str, name: str, **slots: Any) -> str:
        """Return a prompt with its slots filled.

        Raises:
            ArgumentError: a task without prompts.
            PromptError: a user's template cannot be filled within the limits on time, memory and length.
        """
        place = f"{task}/{name}.j2"
        if place not in self._templates:
            raise ArgumentError(f"policy vlm: no prompt '{name}' for task '{task}'; it exists for {list_tasks()}")
        path, source = self._templates[place]
        own = place in self._own
        text = self._filling.fill(path, source, slots) if own else template_worker.fill_template(source, slots)
        return text.strip()

    @cached_property
    def digest(self) -> str:
        """Digest of all templates, as hexadecimal digits."""
        parts = [f"{name}\0{source}\0" for name, (_, source) in sorted(self._templates.items())]
        return blake2b("".join(parts).encode(), digest_size=8).hexdigest()

    def _load_own(self, folder: Path) -> dict[str, tuple[Path, str]]:
        own = _read_templates(folder)
        if not own:
            raise PromptError(
                f"{folder}: expected one of the sets {', '.join(SETS)}, or a folder with templates such as "
                f"{folder / 'ar/planner.j2'}; found none"
            )
        for name, (path, source) in own.items():
            if name not in self._templates:
                raise PromptError(
                    f"{path}: no prompt has this name; expected one of {', '.join(sorted(self._templates))}"
                )
            # tried on, so that what is wrong is known before the first question
            self._filling.fill(path, source, get_slots(path.parent.name), check=True)
        return own


def _read_templates(folder: Path) -> dict[str, tuple[Path, str]]:
    """Return path and source of each template of a folder, by `<task>/<name>.j2`."""
    return {path.relative_to(folder).as_posix(): (path, _read_source(path)) for path in _list_templates(folder)}


def _list_templates(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*.j2"))


def _read_source(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise PromptError(f"{path}: {type(error).__name__}: {error}") from error
