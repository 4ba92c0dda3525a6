# SPDX-License-Identifier: Apache-2.0
"""Access to the live environments, for experiments that need privileged information; agents have none.

A `Query` carries what an agent perceives. The oracle, stages that are given the ground truth, and measurements of
fidelity are `Privileged`: before an episode's first decision they are granted its live environment, by its key. No
policy or world model under test is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from wiw.errors import ArgumentError
from wiw.types import Key


class LiveEnvironments:
    """The environments of the episodes that are being run, by (seed, episode)."""

    def __init__(self) -> None:
        self._by_episode: dict[tuple[int, int], Any] = {}

    def add(self, key: Key, env: Any) -> None:
        """Grant access to the environment of an episode that begins."""
        self._by_episode[key.seed, key.episode] = env

    def remove(self, key: Key) -> None:
        """End access to an episode's environment."""
        self._by_episode.pop((key.seed, key.episode), None)

    def find(self, key: Key) -> Any:
        """Return the environment of an episode in its current state.

        Raises:
            ArgumentError: nobody has granted it.
        """
        env = self._by_episode.get((key.seed, key.episode))
        if env is None:
            raise ArgumentError(
                "this agent has parts that need the simulator (the oracle, ground truth, fidelity): run it with "
                "wiw.evaluate, or pass the environment's fork: decide(..., simulator=env.fork())"
            )
        return env


class Privileged(ABC):
    """A part of an agent that is granted the live environments."""

    @abstractmethod
    def grant(self, environments: LiveEnvironments) -> None:
        """Take the environments in which the next episodes are run."""


class ForkedEnvironment:
    """Stands in for a live environment where only a fork of it is available."""

    def __init__(self, simulator: Any) -> None:
        self._simulator = simulator

    def fork(self) -> Any:
        """Return the fork."""
        return self._simulator
