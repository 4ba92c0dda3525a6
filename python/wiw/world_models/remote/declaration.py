# SPDX-License-Identifier: Apache-2.0
"""A world model's declaration as text, so that a client plans for a served model as for its own."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from wiw.action import Action, GripperTextTemplate, GripperVocabulary, TextTemplate
from wiw.errors import ArgumentError, RemoteError
from wiw.json_text import parse_json
from wiw.world_models.base import Accepts, accepts

MOST_DESCRIBED = 1 << 20
"""Characters of a model's description, which goes into every record of a run."""


def declaration(declared: Accepts) -> str:
    """Return JSON of what a model accepts."""
    values = {field.name: getattr(declared, field.name) for field in fields(declared)}
    if declared.vocabulary is not None:
        values["vocabulary"] = _vocabulary(declared.vocabulary)
    if declared.template is not None:
        values["template"] = _template(declared.template)
    return json.dumps(values)


def parse_declaration(text: str) -> Accepts:
    """Return what a model accepts, from such JSON.

    Raises:
        RemoteError: it cannot be read.
    """
    try:
        values: dict[str, Any] = parse_json(text)
        if values["vocabulary"] is not None:
            values["vocabulary"] = _parse_vocabulary(values["vocabulary"])
        if values["template"] is not None:
            values["template"] = _parse_template(values["template"])
        sizes = {name: tuple(values[name]) for name in ("size", "smallest") if values.get(name) is not None}
        return accepts(**{**values, **sizes})
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, ArgumentError) as error:
        raise RemoteError(
            f"the server's declaration cannot be read: {type(error).__name__}: {error}", "message"
        ) from error


def parse_description(text: str) -> dict[str, Any]:
    """Return what a served model says of itself, from the JSON of its `describe()`.

    Raises:
        RemoteError: it is no JSON object.
    """
    try:
        if len(text) > MOST_DESCRIBED:
            raise ValueError(f"expected at most {MOST_DESCRIBED} characters, got {len(text)}")
        values = parse_json(text)
        if not isinstance(values, dict):
            raise ValueError(f"expected an object, got {type(values).__name__}")
    except ValueError as error:
        raise RemoteError(f"the server's description of its model cannot be read: {error}", "message") from error
    return values


def _vocabulary(vocabulary: dict[int, Any] | GripperVocabulary) -> Any:
    if isinstance(vocabulary, GripperVocabulary):
        return asdict(vocabulary)
    return [[name, np.asarray(own).tolist()] for name, own in vocabulary.items()]


def _parse_vocabulary(values: Any) -> dict[int, Any] | GripperVocabulary:
    return GripperVocabulary(**values) if isinstance(values, dict) else dict(values)


def _template(template: TextTemplate | GripperTextTemplate) -> dict[str, Any]:
    if isinstance(template, GripperTextTemplate):
        return {"prompt": template.prompt, "phrase": template.phrase, "separator": template.separator}
    phrases = [[int(name), phrase] for name, phrase in template.phrases.items()]
    return {
        "prompt": template.prompt,
        "phrases": phrases,
        "separator": template.separator,
        "merge_runs": template.merge_runs,
    }


def _parse_template(values: dict[str, Any]) -> TextTemplate | GripperTextTemplate:
    if "phrase" in values:
        return GripperTextTemplate(**values)
    phrases = {Action(name): phrase for name, phrase in values.pop("phrases")}
    return TextTemplate(phrases=phrases, **values)
