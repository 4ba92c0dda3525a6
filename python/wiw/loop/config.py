# SPDX-License-Identifier: Apache-2.0
"""The parameters of an agent's search, named as in the paper."""

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
    """Parameters of the search, except the number of plans it considers, which `wiw scale` varies."""

    horizon: Annotated[int | None, arg(metavar="L")] = None
    """L, primitives or poses per plan. Default: the task's; 5 without a task. Does not change how many actions are
    executed per decision, unless plans become shorter than that."""
    execute: Annotated[int | None, arg(metavar="N")] = None
    """Actions executed before the next decision; 0: the plan's first `horizon`, which is all of it unless `depth` or
    the policy makes it longer; negative: all of these except that many, but at least one. Default: the task's; L - 2
    without a task. More than `horizon` matters only where plans may be longer."""
    depth: Annotated[int, arg(metavar="N")] = 1
    """Levels of the beam search. The first chooses among the proposals; each further level extends the best plans by
    `horizon` actions, proposed by `Policy.extend` from their imagined ends."""
    width: Annotated[int | None, arg(metavar="N")] = None
    """Plans per episode that are kept and extended at each level. Default: `candidates`."""
    space: Annotated[str | None, Suppress] = None
    """Plan space (`wiw.loop.plan_space`). Default: the task's, or else the policy's."""


@dataclass(frozen=True, kw_only=True)
class AgentConfig(PlanConfig):
    """Parameters of the search. None takes the task's value, or without a task that of the paper's ImageNav.

    Raises:
        ArgumentError: a number out of range.
    """

    candidates: Annotated[int | None, arg(metavar="M")] = None
    """M, plans imagined at each decision. Default: the task's; 3 without a task."""
    pool: Annotated[int | None, arg(metavar="N")] = None
    """Plans to propose, of which the first `candidates` are kept, so that agents that differ only in `candidates` have
    nested sets of plans. Default: `candidates`."""

    def __post_init__(self) -> None:
        for name in ("candidates", "horizon", "depth", "width", "pool", "execute"):
            value = getattr(self, name)
            if not isinstance(value, Integral | None):
                raise ArgumentError(f"agent: expected {name} as a whole number, got {value!r}")
            if name != "execute" and value is not None and int(value) < 1:
                raise ArgumentError(f"agent: expected {name} of at least 1, got {value!r}")
        if self.execute is not None and self.horizon is not None and self.execute < -self.horizon:
            raise ArgumentError(
                f"agent: expected execute of at least -horizon, got execute={self.execute}, horizon={self.horizon}"
            )
        if self.pool is not None and self.pool < (self.candidates or 1):
            raise ArgumentError(
                f"agent: expected a pool of at least candidates={self.candidates}, got pool={self.pool}"
            )

    def resolve(self, defaults: Mapping[str, Any]) -> AgentConfig:
        """Return the parameters that a run uses, with a task's `defaults` for those that this config leaves open.

        Changing the horizon does not change how many actions are executed, and so an episode's budget, unless plans
        become shorter than that.

        Raises:
            ArgumentError: more actions are to be executed than plans of this task have.
        """
        longest = max(self.horizon or defaults.get("horizon", 0), defaults.get("execute", 0))
        if self.execute is not None and 0 < longest < self.execute:
            raise ArgumentError(f"agent: expected execute of at most {longest}, a plan's length, got {self.execute}")
        open_names = {name for name, value in self.numbers.items() if value is None}
        taken = {name: value for name, value in defaults.items() if name in open_names}
        if self.horizon is not None and "execute" in taken:
            taken["execute"] = max(-self.horizon, min(taken["execute"], self.horizon))
        return replace(self, **taken)

    def complete(self) -> AgentConfig:
        """Return the config with every parameter set; those still open are as in the paper's ImageNav."""
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
        """Maximum number of actions in a plan; for a complete config."""
        return (self.horizon or 1) * self.depth

    def describe(self) -> dict[str, int]:
        """Return the parameters stored in a run's manifest: those of a complete config, and the pool if given."""
        complete = self.complete()
        numbers = {name: getattr(complete, name) for name in DESCRIBED}
        return numbers if self.pool is None else {**numbers, "pool": self.pool}

    def count_executed(self, length: int) -> int:
        """Return how many actions of a plan of `length` are executed; for a complete config."""
        assert self.execute is not None and self.horizon is not None
        if self.execute > 0:
            return min(self.execute, length)
        return max(1, min(length, self.horizon) + self.execute)


def set_numbers(config: AgentConfig, numbers: Mapping[str, Any]) -> AgentConfig:
    """Return the config with some parameters replaced.

    Raises:
        ArgumentError: a name that is not a parameter of the search.
    """
    require_known(numbers, [field.name for field in fields(AgentConfig)], "agent", "option")
    return replace(config, **numbers)
