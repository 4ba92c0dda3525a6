# SPDX-License-Identifier: Apache-2.0
"""The rules' ontology: objects, rooms, colours, materials and states, how they are called and how they are related."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any, Literal

import yaml

from wiw.errors import FileError
from wiw.judging.words import split_words
from wiw.mapping_files import parse_yaml

FILE = Path(__file__).parent / "vocabulary.yaml"
Kind = Literal["object", "room", "color", "material", "state"]
KINDS: tuple[Kind, ...] = ("object", "room", "color", "material", "state")
SHADES = ("light", "dark", "pale", "bright", "deep", "pastel", "muted", "faded")
"""Words that make a shade of the colour that they stand before."""


class Relation(IntEnum):
    """How closely two concepts are related; higher is closer."""

    NONE = 0
    GROUP = 1
    """They belong to one group."""
    NEAR = 2
    """They are adjacent hues, shades of one colour, or a state and one in between."""
    BROADER = 3
    """One is a kind of the other."""
    SAME = 4


@dataclass(frozen=True)
class Concept:
    """The meaning of a word; `shade` is the word that qualifies a colour."""

    kind: Kind
    name: str
    shade: str = ""


@dataclass(frozen=True)
class Match:
    """A concept found in words [start, end)."""

    concept: Concept
    start: int
    end: int


class Vocabulary:
    """Concepts by name, and their relations.

    Args:
        file: YAML with `kind: {concept: {also, is_a, near, group}}`.

    Raises:
        FileError: it cannot be read, names an unknown concept, or gives one name to two concepts of a kind.
    """

    def __init__(self, file: Path = FILE) -> None:
        try:
            source = file.read_bytes()
            entries: dict[Kind, dict[str, dict[str, Any]]] = parse_yaml(source.decode("utf-8"))
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise FileError(f"{file}: expected a vocabulary in YAML: {error}") from error
        self.digest = blake2b(source, digest_size=8).hexdigest()
        missing = [kind for kind in KINDS if not isinstance(entries, dict) or not isinstance(entries.get(kind), dict)]
        if missing:
            raise FileError(f"{file}: expected concepts of the kinds {', '.join(KINDS)}; {', '.join(missing)} missing")
        self._entries = entries
        self._names: dict[Kind, dict[tuple[str, ...], str]] = {kind: {} for kind in KINDS}
        for kind in KINDS:
            for name, entry in entries[kind].items():
                self._check_links(file, kind, name, entry)
                for alias in (name, *entry.get("also", ())):
                    self._add_name(file, kind, name, tuple(split_words(alias)))
        self._longest = max(len(words) for names in self._names.values() for words in names)

    def names(self, kind: Kind) -> tuple[str, ...]:
        """Return the names of all concepts of a kind."""
        return tuple(self._entries[kind])

    def find(self, words: Sequence[str], kinds: Sequence[Kind]) -> list[Match]:
        """Return the concepts that words mention, in order; the longest name at a place, then the first kind, wins."""
        found: list[Match] = []
        start = 0
        while start < len(words):
            match = self._match_at(words, start, kinds)
            if match is None:
                start += 1
            else:
                found.append(match)
                start = match.end
        return found

    def find_relation(self, one: Concept, other: Concept) -> Relation:
        """Return how closely two concepts are related."""
        if one.kind != other.kind:
            return Relation.NONE
        if one.name == other.name:
            return self._relate_shades(one.shade, other.shade)
        above, beyond = self._ancestors(one.kind, one.name), self._ancestors(one.kind, other.name)
        if one.name in beyond or other.name in above:
            return Relation.BROADER
        if self._are_near(one, other, above, beyond):
            return Relation.NEAR
        groups = [self._entries[one.kind][each.name].get("group") for each in (one, other)]
        return Relation.GROUP if groups[0] is not None and groups[0] == groups[1] else Relation.NONE

    @staticmethod
    def _relate_shades(one: str, other: str) -> Relation:
        if one == other:
            return Relation.SAME
        return Relation.NEAR if one and other else Relation.BROADER

    def _are_near(self, one: Concept, other: Concept, above: frozenset[str], beyond: frozenset[str]) -> bool:
        entries = self._entries[one.kind]
        if one.kind == "color" and above & beyond:
            return True
        return any(
            b in entries[a].get("near", ()) or a in entries[b].get("near", ())
            for a in (one.name, *above)
            for b in (other.name, *beyond)
        )

    def _ancestors(self, kind: Kind, name: str) -> frozenset[str]:
        parents = self._entries[kind][name].get("is_a", ())
        return frozenset(parents).union(*(self._ancestors(kind, parent) for parent in parents))

    def _match_at(self, words: Sequence[str], start: int, kinds: Sequence[Kind]) -> Match | None:
        shade = words[start] if "color" in kinds and words[start] in SHADES else ""
        if shade and start + 1 < len(words):
            match = self._match_at(words, start + 1, ["color"])
            return None if match is None else Match(Concept("color", match.concept.name, shade), start, match.end)
        for length in range(min(self._longest, len(words) - start), 0, -1):
            piece = tuple(words[start : start + length])
            for kind in kinds:
                name = self._names[kind].get(piece)
                if name is not None:
                    return Match(Concept(kind, name), start, start + length)
        return self._match_approximate_color(words, start) if "color" in kinds else None

    def _match_approximate_color(self, words: Sequence[str], start: int) -> Match | None:
        """Return the colour of a word such as "bluish" or "greyish"."""
        word = words[start]
        if not word.endswith("ish"):
            return None
        stem = word[:-3]
        for guess in (stem, stem + "e", stem[:-1]):  # greenish, bluish, reddish
            name = self._names["color"].get((guess,))
            if name is not None:
                return Match(Concept("color", name, "ish"), start, start + 1)
        return None

    def _add_name(self, file: Path, kind: Kind, name: str, words: tuple[str, ...]) -> None:
        known = self._names[kind].setdefault(words, name)
        if known != name:
            raise FileError(f"{file}: {kind} '{' '.join(words)}' names both '{known}' and '{name}'; keep one")

    def _check_links(self, file: Path, kind: Kind, name: str, entry: dict[str, Any]) -> None:
        for link in (*entry.get("is_a", ()), *entry.get("near", ())):
            if link not in self._entries[kind]:
                raise FileError(f"{file}: {kind} '{name}' refers to '{link}', which is no {kind} there")


@cache
def load_vocabulary() -> Vocabulary:
    """Return the shipped vocabulary."""
    return Vocabulary()
