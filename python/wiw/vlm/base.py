# SPDX-License-Identifier: Apache-2.0
"""Requests to a vision-language model and their replies; every client answers through `Client.ask`."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.vlm.prices import Prices

if TYPE_CHECKING:
    from pydantic import BaseModel

    from wiw.vlm.cache import ReplyCache

FORMAT_VERSION = 1
"""Version of the question format; part of a question's name, so that answers to another wording are not reused."""
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
    schema: type[BaseModel] | None = None
    temperature: float = 0.0
    seed: int = 0
    max_tokens: int = 1024
    """Most tokens of an answer that is not a choice."""
    tries: int = 3
    """Times that it is asked before an unusable answer counts as the outcome."""

    def __post_init__(self) -> None:
        if self.choices and self.schema is not None:
            raise ArgumentError("vlm: a request has choices or a schema, not both")
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
    """Likeliest first tokens; None where the server returns none."""
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
class Said:
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
    mass: float | None = None
    """Probability that the model gave to the choices before normalisation; or the share of votes for one of them."""
    by: str = ""
    """"logprobs", or "votes" where the server returns no log-probabilities."""
    repaired: bool = False
    """Whether JSON syntax errors were repaired."""
    problem: Problem | None = None
    said: tuple[Said, ...] = field(default=(), repr=False)

    @property
    def doubtful(self) -> bool:
        """Whether most of the probability went to something other than the choices."""
        return self.mass is not None and self.mass < 0.5


class Client(ABC):
    """A model that answers batches of requests.

    Args:
        cache: stores answers, so that no question is paid for twice; None stores nothing.
        prices: US dollars per million tokens; a model that is not in the table has an unknown price.
        top_logprobs: most first tokens that the server lists; as many choices are asked at once, more in rounds. 0 for
            a server that refuses to list any: choices are voted on.
        votes: samples to count where a server returns no log-probabilities.
    """

    def __init__(
        self,
        *,
        cache: ReplyCache | None = None,
        prices: Prices | None = None,
        top_logprobs: int = 20,
        votes: int = 5,
    ) -> None:
        if not (top_logprobs == 0 or 2 <= top_logprobs <= 26) or votes < 1:
            raise ArgumentError(
                f"vlm: expected top_logprobs from 2 to 26, or 0, and votes >= 1, got {top_logprobs}, {votes}"
            )
        self.cache, self.prices, self.top_logprobs, self.votes = cache, prices or Prices(), top_logprobs, votes
        self.spent: Counter[str] = Counter()
        """vlm_calls, vlm_cached, vlm_retries, vlm_input_tokens, vlm_output_tokens and their sum vlm_tokens; vlm_usd
        where the price is known."""

    @property
    @abstractmethod
    def model(self) -> str:
        """The name under which the model is requested."""

    @property
    def manner(self) -> str:
        """What answers depend on beside the model's name and the call; part of the names of cached answers."""
        return ""

    @abstractmethod
    def complete(self, calls: Sequence[Call]) -> list[Completion]:
        """Return one completion per call, in order.

        Raises:
            VlmError: the model cannot be reached, or did not answer after retries.
        """

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity: what answers depend on beside the questions."""
        return {"model": self.model, "top_logprobs": self.top_logprobs, "votes": self.votes}

    def ask(self, requests: Sequence[Request]) -> list[Reply]:
        """Ask all requests at once, and repeat those that need it, until each has its reply.

        Raises:
            VlmError: see `complete`; nothing is answered then. An unusable answer is no error: it is in the reply.
        """
        from wiw.vlm.conversation import Conversation

        talks = [Conversation(request, self.top_logprobs, self.votes) for request in requests]
        try:
            while waiting := [talk for talk in talks if talk.calls]:
                calls = [call for talk in waiting for call in talk.calls]
                names = [self.name_of(call) for call in calls]
                answers = iter(zip(names, self._complete(calls, names), strict=True))
                for talk in waiting:
                    talk.receive([next(answers) for _ in talk.calls])
        finally:
            self._keep([talk.reply for talk in talks])
        return [talk.reply for talk in talks]

    def name_of(self, call: Call) -> str:
        """Return a digest of the model and of everything in a call; images by their pixels."""
        digest = blake2b(digest_size=16)
        head = [FORMAT_VERSION, self.model, call.temperature, call.seed, call.max_tokens, call.labels, call.logprobs]
        digest.update(json.dumps([*head, call.schema], sort_keys=True).encode())
        for message in call.messages:
            digest.update(f"\0{message.role}".encode())
            for part in message.content:
                if isinstance(part, str):
                    digest.update(b"\0text" + part.encode("utf-8", "surrogatepass"))
                else:
                    digest.update(f"\0image{part.shape}".encode())
                    digest.update(np.ascontiguousarray(part).data)
        return digest.hexdigest()

    def _complete(self, calls: Sequence[Call], names: Sequence[str]) -> list[Completion]:
        found = [None if self.cache is None else self.cache.get(self._kept_as(name)) for name in names]
        missing = [place for place, completion in enumerate(found) if completion is None]
        fresh = self.complete([calls[place] for place in missing]) if missing else []
        for place, completion in zip(missing, fresh, strict=True):
            found[place] = completion
            self._count(completion)
        self.spent["vlm_cached"] += len(calls) - len(missing)
        return [completion for completion in found if completion is not None]

    def _count(self, completion: Completion) -> None:
        tokens = completion.prompt_tokens, completion.completion_tokens
        self.spent.update(vlm_calls=1, vlm_retries=completion.retries, vlm_tokens=sum(tokens))
        self.spent.update(vlm_input_tokens=tokens[0], vlm_output_tokens=tokens[1])
        usd = self.prices.compute_cost(self.model, *tokens)
        if usd is not None:
            self.spent["vlm_usd"] += usd  # type: ignore[assignment]  # money comes in fractions

    def _keep(self, replies: Sequence[Reply]) -> None:
        """Cache the answers that were used; unusable ones are requested again next time."""
        if self.cache is not None:
            said = [each for reply in replies for each in reply.said if each.used]
            self.cache.put({self._kept_as(each.call): each.completion for each in said})

    def _kept_as(self, name: str) -> str:
        return f"{self.manner} {name}"
