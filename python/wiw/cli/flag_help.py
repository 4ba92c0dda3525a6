# SPDX-License-Identifier: Apache-2.0
"""Build the help of flags, one paragraph each.

tyro takes the description of a flag from a docstring, and keeps every line break there. It also adds
"(default: None)", even if the description already says what the default is.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from functools import lru_cache, partial
from inspect import signature
from typing import Annotated, Any, get_type_hints

from tyro.conf import arg
from tyro.constructors import StructConstructorSpec, StructFieldSpec, StructTypeInfo


def join_lines(command: Callable[..., int]) -> Callable[..., int]:
    """Make the description of each argument in a command's docstring one line; return the command."""
    text, heading, arguments = (command.__doc__ or "").partition("\n    Args:\n")
    command.__doc__ = text + heading + re.sub(r"\n {12}(?=\S)", " ", arguments)
    return command


@lru_cache
def hide_defaults(command: Callable[..., int]) -> Callable[..., int]:
    """Annotate the arguments of a command whose default is None so that it is not shown; return the command."""
    types = get_type_hints(command, include_extras=True)
    for name, parameter in signature(command).parameters.items():
        types[name] = _hide_none(types[name], parameter.default)
    command.__annotations__ = types
    return command


def read_flags(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Return how to read a dataclass of wiw from flags, None for other types: a rule for a `ConstructorRegistry`."""
    is_ours = dataclasses.is_dataclass(info.type) and info.type.__module__.split(".")[0] == "wiw"
    if not is_ours or not isinstance(info.default, info.type):
        return None
    types = get_type_hints(info.type, include_extras=True)
    return StructConstructorSpec(
        instantiate=info.type,
        fields=tuple(
            StructFieldSpec(
                field.name,
                _hide_none(types[field.name], getattr(info.default, field.name)),
                getattr(info.default, field.name),
                partial(_describe, info.type, field.name),
            )
            for field in dataclasses.fields(info.type)
        ),
    )


def _describe(kind: type, name: str) -> str | None:
    """Return the description of a field on one line."""
    found = (_read_descriptions(base).get(name) for base in kind.__mro__ if dataclasses.is_dataclass(base))
    return next((" ".join(text.split()) for text in found if text), None)


@lru_cache
def _read_descriptions(kind: type) -> dict[str, str]:
    import docstring_parser  # only --help needs it

    return {each.arg_name: each.description or "" for each in docstring_parser.parse_from_object(kind).params}


def _hide_none(annotation: Any, default: Any) -> Any:
    """Return the type of a field, annotated so that a default of None is not shown."""
    return Annotated[annotation, arg(help_behavior_hint="")] if default is None else annotation
