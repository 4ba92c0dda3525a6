# SPDX-License-Identifier: Apache-2.0
"""The findings of a run, for comparing it with another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from wiw.studies.run_log import load_run

COSTS = ("seconds", "spent", "calls")
"""Entries that differ from run to run."""


def list_facts(run: Path) -> list[dict[str, Any]]:
    """Return the rows of episodes and decisions, without what they cost."""
    log = load_run(run)
    return [
        {name: value for name, value in row.items() if name not in COSTS} for row in [*log.episodes, *log.decisions]
    ]
