# SPDX-License-Identifier: Apache-2.0
"""Commands without the secrets of servers: a run's store keeps the command, and its report shows it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from wiw.errors import ArgumentError
from wiw.mapping_files import parse_yaml
from wiw.runs.arm_text import parse_arm, split_arms

SECRETS = {"key": "OPENAI_API_KEY", "token": "WIW_TOKEN"}
"""Options that are secrets of servers, which no store keeps, and the environment variables read in their place."""
HIDDEN = "***"
_GIVEN = re.compile(rf"(?<![\w-])({'|'.join(SECRETS)})([\"']?\s*[:=]\s*)(\"[^\"]*\"|'[^']*'|[^,&}}\]\s]+)")
"""A secret in a text that is neither an option nor a list of arms."""


def hide_secrets(command: Sequence[str]) -> list[str]:
    """Return the arguments of a command with the secrets in them hidden."""
    shown, flag = [], ""
    for argument in command:
        if argument.startswith("--"):
            flag, equals, value = argument.partition("=")
            shown.append(f"{flag}{equals}{_hide(flag, value) if equals else ''}")
        else:
            shown.append(_hide(flag, argument))
            flag = ""
    return shown


def _hide(flag: str, text: str) -> str:
    """Return what is given to a flag, as it may be shown."""
    if flag.removeprefix("--") in SECRETS:
        return HIDDEN
    try:
        return _hide_in_arms(text) if flag == "--arms" else _hide_in_option(text)
    except ArgumentError:  # no such text gets a run as far as its store
        return _GIVEN.sub(rf"\1\2{HIDDEN}", text)


def _hide_in_arms(text: str) -> str:
    arms = [parse_arm(arm) for arm in split_arms(text)]
    return ",".join(str(replace(arm, options=tuple(map(_hide_in_option, arm.options)))) for arm in arms)


def _hide_in_option(text: str) -> str:
    """Return KEY=VALUE as it may be shown, and another text too; secrets may also be in a mapping, such as roles."""
    key, equals, value = text.partition("=")
    if equals and key.strip() in SECRETS:
        return f"{key}={HIDDEN}"
    found = _parse(value)
    if not isinstance(found, dict | list):
        return _GIVEN.sub(rf"\1\2{HIDDEN}", text)
    try:
        shown = _mask(found)
        return text if shown == found else f"{key}={json.dumps(shown, default=str)}"
    except (RecursionError, TypeError):  # a mapping that holds itself, or names that JSON has not
        return f"{key}={HIDDEN}"


def _parse(value: str) -> Any:
    """Return an option's value as the command line reads it; None for a text that is no YAML."""
    import yaml

    try:
        return parse_yaml(value)
    except (ValueError, yaml.YAMLError):
        return None


def _mask(value: Any) -> Any:
    """Return a value with all secrets in its mappings hidden."""
    if isinstance(value, Mapping):
        return {name: HIDDEN if name in SECRETS else _mask(own) for name, own in value.items()}
    return [_mask(own) for own in value] if isinstance(value, list) else value
