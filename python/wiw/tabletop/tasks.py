# SPDX-License-Identifier: Apache-2.0
"""The manipulation tasks by name, and the task that an instruction belongs to."""

from __future__ import annotations

import re

from wiw.errors import ArgumentError
from wiw.tabletop.base import TabletopTask
from wiw.tabletop.insert_peg import InsertPeg
from wiw.tabletop.push_buttons import PushButtons
from wiw.tabletop.slide_block import SlideBlock
from wiw.tabletop.stack_cups import StackCups

TABLETOP_TASKS: dict[str, TabletopTask] = {
    task.name: task for task in (PushButtons(), SlideBlock(), InsertPeg(), StackCups())
}


def find_task(instruction: str) -> TabletopTask:
    """Return the task that an instruction belongs to, by its noun.

    Raises:
        ArgumentError: it belongs to none, or to several.
    """
    words = set(re.findall("[a-z]+", instruction.lower()))
    found = [task for task in TABLETOP_TASKS.values() if {task.noun, f"{task.noun}s"} & words]
    if len(found) != 1:
        nouns = ", ".join(task.noun for task in TABLETOP_TASKS.values())
        raise ArgumentError(f"expected an instruction about one of {nouns}, got {instruction!r}")
    return found[0]
