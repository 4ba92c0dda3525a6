# SPDX-License-Identifier: Apache-2.0
"""What servers do wrong, on demand: for tests of those who ask them."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from wiw.errors import ArgumentError
from wiw.serving.vlm_server import Response, VlmServer, make_chat_completion
from wiw.vlm.base import Client
from wiw.vlm.messages import Completion

FAULTS = ("429", "500", "slow", "truncated", "malformed", "refusal", "huge")
HUGE = 10 << 20
"""Characters of a huge answer."""


@dataclass(frozen=True)
class Misbehaviour:
    """How often a server commits each fault; which request meets which is a function of the seed and its number."""

    rates: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0
    slow_seconds: float = 5.0
    retry_after: float = 1.0
    """Seconds that a busy server (429) asks to wait."""

    def __post_init__(self) -> None:
        wrong = [name for name in self.rates if name not in FAULTS]
        if wrong or sum(self.rates.values()) > 1 + 1e-9 or min(self.rates.values(), default=0) < 0:
            raise ArgumentError(
                f"misbehave: expected rates of {', '.join(FAULTS)} that sum to at most 1, got {dict(self.rates)}"
            )

    def fault(self, number: int) -> str | None:
        """What goes wrong with the request of that number, if anything."""
        draw = np.random.default_rng([self.seed, number]).random()
        for name, rate in self.rates.items():
            draw -= rate
            if draw < 0:
                return name
        return None


def spoiled(completion: Completion, fault: str | None, number: int) -> Completion:
    """The completion as a server with that fault gives it."""
    text = completion.text
    if fault == "truncated":
        return replace(completion, text=text[: len(text) // 2], finish="length", logprobs=None)
    if fault == "malformed":
        slips = (
            text.replace('"', "", 3),
            text.replace(":", "", 1).replace(",", ";"),
            f"Sure! Here it is: {text[1:]}",
            json.dumps({"unexpected": text}),
            text + text[1:],
            "<answer>" + text.replace("{", "(").replace("}", ")") + "</answer>",
        )
        junk = (("?", -0.1), ("\n", -3.0))
        return replace(completion, text=slips[number % len(slips)], logprobs=completion.logprobs and junk)
    if fault == "refusal":
        return replace(completion, text="I'm sorry, but I can't help with that.", finish="refusal", logprobs=None)
    if fault == "huge":
        return replace(completion, text=(text * (HUGE // max(1, len(text)) + 1))[:HUGE])
    return completion


class MisbehavingVlmServer(VlmServer):
    """A server that commits faults on demand."""

    def __init__(self, client: Client, port: int = 0, misbehaviour: Misbehaviour | None = None) -> None:
        super().__init__(client, port)
        self.misbehaviour = misbehaviour or Misbehaviour()

    def respond(self, body: dict[str, Any], number: int) -> Response:
        fault = self.misbehaviour.fault(number)
        if fault == "429":
            headers = {"Retry-After": f"{self.misbehaviour.retry_after:g}"}
            return Response(429, {"error": {"message": "too many requests"}}, headers)
        if fault == "500":
            return Response(500, {"error": {"message": "something broke"}})
        if fault == "slow":
            time.sleep(self.misbehaviour.slow_seconds)
        completion = spoiled(self.complete(body), fault, number)
        return Response(200, make_chat_completion(completion, self.client.model, number))
