# SPDX-License-Identifier: Apache-2.0
"""Plan spaces: the actions of plans, how plans are checked and imagined, and which world models can do it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.loop.imagination import Imagination, Request
from wiw.registry import PLAN_SPACES
from wiw.world_models.base import WorldModel


class PlanSpace(ABC):
    """A kind of plan, such as primitives or poses of a gripper.

    A space of your own is a subclass, registered under the name that policies and world models declare
    (`Policy.space`, `wiw.accepts(space=...)`): `PLAN_SPACES.register(name, Class)`, or an entry point in
    "wiw.plan_spaces".
    """

    words: ClassVar[str]
    """Its plans in words, for messages: "discrete primitives"."""

    @abstractmethod
    def check_plan(self, source: str, actions: Any, longest: int) -> NDArray[Any]:
        """Return a plan as an array of this space, 1 to `longest` actions.

        Args:
            source: who made it, for the message.
            actions: the plan.
            longest: most actions.

        Raises:
            ContractError: it is not a plan of this space, or too long.
        """

    @abstractmethod
    def check_model(self, model: WorldModel, longest: int) -> None:
        """Check that a world model can imagine plans of up to `longest` actions.

        Raises:
            ArgumentError: it cannot; says why.
        """

    @abstractmethod
    def imagine(self, model: WorldModel, request: Request) -> Imagination:
        """Imagine all plans of a request."""

    def check_search(self, model: WorldModel, policy: Any, depth: int) -> None:
        """Check that plans of this space can be extended from their imagined ends.

        Raises:
            ArgumentError: they cannot.
        """
        raise ArgumentError(
            f"Agent: depth={depth} proposes plans from imagined places, but {self.words} do not lead to other places"
        )


def plan_space(space: Any) -> PlanSpace:
    """Return a plan space by name, class or instance.

    Raises:
        RegistryError: no space has this name; says which there are.
    """
    made = PLAN_SPACES.make(space)
    assert isinstance(made, PlanSpace)
    return made
