# SPDX-License-Identifier: Apache-2.0
"""The numbers of an agent's search, as the paper names them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from numbers import Integral
from typing import Annotated, Any

from tyro.conf import Suppress, arg

from wiw.errors import ArgumentError
from wiw.typed_values import require_known

DESCRIBED = ("candidates", "horizon", "execute", "depth", "width")


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """Numbers of the search but for how many plans it considers, which `wiw scale` varies."""

    horizon: Annotated[int | None, arg(metavar="L")] = None
    """L, primitives or poses per plan; the task's own number if not given, 5 without a task. As many of them
    are carried out as of the task's own, unless the plan is shorter."""
    execute: Annotated[int | None, arg(metavar="N")] = None
    """Actions carried out before the next decision; 0: the whole plan; negative: all of the plan's first `horizon` but
    that many, at least one. L - 2 without a task."""
    depth: Annotated[int, arg(metavar="N")] = 1
    """Levels of the beam search. The first chooses among the proposals; each further one extends the best plans by
    `horizon` actions, as `Policy.extend` proposes from their imagined ends."""
    width: Annotated[int | None, arg(metavar="N")] = None
    """Plans of an episode that are kept and extended at each level; None means `candidates`."""
    space: Annotated[str | None, Suppress] = None
    """Plan space (`wiw.loop.plan_space`); None means the task's, else the policy's."""


@dataclass(frozen=True, kw_only=True)
class AgentConfig(PlanConfig):
    """Numbers of the search; None leaves one to the task, and without a task to the paper's ImageNav.

    Raises:
        ArgumentError: a number out of range.
    """

    candidates: Annotated[int | None, arg(metavar="M")] = None
    """M, plans imagined at each decision; the task's own number if not given, 3 without a task."""
    pool: Annotated[int | None, arg(metavar="N")] = None
    """Plans that are proposed, of which the first `candidates` are kept, so that the sets of agents that differ in
    `candidates` alone are nested; None proposes as many as are kept."""

    def __post_init__(self) -> None:
        for name in ("candidates", "horizon", "depth", "width", "pool"):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, Integral) and int(value) >= 1):
                raise ArgumentError(f"agent: expected {name} of at least 1, got {value}")
        if not isinstance(self.execute, Integral | None):
            raise ArgumentError(f"agent: expected execute as a whole number, got {self.execute!r}")
        if self.execute is not None and self.horizon is not None and abs(self.execute) > self.horizon:
            raise ArgumentError(
                f"agent: expected execute from -horizon to horizon, got execute={self.execute}, horizon={self.horizon}"
            )
        if self.pool is not None and self.pool < (self.candidates or 1):
            raise ArgumentError(
                f"agent: expected a pool of at least candidates={self.candidates}, got pool={self.pool}"
            )

    def resolve(self, defaults: Mapping[str, Any]) -> AgentConfig:
        """Return the numbers that a run uses, with a task's `defaults` where this config leaves one open.

        Another horizon does not change how many actions are carried out, and so an episode's budget, unless it is
        shorter than that.
        """
        open_names = {name for name, value in self.numbers.items() if value is None}
        taken = {name: value for name, value in defaults.items() if name in open_names}
        if self.horizon is not None and "execute" in taken:
            taken["execute"] = max(-self.horizon, min(taken["execute"], self.horizon))
        return replace(self, **taken)

    def complete(self) -> AgentConfig:
        """Return the config with every number set, those that are still open as in the paper's ImageNav."""
        candidates = self.candidates or 3
        horizon = self.horizon or 5
        execute = max(1, horizon - 2) if self.execute is None else self.execute
        width, pool = self.width or candidates, self.pool or candidates
        return replace(self, candidates=candidates, horizon=horizon, execute=execute, width=width, pool=pool)

    @property
    def numbers(self) -> dict[str, Any]:
        """All settings by name."""
        return {field.name: getattr(self, field.name) for field in fields(AgentConfig)}

    @property
    def longest(self) -> int:
        """Most actions of a plan; for a complete config."""
        return (self.horizon or 1) * self.depth

    def describe(self) -> dict[str, int]:
        """Return the numbers that a run's manifest names: those of a complete config, and a pool that is given."""
        complete = self.complete()
        numbers = {name: getattr(complete, name) for name in DESCRIBED}
        return numbers if self.pool is None else {**numbers, "pool": self.pool}

    def count_executed(self, length: int) -> int:
        """Return how many actions of a plan of `length` are carried out; for a complete config."""
        assert self.execute is not None and self.horizon is not None
        if self.execute > 0:
            return min(self.execute, length)
        return max(1, min(length, self.horizon) + self.execute)


def set_numbers(config: AgentConfig, numbers: Mapping[str, Any]) -> AgentConfig:
    """Return the config with some numbers in place of its own.

    Raises:
        ArgumentError: a name that is no number of the search.
    """
    require_known(numbers, [field.name for field in fields(AgentConfig)], "agent", "option")
    return replace(config, **numbers)
