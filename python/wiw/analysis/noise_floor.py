# SPDX-License-Identifier: Apache-2.0
"""Noise floor of a run: how an arm differs from itself with other random numbers, or with frames of another size."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from wiw.analysis.statistics import Difference, compare
from wiw.metrics.metric import SUCCESS

Agent = dict[str, Any]
"""An agent as the run's configuration describes it."""


@dataclass(frozen=True)
class Repeat:
    """An arm that is another one but for one thing."""

    arm: str
    base: str
    change: str
    """That thing, such as "with other random numbers"."""


@dataclass(frozen=True)
class NoiseFloor:
    """How much an arm differs from itself."""

    change: str
    """The change in words, such as "with frames of 144x256"."""
    difference: Difference
    """In SR: the arm with the change minus the one without."""


def measure_noise(
    repeats: Iterable[Repeat], done: Mapping[str, Mapping[int, Mapping[str, Any]]], seed: int
) -> tuple[NoiseFloor, ...]:
    """Return how each arm that repeats another one of the run differs from that one in success.

    Args:
        repeats: of the run's arms.
        done: scored episodes of each arm, by index.
        seed: of the run.
    """
    found = [(one.change, compare(one.arm, one.base, done, SUCCESS, seed)) for one in repeats]
    return tuple(NoiseFloor(change, difference) for change, difference in found if difference is not None)


def find_repeats(agents: Mapping[str, Agent]) -> Iterator[Repeat]:
    """Yield arms that are another one but for the seed of their draws, or for the size of their model's frames.

    Of arms that differ in size, all are compared with the one of the model's own size, else with the first.
    """
    for arm, base in _pair_with_first(agents, "reseed"):
        yield Repeat(arm, base, "with other random numbers")
    parts = {arm: _split_size(agent) for arm, agent in agents.items()}
    for arm, base in _pair_with_first(parts, "size"):
        size = parts[arm]["size"]
        yield Repeat(arm, base, f"with frames of {'x'.join(map(str, size)) if isinstance(size, list) else size}")


def _pair_with_first(agents: Mapping[str, Agent], key: str) -> Iterator[tuple[str, str]]:
    """Yield arms with the one that they are but for `key`: the one that has none, else the first."""
    bases: list[str] = []
    for arm in sorted(agents, key=lambda name: agents[name].get(key) is not None):
        rest = _without(agents[arm], [key])
        base = next((one for one in bases if _without(agents[one], [key]) == rest), None)
        if base is None:
            bases.append(arm)
        elif agents[base].get(key) != agents[arm].get(key):
            yield arm, base


def _split_size(agent: Agent) -> Agent:
    """Return the agent with the size of its model's frames beside the model's other options; None for its own."""
    options = agent.get("model_options", {})
    return {**agent, "model_options": _without(options, ["size"]), "size": options.get("size")}


def _without(values: Mapping[str, Any], names: Collection[str]) -> Agent:
    return {name: value for name, value in values.items() if name not in names}
