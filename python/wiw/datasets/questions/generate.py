# SPDX-License-Identifier: Apache-2.0
"""Questions of a scene that can be answered there, and from nowhere near the start.

What is true comes from the scene table (`answers`), what can be seen from rendered instance ids (`survey`), and colours
must be rendered as they are called. Each valid question is a function of (scene, seed, rules) and its text.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.fields import to_position
from wiw.datasets.questions.answers import Fact, find_answer, propose
from wiw.datasets.questions.colors import name_rendered_color
from wiw.datasets.questions.facts import SceneTable, make_table
from wiw.datasets.questions.grammar import TEMPLATES, phrase
from wiw.datasets.questions.mesh_table import NO_ATTRIBUTES, Attributes, observe_table
from wiw.datasets.questions.question import CATEGORIES, Question, Viewpoint
from wiw.datasets.questions.survey import Survey, choose_places, place_key, survey
from wiw.datasets.worlds import World, world
from wiw.errors import ArgumentError
from wiw.types import Episode

Backend = Literal["auto", "cpu", "gpu"]


@dataclass(frozen=True)
class EpisodeRules:
    """Rules that a question and its start satisfy. Lengths in metres."""

    shortest: float = 4.0
    """Minimum L*, the walk from the start to the nearest place from which the question can be answered."""
    longest: float = 15.0
    share: float = 0.003
    """Minimum part of a view that target and anchor fill at such a place."""
    counted: float = 0.001
    """The same for each of several things that need not be in one view, such as those that are counted."""
    reach: float = 4.0
    """Greatest distance of such a place from the target."""
    clear: float = 0.5
    """Minimum share of a thing's pixels that are rendered in the colour that a question speaks of."""
    rooms: int = 6
    """Minimum number of rooms of an apartment, passages included; there is nothing to explore in smaller ones."""
    places: int = 320
    """Places looked at in a scene."""
    viewpoints: int = 24
    """Maximum number of places that an episode names as those from which it can be answered."""
    yes_no: float = 0.2
    """Greatest share of questions that are answered by yes or no; half of these by yes."""
    guessing: float = 0.2
    """Highest mean score of a guess from the text, 0 to 1, as far as there are questions to choose from."""
    twins: float = 0.25
    """Share of the questions that are also asked in a copy of the apartment where something else is true."""


DEFAULT_RULES = EpisodeRules()


@dataclass(frozen=True, eq=False)
class Answerable:
    """A question with its true answer in one scene, and all that its episode needs."""

    scene: str
    text: str
    template: str
    slots: Mapping[str, str]
    fact: Fact
    start: int
    """Index of the start among the scene's surveyed places."""
    start_position: tuple[float, float, float]
    start_yaw: float
    geodesic: float
    viewpoints: tuple[Viewpoint, ...]

    @property
    def category(self) -> str:
        """OpenEQA's category."""
        return TEMPLATES[self.template].category

    @property
    def answer_type(self) -> str:
        """Kind of answer."""
        return TEMPLATES[self.template].answer_type

    def to_episode(self, number: int, twin: str = "") -> Episode:
        """Return the episode that asks it."""
        question = Question(
            self.text,
            self.fact.answer,
            self.category,
            self.answer_type,
            self.fact.extra_answers,
            self.template,
            self.slots,
            self.fact.target,
            self.viewpoints,
            twin,
        )
        goal = self.viewpoints[0]
        return Episode(
            episode_id=f"{number:04d}",
            scene=self.scene,
            start_position=self.start_position,
            start_yaw=self.start_yaw,
            goal_position=goal[:3],
            goal_yaw=goal[3],
            geodesic=self.geodesic,
            info={"question": question.to_info()},
        )


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A scene with its table and its survey: all that decides whether a question is valid there."""

    place: World
    table: SceneTable
    survey: Survey
    rules: EpisodeRules
    seed: int

    def ask(self, template: str, slots: Mapping[str, str], start: int | None = None) -> Answerable | None:
        """Return a question if it can be answered here, and not from its start.

        Without `start`, the index of a place, it is drawn with a key of scene, seed and text.
        """
        fact = find_answer(self.table, template, slots)
        if fact is None:
            return None
        views = [
            self.survey.find_viewpoints(self.table, sight, self.rules.share, self.rules.counted, self.rules.reach)
            for sight in fact.sights
        ]
        places = [np.flatnonzero(view.any(axis=1)) for view in views]
        if not all(len(each) for each in places):
            return None
        lengths, order = _shortest_routes(self.survey.distances, places)
        outside = ~np.any([view.any(axis=1) for view in views], axis=0)
        fit = np.flatnonzero(outside & (lengths >= self.rules.shortest) & (lengths <= self.rules.longest))
        text = phrase(template, slots)
        draws = core.uniform(
            core.fold_key([place_key(self.seed, self.place.name.partition("?")[0]), *text.encode()]), 2
        )
        if not len(fit) or (start is not None and start not in fit):
            return None
        start = int(fit[int(draws[0] * len(fit))]) if start is None else start
        if fact.colored and self._rendered_color(fact.colored, views[0]) != fact.color:
            return None
        route = _walk(self.survey.distances, start, [places[i] for i in order[start]])
        chosen = self._viewpoints(fact, views, list(zip(order[start], route, strict=True)), start)
        return Answerable(
            scene=self.place.name,
            text=text,
            template=template,
            slots=dict(slots),
            fact=fact,
            start=start,
            start_position=to_position(self.survey.points[start]),
            start_yaw=float(2 * np.pi * draws[1]),
            geodesic=float(lengths[start]),
            viewpoints=chosen,
        )

    def _viewpoints(
        self, fact: Fact, views: list[NDArray[np.bool_]], route: list[tuple[int, int]], start: int
    ) -> tuple[Viewpoint, ...]:
        """Return the end of the shortest route and its other stops, or the places nearest to the start."""
        stops = [self._viewpoint(fact, views, sight, place) for sight, place in reversed(route)]
        if len(views) > 1:
            return tuple(stops)
        places = np.flatnonzero(views[0].any(axis=1))
        near = places[np.argsort(self.survey.distances[start, places], kind="stable")]
        others = [self._viewpoint(fact, views, 0, int(each)) for each in near[: self.rules.viewpoints]]
        return tuple(dict.fromkeys([*stops, *others]))[: self.rules.viewpoints]

    def _viewpoint(self, fact: Fact, views: list[NDArray[np.bool_]], sight: int, place: int) -> Viewpoint:
        """Return a place with the heading in which the first thing of a sight looks largest."""
        shares = np.where(views[sight][place], self.survey.shares[place, :, fact.sights[sight].things[0]], -1.0)
        return (*to_position(self.survey.points[place]), float(self.survey.headings[int(shares.argmax())]))

    def _rendered_color(self, instance: int, view: NDArray[np.bool_]) -> str:
        """Return what a colour is called where the instance looks largest, and where it looks of middling size."""
        shares = np.where(view, self.survey.shares[:, :, instance], 0.0)
        ranked = [int(i) for i in np.argsort(-shares.ravel(), kind="stable")[: int((shares > 0).sum())]]
        at = [divmod(i, shares.shape[1]) for i in dict.fromkeys([ranked[0], ranked[len(ranked) // 2]])]
        viewpoints = [(*to_position(self.survey.points[i]), float(self.survey.headings[yaw])) for i, yaw in at]
        return name_rendered_color(self.place, instance, viewpoints, self.rules.clear)


def look_around(
    place: World,
    seed: int,
    rules: EpisodeRules,
    points: NDArray[np.float64] | None = None,
    attributes: Attributes = NO_ATTRIBUTES,
) -> Surroundings:
    """Survey a scene, from its own places or those of a similar one.

    The rooms of a scene that does not define any are found by what is in them (`mesh_table`); `attributes` says more.

    Raises:
        ArgumentError: no rooms are found; attributes of instances that do not exist.
    """
    table = make_table(place.scene, place.name)
    if points is None:
        points = choose_places(place, rules.places, place_key(seed, place.name))
    views = survey(place, points)
    if not table.rooms:
        table = observe_table(place, views, attributes, rules.clear)
    if not table.rooms:
        raise ArgumentError(
            f"{place.name}: expected a scene with rooms, such as apartments:val/3, or one whose instances have names "
            "from which rooms can be inferred, such as bed and stove; for other scenes give questions in a file "
            "(episode_file=...)"
        )
    return Surroundings(place, table, views, rules, seed)


def find_questions(surroundings: Surroundings) -> list[Answerable]:
    """Return every valid question of a scene, each text once, in the order of `answers.propose`.

    Nothing is asked about what has a name that could not be told from the words around it, such as "cabinet left".
    """
    found: dict[str, Answerable | None] = {}
    for template, slots in propose(surroundings.table):
        try:
            text = phrase(template, slots)
        except ArgumentError:
            continue
        if text not in found:
            found[text] = surroundings.ask(template, slots)
    return [each for each in found.values() if each is not None]


@lru_cache(maxsize=16)
def questions_of(
    scene: str, seed: int, rules: EpisodeRules, backend: Backend, attributes: Attributes = NO_ATTRIBUTES
) -> tuple[Answerable, ...]:
    """Return the valid questions of a single scene's spec, from memory where possible."""
    return tuple(find_questions(look_around(world(scene, backend), seed, rules, attributes=attributes)))


def generate(
    world: World,
    count: int,
    seed: int,
    rules: EpisodeRules = DEFAULT_RULES,
    *,
    first: int = 0,
    before: Iterable[str] = (),
    attributes: Attributes = NO_ATTRIBUTES,
) -> list[Episode]:
    """Return episodes `first` to `first + count - 1` of one scene alone, none with a text of `before`.

    Categories take turns. Nothing here keeps a text from having one answer everywhere: `balance.make_episodes` does,
    which pairs scenes.

    Raises:
        ArgumentError: the scene has no rooms, or too few valid questions.
    """
    made = generate_available(world, count, seed, rules, first=first, before=before, attributes=attributes)
    if len(made) < count:
        raise ArgumentError(
            f"{world.name}: only {len(made)} of {count} questions satisfy {rules}; request fewer per scene"
        )
    return made


def generate_available(
    world: World,
    count: int | None,
    seed: int,
    rules: EpisodeRules = DEFAULT_RULES,
    *,
    first: int = 0,
    before: Iterable[str] = (),
    attributes: Attributes = NO_ATTRIBUTES,
) -> list[Episode]:
    """Return the same episodes as `generate`, or as many as there are; None for all.

    Raises:
        ArgumentError: the scene has no rooms.
    """
    pool = list(questions_of(world.name, seed, rules, world.backend, attributes))
    draws = core.uniform(core.fold_key([place_key(seed, world.name), first]), len(pool))
    pool = [pool[i] for i in np.argsort(draws, kind="stable")]
    made: list[Answerable] = []
    tally: Counter[str] = Counter()
    texts = set(before)
    while count is None or len(made) < count:
        free = [each for each in pool if each.text not in texts and _within_limits(each, made, rules)]
        if not free:
            break
        chosen = min(
            free,
            key=lambda each: (
                tally[each.category],
                tally[each.template],
                tally[_name_fact(each)],
                CATEGORIES.index(each.category),
            ),
        )
        made.append(chosen)
        texts.add(chosen.text)
        tally.update([chosen.category, chosen.template, _name_fact(chosen)])
    return [each.to_episode(first + i) for i, each in enumerate(made)]


def _name_fact(question: Answerable) -> str:
    """Return what a question asks about, whether or not its text names the room as well."""
    return f"{question.template} {sorted(question.fact.target)}"


def _within_limits(question: Answerable, made: list[Answerable], rules: EpisodeRules) -> bool:
    """Return whether one more question keeps yes-no questions few, and as often answered by yes as by no."""
    if question.answer_type != "yes_no":
        return True
    answers = [each.fact.answer for each in made if each.answer_type == "yes_no"]
    return len(answers) + 1 <= rules.yes_no * (len(made) + 1) and answers.count(question.fact.answer) * 2 <= len(
        answers
    )


def _shortest_routes(
    distances: NDArray[np.float64], stops: list[NDArray[np.intp]]
) -> tuple[NDArray[np.float64], list[tuple[int, ...]]]:
    """Return from each place the length of the shortest walk by one place of each set, and the order of the sets."""
    best = np.full(len(distances), np.inf)
    orders: list[tuple[int, ...]] = [tuple(range(len(stops)))] * len(distances)
    for order in permutations(range(len(stops))):
        lengths = _route_lengths(distances, [stops[i] for i in order])
        for place in np.flatnonzero(lengths < best):
            orders[place] = order
        best = np.minimum(best, lengths)
    return best, orders


def _route_lengths(distances: NDArray[np.float64], stops: list[NDArray[np.intp]]) -> NDArray[np.float64]:
    """Return from each place the length of the shortest walk by one place of each set in this order."""
    lengths = np.zeros(len(distances))
    for places in reversed(stops):
        lengths = (distances[:, places] + lengths[places]).min(axis=1)
    return lengths


def _walk(distances: NDArray[np.float64], start: int, stops: list[NDArray[np.intp]]) -> list[int]:
    """Return the places of the shortest walk by one place of each set in this order."""
    route, here = [], start
    for i, places in enumerate(stops):
        rest = _route_lengths(distances, stops[i + 1 :])
        here = int(places[int((distances[here, places] + rest[places]).argmin())])
        route.append(here)
    return route
