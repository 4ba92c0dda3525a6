# SPDX-License-Identifier: Apache-2.0
"""Messages between a policy and a vision-language model: requests, calls, completions and replies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError

if TYPE_CHECKING:
    from pydantic import BaseModel

Kind = Literal["empty", "refusal", "truncated", "malformed", "schema", "huge", "no_option"]
Part = str | NDArray[np.uint8]


@dataclass(frozen=True)
class Message:
    """One turn of a conversation; its parts are text and images uint8 [H, W, 3]."""

    role: Literal["system", "user", "assistant"]
    content: tuple[Part, ...]


def user(*content: Part) -> Message:
    """Return a message of the user."""
    return Message("user", content)


@dataclass(frozen=True)
class Request:
    """One question: multiple choice where it has choices, JSON where it has a schema, otherwise free text.

    Raises:
        ArgumentError: choices and a schema, fewer than two choices, or the same choice twice.
    """

    messages: tuple[Message, ...]
    choices: tuple[str, ...] = ()
    rounds: bool = True
    """Whether more choices than the server lists tokens are asked about in rounds. In one question with all of them,
    choices that are not listed are known to be unlikely, and nothing else."""
    schema: type[BaseModel] | None = None
    temperature: float = 0.0
    seed: int = 0
    """What the seeds of its calls are derived from; they differ by the attempt."""
    exact_seed: bool = False
    """Whether the first call for text or JSON has `seed` itself, as a published protocol may ask for."""
    max_tokens: int = 1024
    """Maximum number of tokens of an answer that is not a choice."""
    tries: int = 3
    """Times that it is asked for text or JSON before an unusable answer counts as the outcome. For a choice the votes
    are all that is asked."""

    def __post_init__(self) -> None:
        if self.choices and self.schema is not None:
            raise ArgumentError("vlm: a request takes choices or a schema, not both")
        if len(self.choices) == 1 or len(set(self.choices)) != len(self.choices):
            raise ArgumentError(f"vlm: expected at least two different choices, got {self.choices}")
        if self.tries < 1:
            raise ArgumentError(f"vlm: expected tries of at least 1, got {self.tries}")


@dataclass(frozen=True)
class Call:
    """One completion requested of a model; `Client.name_of` names it by its content."""

    messages: tuple[Message, ...]
    temperature: float
    seed: int
    max_tokens: int
    labels: tuple[str, ...] = ()
    """Expected first tokens."""
    logprobs: int = 0
    """Number of likeliest first tokens to list with their log-probabilities."""
    schema: Mapping[str, Any] | None = None
    """JSON schema that the answer should match."""


@dataclass(frozen=True)
class Completion:
    """A model's answer to a call."""

    text: str
    finish: str = "stop"
    """"stop", "length", "refusal", "huge", or the server's own word."""
    logprobs: tuple[tuple[str, float], ...] | None = None
    """Likeliest first tokens; None if the server returns none."""
    prompt_tokens: int = 0
    completion_tokens: int = 0
    retries: int = 0
    """Number of failed attempts before it."""

    def to_json(self) -> dict[str, Any]:
        """Return a JSON-able form for caches and records; `from_json` is the inverse."""
        return {
            "text": self.text,
            "finish": self.finish,
            "logprobs": None if self.logprobs is None else [list(pair) for pair in self.logprobs],
            "prompt_tokens": self.prompt_tokens,
            "completion_tokens": self.completion_tokens,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Completion:
        """Restore a completion from its JSON form."""
        pairs = values["logprobs"]
        logprobs = None if pairs is None else tuple((str(token), float(value)) for token, value in pairs)
        tokens = int(values["prompt_tokens"]), int(values["completion_tokens"])
        return cls(str(values["text"]), str(values["finish"]), logprobs, *tokens)


@dataclass(frozen=True)
class Problem:
    """Why an answer cannot be used."""

    kind: Kind
    detail: str
    raw: str
    """The model's text, truncated."""

    def __str__(self) -> str:
        return f"{self.kind}: {self.detail}"


@dataclass(frozen=True)
class CompletionRecord:
    """One completion of a conversation, for the record."""

    call: str
    """Name of the call."""
    completion: Completion
    used: bool


@dataclass(frozen=True)
class Reply:
    """The outcome of a request: a usable answer, or a `problem`."""

    text: str = ""
    value: Any = None
    """The validated object, where the request has a schema."""
    probabilities: NDArray[np.float64] | None = None
    """float64 [choices], sum 1, where the request has choices."""
    raw: NDArray[np.float64] | None = None
    """float64 [choices], sum at most 1: `probabilities` as the model gave them, before they were made to sum to 1; 0
    where it listed none. With votes, the shares of all samples. After several rounds, scaled by the last one's."""
    by: str = ""
    """"logprobs", or "votes" where the server returns no log-probabilities."""
    repaired: bool = False
    """Whether JSON syntax errors were repaired."""
    adapted: bool = False
    """Whether keys or values were read in another form than they were written in."""
    problem: Problem | None = None
    completions: tuple[CompletionRecord, ...] = field(default=(), repr=False)
    model: str = ""
    """Name of the model that was asked, where the asker has several."""

    @property
    def mass(self) -> float | None:
        """Probability that the model gave to all choices together; or the share of votes for one of them."""
        return None if self.raw is None else float(self.raw.sum())

    @property
    def doubtful(self) -> bool:
        """Whether most of the probability went to something other than the choices."""
        return self.mass is not None and self.mass < 0.5
