# SPDX-License-Identifier: Apache-2.0
"""Multiple choice: options are labelled with letters, and the probabilities of the first token are the answer."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from string import ascii_uppercase

import numpy as np
from numpy.typing import NDArray

from wiw.vlm.messages import Message

LABELS = ascii_uppercase + "ΓΔΘΛΞΠΣΦΨΩ"
"""Letters of options: the Latin capitals, then those Greek ones that look like none of them."""
LETTER_CONTEXT = " \t\r\n\u2581\u0120\u010a().:*\"'`[]"
"""Characters that tokenizers and models put around a letter; the special ones are the spaces of sentencepiece and
byte-level BPE.
"""
_VOTE = re.compile(
    r"\W*(?:(?:the\s+)?(?:correct\s+)?(?:answer|option)(?:\s+is)?[\s:*_]*)?[(\[*\"'`]*([A-ZΓΔΘΛΞΠΣΦΨΩ])\s*(?:$|[.):,;*\]\n])",
    re.IGNORECASE,
)
"""Matches a letter that stands by itself; "A chair" and "I'm sorry" begin with words."""
LEAST_MASS = 0.01
"""Probability of all letters together below which they are noise."""
_VOTE_LENGTH = 64
"""Characters searched for a vote."""


def get_labels(count: int) -> tuple[str, ...]:
    """Return the first letters."""
    return tuple(LABELS[:count])


def append_options(messages: Sequence[Message], options: Sequence[str]) -> tuple[Message, ...]:
    """Append the options, each after its letter, to the last message."""
    lines = [f"{label}. {option}" for label, option in zip(get_labels(len(options)), options, strict=True)]
    text = "\n".join(["", "Options:", *lines, "Answer with the letter of one option and nothing else."])
    last = messages[-1]
    return (*messages[:-1], Message(last.role, (*last.content, text)))


def split_options(count: int, most: int) -> list[list[int]]:
    """Split the indices of options into as few groups of at most `most` as possible, nearly equal in size."""
    groups = math.ceil(count / most)
    return [part.tolist() for part in np.array_split(np.arange(count), groups)]


def read_logprobs(
    listed: Sequence[tuple[str, float]], labels: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the labels' probabilities, which sum to 1, and those that the model gave them; None if none is listed, or
    all of them together have less than `LEAST_MASS`: the model is about to say something else.

    Variants of a label ("A", " A", "(A") are one. Of the former, a label that is not listed gets the most that it can
    have: as much as the least likely listed token, or the remaining probability; of the latter, nothing.
    """
    listed = [(token, min(value, 0.0)) for token, value in listed if not math.isnan(value)]
    found = [
        [value for token, value in listed if token.strip(LETTER_CONTEXT) == label and value > -math.inf]
        for label in labels
    ]
    if sum(math.exp(value) for values in found for value in values) < LEAST_MASS:
        return None
    left = 1.0 - float(sum(np.exp(value) for _, value in listed))
    least = min(*(value for _, value in listed), float(np.log(max(left, 1e-300))))
    scores = np.array([np.logaddexp.reduce(values) if values else least for values in found], np.float64)
    raw = np.where([bool(values) for values in found], np.exp(np.maximum(scores, -745.0)), 0.0)
    weights = np.exp(np.clip(scores - scores.max(), -745.0, 0.0))
    return weights / weights.sum(), raw / max(raw.sum(), 1.0)


def count_votes(texts: Sequence[str], labels: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return each label's share of the votes, and of all samples; None if no sample begins with a label."""
    votes = [vote for vote in (parse_vote(text, labels) for text in texts) if vote is not None]
    if not votes:
        return None
    counts = np.bincount(votes, minlength=len(labels))
    return counts / len(votes), counts / len(texts)


def parse_vote(text: str, labels: Sequence[str]) -> int | None:
    """Return the label that a written answer begins with, e.g. "B", "(b) chair", "**Answer:** B"; None for other
    text.
    """
    match = _VOTE.match(text[:_VOTE_LENGTH])
    letter = match.group(1).upper() if match else ""
    return labels.index(letter) if letter in labels else None


def combine_groups(
    groups: Sequence[Sequence[int]],
    first: Sequence[NDArray[np.float64]],
    finalists: Sequence[int],
    final: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Combine groups that were asked separately, and a final among their best, into one distribution over all options.

    A finalist has the weight of the final; the others of a group keep their odds relative to its finalists.
    """
    weights = np.zeros(sum(map(len, groups)))
    weights[list(finalists)] = final
    for group, own in zip(groups, first, strict=True):
        inside = np.isin(group, finalists)
        scale = weights[list(group)].sum() / max(own[inside].sum(), 1e-300)
        for option, share, is_finalist in zip(group, own, inside, strict=True):
            if not is_finalist:
                weights[option] = share * scale
    return weights / weights.sum()
