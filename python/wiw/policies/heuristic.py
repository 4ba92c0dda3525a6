# SPDX-License-Identifier: Apache-2.0
"""The paper's rule-based policy: random primitives under two rules that avoid dithering."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from wiw._core import core
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError
from wiw.policies.base import Policy, Situation
from wiw.types import Proposal

MAX_TURNS = 4
"""Turns the same way in a row, at most, as in the paper."""
INVERSE: dict[int, int] = {TURN_LEFT: TURN_RIGHT, TURN_RIGHT: TURN_LEFT}


class Heuristic(Policy):
    """Samples primitives that never undo the previous one and never turn the same way more than four times in a row.

    Source: paper, appendix "Policies in Embodied Tasks". It proposes only; `matcher` is its default reviser.

    Args:
        max_turns: turns the same way in a row, at most.

    Raises:
        ArgumentError: `max_turns` below 1.
    """

    default_revision = "matcher"

    def __init__(self, max_turns: int = MAX_TURNS) -> None:
        if isinstance(max_turns, bool) or not isinstance(max_turns, int) or max_turns < 1:
            raise ArgumentError(f"policy heuristic: expected a whole max_turns of at least 1, got {max_turns!r}")
        self.max_turns = max_turns

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity, with `max_turns` where it is not the paper's."""
        own = super().describe()
        return own if self.max_turns == MAX_TURNS else {**own, "max_turns": self.max_turns}

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return independent random plans, keyed by (seed, episode, decision, candidate); the first is the base
        policy's.
        """
        return [
            [self._make_plan(situation, candidate, horizon) for candidate in range(candidates)]
            for situation in situations
        ]

    def _make_plan(self, situation: Situation, candidate: int, horizon: int) -> Proposal:
        key = situation.key
        draws = core.uniform(core.fold_key([key.seed, key.episode, key.decision, candidate]), horizon)
        history = list(situation.executed)
        for draw in draws:
            allowed = self.list_allowed(history)
            history.append(allowed[int(draw * len(allowed))])
        return Proposal(np.array(history[len(situation.executed) :], np.int8))

    def list_allowed(self, history: Sequence[int]) -> list[int]:
        """Return the primitives that may follow `history`."""
        last = history[-1] if history else None
        undoing = None if last is None else INVERSE.get(last)
        turns = 0
        while turns < len(history) and last in INVERSE and history[-1 - turns] == last:
            turns += 1
        return [
            action
            for action in (FORWARD, TURN_LEFT, TURN_RIGHT)
            if action != undoing and not (action == last and turns >= self.max_turns)
        ]
