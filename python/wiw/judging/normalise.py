# SPDX-License-Identifier: Apache-2.0
"""Answers in a normal form, and what they say: concepts, yes or no, counts."""

from __future__ import annotations

from collections.abc import Sequence

from wiw.judging.vocabulary import KINDS, Concept, Kind, Match, load_vocabulary
from wiw.judging.words import (
    ARTICLES,
    cut_after_last_period,
    merge_numbers,
    split_clauses,
    split_raw_words,
    split_words,
)

__all__ = [
    "affirms_words",
    "cut_after_last_period",
    "find_concepts",
    "find_negated",
    "find_states",
    "has_negation",
    "normalise",
    "read_counts",
    "read_polarity",
]

NEGATIONS = frozenset(
    {"no", "not", "never", "none", "nothing", "nobody", "neither", "nor", "without", "nope", "nowhere"}
)
_REPLACED = frozenset({"instead", "rather"})
"""Words before "of" or "than" and what is not the case."""
_YES = frozenset({"yes", "yeah", "yep", "yup", "true", "correct", "affirmative", "indeed", "certainly", "definitely"})
_EMPHATIC = frozenset({"indeed", "certainly", "definitely"})
"""Words of `_YES` that "not" turns round right behind them; "yes, not far from the sofa" remains a yes."""
_NO = frozenset({"no", "nope", "nah", "false", "incorrect", "negative"})
_UNSURE = frozenset({"maybe", "perhaps", "possibly", "unsure", "unknown", "uncertain", "unclear"})
_FORMS_OF_BE = frozenset({"is", "are", "was", "were", "be", "am"})
_PLACEHOLDERS = frozenset({"it", "there", "they", "that", "this", "i", "think", "so", "do", "does", "here", "yes"})
_PREPOSITIONS = frozenset({
    "on", "in", "at", "near", "next", "beside", "by", "under", "above", "below", "behind", "between", "of", "with",
    "inside", "against", "over", "opposite", "from", "to", "across", "along", "around",
})  # fmt: skip
_COPULAS = _FORMS_OF_BE | {"look", "appear", "seem", "called"}
_NOTICED = frozenset({"see", "seen", "find", "found", "have", "has", "had", "can", "could", "did", "any"})
"""Words of an answer to "is there ...?" that say no more than "there is"."""
_DOUBTS = frozenset({"if", "whether", "might", "may", "know", "tell", "sure", "certain"})
"""Words before a statement that leave open whether it holds."""
_CONTINUING = frozenset({
    "and", "or", "there", "here", "that", "which", "too", "also", "as", "visible", "present", "anywhere", "somewhere",
})  # fmt: skip
"""Words that go on behind a thing, so that they are no part of its name as in "piano stool"."""
_VERBS = _FORMS_OF_BE | _NOTICED - {"any"} | {"do", "does", "think"}
"""Words of which a statement has one; "it" alone affirms nothing."""
_OPPOSITES = (("open", "closed"), ("on", "off"), ("made", "unmade"))
OPPOSITE_STATES = {one: other for pair in _OPPOSITES for one, other in (pair, pair[::-1])}
_UNCOUNTED = frozenset({"know", "tell", "sure", "certain", "idea", "count", "say", "many", "much"})
"""Words behind "not" or "no" (and one more word) that make it no zero: "I do not know", "no idea", "not many"."""
_AMOUNTS = frozenset({"few", "lot", "number", "bunch", "handful", "several", "some", "lots"})
"""Words behind an article that is no number: "a few chairs", "a small number"."""
_PAIRS = frozenset({"couple", "pair", "both"})
_LEADS = (["there", "is"], ["i", "see"], ["i", "found"])
"""Words before the article of a single thing: "there is a chair"."""


def normalise(text: str) -> str:
    """Return an answer in a normal form: NFKC, lower case, singular, no articles, digits, one name for each concept."""
    words = split_words(text)
    parts: list[str] = []
    end = 0
    for match in load_vocabulary().find(words, KINDS):
        parts += words[end : match.start]
        parts += [match.concept.shade, match.concept.name] if match.concept.shade else [match.concept.name]
        end = match.end
    return " ".join([*parts, *words[end:]])


def has_negation(text: str) -> bool:
    """Return whether an odd number of words negate a text."""
    return sum(word in NEGATIONS for word in split_words(text)) % 2 == 1


def find_concepts(text: str, kinds: Sequence[Kind], head: bool = True) -> list[Concept]:
    """Return the different concepts that a text affirms, in order; "not a sofa but a chair" affirms the chair.

    Args:
        text: an answer.
        kinds: of concepts to look for.
        head: look first at what follows "is" and precedes a preposition, and at the rest only where nothing is found:
            "the thing on the table is a vase by the wall" affirms the vase.
    """
    found: dict[Concept, None] = {}
    for clause in split_clauses(text):
        for words in _narrow_down(clause) if head else [clause]:
            matches = [match for match in load_vocabulary().find(words, kinds) if not is_negated(words, match)]
            if matches:
                found |= dict.fromkeys(match.concept for match in matches)
                break
    return list(found)


def find_negated(text: str, kinds: Sequence[Kind]) -> list[Concept]:
    """Return the different concepts that a text denies, in order."""
    found = [
        match.concept
        for clause in split_clauses(text)
        for match in load_vocabulary().find(clause, kinds)
        if is_negated(clause, match)
    ]
    return list(dict.fromkeys(found))


def affirms_words(text: str, words: str) -> bool:
    """Return whether a text says some words, of which no concept need be known, and does not deny them before."""
    wanted = f" {normalise(words)} "
    for part in [*map(" ".join, split_clauses(text)), text]:
        before, found, _ = f" {normalise(part)} ".partition(wanted)
        if found:
            return not (NEGATIONS | _REPLACED) & set(before.split())
    return False


def find_states(text: str) -> list[Concept]:
    """Return the states that a text affirms, in order, else the opposites of those it denies: "not open" is closed."""
    affirmed = find_concepts(text, ["state"])
    if affirmed:
        return affirmed
    denied = [OPPOSITE_STATES.get(concept.name) for concept in find_negated(text, ["state"])]
    return [Concept("state", name) for name in denied if name is not None]


def is_negated(words: Sequence[str], match: Match) -> bool:
    """Return whether a word before a match negates it."""
    return any(word in NEGATIONS or word in _REPLACED for word in words[: match.start])


def _narrow_down(clause: list[str]) -> list[list[str]]:
    """Return the parts of a clause that may name what is requested, most specific first; each keeps its negation."""
    verbs = [place for place, word in enumerate(clause) if word in _COPULAS]
    rest = clause[verbs[-1] + 1 :] if verbs else clause
    if any(word in NEGATIONS for word in clause) and not any(word in NEGATIONS for word in rest):
        rest = ["not", *rest]
    stop = next((place for place, word in enumerate(rest) if word in _PREPOSITIONS), len(rest))
    return [rest[:stop], rest, clause]


def read_counts(text: str) -> list[int]:
    """Return the numbers that an answer states; "none" is 0, and "a chair" is 1 where no number stands."""
    raw = split_raw_words(text)
    words = merge_numbers(raw)
    values = [float(word) for word in words if word[0].isdigit()]
    counts = [int(value) for value in values if value == int(value)]
    if values:
        return list(dict.fromkeys(counts))
    if any(word in _PAIRS for word in words):
        return [2]
    negations = [place for place, word in enumerate(words) if word in NEGATIONS]
    if negations:
        doubts = [_UNCOUNTED & set(words[place + 1 : place + 3]) for place in negations if words[place] != "none"]
        return [] if any(doubts) else [0]
    named = raw[2:] if raw[:2] in _LEADS else raw
    if _AMOUNTS & set(named[1:3]):
        return []
    return [1] if (len(named) > 1 and named[0] in ARTICLES - {"the"}) or {"single", "once"} & set(words) else []


def read_polarity(text: str, question: str = "") -> bool | None:
    """Return whether an answer says yes; None if it says neither, or both.

    Args:
        text: such as "yes", "No, there are no chairs", or with a question "it is shut".
        question: a yes-no question, which tells what a statement without yes or no says about it.
    """
    words = split_words(text)
    explicit = [word for word in words if word in _YES or word in _NO]
    if not words or _UNSURE & set(words) or _says_yes_and_no(words):
        return None
    if words[0] in _YES | _NO:
        negated = words[1:2] == ["not"] and words[0] in _EMPHATIC  # "certainly not"
        return words[0] in _YES and not negated
    negated = has_negation(text) != any(word in ("false", "incorrect") for word in words)
    if explicit or (negated and not question):
        return not negated
    return _compare_statement(text, question, negated)


def _says_yes_and_no(words: Sequence[str]) -> bool:
    """Return whether an answer begins with yes and no."""
    first = [word for word in words[:3] if word not in ("and", "or")][:2]
    return (
        len(first) == 2
        and first[0] in _YES | _NO
        and first[1] in _YES | _NO
        and (first[0] in _YES) != (first[1] in _YES)
    )


def _compare_statement(text: str, question: str, negated: bool) -> bool | None:
    """Return whether a statement agrees with a question; None if they are about different things."""
    vocabulary = load_vocabulary()
    asked, said = split_words(question), split_words(text)
    wanted = [match.concept.name for match in vocabulary.find(asked, ["state"])][-1:]
    stated = [concept.name for concept in find_states(text)][-1:]  # its negation is a state too: "not lit" is off
    if wanted and stated and stated[0] in (wanted[0], OPPOSITE_STATES.get(wanted[0])):
        return wanted == stated
    colors = [{m.concept for m in vocabulary.find(words, ["color"])} for words in (asked, said)]
    if all(colors) and not negated:
        return colors[0] == colors[1]
    says = _read_presence(text, question)
    return says if says is not None else _compare_content(normalise(text).split(), normalise(question).split(), negated)


def _read_presence(text: str, question: str) -> bool | None:
    """Return whether a statement says that there is what "is there ...?" asks for; None if it does not say, or both."""
    thing = _find_asked_thing(normalise(question).split())
    rooms = set(find_concepts(question, ["room"], head=False))
    found = {
        _says_presence(normalise(" ".join(clause)).split(), thing)
        for clause in (split_clauses(text) if thing else [])
        if not (named := set(find_concepts(" ".join(clause), ["room"], head=False))) or not rooms or named & rooms
    } - {None}
    return found.pop() if len(found) == 1 else None


def _find_asked_thing(asked: Sequence[str]) -> Sequence[str]:
    """Return the words for what "is there ...?" asks for; none of another question."""
    if asked[1:2] != ["there"] or asked[0] not in _FORMS_OF_BE:
        return []
    return asked[2 : next((place for place, word in enumerate(asked) if word in _PREPOSITIONS), len(asked))]


def _says_presence(words: Sequence[str], thing: Sequence[str]) -> bool | None:
    """Return whether a clause says that there is a thing, as "there is a black piano by the wall" does of a piano.

    "A picture of a piano", "a piano stool" and "I am not sure that there is a piano" say neither.
    """
    place = next((at for at in range(len(words)) if words[at : at + len(thing)] == thing), None)
    if place is None or not _VERBS & set(words):
        return None
    before, after = words[:place], words[place + len(thing) :]
    if _DOUBTS & set(before) or before[-1:] in (["of"], ["for"]) or NEGATIONS & set(after):
        return None
    if after and after[0] not in _PREPOSITIONS | _VERBS | _CONTINUING:
        return None
    return not (NEGATIONS | {"0"}) & set(before)


def _compare_content(said: Sequence[str], asked: Sequence[str], negated: bool) -> bool | None:
    """Return whether a statement in a question's own words, or in pronouns, affirms it; None if it has other words.

    Where a question begins with "is there", "I see two" says so of what it asks for.
    """
    content = set(said) - NEGATIONS - _FORMS_OF_BE - _PLACEHOLDERS
    if thing := _find_asked_thing(asked):
        content -= _NOTICED | {word for word in content if word.isdecimal() and word != "0"}
        if content and not content & set(thing):
            return None
    if not content <= set(asked) or not (negated or _VERBS & set(said)):
        return None
    return not negated
