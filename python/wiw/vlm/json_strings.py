# SPDX-License-Identifier: Apache-2.0
"""Strings of JSON as a model writes them, which may be begun only, or escaped wrongly."""

from __future__ import annotations

import json
import re

_INSIDE = re.compile(r'(?:[^"\\]|\\.)*', re.DOTALL)
"""Matches what is inside a string, as far as its closing quote or a lone backslash at the end."""
_ESCAPE = re.compile(r'\\(["\\/bfnrt]|u[0-9a-fA-F]{4})?')


def read_string(written: str) -> tuple[str, bool]:
    """Return the content of a string, unescaped, and whether its closing quote is there.

    Backslashes that begin no escape of JSON, as in a path, count as themselves. Half a character is left out at the end
    and replaced by "?" elsewhere.

    Args:
        written: what follows the opening quote; what follows the closing one does not count.
    """
    match = _INSIDE.match(written)
    assert match is not None
    closed = written[match.end() : match.end() + 1] == '"'
    inside = match[0] if closed else match[0].rstrip("\ufffd")
    mended = _ESCAPE.sub(lambda escape: escape[0] if escape[1] else r"\\", inside)
    text: str = json.loads(f'"{mended}"', strict=False)
    return text.encode("utf-8", "replace").decode(), closed
