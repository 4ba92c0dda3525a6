# SPDX-License-Identifier: Apache-2.0
"""Announce a run in four lines, before anything heavy is loaded."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import Any

from wiw.cli.terminal import printable
from wiw.runs.config import RunConfig
from wiw.tasks.base import Task


def announce(task: Task, arms: Mapping[str, Any], config: RunConfig) -> None:
    """Print task, scenes, arms, workers and folder of a run.

    Args:
        task: as built.
        arms: recipes by name.
        config: how the run goes.

    Raises:
        RegistryError: an arm's part is not known, or takes other options.
        ArgumentError: an arm does not fit the task.
    """
    said = task.describe()
    count = task.default_episodes if config.episodes is None else config.episodes
    for recipe in arms.values():
        recipe.describe()
        recipe.require(task, count)
    policies = sorted({str(recipe.policy) for recipe in arms.values()})
    trials = f"{count_noun(count, 'episode')}{_describe_scenes(said, count, task.block)}"
    lines = {
        "task": f"{said.get('task', task.name)}: {trials}, seed {config.seed}",
        "arms": f"{', '.join(arms)} ({'policy' if len(policies) == 1 else 'policies'} {', '.join(policies)})",
        "workers": str(config.workers),
        **({} if config.shard is None else {"shard": config.shard}),
        **({} if config.until is None else {"until": _describe_rule(config, list(arms))}),
        "run": str(config.out),
    }
    for name, line in lines.items():
        print(f"{name:<8}{printable(line)}", file=sys.stderr)
    print(file=sys.stderr, flush=True)


def _describe_rule(config: RunConfig, arms: list[str]) -> str:
    """Return the rule that may stop the run early.

    Raises:
        ArgumentError: one that is not understood.
    """
    from wiw.analysis.stopping import parse_stop_rule

    rule = parse_stop_rule(str(config.until), arms, config.look_every)
    return f"{rule.text}; checked every {count_noun(rule.every, 'episode')} per arm"


def announce_protocol(task: Task, arms: Mapping[str, Any], episodes: int) -> None:
    """Print a task's preset, and where a run of so many `episodes` departs from the paper, with reasons."""
    from wiw.cli.presets import list_settings
    from wiw.runs.departures import find_departures
    from wiw.tasks.presets import find_owner

    if task.preset:
        print(f"preset {task.preset}")
        for line in list_settings(find_owner(type(task)), task.preset):
            print(f"  sets {line}")
    found = find_departures(task, arms, episodes)
    print("departures from the paper" if found else "no departures from the paper")
    for departure in found:
        print(f"  {printable(departure)}")


def count_noun(count: int, noun: str) -> str:
    """Return "1 episode" or "3 episodes"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _describe_scenes(task: Mapping[str, Any], episodes: int, each: int | None) -> str:
    """Return where the episodes take place, `each` of them in a scene; empty for a task that does not say."""
    from wiw.scenes import resolve

    file, spec = task.get("episode_file"), task.get("scenes")
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
