# SPDX-License-Identifier: Apache-2.0
"""Counterfactual twins: the same question from the same start, in an apartment where one thing is different.

Who answers both rightly has looked; no prior of homes, and no memory of the apartment, helps with both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wiw import scenes
from wiw._core import core
from wiw.datasets.questions.answers import are_different, find_answer
from wiw.datasets.questions.facts import SceneTable, make_table
from wiw.datasets.questions.generate import Answerable, Backend, EpisodeRules, look_around
from wiw.datasets.questions.survey import choose_places, place_key
from wiw.datasets.worlds import World, world
from wiw.errors import ArgumentError
from wiw.nav import Ground, NavMesh
from wiw.render import Renderer
from wiw.scenes.specs import parse_single

KINDS = ("color", "state", "remove", "swap")
TRIES = 4
"""Edits of a question whose copies are looked at before it has no twin."""


@dataclass(frozen=True)
class Edit:
    """One difference between a scene and its copy."""

    text: str
    """As in the copy's spec, such as "state:ceiling_lamp_1=off"."""
    kind: str
    names: tuple[str, ...]
    """Names of the instances that it changes."""

    @classmethod
    def parse(cls, text: str) -> Edit:
        """Return the edit that a part of a scene's spec stands for.

        Raises:
            ArgumentError: it is none.
        """
        kind, colon, rest = text.partition(":")
        name, equals, _ = rest.replace("+", " ").replace("_", " ").partition("=")
        if kind not in KINDS or not colon or bool(equals) != (kind in ("color", "state")):
            raise ArgumentError(
                f"edit '{text}': expected color:<instance>=<color>, state:<instance>=<state>, remove:<instance> or "
                "swap:<instance>,<instance>"
            )
        return cls(text, kind, tuple(name.split(",")))


def edits_of(scene: str) -> list[Edit]:
    """Return the edits that can be made to a scene; none to one from a file."""
    return [Edit.parse(text) for text in scenes.possible_edits(scene)] if scenes.is_generated(scene) else []


def find_twin(
    question: Answerable, table: SceneTable, edits: Sequence[Edit], seed: int, rules: EpisodeRules, backend: Backend
) -> Answerable | None:
    """Return the same question from the same start in an edited copy of its scene where the answer differs, if any.

    Copies are looked at without their light, which takes seconds to bake, unless the question is about a colour.
    """
    key = place_key(seed, question.scene)
    hopeful = list(_find_changing_edits(question, table, edits))
    draws = core.uniform(core.fold_key([key, 0x7F1A, *question.text.encode()]), len(hopeful))
    points = None
    for i in np.argsort(draws, kind="stable")[:TRIES]:
        spec = f"{question.scene}?{hopeful[i].text}"
        copy = world(spec, backend) if question.fact.colored else open_unlit(spec, backend)
        if points is None:
            points = choose_places(world(question.scene, backend), rules.places, key)
        twin = look_around(copy, seed, rules, points).ask(question.template, question.slots, question.start)
        if twin is not None and are_different(question.fact, twin.fact, question.answer_type):
            return replace(twin, start_position=question.start_position)
    return None


def open_unlit(spec: str, backend: Backend) -> World:
    """Return the world of an apartment without light: all is where it is, and only colours are not to be trusted."""
    scene = outline(spec)
    return World(spec, scene, Renderer(scene, backend=backend), NavMesh.build(scene), Ground(scene), backend)


def outline(spec: str) -> scenes.Scene:
    """Return an apartment's scene without its light."""
    seed, split, edits = parse_single(spec)
    return scenes.apartment_table(seed, split, edits=edits)


def may_have_twin(question: Answerable, table: SceneTable, edits: Sequence[Edit]) -> bool:
    """Return whether some edit changes the answer of a question; where it can be seen from is another matter."""
    return next(_find_changing_edits(question, table, edits), None) is not None


def _find_changing_edits(question: Answerable, table: SceneTable, edits: Sequence[Edit]) -> Iterator[Edit]:
    """Yield the edits of what a question is about that change its answer."""
    names = {thing.name for thing in table.things if thing.id in question.fact.target}
    for edit in edits:
        if not names & set(edit.names) or (edit.kind == "color" and not question.fact.colored):
            continue
        fact = find_answer(make_table(outline(f"{question.scene}?{edit.text}")), question.template, question.slots)
        if fact is not None and are_different(question.fact, fact, question.answer_type):
            yield edit
