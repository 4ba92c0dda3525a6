# SPDX-License-Identifier: Apache-2.0
"""KEY=VALUE on the command line, as options of a class or function."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from tyro.conf import UseAppendAction, arg

from wiw.errors import ArgumentError
from wiw.runs.part_options import parse_options

Options = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="KEY=VALUE")]
"""A flag that may be repeated."""
JudgeName = Annotated[str | None, arg(metavar="NAME|DIGEST")]
"""A judge that has marked a run's answers."""


def model_options(model: str | None, pairs: Sequence[str]) -> dict[str, Any]:
    """Return the options of a world model from `--world-model-option`.

    Raises:
        ArgumentError: options without a model to take them.
    """
    from wiw.registry import WORLD_MODELS

    if pairs and model is None:
        raise ArgumentError("--world-model-option: name the model it is for with --world-model")
    return parse_options(pairs, WORLD_MODELS.find(model), "--world-model-option") if model and pairs else {}


def policy_options(
    policy: str | None, pairs: Sequence[str], beside: Mapping[str, Mapping[str, Any]], flag: str = "--policy-option"
) -> dict[str, Mapping[str, Any]]:
    """Return the options of policies by name: those from a flag for one policy, on top of the known ones.

    Raises:
        ArgumentError: options without a policy to take them.
    """
    from wiw.registry import POLICIES

    if not pairs:
        return dict(beside)
    if policy is None:
        raise ArgumentError(f"{flag}: name the policy it is for with {flag.removesuffix('-option')}")
    return {**beside, policy: {**beside.get(policy, {}), **parse_options(pairs, POLICIES.find(policy), flag)}}


def tracker_options(tracker: str | None, pairs: Sequence[str]) -> dict[str, Any]:
    """Return the options of a tracker from `--tracker-option`; of policy vlm's tracker if none is named."""
    from wiw.registry import TRACKERS

    return parse_options(pairs, TRACKERS.find(tracker or "frames"), "--tracker-option") if pairs else {}


def semantics_options(source: str | None, pairs: Sequence[str]) -> dict[str, Any]:
    """Return the options of a source of semantics from `--semantics-option`.

    Raises:
        ArgumentError: options without a source to take them.
    """
    from wiw.registry import SEMANTICS

    if pairs and source in (None, "simulator"):
        raise ArgumentError("--semantics-option: name the source it is for with --semantics, such as rednet")
    return parse_options(pairs, SEMANTICS.find(str(source)), "--semantics-option") if pairs else {}


def task_options(task: str, pairs: Sequence[str], flags: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a task: those from its `flags`, and those from `--task-option`.

    Raises:
        ArgumentError: an option that has a flag of its own.
    """
    from wiw.registry import TASKS

    options = parse_options(pairs, TASKS.find(task), "--task-option") if pairs else {}
    for name in options:
        if name in flags:
            raise ArgumentError(f"--task-option: '{name}' has its own flag, --{name.replace('_', '-')}")
    return {**{name: value for name, value in flags.items() if value is not None}, **options}
