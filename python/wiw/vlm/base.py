# SPDX-License-Identifier: Apache-2.0
"""Clients of vision-language models; every one answers through `Client.ask`."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from hashlib import blake2b
from typing import Any

import numpy as np

from wiw.errors import ArgumentError
from wiw.vlm.cache import ReplyCache
from wiw.vlm.conversation import Conversation
from wiw.vlm.messages import Call, Completion, Reply, Request
from wiw.vlm.prices import Prices

FORMAT_VERSION = 1
"""Version of the question format; part of a question's name, so that answers to another wording are not reused."""


class Client(ABC):
    """A model that answers batches of requests.

    Args:
        cache: stores answers, so that no question is paid for twice; None stores nothing.
        prices: US dollars per million tokens; a model that is not in the table has an unknown price.
        top_logprobs: most first tokens that the server lists; as many choices are asked at once, more in rounds. 0 for
            a server that refuses to list any: choices are voted on.
        votes: samples to count where a server returns no log-probabilities.
    """

    concurrency: int = 1
    """Maximum number of requests at a time."""

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
        where the price is known; vlm_uncounted, calls without a count of tokens; where there are prices, vlm_unpriced,
        calls of models without one. The last two are missing where there are none."""

    @property
    @abstractmethod
    def model(self) -> str:
        """The name under which the model is requested."""

    @property
    def manner(self) -> str:
        """Settings that answers depend on beside the model's name and the call; part of the names of cached answers."""
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
            VlmError: see `complete`; nothing is answered then, but completions that arrived are in the cache. An
                unusable answer is not an error: it is in the reply.
        """
        talks = [Conversation(request, self.top_logprobs, self.votes) for request in requests]
        try:
            while waiting := [talk for talk in talks if talk.calls]:
                self._continue(waiting)
        finally:
            self._keep(talks)
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

    def iterate_completions(self, calls: Sequence[Call]) -> Iterator[tuple[int, Completion]]:
        """Yield the place of each call with its completion, in any order.

        Raises:
            VlmError: see `complete`; after all completions that arrived.
        """
        yield from enumerate(self.complete(calls))

    def _continue(self, talks: Sequence[Conversation]) -> None:
        """Complete the calls of conversations and pass them the answers: where some fail, those that arrived."""
        calls = [call for talk in talks for call in talk.calls]
        names = [self.name_of(call) for call in calls]
        found = [None if self.cache is None else self.cache.get(self._make_cache_name(name)) for name in names]
        try:
            self._complete_missing(calls, found)
        finally:
            answers = iter(zip(names, found, strict=True))
            for talk in talks:
                talk.receive([next(answers) for _ in talk.calls])

    def _complete_missing(self, calls: Sequence[Call], found: list[Completion | None]) -> None:
        """Put the completions of calls that have none in their places, and count all."""
        missing = [place for place, completion in enumerate(found) if completion is None]
        self.spent["vlm_cached"] += len(calls) - len(missing)
        if not missing:
            return
        try:
            for place, completion in self.iterate_completions([calls[place] for place in missing]):
                found[missing[place]] = completion
        finally:
            for place in missing:  # in order, so that the sum of dollars is the same every time
                completion_of_place = found[place]
                if completion_of_place is not None:
                    self._count(completion_of_place)

    def _count(self, completion: Completion) -> None:
        tokens = completion.prompt_tokens, completion.completion_tokens
        self.spent.update(vlm_calls=1, vlm_retries=completion.retries, vlm_tokens=sum(tokens))
        self.spent.update(vlm_input_tokens=tokens[0], vlm_output_tokens=tokens[1])
        if not any(tokens):
            self.spent["vlm_uncounted"] += 1
        usd = self.prices.compute_cost(self.model, *tokens)
        if usd is None and self.prices.table:
            self.spent["vlm_unpriced"] += 1
        if usd is not None:
            self.spent["vlm_usd"] += usd  # type: ignore[assignment]  # money comes in fractions

    def _keep(self, talks: Sequence[Conversation]) -> None:
        """Cache the answers of use; unusable ones are requested again next time."""
        if self.cache is not None:
            useful = [answer for talk in talks for answer in talk.list_useful()]
            self.cache.put({self._make_cache_name(name): completion for name, completion in useful})

    def _make_cache_name(self, name: str) -> str:
        return f"{self.manner} {name}"
