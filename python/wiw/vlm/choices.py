# SPDX-License-Identifier: Apache-2.0
"""Multiple choice: options are labelled with letters, and the probability of the first token is the belief."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from string import ascii_uppercase

import numpy as np
from numpy.typing import NDArray

from wiw.vlm.base import Message

AROUND = " \t\r\n\u2581\u0120\u010a().:*\"'`[]"
"""What tokenizers and models put around a letter; the special ones are sentencepiece's and byte-level BPE's spaces."""
_VOTE = re.compile(
    r"\W*(?:(?:the\s+)?(?:correct\s+)?(?:answer|option)(?:\s+is)?\s*:?\s*)?[(\[*\"'`]*([A-Z])\s*(?:$|[.):,;*\]\n])",
    re.IGNORECASE,
)
"""A letter that stands by itself; "A chair" and "I'm sorry" begin with words."""
_VOTE_LENGTH = 64
"""Characters in which a vote is looked for."""


def labels_of(count: int) -> tuple[str, ...]:
    """The first letters."""
    return tuple(ascii_uppercase[:count])


def asked(messages: Sequence[Message], options: Sequence[str]) -> tuple[Message, ...]:
    """The messages with the options, each behind its letter, at the end of the last one."""
    lines = [f"{label}. {option}" for label, option in zip(labels_of(len(options)), options, strict=True)]
    text = "\n".join(["", "Options:", *lines, "Answer with the letter of one option and nothing else."])
    last = messages[-1]
    return (*messages[:-1], Message(last.role, (*last.content, text)))


def chunks(count: int, most: int) -> list[list[int]]:
    """Indices of options in as few groups of at most `most` as there can be, nearly equal in size."""
    groups = math.ceil(count / most)
    return [part.tolist() for part in np.array_split(np.arange(count), groups)]


def from_logprobs(
    listed: Sequence[tuple[str, float]], labels: Sequence[str]
) -> tuple[NDArray[np.float64], float] | None:
    """Probabilities of the labels and the mass that the model gave them; None where none of them is listed.

    Variants of a label ("A", " A", "(A") are one. A label that is not listed counts as much as it may at most: as the
    least likely token that is listed, or as what all of these leave over.
    """
    listed = [(token, min(value, 0.0)) for token, value in listed if not math.isnan(value)]
    found = [
        [value for token, value in listed if token.strip(AROUND) == label and value > -math.inf] for label in labels
    ]
    if not any(found):
        return None
    left = 1.0 - float(sum(np.exp(value) for _, value in listed))
    least = min(*(value for _, value in listed), float(np.log(max(left, 1e-300))))
    scores = np.array([np.logaddexp.reduce(values) if values else least for values in found], np.float64)
    mass = float(sum(np.exp(score) for score, values in zip(scores, found, strict=True) if values))
    weights = np.exp(np.clip(scores - scores.max(), -745.0, 0.0))
    return weights / weights.sum(), min(mass, 1.0)


def from_votes(texts: Sequence[str], labels: Sequence[str]) -> tuple[NDArray[np.float64], float] | None:
    """Shares of the samples that begin with each label, and the share that begins with any; None where none does."""
    votes = [vote for vote in (vote_of(text, labels) for text in texts) if vote is not None]
    if not votes:
        return None
    return np.bincount(votes, minlength=len(labels)) / len(votes), len(votes) / len(texts)


def vote_of(text: str, labels: Sequence[str]) -> int | None:
    """The label that a written answer begins with, e.g. "B", "(b) chair", "The answer is B."; None for other text."""
    match = _VOTE.match(text[:_VOTE_LENGTH])
    letter = match.group(1).upper() if match else ""
    return labels.index(letter) if letter in labels else None


def united(
    groups: Sequence[Sequence[int]],
    first: Sequence[NDArray[np.float64]],
    finalists: Sequence[int],
    final: NDArray[np.float64],
) -> NDArray[np.float64]:
    """One distribution over all options from groups that were asked apart and from a final among their best.

    A finalist weighs what the final gives it; the others of a group keep their odds against its finalists.
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
