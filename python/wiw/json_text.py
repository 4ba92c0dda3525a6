# SPDX-License-Identifier: Apache-2.0
"""Parse untrusted JSON, of which every defect raises a `ValueError` that describes it, tell values that are nested too
deep, and make any text such that UTF-8 can carry it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Any

MOST_LEVELS = 32
"""Deepest nesting of lists and objects; values are walked through recursively later."""
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def parse_json(text: bytes | str) -> Any:
    """Return the value of a JSON text whose strings can all be written as UTF-8.

    Raises:
        ValueError: the text is not JSON, holds half a surrogate pair, or has more than `MOST_LEVELS` lists and objects
            in one another.
    """
    if isinstance(text, bytes):
        text = text.decode(json.detect_encoding(text))
    try:
        value = json.loads(text)
        if _SURROGATE.search(text):
            json.dumps(value, ensure_ascii=False).encode()
        deep = is_too_deep(value)
    except RecursionError:
        deep = True
    if deep:
        raise ValueError(f"expected at most {MOST_LEVELS} levels of nested lists and objects, but there are more")
    return value


def is_too_deep(value: Any) -> bool:
    """Return whether a value has more than `MOST_LEVELS` lists and dicts in one another."""
    level = [value]
    for _ in range(MOST_LEVELS):
        level = [inner for outer in level for inner in _items(outer)]
    return any(isinstance(inner, dict | list) for inner in level)


def _items(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


def escape_surrogates(text: str) -> str:
    r"""Return a text in which half a surrogate pair, which UTF-8 cannot carry, is written out, such as \udce9.

    File names in other encodings and cut-off replies have them, and so do the errors that tell of them.
    """
    return text.encode(errors="backslashreplace").decode()
