# SPDX-License-Identifier: Apache-2.0
"""Episodes that a text alone does not give away.

Scenes are taken in blocks of four, in the order given, and a block's questions are made in pairs: the same text in two
scenes of the block, or in a scene and its twin, with different answers. So in every run each text occurs in two scenes
at least, no answer of a text is right more than half of the time, and half of the yes-no questions are answered by yes.
A block's episodes depend on its own scenes only, and pairs stay together: the first N episodes are the same however
many are requested, and every even N has the property.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, islice
from typing import Any

import numpy as np

from wiw import scenes as scene_specs
from wiw._core import core
from wiw.datasets.questions.answers import are_different, resemblance
from wiw.datasets.questions.blind import blind_answer
from wiw.datasets.questions.facts import make_table
from wiw.datasets.questions.generate import DEFAULT_RULES, Answerable, Backend, EpisodeRules, questions_of
from wiw.datasets.questions.question import CATEGORIES
from wiw.datasets.questions.survey import place_key
from wiw.datasets.questions.twins import edits_of, find_twin, may_have_twin, outline
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError
from wiw.types import Episode

BLOCK = 4
"""Scenes among which questions are paired; as many as a process keeps open."""
TWIN_TRIES = 6
"""Questions of a block that are tried for one twin."""

SPARE = 2
"""Questions that a scene may have beyond its share, so that the last pairs of a block can be found."""
FAMILIES = {"floor_material": "material", "which_room": "where"}
"""Templates that alternate with another one that asks the same."""

Pair = tuple[Answerable, Answerable]


def make_episodes(
    scenes: Sequence[str],
    count: int,
    seed: int,
    rules: EpisodeRules = DEFAULT_RULES,
    *,
    per_scene: int = 8,
    backend: Backend = "auto",
) -> list[Episode]:
    """Return the first `count` episodes of scenes that are named by single specs.

    Raises:
        ArgumentError: the scenes have too few questions, or too few rooms; says how many.
    """
    return EpisodeSeries(scenes, seed, rules, per_scene=per_scene, backend=backend).require(count)


class EpisodeSeries:
    """The episodes of scenes that are named by single specs, made in order, each once, as far as they are needed.

    It can be pickled: in another process the episodes made so far are there, and further ones take as long as all.
    """

    def __init__(
        self,
        scenes: Sequence[str],
        seed: int,
        rules: EpisodeRules = DEFAULT_RULES,
        *,
        per_scene: int = 8,
        backend: Backend = "auto",
    ) -> None:
        self.scenes, self.seed, self.rules, self.per_scene, self.backend = scenes, seed, rules, per_scene, backend
        self._made: list[Episode] = []
        self._rest: Iterator[Episode] | None = None
        self._is_complete = False

    def take(self, count: int | None = None) -> list[Episode]:
        """Return the first `count` episodes, or as many as there are; None for all."""
        if not self._is_complete and (count is None or len(self._made) < count):
            self._extend(count)
        return self._made[:count]

    def require(self, count: int) -> list[Episode]:
        """Return the first `count` episodes.

        Raises:
            ArgumentError: the scenes have too few questions, or too few rooms; says how many.
        """
        found = self.take(count)
        if len(found) < count:
            raise ArgumentError(self._explain_lack(count))
        return found

    def _extend(self, count: int | None) -> None:
        if self._rest is None:
            self._rest = islice(self._generate(), len(self._made), None)
        try:
            self._made += islice(self._rest, None if count is None else count - len(self._made))
        except BaseException:  # such as Ctrl-C in a notebook: a broken generator would look like an exhausted one
            self._rest = None
            raise
        self._is_complete = count is None or len(self._made) < count

    def _generate(self) -> Iterator[Episode]:
        first = 0
        for block in compose_blocks(self.scenes, self.rules):
            for pair in pair_questions(block, self.seed, self.rules, self.per_scene, self.backend):
                yield from to_episodes(pair, first)
                first += 2

    def _explain_lack(self, count: int) -> str:
        blocks = sum(1 for _ in compose_blocks(self.scenes, self.rules))
        more = "raise per_scene, or lower rooms"
        if len(self.scenes) == 1:
            more = "or set twins=1 for questions about this one and edited copies of it"
        return (
            f"only {len(self._made)} of {count} questions in {blocks} blocks of up to {BLOCK} scenes with "
            f"{self.rules.rooms} rooms or more, each asked in two of them with different answers; name more scenes "
            f"(apartments:SPLIT:N), {more}"
        )

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rest": None}


def compose_blocks(scenes: Sequence[str], rules: EpisodeRules) -> Iterator[list[str]]:
    """Yield blocks of scenes that have enough rooms, in their order; the last may be smaller."""
    block: list[str] = []
    for scene in scenes:
        if _count_rooms(scene) >= rules.rooms:
            block.append(scene)
        if len(block) == BLOCK:
            yield block
            block = []
    if block:
        yield block


def _count_rooms(scene: str) -> int:
    """Return the number of rooms of a scene, without baking the light of one that has too few."""
    return len((outline(scene) if scene_specs.is_generated(scene) else scene_specs.open_scene(scene)).rooms)


def to_episodes(pair: Pair, first: int) -> list[Episode]:
    """Return the two episodes of a pair, numbered on from `first`; twins name each other."""
    twins = pair[0].scene.partition("?")[0] == pair[1].scene.partition("?")[0]
    names = [f"{first + i:04d}" for i in range(2)]
    return [question.to_episode(first + i, names[1 - i] if twins else "") for i, question in enumerate(pair)]


@dataclass
class _Tally:
    """The contents of a block so far."""

    pairs: list[Pair] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    """By category, template, scene and answer."""
    texts: set[str] = field(default_factory=set)
    targets: Counter[tuple[str, int]] = field(default_factory=Counter)

    def add(self, pair: Pair) -> None:
        """Count one more pair."""
        self.pairs.append(pair)
        self.texts.add(pair[0].text)
        self.counts.update([pair[0].category, _family(pair[0]), *(_home(each) for each in pair)])
        self.counts.update(_answer(each) for each in pair)
        self.targets.update((_home(each), each.fact.target[0]) for each in pair if each.fact.target)

    def compute_excess(self, pair: Pair, rules: EpisodeRules) -> float:
        """Return what guessing from the text is worth for a pair, 0 where its category can do with such a pair."""
        worth = [guess_value(each) for each in self.pairs if each[0].category == pair[0].category]
        value = guess_value(pair)
        return value if sum(worth) + value > rules.guessing * (len(worth) + 1) else 0.0

    def admits_yes_no(self, rules: EpisodeRules) -> bool:
        """Return whether one more yes-no question keeps them few."""
        asked = sum(pair[0].answer_type == "yes_no" for pair in self.pairs)
        return asked + 1 <= rules.yes_no * (len(self.pairs) + 1)


def pair_questions(
    block: Sequence[str],
    seed: int,
    rules: EpisodeRules,
    per_scene: int,
    backend: Backend = "auto",
) -> Iterator[Pair]:
    """Yield the pairs of a block: about `per_scene` questions for each of its scenes, or as many as there are.

    Categories and templates take turns, and so do answers: what is a rare answer to a template is taken first, and once
    the most frequent answers of train apartments are worth `rules.guessing` in a category, pairs with other answers.
    """
    pools = {scene: questions_of(scene, seed, rules, backend) for scene in block}
    candidates = _candidates(pools, core.fold_key([seed, *"/".join(block).encode()]))
    shares = _answer_shares(pools)
    tally = _Tally()
    wanted = len(block) * per_scene // 2
    spacing = round(1 / rules.twins) if rules.twins > 0 else 0
    while len(tally.pairs) < wanted:
        twins = spacing and len(tally.pairs) % spacing == spacing - 1
        pair = _next_twins(pools, tally, seed, rules, backend) if twins else None
        pair = pair or _next_pair(candidates, tally, shares, rules, per_scene)
        if pair is None:
            break
        tally.add(pair)
        yield pair


def guess_value(pair: Pair) -> float:
    """Return about what train apartments' most frequent answer is worth for the two questions of a pair, 0 to 1."""
    guess = blind_answer(pair[0].text)
    return sum(resemblance(guess, each.fact, each.answer_type) for each in pair) / 2


def _candidates(pools: Mapping[str, Sequence[Answerable]], key: int) -> list[Pair]:
    """Return every pair of scenes with one text and different answers, in an order drawn with `key`."""
    by_text: dict[str, list[Answerable]] = {}
    for pool in pools.values():
        for question in pool:
            by_text.setdefault(question.text, []).append(question)
    pairs = [
        pair
        for questions in by_text.values()
        for pair in combinations(questions, 2)
        if are_different(pair[0].fact, pair[1].fact, pair[0].answer_type)
    ]
    return [pairs[i] for i in np.argsort(core.uniform(key, len(pairs)), kind="stable")]


def _answer_shares(pools: Mapping[str, Sequence[Answerable]]) -> dict[str, float]:
    """Return how often each answer of a template is right in the scenes of a block, 0 to 1."""
    every = [question for pool in pools.values() for question in pool]
    templates, answers = Counter(each.template for each in every), Counter(_answer(each) for each in every)
    return {_answer(each): answers[_answer(each)] / templates[each.template] for each in every}


def _next_pair(
    candidates: Sequence[Pair], tally: _Tally, shares: Mapping[str, float], rules: EpisodeRules, per_scene: int
) -> Pair | None:
    """Return the pair that a block lacks most, if there is one."""

    def rank(pair: Pair) -> tuple[float, ...]:
        answers = [tally.counts[_answer(each)] + shares[_answer(each)] for each in pair]
        repeated = sum(tally.targets[_home(each), each.fact.target[0]] for each in pair if each.fact.target)
        category = pair[0].category
        return (
            tally.counts[category],
            tally.compute_excess(pair, rules),
            tally.counts[_family(pair[0])],
            repeated,
            sum(answers),
            sum(tally.counts[_home(each)] for each in pair),
            CATEGORIES.index(category),
        )

    yes_no = tally.admits_yes_no(rules)
    free = [
        pair
        for pair in candidates
        if pair[0].text not in tally.texts
        and (yes_no or pair[0].answer_type != "yes_no")
        and all(tally.counts[_home(each)] < per_scene + SPARE for each in pair)
    ]
    return min(free, key=rank, default=None)


def _next_twins(
    pools: Mapping[str, Sequence[Answerable]],
    tally: _Tally,
    seed: int,
    rules: EpisodeRules,
    backend: Backend,
) -> Pair | None:
    """Return a question and its twin, of the scene that has fewest, if one of a few questions tried has a twin."""
    scene = min(pools, key=lambda each: (tally.counts[each], list(pools).index(each)))
    table = make_table(world(scene, backend).scene, scene)
    edits = edits_of(scene)
    free = [
        each
        for each in pools[scene]
        if each.text not in tally.texts and (each.answer_type != "yes_no" or tally.admits_yes_no(rules))
    ]
    draws = core.uniform(core.fold_key([place_key(seed, scene), 0x7F1B, len(tally.pairs)]), len(free))
    order = sorted(
        range(len(free)),
        key=lambda i: (tally.counts[free[i].category], tally.counts[_family(free[i])], float(draws[i])),
    )
    tried = 0
    for i in order:
        if not may_have_twin(free[i], table, edits):
            continue
        twin = find_twin(free[i], table, edits, seed, rules, backend)
        if twin is not None:
            return free[i], twin
        tried += 1
        if tried == TWIN_TRIES:
            break
    return None


def _home(question: Answerable) -> str:
    """Return the scene of a question without its edits."""
    return question.scene.partition("?")[0]


def _family(question: Answerable) -> str:
    return FAMILIES.get(question.template, question.template)


def _answer(question: Answerable) -> str:
    return f"{question.template}: {question.fact.key}"
