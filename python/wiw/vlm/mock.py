# SPDX-License-Identifier: Apache-2.0
"""A mock model for tests and first trials: well-formed answers, without looking at the images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from wiw.vlm.base import Client
from wiw.vlm.instances import generate_instance
from wiw.vlm.messages import Call, Completion

Script = Callable[[Call], "str | Mapping[str, float] | Completion"]
PHRASES = ("the way ahead is clear", "something is in the way", "it is on the left", "it is on the right")
"""Free strings of objects."""
WORDS = ("a", "door", "is", "ahead", "on", "the", "left", "right", "and", "clear")


class MockClient(Client):
    """Answers by a script, or randomly by the question's name and seed: the same question has the same answer.

    Args:
        script: returns the answer to a call: text, a probability for each first token, or a whole completion.
        model: its name.
        record: whether `calls` keeps every call, with its images, for tests that look at them.
        options: see `Client`.
    """

    def __init__(
        self, script: Script | None = None, model: str = "mock", *, record: bool = True, **options: Any
    ) -> None:
        super().__init__(**options)
        self.script, self._model, self.record = script, model, record
        self.calls: list[Call] = []
        """All calls so far; none where they are not recorded."""

    @property
    def model(self) -> str:
        """Its name."""
        return self._model

    def complete(self, calls: Sequence[Call]) -> list[Completion]:
        """Return the script's answers, or random ones."""
        if self.record:
            self.calls += calls
        return [to_completion(self._draw(call) if self.script is None else self.script(call), call) for call in calls]

    def _draw(self, call: Call) -> str | dict[str, float]:
        random = np.random.default_rng(int(self.name_of(call), 16))
        if call.labels or call.logprobs:
            labels = call.labels or ("A", "B")  # what is asked about letters without naming them has two at least
            return dict(zip(labels, random.dirichlet(np.ones(len(labels))).tolist(), strict=True))
        if call.schema is not None:
            return generate_instance(
                call.schema,
                lambda _, options: int(random.integers(len(options))),
                lambda _, least, most: PHRASES[int(random.integers(len(PHRASES)))].ljust(least, ".")[:most],
            )
        return " ".join(WORDS[k] for k in random.integers(len(WORDS), size=6))


def to_completion(said: str | Mapping[str, float] | Completion, call: Call) -> Completion:
    """Convert a script's answer to a completion; tokens are estimated: four characters, or a 28 x 28 patch, each."""
    if isinstance(said, Completion):
        return said
    parts = [part for message in call.messages for part in message.content]
    read = sum(len(part) // 4 + 1 if isinstance(part, str) else part.shape[0] * part.shape[1] // 784 for part in parts)
    if isinstance(said, str):
        return Completion(said, prompt_tokens=read, completion_tokens=len(said) // 4 + 1)
    ranked = sorted(said.items(), key=lambda pair: -pair[1])
    listed = tuple((token, float(np.log(max(p, 1e-300)))) for token, p in ranked[: call.logprobs])
    return Completion(ranked[0][0], "length", listed or None, read, 1)
