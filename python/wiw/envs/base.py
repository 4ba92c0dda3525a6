# SPDX-License-Identifier: Apache-2.0
"""`Env`: the interface of environments that the closed loop drives, for any task and any plan space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.types import Answer, Episode, Goal, Key, TextAnswer, Truth


@dataclass(frozen=True)
class Segment:
    """The outcome of executing one decision's actions."""

    observation: Any
    """The observation at its end, such as a `wiw.types.Observation`."""
    executed: NDArray[Any]
    """The executed actions: fewer than planned if the episode ended on the way."""
    path: NDArray[np.float64]
    """float64 [len(executed) + 1, 3]: world positions from before the first action to after the last."""
    terminated: bool
    truncated: bool
    key: Key | None = None
    """Key of the next decision, if the environment counts decisions itself."""
    refused: tuple[str, ...] = ()
    """Why actions were not executed to their end, one reason for each such action."""


class Guide(ABC):
    """Ground truth about plans from an environment's present state.

    Only the loop passes on guides, to stages that an experiment gives ground truth; policies and models get none.
    """

    @abstractmethod
    def evaluate_plan(self, plan: NDArray[Any]) -> float:
        """Return the true value of a plan, higher is better: the progress at its end, or at the point where it
        completes the task.
        """

    @abstractmethod
    def suggest_plan(self, length: int) -> NDArray[Any]:
        """Return a plan of at most `length` actions that makes progress in the real environment."""


class Env(ABC):
    """An environment that runs one episode at a time for the closed loop.

    The loop calls `begin` once per episode, then `run` once per decision until a segment is terminated or truncated,
    then `result`. An environment is used for one episode after another until it is closed.
    """

    task: Any
    """The `wiw.Task` whose episodes it runs."""

    @abstractmethod
    def begin(self, episode: Episode) -> Any:
        """Start an episode and return the first observation."""

    @abstractmethod
    def run(self, plan: Any, answer: Answer | TextAnswer | None = None) -> Segment:
        """Execute the actions of one decision, as long as the episode continues, and observe once, at the end.

        `answer` is what the agent believes now; the loop passes it only if the goal expects one.
        """

    @property
    @abstractmethod
    def goal(self) -> Goal:
        """The goal of the running episode."""

    @property
    @abstractmethod
    def observation(self) -> Any:
        """The agent's present view, such as a `wiw.types.Observation`."""

    @abstractmethod
    def truth(self) -> Truth:
        """Return where the agent truly is; only for records, metrics and reports."""

    @abstractmethod
    def result(self) -> Mapping[str, float]:
        """Return the metrics of the running episode, "success" (0 or 1) among them."""

    def details(self) -> Mapping[str, Any]:
        """Return the JSON-able values recorded of the running episode besides its metrics."""
        return {}

    def fork(self) -> Any:
        """Return a copy of the simulator in its present state, which the world model `oracle` simulates ahead."""
        raise self._lacks("has no simulator to copy, which world model 'oracle' needs", "fork")

    def guide(self) -> Guide:
        """Return the ground truth about plans from here, which `wiw blame` gives to stages of the loop."""
        raise self._lacks("does not provide the true value of plans, which `wiw blame` needs", "guide")

    def semantic(self) -> NDArray[np.uint32]:
        """Return the true category of each pixel of the panorama, uint32 [H, W], for `--semantics simulator`."""
        raise self._lacks("has no true semantics, which `--semantics simulator` needs", "semantic")

    def instances(self) -> tuple[NDArray[np.uint32], Sequence[Mapping[str, Any]]]:
        """Return the true instance of each pixel of the panorama, uint32 [H, W], and the scene's table of them."""
        raise self._lacks("does not provide the instance that each pixel shows", "instances")

    def close(self) -> None:
        """Release the resources of the environment."""
        return

    def _lacks(self, what: str, method: str) -> ArgumentError:
        name = type(self).__name__
        return ArgumentError(f"{name} {what}; use something else, or implement `{name}.{method}`")


def read_episode_number(options: Mapping[str, Any] | None) -> int | None:
    """Return the "episode" of gymnasium's reset options; None if not given.

    Raises:
        ArgumentError: another option, or no whole number of at least 0.
    """
    given = _read_episode_option(options)
    return None if given is None else _require_number(given)


def read_episode_numbers(options: Mapping[str, Any] | None, count: int) -> list[int] | None:
    """Return the "episode" of a vector environment's reset options, one for each of `count` places; None if not given.

    Raises:
        ArgumentError: another option, or no list of as many whole numbers of at least 0.
    """
    given = _read_episode_option(options)
    if given is None:
        return None
    if np.ndim(given) != 1:
        raise ArgumentError(f"reset: expected a list of {count} episodes, one for each place, got {given!r}")
    if len(given) != count:
        raise ArgumentError(f"reset: expected {count} episodes, got {len(given)}")
    return [_require_number(each) for each in given]


def _read_episode_option(options: Mapping[str, Any] | None) -> Any:
    given = options or {}
    if unknown := [str(name) for name in given if name != "episode"]:
        raise ArgumentError(f"reset: unknown option '{unknown[0]}'; the only option is 'episode', the episode's number")
    return given.get("episode")


def _require_number(given: Any) -> int:
    if isinstance(given, bool) or not isinstance(given, int | np.integer) or given < 0:
        raise ArgumentError(f"reset: expected an episode number, a whole number of at least 0, got {given!r}")
    return int(given)
