# SPDX-License-Identifier: Apache-2.0
"""What a run is about to do, in four lines, before anything heavy is loaded."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wiw.cli.terminal import printable


def announce(task: Any, arms: Mapping[str, Any], episodes: int | None, seed: int, workers: int, folder: Path) -> None:
    """Print task, scenes, arms, workers and folder of a run.

    Args:
        task: as built.
        arms: recipes by name.
        episodes: how many; None means the task's own number.
        seed: of the run.
        workers: processes.
        folder: of the run.

    Raises:
        RegistryError: an arm's part is not known, or takes other options.
        ArgumentError: an arm does not fit the task.
    """
    said = task.describe()
    for recipe in arms.values():
        recipe.describe()
        recipe.require(said)
    count = episodes
    if count is None:
        count = int(getattr(task, "default_episodes", getattr(task, "usual", 20)))
    policies = sorted({str(getattr(recipe, "policy", type(recipe).__name__)) for recipe in arms.values()})
    trials = f"{count_noun(count, 'episode')}{_describe_scenes(said, count)}"
    lines = {
        "task": f"{said.get('task', task.name)}: {trials}, seed {seed}",
        "arms": f"{', '.join(arms)} ({'policy' if len(policies) == 1 else 'policies'} {', '.join(policies)})",
        "workers": str(workers),
        "run": str(folder),
    }
    for name, line in lines.items():
        print(f"{name:<8}{printable(line)}", file=sys.stderr)
    print(file=sys.stderr, flush=True)


def count_noun(count: int, noun: str) -> str:
    """Return "1 episode" or "3 episodes"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _describe_scenes(task: Mapping[str, Any], episodes: int) -> str:
    """Return where the episodes take place; empty for a task that does not say."""
    from wiw.scenes import resolve

    file, spec, each = task.get("episode_file"), task.get("scenes"), task.get("per_scene")
    if file is not None:
        return f" of {file}"
    if spec is None:
        return f" of {', '.join(task['tasks'])}" if task.get("tasks") else ""
    try:
        there = len(resolve(spec))
    except Exception:  # a wrong spec is refused where the scenes are made, with a message of its own
        return f" in {spec}"
    used = min(there, math.ceil(episodes / each)) if each else there
    of = f"{used} of {count_noun(there, 'scene')}" if used < there else count_noun(there, "scene")
    return f" in {of} ({spec}{f', {each} per scene' if each else ''})"
