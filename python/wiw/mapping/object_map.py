# SPDX-License-Identifier: Apache-2.0
"""A map of objects: what was observed, where, how large, in which state and colour, under one id per thing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wiw.errors import ArgumentError
from wiw.mapping.fragments import VOXEL, Fragments, Labels, find_fragments, unpack_voxels
from wiw.mapping.label_votes import LabelVotes
from wiw.mapping.views import Views

NEAR = 0.15
"""Metres within which voxels count as overlapping."""
SMALL = 0.4
"""Metres of the longest side up to which things must fill the same space to be one: cups stand close together."""
OVERLAP = 0.2
"""Share of the voxels of a fragment, or of an object, that must overlap for both to be one thing."""
SAME_SPACE = 0.075
"""Metres within which voxels of small things, or of two confusable categories, count as overlapping."""
CONFUSABLE_OVERLAP = 0.5
"""The same, both ways, for two categories that are only confusable: a cup beside a vase remains a cup."""
SAMPLE = 128
"""Voxels at most that an overlap is measured with."""
SUPPORT_VOXELS = 256
"""Voxels at most that a thing's support is measured with."""
INSIDE = 0.8
"""Share of a small part in the box of a larger one of its category that makes both one, such as a chair's legs."""
SCRAP = 0.1
"""Voxels that such a part has at most, relative to the larger one's."""
TREE_POINTS = 1000
"""Voxels at most that distances are measured to; fewer of larger things, whose are closer together than `NEAR`."""
LEAST_CONFIDENCE = 0.3
COLOR_PIXELS = 256
"""Pixels at most that a fragment's colour is named from."""
BACKGROUND = ("", "wall", "floor", "ceiling", "door frame", "unknown", "misc", "other")
"""Categories that are not things; they are never mapped."""
ON_WALLS = frozenset({"picture", "mirror", "clock", "wall shelf", "photo", "television"})
"""Categories that hang close to each other and on both sides of a wall; they must fill the same space as well."""
CONFUSABLE: tuple[frozenset[str], ...] = (
    frozenset({"armchair", "sofa"}),
    frozenset({"chair", "office chair", "dining chair", "armchair"}),
    frozenset({"stool", "bench", "ottoman"}),
    frozenset({"table", "dining table", "desk"}),
    frozenset({"coffee table", "side table", "bench"}),
    frozenset({"cabinet", "sideboard", "dresser", "console table", "tv stand"}),
    frozenset({"kitchen counter", "kitchen cabinet", "kitchen sink"}),
    frozenset({"bookshelf", "shelf", "shoe rack"}),
    frozenset({"bowl", "cup", "vase", "plant pot", "bottle", "kettle"}),
    frozenset({"plant", "plant pot"}),
    frozenset({"books", "box"}),
    frozenset({"picture", "mirror", "television", "clock"}),
    frozenset({"ceiling lamp", "pendant lamp"}),
    frozenset({"floor lamp", "table lamp"}),
    frozenset({"door", "wardrobe", "passage"}),
    frozenset({"sink", "toilet", "bathtub", "shower"}),
)
"""Categories that are taken for each other."""

NameColor = Callable[[NDArray[np.uint8], str], tuple[str, float]]
"""Names the colour of pixels uint8 [n, 3] of a thing of some category, with a confidence."""


@dataclass(frozen=True)
class MapObject:
    """One thing of the map."""

    id: int
    """1 or more. It stays when other parts of the thing come into sight; of two that turn out to be one, the lower."""
    voxels: NDArray[np.int64]
    """Sorted keys of the voxels that were observed; `wiw.mapping.fragments.unpack_voxels` has their middles."""
    category_votes: NDArray[np.float64]
    """float64 [categories]: confidence times apparent size, summed over fragments."""
    state_votes: NDArray[np.float64]
    color_votes: tuple[tuple[str, float], ...]
    """Sorted by name."""
    category: str
    state: str
    """Empty where none is known."""
    color: str
    size: float
    """Best apparent size: the largest share of a view that it has filled."""
    confidence: float
    """Best mean confidence of a fragment."""
    decisions: int
    """Observations in which it appeared."""
    first: int
    last: int

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """float64 [N, 3]: middles of its voxels."""
        return unpack_voxels(self.voxels)

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """float64 [2, 3]: lowest and highest corner, a few stray voxels in a hundred left out."""
        points = self.points
        if len(points) < 100:
            return self.box
        return np.asarray(np.quantile(points, [0.01, 0.99], axis=0) + np.array([[-VOXEL / 2], [VOXEL / 2]]))

    @property
    def center(self) -> NDArray[np.float64]:
        """float64 [3]: middle of its bounds."""
        return np.asarray(self.bounds.mean(axis=0))

    @property
    def extent(self) -> NDArray[np.float64]:
        """float64 [3]: metres along x, y and z."""
        return np.asarray(self.bounds[1] - self.bounds[0])

    @cached_property
    def box(self) -> NDArray[np.float64]:
        """float64 [2, 3]: lowest and highest corner of all its voxels."""
        return np.stack([self.points.min(axis=0) - VOXEL / 2, self.points.max(axis=0) + VOXEL / 2])

    @cached_property
    def tree(self) -> cKDTree:
        """Its points, at most `TREE_POINTS` of them, for questions about distances."""
        thinned = self.points[:: -(-len(self.voxels) // TREE_POINTS)]
        return cKDTree(thinned, balanced_tree=False, compact_nodes=False)

    @property
    def category_share(self) -> float:
        """Share of the votes that its category has, 0 to 1."""
        return float(self.category_votes.max() / self.category_votes.sum())

    @property
    def state_share(self) -> float:
        """Share of the votes that its state has, 0 where none is known."""
        total = self.state_votes[1:].sum()
        return float(self.state_votes[1:].max() / total) if total > 0 else 0.0

    @property
    def color_share(self) -> float:
        """Share of the votes that its colour has, 0 where none is known."""
        total = sum(vote for _, vote in self.color_votes)
        return max(vote for _, vote in self.color_votes) / total if total > 0 else 0.0


@dataclass
class ObjectMap:
    """The objects observed so far.

    Args:
        categories: as a `Labeller` numbers them; index 0 is "".
        states: index 0 is "".
        background: categories that are not mapped.
        confusable: groups of categories that may be one thing, labelled differently from elsewhere.
    """

    categories: tuple[str, ...]
    states: tuple[str, ...] = ("", "on", "off", "open", "closed")
    background: tuple[str, ...] = BACKGROUND
    confusable: tuple[frozenset[str], ...] = CONFUSABLE
    least_confidence: float = LEAST_CONFIDENCE
    votes: LabelVotes = field(default_factory=LabelVotes)
    """Votes of all views for the category of each voxel, background included."""
    _objects: dict[int, MapObject] = field(default_factory=dict)
    _next_id: int = 1
    _decision: int = -1

    def __post_init__(self) -> None:
        if not self.categories or self.categories[0]:
            raise ArgumentError(f"ObjectMap: expected categories with '' first, got {self.categories[:3]}")
        self._things = np.array([name not in self.background for name in self.categories])
        self._overlaps = _tabulate_overlaps(self.categories, self.confusable)

    @property
    def objects(self) -> tuple[MapObject, ...]:
        """All objects, by id."""
        return tuple(self._objects[number] for number in sorted(self._objects))

    @property
    def decision(self) -> int:
        """Number of the latest observation, the first is 0; -1 before any."""
        return self._decision

    def __getitem__(self, number: int) -> MapObject:
        return self._objects[number]

    def __contains__(self, number: int) -> bool:
        return number in self._objects

    def add(self, views: Views, labels: Labels, name_color: NameColor | None = None) -> NDArray[np.int32]:
        """Add one observation; return the object of each pixel, int32 [4, H, W], 0 if there is none.

        Raises:
            ArgumentError: labels that do not fit the views or the categories.
        """
        self._decision += 1
        fragments = find_fragments(views, labels, self._things, len(self.states), self.least_confidence)
        self.votes.add(views, labels)
        colors = self._name_colors(views, fragments, name_color)
        owners = np.zeros(len(fragments) + 1, np.int32)
        order = np.lexsort((np.arange(1, len(owners)), -fragments.pixels[1:])) + 1  # the largest first
        for part in order.tolist():
            new = self._make_object(fragments, part, colors[part], views.size)
            owners[part] = self._absorb(new)
        return self._unite_touched(owners)[fragments.index]

    def _name_colors(
        self, views: Views, fragments: Fragments, name_color: NameColor | None
    ) -> list[tuple[str, float] | None]:
        """Return the colour of each fragment, and its confidence."""
        if name_color is None:
            return [None] * (len(fragments) + 1)
        pixels = views.images.reshape(-1, 3)
        found: list[tuple[str, float] | None] = [None]
        for where, category in zip(fragments.samples[1:], fragments.category[1:], strict=True):
            some = where[:: -(-len(where) // COLOR_PIXELS)]
            found.append(name_color(pixels[some], self.categories[category]))
        return found

    def _make_object(
        self, fragments: Fragments, part: int, color: tuple[str, float] | None, size: tuple[int, int]
    ) -> MapObject:
        share = float(fragments.pixels[part] / (size[0] * size[1]))
        weight = share * float(fragments.confidence[part])
        votes = np.zeros(len(self.categories))
        votes[fragments.category[part]] = weight
        named = () if color is None or not color[0] else ((color[0], weight * color[1]),)
        return self._summarise(
            0, fragments.voxels[part], votes, fragments.state[part] * weight, named, share,
            float(fragments.confidence[part]), 1, self._decision, self._decision,
        )  # fmt: skip

    def _absorb(self, new: MapObject) -> int:
        """Unite a fragment with the object that it is part of, or make it one; return its object's id."""
        same = self._find_matches(new)
        if same:
            self._objects[same[0]] = self.unite(self._objects[same[0]], new)
            return same[0]
        number, self._next_id = self._next_id, self._next_id + 1
        self._objects[number] = replace(new, id=number)
        return number

    def _unite_touched(self, owners: NDArray[np.int32]) -> NDArray[np.int32]:
        """Unite objects that have turned out to be one by what was added; return the owners, renamed."""
        owners = owners.copy()
        waiting = sorted({number for number in owners.tolist() if number})
        while waiting:
            number = waiting.pop(0)
            if number not in self._objects:
                continue
            thing = self._objects[number]
            matches = [other for other in self._find_matches(thing) if self._objects[other].category == thing.category]
            if matches:
                lower, upper = min(number, matches[0]), max(number, matches[0])
                self._objects[lower] = self.unite(self._objects[lower], self._objects.pop(upper))
                owners[owners == upper] = lower
                waiting.insert(0, lower)
        return owners

    def _find_matches(self, new: MapObject) -> list[int]:
        """Return the ids of the other objects that overlap enough, the most overlapping first."""
        if not self._objects:
            return []
        numbers = np.array(sorted(self._objects))
        known = [self._objects[number] for number in numbers.tolist()]
        kinds = np.array([thing.category_votes.argmax() for thing in known])
        least = self._overlaps[new.category_votes.argmax(), kinds]
        boxes = np.stack([thing.box for thing in known])
        least[numbers == new.id] = np.inf
        near = (new.box[0] <= boxes[:, 1] + NEAR).all(axis=1) & (boxes[:, 0] <= new.box[1] + NEAR).all(axis=1)
        found = []
        for row in np.flatnonzero(near & (least <= 1)).tolist():
            narrow = known[row].category in ON_WALLS
            overlap = measure_overlap(new, known[row], mutual=least[row] > OVERLAP, narrow=narrow)
            if least[row] == OVERLAP and _measure_inside(new, known[row]) >= INSIDE:
                overlap = max(overlap, OVERLAP)
            if overlap >= least[row]:
                found.append((-overlap, int(numbers[row])))
        return [number for _, number in sorted(found)]

    def unite(self, one: MapObject, other: MapObject) -> MapObject:
        """Return what both are together, under the id of the first; a fragment, whose id is 0, comes second."""
        known = max(one.decisions, other.decisions) if other.id else one.decisions + (other.last > one.last)
        return self._summarise(
            one.id,
            np.union1d(one.voxels, other.voxels),
            one.category_votes + other.category_votes,
            one.state_votes + other.state_votes,
            _add_votes(one.color_votes, other.color_votes),
            max(one.size, other.size),
            max(one.confidence, other.confidence),
            int(known),
            min(one.first, other.first),
            max(one.last, other.last),
        )

    def _summarise(
        self,
        number: int,
        voxels: NDArray[np.int64],
        category_votes: NDArray[np.float64],
        state_votes: NDArray[np.float64],
        color_votes: tuple[tuple[str, float], ...],
        size: float,
        confidence: float,
        decisions: int,
        first: int,
        last: int,
    ) -> MapObject:
        state = self.states[1 + int(state_votes[1:].argmax())] if state_votes[1:].any() else ""
        color = max(color_votes, key=lambda entry: entry[1])[0] if color_votes else ""
        category = self.categories[int(category_votes.argmax())]
        return MapObject(
            number, voxels, category_votes, state_votes, color_votes, category, state, color, size, confidence,
            decisions, first, last,
        )  # fmt: skip

    # -- questions -----------------------------------------------------------------------------------------------------

    def measure_support(self, thing: MapObject) -> float:
        """Return the share of the votes of all views for what is where a thing is that say what the thing is, 0 to 1.

        Views that show something else there, or nothing but a wall, count against it.
        """
        some = thing.voxels[:: -(-len(thing.voxels) // SUPPORT_VOXELS)]
        votes = self.votes.count(some, len(self.categories))
        total = votes.sum()
        return float(votes[self.categories.index(thing.category)] / total) if total > 0 else 1.0

    def find_supported(self, thing: MapObject, least: float) -> NDArray[np.int64]:
        """Return the voxels of a thing that at least some share of their own votes say are of its category.

        Labels do not end where depth does: what a thing's edge was painted across lies on the wall behind it, and
        other views see the wall there.
        """
        return thing.voxels[self.votes.measure_shares(thing.voxels, self.categories.index(thing.category)) >= least]

    def find(self, category: str, least_size: float = 0.0) -> tuple[MapObject, ...]:
        """Return the objects of a category, by id; spaces and underscores, upper and lower case are the same."""
        name = _normalise_name(category)
        return tuple(
            thing for thing in self.objects if _normalise_name(thing.category) == name and thing.size >= least_size
        )

    def count(self, category: str, least_size: float = 0.0) -> int:
        """Return how many objects of a category there are."""
        return len(self.find(category, least_size))


def measure_overlap(one: MapObject, other: MapObject, mutual: bool = False, narrow: bool = False) -> float:
    """Return the share of voxels of one that lie near the other's, or the other way round if that is more.

    `mutual`: if that is less, so that both must fill the same space. `narrow`: near means in the same space, as it does
    for small things.
    """
    small = max(float(thing.extent.max()) for thing in (one, other)) <= SMALL
    reach = SAME_SPACE if mutual or small or narrow else NEAR
    shares = _measure_share(one, other, reach), _measure_share(other, one, reach)
    return min(shares) if mutual else max(shares)


def _measure_share(part: MapObject, whole: MapObject, reach: float) -> float:
    points = part.points[:: -(-len(part.points) // SAMPLE)]
    inside = points[((points >= whole.box[0] - reach) & (points <= whole.box[1] + reach)).all(axis=1)]
    if not len(inside):
        return 0.0
    distance, _ = whole.tree.query(inside, distance_upper_bound=reach + 1e-9)
    return float(np.isfinite(distance).sum() / len(points))


def _measure_inside(one: MapObject, other: MapObject) -> float:
    """Return the share of the smaller one's voxels that lie in the bounds of the larger; 0 unless it is far smaller."""
    part, whole = sorted((one, other), key=lambda thing: len(thing.voxels))
    if len(part.voxels) > SCRAP * len(whole.voxels):
        return 0.0
    return float(((part.points >= whole.bounds[0]) & (part.points <= whole.bounds[1])).all(axis=1).mean())


def _tabulate_overlaps(categories: Sequence[str], groups: Iterable[frozenset[str]]) -> NDArray[np.float64]:
    """Return the overlap that two categories need for being one thing, float64 [C, C]; 2 where they never are."""
    table = np.full((len(categories), len(categories)), 2.0)
    for group in groups:
        members = [number for number, name in enumerate(categories) if name in group]
        table[np.ix_(members, members)] = CONFUSABLE_OVERLAP
    np.fill_diagonal(table, OVERLAP)
    return table


def _add_votes(
    one: tuple[tuple[str, float], ...], other: tuple[tuple[str, float], ...]
) -> tuple[tuple[str, float], ...]:
    total: dict[str, float] = {}
    for name, vote in (*one, *other):
        total[name] = total.get(name, 0.0) + vote
    return tuple(sorted(total.items()))


def _normalise_name(name: str) -> str:
    return name.strip().casefold().replace("_", " ")
