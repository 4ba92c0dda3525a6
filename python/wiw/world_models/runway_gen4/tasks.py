# SPDX-License-Identifier: Apache-2.0
"""Orders at Runway's service: begun once, waited for to any end."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from typing import Any

from wiw.errors import ArgumentError, InfrastructureError

WAITING = ("PENDING", "THROTTLED", "RUNNING")


class Tasks:
    """The tasks of one connection, by what was ordered.

    Args:
        url: of the service; the SDK's own choice if None.
        poll: seconds between two looks.
        patience: seconds after which a task that has not ended counts as lost.
        budget: credits after which no more tasks are started.

    Raises:
        ArgumentError: no key in the environment.
    """

    def __init__(self, url: str | None, poll: float, patience: float, budget: float | None) -> None:
        import runwayml

        try:
            self._client = runwayml.RunwayML(base_url=url)
        except runwayml.RunwayMLError as error:
            raise ArgumentError(f"RunwayGen4: {error}; set RUNWAYML_API_SECRET to a key of dev.runwayml.com") from error
        self._poll, self._patience, self._budget = poll, patience, budget
        self._begun: dict[str, str] = {}
        """Task of each order that has not failed."""
        self._charged: dict[str, int] = {}
        """Credits of each task that has ended."""

    @property
    def credits(self) -> int:
        """Charges so far."""
        return sum(self._charged.values())

    def outputs(self, orders: Sequence[Mapping[str, Any]]) -> list[str]:
        """Return the addresses of the videos of some orders, as arguments of `image_to_video.create`.

        Raises:
            InfrastructureError: a task failed, was cancelled or did not end in time; the service refused; or the
                budget is spent.
        """
        names = [_digest_order(order) for order in orders]
        for name, order in zip(names, orders, strict=True):
            if name not in self._begun:
                self._begun[name] = self._begin(order)
        deadline = time.monotonic() + self._patience
        found: dict[str, str] = {}
        while True:
            found |= {name: url for name in names if name not in found and (url := self._output(name))}
            if len(found) == len(set(names)):
                return [found[name] for name in names]
            if time.monotonic() > deadline:
                raise InfrastructureError(
                    f"RunwayGen4: {len(set(names)) - len(found)} tasks have not finished within {self._patience:g} s; "
                    "repeating the request waits for them again, with a larger patience= for longer"
                )
            time.sleep(self._poll)

    def _begin(self, order: Mapping[str, Any]) -> str:
        if self._budget is not None and self.credits >= self._budget:
            raise InfrastructureError(
                f"RunwayGen4: {self.credits} credits of budget={self._budget:g} are spent; raise it to continue"
            )
        return str(self._ask(self._client.image_to_video.create, **order).id)

    def _output(self, name: str) -> str | None:
        """Return the address of a task's video; None while the task has not ended."""
        task = self._ask(self._client.tasks.retrieve, self._begun[name])
        if task.status in WAITING:
            return None
        self._charged[task.id] = int(task.cost.credits)
        if task.status == "SUCCEEDED" and task.output:
            return str(task.output[0])
        del self._begun[name]
        reason = f": {task.failure} ({task.failure_code})" if task.status == "FAILED" else ""
        raise InfrastructureError(f"RunwayGen4: task {task.id} ended as {task.status}{reason}")

    def _ask(self, call: Any, *values: Any, **named: Any) -> Any:
        """Return an answer of the service; the SDK itself retries where that may help.

        Raises:
            InfrastructureError: it refused, or is out of reach.
        """
        import runwayml

        try:
            return call(*values, **named)
        except runwayml.AuthenticationError as error:
            raise InfrastructureError(f"RunwayGen4: the key in RUNWAYML_API_SECRET is refused ({error})") from error
        except runwayml.APIError as error:
            raise InfrastructureError(f"RunwayGen4: {type(error).__name__}: {error}") from error


def _digest_order(order: Mapping[str, Any]) -> str:
    return blake2b(json.dumps(order, sort_keys=True).encode(), digest_size=20).hexdigest()
