# SPDX-License-Identifier: Apache-2.0
"""The user's words for plans, as an option of models that take plans in words."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wiw.action import FORWARD, NULL, STOP, TURN_LEFT, TURN_RIGHT, TextTemplate, to_text
from wiw.errors import ArgumentError
from wiw.mapping_files import read_yaml_mapping
from wiw.types import Control
from wiw.world_models.clips import Alignment

PHRASES = {"forward": FORWARD, "turn_left": TURN_LEFT, "turn_right": TURN_RIGHT, "stop": STOP}
SETTINGS = ("prompt", "separator", "merge_runs")
Words = str | Path | Mapping[str, Any] | None
"""A prompt with {actions}; a mapping of `SETTINGS` and `PHRASES`, or a YAML file of one; None means the default."""


def read_words(option: Words) -> str | dict[str, Any] | None:
    """Return the option with a file's content in its place, so that a record has the words themselves.

    Raises:
        FileError: the file cannot be read.
    """
    if option is None or isinstance(option, Mapping):
        return None if option is None else dict(option)
    path = Path(option)
    if path.suffix not in (".yaml", ".yml"):
        return str(option)
    return read_yaml_mapping(path.expanduser(), "`prompt: ...` and phrases of a template")


def make_template(words: str | Mapping[str, Any] | None) -> TextTemplate | None:
    """Return the template of an option; None for the default.

    Phrases may hold {metres}, {degrees} and {count}.

    Raises:
        ArgumentError: an unknown key, a value that is not text, or a prompt without {actions}.
    """
    if words is None:
        return None
    given = {"prompt": words} if isinstance(words, str) else dict(words)
    unknown = [name for name in given if name not in (*SETTINGS, *PHRASES)]
    if unknown:
        raise ArgumentError(f"template: expected {', '.join((*SETTINGS, *PHRASES))}, got '{unknown[0]}'")
    texts = [name for name, value in given.items() if not isinstance(value, bool if name == "merge_runs" else str)]
    if texts:
        raise ArgumentError(
            f"template: expected {texts[0]} as text (merge_runs true or false), got {given[texts[0]]!r}"
        )
    phrases = {PHRASES[name]: given.pop(name) for name in list(given) if name in PHRASES}
    template = TextTemplate(phrases=phrases, **given)
    to_text([FORWARD], template)  # refuses a prompt without {actions}
    return template


def write_prompt(control: Control, template: TextTemplate | None, alignment: Alignment) -> str:
    """Return the prompt of a plan; with a fixed pace it names all actions that a clip shows, padding included.

    A control without words keeps none: placebos ask so. A plan of poses keeps its instruction, whatever the pace.
    """
    if not control.text or alignment.pace is None or (control.actions == NULL).all():
        return control.text
    return to_text(control.actions, template)
