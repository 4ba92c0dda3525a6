# SPDX-License-Identifier: Apache-2.0
"""The best guess at an answer from the text alone: what is most often true in train apartments.

It is the score that seeing is measured against, and the answer of an episode that ends without one. The table ships
with the package; `write_table` makes it anew.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from wiw.datasets.questions.generate import DEFAULT_RULES, Answerable, EpisodeRules, questions_of
from wiw.datasets.questions.grammar import parse
from wiw.errors import FileError
from wiw.json_text import parse_json

TABLE = Path(__file__).with_name("blind_answers.json")
SCENES = tuple(f"apartments:train/{i}" for i in range(60))
"""Apartments that the package's table is made from."""
LEAST = 3
"""Questions below which a guess rests on broader ones."""


def blind_answer(text: str) -> str:
    """Return the most frequent answer in train apartments of this text, else of ever broader kinds of question.

    Texts of other languages than the generator's get the most frequent answer of questions that begin like them.
    """
    table = _load_table()
    return next((table[key] for key in _keys(text) if key in table), table[""])


def _keys(text: str) -> Iterator[str]:
    """Yield the names of a question's kinds, from the narrowest to the broadest, which is ""."""
    found = parse(text)
    if found is not None:
        slots = dict(found.slots)
        yield "/".join([found.template, *(f"{name}={slots[name]}" for name in sorted(slots))])
        slots.pop("room", None)
        yield "/".join([found.template, *(f"{name}={slots[name]}" for name in sorted(slots))])
        yield found.template
    words = text.lower().replace("?", " ").split()
    for length in (2, 1):
        yield "begins: " + " ".join(words[:length])
    yield ""


def count_answers(questions: Iterable[Answerable]) -> dict[str, Counter[str]]:
    """Return the answers of every kind of question."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for question in questions:
        for key in dict.fromkeys(_keys(question.text)):
            counts[key][question.fact.answer] += 1
    return counts


def choose_answers(counts: Mapping[str, Counter[str]]) -> dict[str, str]:
    """Return the most frequent answer of every kind of which there were at least `LEAST`; of equals the first."""
    return {
        key: min(answers, key=lambda answer: (-answers[answer], answer))
        for key, answers in sorted(counts.items())
        if answers.total() >= LEAST or not key
    }


def write_table(
    path: str | Path = TABLE, scenes: Iterable[str] = SCENES, seed: int = 0, rules: EpisodeRules = DEFAULT_RULES
) -> dict[str, str]:
    """Write the table of the most frequent answers in some scenes, and return it. Takes seconds a scene."""
    named = list(scenes)
    answers = choose_answers(count_answers(q for scene in named for q in questions_of(scene, seed, rules, "cpu")))
    body = {"format": "wiw-blind-answers", "version": 1, "scenes": named, "seed": seed, "answers": answers}
    Path(path).write_text(json.dumps(body, indent=0, sort_keys=True) + "\n")
    _load_table.cache_clear()
    return answers


@cache
def _load_table() -> dict[str, str]:
    try:
        body: Any = parse_json(TABLE.read_bytes())
    except (OSError, ValueError) as error:
        raise FileError(f"{TABLE}: {error}; install the package again, or call blind.write_table()") from error
    return dict(body["answers"])
