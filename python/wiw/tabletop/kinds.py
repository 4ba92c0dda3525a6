# SPDX-License-Identifier: Apache-2.0
"""The kinds of manipulation task, by name."""

from __future__ import annotations

from wiw.tabletop.insert_peg import InsertPeg
from wiw.tabletop.kind import Kind
from wiw.tabletop.push_buttons import PushButtons
from wiw.tabletop.slide_block import SlideBlock
from wiw.tabletop.stack_cups import StackCups

KINDS: dict[str, Kind] = {kind.name: kind for kind in (PushButtons(), SlideBlock(), InsertPeg(), StackCups())}
