# SPDX-License-Identifier: Apache-2.0
"""The course of one request: what to ask next, until the answer is usable or the tries are used up."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.vlm import choices, structured
from wiw.vlm.messages import Call, Completion, CompletionRecord, Problem, Reply, Request

RETRY_TEMPERATURE = 0.7
"""Minimum temperature of a repeated question: at 0 the answer would be the same."""
VOTE_TOKENS = 8
Talk = Generator[list[Call], list[Completion], Reply]


class Conversation:
    """One request in progress; the client completes `calls` and passes them to `receive`, until there are none."""

    def __init__(self, request: Request, top_logprobs: int, votes: int) -> None:
        self._talk = _ask_for_choice(request, top_logprobs, votes) if request.choices else _ask_for_text(request)
        self._is_choice = bool(request.choices)
        self._said: list[tuple[str, Completion]] = []
        self.calls: list[Call] = next(self._talk)
        self.reply = Reply()

    def receive(self, answers: Sequence[tuple[str, Completion | None]]) -> None:
        """Take (name, completion) for each of the calls; where one failed (None), the conversation does not go on."""
        arrived = [(name, completion) for name, completion in answers if completion is not None]
        self._said += arrived
        if len(arrived) < len(answers):
            return
        try:
            self.calls = self._talk.send([completion for _, completion in arrived])
        except StopIteration as end:
            reply: Reply = end.value
            latest = len(self._said) - len(answers)
            records = tuple(
                CompletionRecord(name, completion, reply.problem is None and (bool(reply.by) or place >= latest))
                for place, (name, completion) in enumerate(self._said)
            )
            self.calls, self.reply = [], replace(reply, completions=records)

    def list_useful(self) -> list[tuple[str, Completion]]:
        """Return (name, completion) of the answers that were used; of a choice that did not end, the usable ones."""
        if not self.calls:
            return [(each.call, each.completion) for each in self.reply.completions if each.used]
        return [each for each in self._said if self._is_choice and structured.find_problem(each[1]) is None]


def _ask_for_text(request: Request) -> Talk:
    """Ask for free text, or JSON."""
    found: Reply | None = None
    for attempt in range(request.tries):
        (completion,) = yield [_make_call(request, attempt)]
        found = _read_reply(request, completion)
        if found.problem is None:
            return found
    assert found is not None
    return found


def _read_reply(request: Request, completion: Completion) -> Reply:
    if request.schema is None:
        answer = _remove_thoughts(completion)
        return Reply(answer.text, problem=structured.find_problem(answer))
    outcome = structured.parse_object(completion, request.schema)
    if isinstance(outcome, Problem):
        return Reply(completion.text, problem=outcome)
    return Reply(completion.text, outcome.value, repaired=outcome.repaired, adapted=outcome.adapted)


def _make_call(request: Request, attempt: int) -> Call:
    temperature = request.temperature if attempt == 0 else max(request.temperature, RETRY_TEMPERATURE)
    schema = None if request.schema is None else request.schema.model_json_schema()
    seed = request.seed if request.exact_seed and attempt == 0 else _derive_seed(request.seed, attempt)
    return Call(request.messages, temperature, seed, request.max_tokens, schema=schema)


def _derive_seed(seed: int, attempt: int) -> int:
    """Derive a seed of at most 31 bits, so that every server accepts it."""
    return int.from_bytes(blake2b(f"{seed} {attempt}".encode(), digest_size=4).digest(), "little") >> 1


def _ask_for_choice(request: Request, listed: int, votes: int) -> Talk:
    """Ask a multiple-choice question; the text is the last round's; "votes" if any round used them."""
    found = yield from _ask_in_rounds(request, range(len(request.choices)), listed, votes)
    if isinstance(found, Reply):
        return found
    probabilities, rounds = found
    by = "votes" if any(reply.by == "votes" for reply in rounds) else "logprobs"
    raw = rounds[0].raw if len(rounds) == 1 else probabilities * rounds[-1].mass
    return Reply(rounds[-1].text, probabilities=probabilities, raw=raw, by=by)


def _ask_in_rounds(
    request: Request, options: Sequence[int], listed: int, votes: int
) -> Generator[list[Call], list[Completion], tuple[NDArray[np.float64], list[Any]] | Reply]:
    """Return the probabilities of some of the choices, and all replies on the way; or an unusable reply.

    More choices than there are labels, or with `rounds` than a server lists tokens, are asked about in groups, and the
    best of each group in a final.
    """
    most = listed if listed and request.rounds else len(choices.LABELS)
    groups = choices.split_options(len(options), most)
    first = yield from _ask_groups(request, [[options[i] for i in group] for group in groups], listed, votes)
    if isinstance(first, Reply):
        return first
    if len(groups) == 1:
        return first[0].probabilities, first
    best = [np.argsort(-reply.probabilities, kind="stable")[: max(1, most // len(groups))] for reply in first]
    finalists = sorted(group[i] for group, order in zip(groups, best, strict=True) for i in order)
    final = yield from _ask_in_rounds(request, [options[i] for i in finalists], listed, votes)
    if isinstance(final, Reply):
        return final
    together = choices.combine_groups(groups, [reply.probabilities for reply in first], finalists, final[0])
    return together, [*first, *final[1]]


def _ask_groups(
    request: Request, groups: Sequence[Sequence[int]], listed: int, votes: int
) -> Generator[list[Call], list[Completion], list[Any] | Reply]:
    """Return the model's choice in each group of options, or the unusable reply of the first group that has one."""
    options = [[request.choices[i] for i in group] for group in groups]
    messages = [choices.append_options(request.messages, names) for names in options]
    labels = [choices.get_labels(len(names)) for names in options]
    seed = _derive_seed(request.seed, 0)
    calls = [Call(said, 0.0, seed, 1, own, listed) for said, own in zip(messages, labels, strict=True)]
    found: list[Any] = [None for _ in calls]
    if listed:
        completions = yield calls
        found = [
            _make_reply(choices.read_logprobs(_list_logprobs(completion), own), completion, "logprobs")
            for completion, own in zip(completions, labels, strict=True)
        ]
    open_ = [place for place, reply in enumerate(found) if reply is None]
    samples = [
        replace(
            calls[place], temperature=1.0, seed=_derive_seed(request.seed, 1 + vote), max_tokens=VOTE_TOKENS, logprobs=0
        )
        for place in open_
        for vote in range(votes)
    ]
    said = iter((yield samples) if samples else [])
    for place in open_:
        texts = [next(said) for _ in range(votes)]
        counted = choices.count_votes([_read_vote(each) for each in texts], labels[place])
        found[place] = _make_reply(counted, texts[0], "votes")
        if found[place] is None:
            refused = structured.find_problem(texts[0])
            detail = f"none of {votes} answers begins with one of the {len(labels[place])} letters"
            return Reply(texts[0].text, problem=refused or structured.make_problem("no_option", detail, texts[0]))
    return found


def _list_logprobs(completion: Completion) -> tuple[tuple[str, float], ...]:
    """Return the listed tokens: none for an answer that was withheld."""
    return () if completion.finish in structured.REFUSED else completion.logprobs or ()


def _read_vote(completion: Completion) -> str:
    """Return the text that counts as a vote."""
    answer = _remove_thoughts(completion)
    return "" if structured.find_problem(answer) else answer.text


def _remove_thoughts(completion: Completion) -> Completion:
    """Return a completion without what a model thinks aloud before its answer; unchanged where it does not."""
    return replace(completion, text=structured.strip_thoughts(completion.text))


def _make_reply(
    outcome: tuple[NDArray[np.float64], NDArray[np.float64]] | None, completion: Completion, by: str
) -> Reply | None:
    if outcome is None:
        return None
    probabilities, raw = outcome
    return Reply(completion.text, probabilities=probabilities, raw=raw, by=by)
