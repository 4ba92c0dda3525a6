# SPDX-License-Identifier: Apache-2.0
"""Plans made of primitives: move forward, turn left, turn right, stop (paper, section "Unified Action API")."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, NULL, STOP, TURN_LEFT, TURN_RIGHT, Action, parse_action
from wiw.errors import ArgumentError, ContractError
from wiw.loop.contract import check_needs, check_plan_space
from wiw.loop.imagination import Imagination, Request
from wiw.loop.imagine import imagine_primitives
from wiw.loop.plan_space import PlanSpace
from wiw.types import PRIMITIVES
from wiw.world_models.base import WorldModel

_KNOWN = frozenset(map(int, (FORWARD, TURN_LEFT, TURN_RIGHT, STOP)))


class Primitives(PlanSpace):
    """int8 [K] of `wiw.action`."""

    words = "discrete primitives"

    def check_plan(self, source: str, actions: Any, longest: int) -> NDArray[np.int8]:
        """Return int8 [K]; see `PlanSpace.check_plan`."""
        plan = np.asarray(actions)
        if plan.ndim != 1 or not 1 <= len(plan) <= longest:
            raise ContractError(f"{source}: expected plans of 1 to {longest} primitives, got shape {plan.shape}")
        if unknown := set(plan.tolist()) - _KNOWN:
            raise ContractError(f"{source}: expected primitives among {sorted(_KNOWN)}, got {sorted(unknown)}")
        return plan.astype(np.int8)

    def check_model(self, model: WorldModel, longest: int) -> None:
        """See `PlanSpace.check_model`; a model that needs more than an image cannot continue from an imagined frame."""
        accepts, name = model.accepts, type(model.unwrapped).__name__
        check_plan_space(model, PRIMITIVES, self.words)
        check_needs(model)
        _check_vocabulary(model)
        lacking = [need for need in accepts.needs if need != "history"]  # imagined frames make a history
        if lacking and accepts.frames and longest > accepts.frames - 1:
            raise ArgumentError(
                f"{name} imagines {accepts.frames - 1} primitives at a time and needs {', '.join(lacking)}, "
                f"which an imagined frame does not have, but plans have up to {longest}; lower horizon or depth, or "
                "raise frames"
            )

    def imagine(self, model: WorldModel, request: Request) -> Imagination:
        """Imagine plans of all episodes in one batch; see `wiw.loop.imagine`."""
        return imagine_primitives(model, request)

    def check_search(self, model: WorldModel, policy: Any, depth: int) -> None:
        """See `PlanSpace.check_search`: the model must show panoramas, and the policy must do without depth there."""
        if model.accepts.view != "panorama":
            raise ArgumentError(
                f"Agent: depth={depth} proposes plans from imagined panoramas, but {type(model.unwrapped).__name__} "
                "only imagines the front view; use depth=1, or a panorama model"
            )
        if not policy.can_extend:
            raise ArgumentError(
                f"Agent: with depth={depth} plans are proposed from imagined places, which have no depth images, but "
                f"{type(policy.unwrapped).__name__} needs them; implement its `extend`, or propose with another policy "
                "and give this one as reviser="
            )


def _check_vocabulary(model: WorldModel) -> None:
    """Check that a model has words of its own for all that plans and their padding are made of.

    Raises:
        ArgumentError: its vocabulary lacks a primitive.
    """
    accepts = model.accepts
    if accepts.control != "action" or not isinstance(accepts.vocabulary, dict):
        return
    needed = (*((NULL,) if accepts.null_first else ()), FORWARD, TURN_LEFT, TURN_RIGHT)
    known = [parse_action(each) for each in accepts.vocabulary]
    if missing := [each.name.lower() for each in needed if each not in known]:
        raise ArgumentError(
            f"{type(model.unwrapped).__name__}: expected a vocabulary with {_list_names(needed)}, got one with "
            f"{_list_names(known) or 'nothing'}; add {', '.join(missing)} to accepts(vocabulary=...)"
        )


def _list_names(actions: Iterable[Action]) -> str:
    return ", ".join(each.name.lower() for each in actions)
