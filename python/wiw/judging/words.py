# SPDX-License-Identifier: Apache-2.0
"""English answers as plain words: Unicode, case, contractions, articles, number words and plurals."""

from __future__ import annotations

import re
import unicodedata

ARTICLES = frozenset({"a", "an", "the"})
_UNITS = (
    "zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve",
    "thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen",
)  # fmt: skip
_TENS = {"twenty": 20, "thirty": 30, "forty": 40, "fifty": 50, "sixty": 60, "seventy": 70, "eighty": 80, "ninety": 90}
NUMBERS = {word: value for value, word in enumerate(_UNITS)} | _TENS | {"dozen": 12}
_MULTIPLES = {"dozen": 12, "hundred": 100, "thousand": 1000}
"""Words that multiply a number, or "a", before them."""
IRREGULAR_PLURALS = {
    "children": "child", "people": "person", "men": "man", "women": "woman", "feet": "foot", "teeth": "tooth",
    "mice": "mouse", "geese": "goose", "knives": "knife", "shelves": "shelf", "bookshelves": "bookshelf",
    "leaves": "leaf", "loaves": "loaf", "halves": "half", "wives": "wife", "wolves": "wolf", "scarves": "scarf",
    "shoes": "shoe", "toes": "toe", "buses": "bus", "gases": "gas", "canvases": "canvas", "lenses": "lens",
}  # fmt: skip
_NO_PLURALS = frozenset({
    "always", "across", "perhaps", "upstairs", "downstairs", "stairs", "canvas", "gas", "yes", "this", "his", "its",
    "was", "has", "does", "us", "as", "vs", "lens", "news", "series", "atlas", "chaos", "bias", "sometimes",
    "towards", "besides", "afterwards", "whereas",
})  # fmt: skip
_CONTRACTIONS = (
    (r"\bcan't\b", "can not"),
    (r"\bcannot\b", "can not"),
    (r"\bwon't\b", "will not"),
    (r"n't\b", " not"),
    (r"\b(it|that|there|here|what|where|he|she|who)'s\b", r"\1 is"),
    (r"'re\b", " are"),
    (r"'m\b", " am"),
    (r"'s\b", ""),
    (r"s'(?=\W|$)", "s"),
)
_WORD = re.compile(r"\d+(?:\.\d+)?|[^\W\d_]+")
_THOUSANDS = re.compile(r"(?<=\d),(?=\d{3}(?!\d))")
_LAST_PERIOD = re.compile(r"\.(?!\d)")


def cut_after_last_period(text: str) -> str:
    """Return a text without what follows its last period, as OpenEQA does: "a. b" becomes "a.".

    The point of a number such as 2.5 is not a period.
    """
    periods = list(_LAST_PERIOD.finditer(text))
    return text[: periods[-1].end()] if periods else text


def unify_characters(text: str) -> str:
    """Return a text in lower case and compatible Unicode (NFKC), with plain apostrophes and contractions resolved."""
    text = unicodedata.normalize("NFKC", text).casefold().replace("\u2019", "'").replace("\u2018", "'")
    for pattern, instead in _CONTRACTIONS:
        text = re.sub(pattern, instead, text)
    return _THOUSANDS.sub("", text)


def split_raw_words(text: str) -> list[str]:
    """Return the words and numbers of a text in lower case, articles and plurals as they are."""
    return _WORD.findall(unify_characters(text))


def split_words(text: str) -> list[str]:
    """Return the words of a text in singular, without articles, numbers as digits."""
    return [make_singular(word) for word in merge_numbers(split_raw_words(text)) if word not in ARTICLES]


def split_clauses(text: str) -> list[list[str]]:
    """Return the words of each clause of a text; punctuation and "but" separate clauses."""
    parts = re.split(r"[,;:!?()]|\.(?!\d)|\bbut\b", unify_characters(text))
    return [words for words in map(split_words, parts) if words]


def merge_numbers(words: list[str]) -> list[str]:
    """Return words with number words as digits: "twenty", "one" becomes "21", and "two", "dozen" becomes "24"."""
    merged: list[str] = []
    tens = 0
    for word in words:
        value = NUMBERS.get(word)
        if word in _MULTIPLES and merged and (merged[-1].isdecimal() or merged[-1] == "a"):
            merged[-1] = str(_MULTIPLES[word] * (1 if merged[-1] == "a" else int(merged[-1])))
        elif tens and value is not None and 0 < value < 10:
            merged[-1] = str(tens + value)
        else:
            merged.append(word if value is None else str(value))
        tens = _TENS.get(word, 0)
    return merged


def make_singular(word: str) -> str:
    """Return the singular of a noun; words that are not plural stay as they are."""
    if word in IRREGULAR_PLURALS:
        return IRREGULAR_PLURALS[word]
    if len(word) < 4 or word in _NO_PLURALS or not word.endswith("s") or word.endswith(("ss", "us", "is")):
        return word
    if word.endswith("ies") and len(word) > 4:
        return word[:-3] + "y"
    if word.endswith(("ches", "shes", "xes", "sses", "zes", "oes")):
        return word[:-2]
    return word[:-1]
