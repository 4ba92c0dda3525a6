# SPDX-License-Identifier: Apache-2.0
"""Counterfactual twins: the same question from the same start, in an apartment where one thing is different.

Who answers both rightly has looked; no prior of homes, and no memory of the apartment, helps with both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wiw._core import core
from wiw.datasets.questions.answers import differ, find_answer
from wiw.datasets.questions.facts import SceneTable, Thing, make_table
from wiw.datasets.questions.generate import Answerable, Backend, EpisodeRules, look_around
from wiw.datasets.questions.survey import choose_places, place_key
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError

PossibleEdits = Callable[[str], Sequence[str]]
"""Returns the edits that the generator can do to a scene, each as it is written behind "?" in a scene's spec."""

KINDS = ("color", "state", "remove", "swap")
TRIES = 3
"""Edits of a question that are generated, each in seconds, before another question is taken."""


@dataclass(frozen=True)
class Edit:
    """One difference between a scene and its copy."""

    text: str
    """As in the copy's spec, such as "state:ceiling+lamp+1=off"."""
    kind: str
    names: tuple[str, ...]
    """Of the instances that it changes."""
    value: str = ""
    """What a colour or state becomes."""

    @classmethod
    def parse(cls, text: str) -> Edit:
        """Return the edit that a part of a scene's spec stands for.

        Raises:
            ArgumentError: it is none.
        """
        kind, colon, rest = text.partition(":")
        plain = rest.replace("+", " ").replace("_", " ").replace("%20", " ")
        name, equals, value = plain.partition("=")
        if kind not in KINDS or not colon or bool(equals) != (kind in ("color", "state")):
            raise ArgumentError(
                f"edit '{text}': expected color:<instance>=<color>, state:<instance>=<state>, remove:<instance> or "
                "swap:<instance>,<instance>"
            )
        names = tuple(each.strip() for each in name.split(",")) if kind == "swap" else (name,)
        return cls(text, kind, names, value)

    def preview(self, table: SceneTable) -> SceneTable | None:
        """Return the table that the edited scene will have, or None where only the scene itself tells it."""
        if self.kind == "swap":
            return None
        things: list[Thing] = []
        for thing in table.things:
            if thing.name not in self.names:
                things.append(thing)
            elif self.kind == "color":
                things.append(replace(thing, color=self.value))
            elif self.kind == "state":
                things.append(replace(thing, state=self.value))
        return replace(table, things=tuple(things))


def find_twin(
    question: Answerable, seed: int, rules: EpisodeRules, backend: Backend, possible_edits: PossibleEdits
) -> Answerable | None:
    """Return the same question from the same start in an edited copy of its scene where the answer differs, if any."""
    place = world(question.scene, backend)
    table = make_table(place.scene, place.name)
    edits = [Edit.parse(text) for text in possible_edits(question.scene)]
    hopeful = list(_hopeful(question, table, edits))
    draws = core.uniform(
        core.fold_key([place_key(seed, question.scene), 0x7F1A, *question.text.encode()]), len(hopeful)
    )
    points = choose_places(place, rules.places, place_key(seed, question.scene))
    for i in np.argsort(draws, kind="stable")[:TRIES]:
        copy = world(f"{question.scene}?{hopeful[i].text}", backend)
        # Points that the edit has made unreachable stay, at an infinite distance, so that the start keeps its index.
        twin = look_around(copy, seed, rules, points).ask(question.template, question.slots, question.start)
        if twin is not None and differ(question.fact, twin.fact, question.answer_type):
            return replace(twin, start_yaw=question.start_yaw, start_position=question.start_position)
    return None


def may_have_twin(question: Answerable, table: SceneTable, edits: Sequence[Edit]) -> bool:
    """Return whether some edit may change the answer of a question; only the edited scene tells for sure."""
    return next(_hopeful(question, table, edits), None) is not None


def _hopeful(question: Answerable, table: SceneTable, edits: Sequence[Edit]) -> Iterator[Edit]:
    """Yield the edits that change the answer, as far as tables tell, without changing the kind of question."""
    names = {thing.name for thing in table.things if thing.id in question.fact.target}
    for edit in edits:
        if not names & set(edit.names):
            continue
        preview = edit.preview(table)
        if preview is None:
            yield edit
            continue
        fact = find_answer(preview, question.template, question.slots)
        if fact is not None and differ(question.fact, fact, question.answer_type):
            yield edit
