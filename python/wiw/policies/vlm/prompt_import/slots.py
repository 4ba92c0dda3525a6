# SPDX-License-Identifier: Apache-2.0
"""Slots of a published prompt, which are Python's (`{name}`, `{}`, doubled braces for braces), as those of a template.

In LaTeX a slot may also stand as `<name>`, and in a typewriter face.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from wiw.errors import PromptError
from wiw.policies.vlm.prompt_import.sources import FoundPrompt

EXPRESSIONS = {
    "high_level_plan": '{{ {"Action Plan": high_level_plan.action_plan, '
    '"Chosen Landmark": high_level_plan.chosen_landmark or "None"} }}'
}
"""Slots whose value has other names in the published prompts."""
NAMED: dict[str, tuple[str, ...]] = {
    "ar/answerer": (),
    "ar/answerer_imagined": (),
    "ar/planner": ("obs_key", "look_ahead_action_num"),
    "ar/planner_imagined": (),
    "imagenav/planner": ("obs_key", "look_ahead_action_num"),
    "imagenav/planner_imagined": ("look_ahead_action_num",),
    "aeqa/planner": ("question", "detected_objs", "obs_key"),
    "aeqa/low_level_planner": ("high_level_plan", "obs_key", "look_ahead_action_num"),
    "aeqa/planner_imagined": (),
    "manipulation/planner": (),
    "manipulation/planner_imagined": (),
}
"""Every template that can be imported, with the slots that it has by name."""
NUMBERED: dict[str, tuple[str, ...]] = {
    "manipulation/planner": ("position_bins", "position_bins", "rotation_bins", "rotation_degrees", ""),
}
"""The slots `{}` of a template, in order; the empty one is for examples, which are a separate template."""
ANSWER_FORMS = {
    "aeqa/low_level_planner": """
Actions:
{% for name, meaning in actions.items() %}"{{ name }}": {{ meaning }}
{% endfor %}

Reply with one JSON object and nothing else:
{"reason": "<your reason>", "actions": [{"action": "<action>", "times": <1 to {{ action_times }}>}, ...]}
"""
}
"""Format of the answer, for templates without another one for it."""
_SLOT = re.compile(r"(?P<open>\{\{)|(?P<close>\}\})|\{(?P<named>[A-Za-z_]\w*)\}|(?P<numbered>\{\})|<(?P<angled>\w+)>")


def convert_slots(name: str, prompt: FoundPrompt) -> str:
    """Return the Jinja template of a prompt.

    Raises:
        PromptError: a slot is unknown or lacks.
    """
    text, numbered = strip_faces(prompt.text, NAMED[name]), iter(NUMBERED.get(name, ()))
    parts, end, seen = [], 0, set()
    for match in _SLOT.finditer(text):
        parts.append(_escape(text[end : match.start()]))
        end = match.end()
        slot = match["named"] or match["angled"]
        if match["named"] and slot not in NAMED[name]:
            expected = ", ".join(NAMED[name]) or "none"
            raise PromptError(f"{prompt.place}: unknown slot '{slot}' in the prompt for {name}; expected {expected}")
        if slot in NAMED[name]:
            seen.add(slot)
            written = EXPRESSIONS.get(slot, f"{{{{ {slot} }}}}")
            parts.append(f"<{written}>" if match["angled"] else written)
        elif match["numbered"]:
            parts.append(_take_numbered(numbered, name, prompt))
        else:
            parts.append(_escape({"{{": "{", "}}": "}"}.get(match.group(), match.group())))
    missing = [slot for slot in NAMED[name] if slot not in seen] + ["{}" for _ in numbered]
    if missing:
        raise PromptError(f"{prompt.place}: the prompt for {name} lacks {', '.join(missing)}")
    return "".join([*parts, _escape(text[end:])]).strip() + "\n" + ANSWER_FORMS.get(name, "")


def strip_faces(text: str, slots: tuple[str, ...]) -> str:
    """Return the text with slots out of the typewriter face that LaTeX sets them in."""
    for slot in slots:
        text = text.replace(f"`{slot}`", slot).replace(f"`<{slot}>`", f"<{slot}>")
        text = text.replace(f"`{{{slot}}}`", f"{{{slot}}}").replace(f"`<{{{slot}}}>`", f"<{{{slot}}}>")
    return text


def _take_numbered(numbered: Iterator[str], name: str, prompt: FoundPrompt) -> str:
    slot = next(numbered, None)
    if slot is None:
        expected = len(NUMBERED.get(name, ()))
        raise PromptError(f"{prompt.place}: expected {expected} slots {{}} in the prompt for {name}, found more")
    return f"{{{{ {slot} }}}}" if slot else ""


def _escape(text: str) -> str:
    """Return text in which no brace begins anything of Jinja's."""
    return text.replace("{", '{{ "{" }}')
