# SPDX-License-Identifier: Apache-2.0
"""The manipulation tasks by name, and which of them an instruction is about."""

from __future__ import annotations

import re

from wiw.errors import ArgumentError
from wiw.tabletop.insert_peg import InsertPeg
from wiw.tabletop.kind import Kind
from wiw.tabletop.push_buttons import PushButtons
from wiw.tabletop.slide_block import SlideBlock
from wiw.tabletop.stack_cups import StackCups

KINDS: dict[str, Kind] = {kind.name: kind for kind in (PushButtons(), SlideBlock(), InsertPeg(), StackCups())}


def kind_of(instruction: str) -> Kind:
    """The kind of task that an instruction is about, by its noun.

    Raises:
        ArgumentError: it is about none of them, or about several.
    """
    words = set(re.findall("[a-z]+", instruction.lower()))
    found = [kind for kind in KINDS.values() if {kind.noun, f"{kind.noun}s"} & words]
    if len(found) != 1:
        nouns = ", ".join(kind.noun for kind in KINDS.values())
        raise ArgumentError(f"expected an instruction about one of {nouns}, got {instruction!r}")
    return found[0]
