# SPDX-License-Identifier: Apache-2.0
"""A world model's declaration as text, so that a client plans for a served model as for its own."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

import numpy as np

from wiw.action import Action, TextTemplate
from wiw.errors import ArgumentError, RemoteError
from wiw.world_models.base import Accepts, accepts


def declaration(declared: Accepts) -> str:
    """Return JSON of what a model accepts."""
    values = {field.name: getattr(declared, field.name) for field in fields(declared)}
    if declared.vocabulary is not None:
        values["vocabulary"] = [[int(name), np.asarray(own).tolist()] for name, own in declared.vocabulary.items()]
    if declared.template is not None:
        values["template"] = _template(declared.template)
    return json.dumps(values)


def parse_declaration(text: str) -> Accepts:
    """Return what a model accepts, from such JSON.

    Raises:
        RemoteError: it cannot be read.
    """
    try:
        values: dict[str, Any] = json.loads(text)
        if values["vocabulary"] is not None:
            values["vocabulary"] = dict(values["vocabulary"])
        if values["template"] is not None:
            phrases = {Action(name): phrase for name, phrase in values["template"].pop("phrases")}
            values["template"] = TextTemplate(phrases=phrases, **values["template"])
        return accepts(**{**values, "size": tuple(values["size"])})
    except (ValueError, KeyError, TypeError, AttributeError, ArgumentError) as error:
        raise RemoteError(
            f"the server's declaration cannot be read: {type(error).__name__}: {error}", "message"
        ) from error


def _template(template: TextTemplate) -> dict[str, Any]:
    phrases = [[int(name), phrase] for name, phrase in template.phrases.items()]
    return {
        "prompt": template.prompt,
        "phrases": phrases,
        "separator": template.separator,
        "merge_runs": template.merge_runs,
    }
