# SPDX-License-Identifier: Apache-2.0
"""Schemas of answers, which servers receive in full, and the harmless variations in which models write them.

An answer may have further keys, lack its reasons, and write a key or a name with capitals or spaces. What is ambiguous
is not read: two keys that are spellings of one field, or a name outside the vocabulary.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

if TYPE_CHECKING:
    from pydantic import BaseModel

NULL_WORDS = ("", "none", "null", "n/a")
"""Words that models write for null."""
_BETWEEN_WORDS = re.compile(r"[\s_-]+")


def create_answer_model(
    name: str,
    *,
    reasons: Sequence[str] = (),
    refused: Sequence[str] = (),
    validators: dict[str, Any] | None = None,
    **fields: Any,
) -> type[BaseModel]:
    """Create the model of an answer, or of a part of one.

    Args:
        name: of the model in its schema.
        reasons: fields of text that nothing depends on; they are empty where they are missing.
        refused: further keys that would say something; an answer with one of them, unless it is null, is not read.
        validators: of pydantic, by any name.
        fields: as `pydantic.create_model` takes them.
    """
    from pydantic import ConfigDict, create_model, model_validator

    def read_keys(values: Any) -> Any:
        return _read_keys(values, fields, reasons, refused) if isinstance(values, dict) else values

    keys: Any = {"read_keys": model_validator(mode="before")(read_keys), **(validators or {})}
    return create_model(name, __config__=ConfigDict(extra="forbid"), __validators__=keys, **fields)


def make_name_type(names: Sequence[str]) -> Any:
    """Return the type of one of several names, read whatever its case and whatever is between its words."""
    from pydantic import BeforeValidator

    def read_name(value: Any) -> Any:
        found = [name for name in names if isinstance(value, str) and _fold_name(name) == _fold_name(value)]
        return found[0] if len(found) == 1 else value

    return Annotated[Literal[tuple(names)], BeforeValidator(read_name)]


def read_null(value: Any) -> Any:
    """Read words for nothing, such as "None", as null."""
    nothing = isinstance(value, str) and value.strip().casefold().rstrip(".") in NULL_WORDS
    return None if nothing else value


def read_text(value: Any) -> Any:
    """Read a number where a text is expected as its digits, and words for nothing as null."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return str(value) if is_number else read_null(value)


def _read_keys(
    values: dict[str, Any], fields: dict[str, Any], reasons: Sequence[str], refused: Sequence[str]
) -> dict[str, Any]:
    """Return the values of the fields, and of further keys only those that make the answer unreadable."""
    known = {_fold_name(name): name for name in fields}
    spellings = Counter(map(_fold_name, values))
    kept = {}
    for key, value in values.items():
        folded = _fold_name(key)
        if folded in known:
            kept[known[folded] if spellings[folded] == 1 else key] = value
        elif key in refused and read_null(value) is not None:
            kept[key] = value
    return {**dict.fromkeys((name for name in reasons if _fold_name(name) not in spellings), ""), **kept}


def _fold_name(name: str) -> str:
    return _BETWEEN_WORDS.sub("_", name.strip().casefold())
