# SPDX-License-Identifier: Apache-2.0
"""KEY=VALUE as an option of a class or function: on the command line and behind the model of an arm."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError
from wiw.mapping_files import parse_yaml

FILES = ("weights", "checkpoint", "vae")
"""Options that are files or folders although they are annotated as text, since they may be names on a hub too."""


def parse_options(pairs: Sequence[str], factory: Callable[..., Any], flag: str) -> dict[str, Any]:
    """`["steps=30", "size=[480, 480]"]` as options of a factory.

    A value is read as YAML (number, true, [list], text); it stays text where the factory's parameter is annotated as
    such, so that a revision of digits is not a number, except for `null` where it may be None. The brackets of a list
    may be left out where it is annotated as a sequence: `categories=bed,coffee table`. Files and folders that exist are
    named from the root on, so that a run can be resumed from any folder.

    Raises:
        ArgumentError: no `=`, a key given twice, or a value that is no YAML; names the flag.
    """
    import yaml

    options: dict[str, Any] = {}
    parameters = inspect.signature(factory).parameters
    for pair in pairs:
        key, equals, value = pair.partition("=")
        name = key.strip().replace("-", "_")
        if not equals or not name:
            raise ArgumentError(f"{flag}: expected KEY=VALUE, got '{pair}'")
        if name in options:
            raise ArgumentError(f"{flag}: '{name}' is given twice")
        annotation = inspect.formatannotation(parameters[name].annotation).strip("'") if name in parameters else ""
        if annotation.startswith("Sequence") and not value.lstrip().startswith("["):
            value = f"[{value}]"
        default = parameters[name].default if name in parameters else None
        names_files = (name in FILES or re.search(r"\bPath\b", annotation)) and value != default
        path = find_path(value) if names_files else None
        try:
            is_text = annotation.startswith("str") and not (value == "null" and "None" in annotation)
            options[name] = path or (value if is_text else parse_yaml(value))
        except (ValueError, yaml.YAMLError) as error:
            raise ArgumentError(f"{flag}: {pair}: the value is not valid YAML ({error})") from None
    return options


def find_path(value: str) -> str | None:
    """Return the absolute path of a file or folder that exists; None for any other text."""
    try:
        path = Path(value).expanduser()
        return str(path.resolve()) if value and path.exists() else None
    except (OSError, RuntimeError, ValueError):  # too long for a name, or of a user whom nobody knows: no file
        return None
