# SPDX-License-Identifier: Apache-2.0
"""Active Recognition episodes: targets hardly visible at the start, and clearly visible from within the budget.

A thing is hardly seen when most of it is hidden, or when it is so far away or so foreshortened that little is to be
seen, a small part of what a good view shows; both are measured in rendered instance ids (`wiw.datasets.visibility`).
Or it is averted: seen from the side or from behind, where it has a front. No recogniser is asked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.action import ActionSpace
from wiw.datasets import episodes as episode_file
from wiw.datasets import habitat
from wiw.datasets.fields import to_position
from wiw.datasets.visibility import COARSE, measure_sizes, measure_unoccluded_sizes
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError, FileError
from wiw.types import Episode

CATEGORIES = (
    "bathtub",
    "bed",
    "bin",
    "bookshelf",
    "chair",
    "coffee table",
    "desk",
    "dining table",
    "dresser",
    "floor lamp",
    "laundry basket",
    "microwave",
    "nightstand",
    "plant",
    "refrigerator",
    "shoe rack",
    "shower",
    "sink",
    "sofa",
    "stool",
    "stove",
    "table lamp",
    "television",
    "toilet",
    "wardrobe",
    "washing machine",
)
"""Categories of targets and answers where no others are given: as many as there are letters."""

PUBLISHED_CATEGORIES = (
    "appliances",
    "bathtub",
    "bed",
    "cabinet",
    "chair",
    "chest_of_drawers",
    "clothes",
    "counter",
    "curtain",
    "cushion",
    "door",
    "fireplace",
    "furniture",
    "gym_equipment",
    "mirror",
    "picture",
    "plant",
    "seating",
    "shower",
    "sink",
    "sofa",
    "stool",
    "table",
    "toilet",
    "towel",
    "tv_monitor",
    "window",
)
"""Choices of World-in-World's episodes: 27 categories of Matterport3D, all of them whatever a file's targets are."""

ALIASES = {
    "carpet": "rug",
    "couch": "sofa",
    "fridge": "refrigerator",
    "kitchen table": "dining table",
    "night stand": "nightstand",
    "portrait": "picture",
    "rangehood": "range hood",
    "reading desk": "desk",
    "trash": "bin",
    "tv": "television",
    "tv cabinet": "tv stand",
}
"""Other scenes' words for the apartments' categories."""

HIDDEN_LOOK, SMALL_LOOK, AVERTED_LOOK = "hidden", "small", "averted"
"""Why a first look is hard."""
FIRST_LOOKS = (HIDDEN_LOOK, SMALL_LOOK, AVERTED_LOOK)
FRONTLESS = ("bin", "floor lamp", "laundry basket", "plant", "stool", "table lamp")
"""Categories that look alike from all sides."""

LABELS_NEEDED = "put the files with its labels next to its mesh (docs/real-scans.md)"
HIDDEN = (0.4, 0.2)
"""Visible shares at the start below which an episode is of difficulty 1 and 2."""


@dataclass(frozen=True)
class EpisodeRules:
    """Rules that a target and a start of an episode satisfy. Lengths in metres, sizes in steradians."""

    nearest: float = 0.7
    """Minimum horizontal distance from the start to the target's centre."""
    farthest: float = 5.0
    seen: float = 0.0025
    """Minimum size of what is seen of the target at the start: 75 pixels of the panorama at eye level."""
    hidden: float = HIDDEN[0]
    """Heavily occluded: at most this share of the target is visible ..."""
    small: float = 0.25
    """... or an extreme viewpoint: it fills at most this part of what it fills in the best view ..."""
    tiny: float = 0.008
    """... and is no larger than this, 5 degrees across."""
    clear: float = 0.7
    """Minimum visible share in the best view."""
    large: float = 0.02
    """Minimum size of the best view: 8 degrees across ..."""
    enough: float = 0.3
    """... and the size above which it gets no better: 31 degrees across."""
    gain: float = 2.5
    """How much larger than at the start the target must be seen there, at least."""
    budget: int = 8
    """Maximum number of primitives from the start to the best view; the paper's 10 decisions leave 9 to carry out."""
    turned: float = 67.5
    """Most degrees between the start's heading and the target."""
    survey: int = 250
    """Places looked at in a scene."""
    places: int = 30
    """Places near a target where its visible share is measured."""
    attempts: int = 6
    """Starts tried for a target."""
    first_look: Literal["any", "balanced"] = "any"
    """any: hidden or small, as they come; balanced: hidden, small and averted take turns."""
    averted: float = 70.0
    """Averted: least degrees between the target's front and the direction to the start ..."""
    facing: float = 55.0
    """... and most degrees between its front and the direction to the best view ..."""
    nearby: float = 3.0
    """... from at most this far away, so that it is hard for its side alone."""

    def __post_init__(self) -> None:
        for name in ("survey", "places", "attempts"):
            if getattr(self, name) < 1:
                raise ArgumentError(f"ar: {name}: expected at least 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class Survey:
    """The apparent size of each instance from each sampled place of one scene."""

    points: NDArray[np.float64]
    """float64 [N, 3], on the floor."""
    sizes: NDArray[np.float64]
    """float64 [N, instances + 1] steradians, roughly."""


def category_of(instance: Mapping[str, Any]) -> str:
    """Return an instance's category in the apartments' words."""
    return ALIASES.get(instance["category"], instance["category"])


def centre_of(world: World, instance: int, where: str) -> NDArray[np.float64]:
    """Return the middle of an instance's bounds, world metres.

    Raises:
        ArgumentError: the scene has no such instance; names `where`.
    """
    things = world.scene.instances
    if not 1 <= instance <= len(things):
        raise ArgumentError(
            f"{where}: target {instance} is not an instance of {world.name}, which has 1 to {len(things)}"
        )
    if world.scene.attributes.get("labels") == "none":
        raise ArgumentError(f"{where}: {world.name} has no labels, so target {instance} is unknown; {LABELS_NEEDED}")
    if not things[instance - 1]["triangle_count"]:
        raise ArgumentError(f"{where}: target {instance} has no surface in {world.name}")
    return np.asarray(things[instance - 1]["bounds"], np.float64).mean(axis=0)


def generate(
    world: World,
    count: int,
    seed: int,
    categories: Sequence[str] = CATEGORIES,
    rules: EpisodeRules = EpisodeRules(),
    *,
    first: int = 0,
    before: Iterable[str] = (),
) -> list[Episode]:
    """Return episodes `first` to `first + count - 1` of one scene.

    Categories take turns: those that are rarest among `before`, the targets of the episodes made so far, come first.
    Otherwise the episodes are a function of (scene, seed, `first`).

    Raises:
        ArgumentError: the scene has no object of `categories`, or too few targets and starts satisfy `rules`.
    """
    key = core.fold_key([seed, first, 0xA12])
    things = _targets(world, categories)
    points = world.ground.put_down(world.navmesh.sample(rules.survey, key, world.floor)).astype(np.float64)
    survey = Survey(points, measure_sizes(world, points, COARSE))
    made: list[Episode] = []
    tally = Counter(before)
    balanced = rules.first_look == "balanced"
    for round_ in range(count + len(FIRST_LOOKS) if balanced else count):
        for number, category in enumerate(_order(things, tally, core.fold_key([key, round_]))):
            draw = core.fold_key([key, round_, number])
            look = _choose_look(tally.total(), round_) if balanced else None
            episode = _episode(world, survey, things[category], draw, rules, made, look)
            if episode is not None:
                made.append(episode)
                tally[category] += 1
            if len(made) == count:
                return [_number_episode(episode, first + i) for i, episode in enumerate(made)]
    raise ArgumentError(
        f"{world.name}: only {len(made)} of {count} targets and starts satisfy {rules}; request fewer per scene"
    )


def _choose_look(number: int, round_: int) -> str | None:
    """Return the look whose turn it is: where a round did not find it, the next one, and in the end any."""
    return FIRST_LOOKS[(number + round_) % len(FIRST_LOOKS)] if round_ < len(FIRST_LOOKS) else None


def _targets(world: World, categories: Sequence[str]) -> dict[str, list[Mapping[str, Any]]]:
    """Return the instances by category."""
    things: dict[str, list[Mapping[str, Any]]] = {}
    for instance in world.scene.instances:
        if category_of(instance) in categories:
            things.setdefault(category_of(instance), []).append(instance)
    if not things:
        raise ArgumentError(
            f"{world.name}: has no object of the categories {', '.join(categories)}; it has "
            f"{', '.join(sorted(world.scene.categories)) or 'none at all'}: choose the categories to use "
            "(categories=[...])"
        )
    return things


def _order(things: Mapping[str, Any], tally: Counter[str], key: int) -> list[str]:
    """Return the categories of a scene, the rarest so far first, otherwise at random."""
    names = sorted(things)
    draws = dict(zip(names, core.uniform(key, len(names)), strict=True))
    return sorted(names, key=lambda name: (tally[name], draws[name]))


def _episode(
    world: World,
    survey: Survey,
    instances: Sequence[Mapping[str, Any]],
    key: int,
    rules: EpisodeRules,
    made: Sequence[Episode],
    look: str | None,
) -> Episode | None:
    """Return an episode with one of the instances as target, if one has a start that is hard and can be mended.

    Never from where the same target is looked at in one of those `made`; if `look` is given, it is hard for that
    reason.
    """
    draws = core.uniform(key, 2)
    instance = instances[int(draws[0] * len(instances))]
    name, centre = int(instance["id"]), np.asarray(instance["bounds"], np.float64).mean(axis=0)
    front = find_front(world, instance)
    if look == AVERTED_LOOK and front is None:
        return None
    for start, size, share in _starts(world, survey, instance, core.fold_key([key, 1]), rules, look):
        if any(name == other.info["target"] and to_position(start) == other.start_position for other in made):
            continue
        ahead = np.arctan2(-(centre - start)[0], -(centre - start)[2])
        yaw = float(ahead + np.radians(rules.turned) * (2 * draws[1] - 1)) % (2 * np.pi)
        averted = share > rules.hidden and bool(_are_averted(start, centre, front, rules))
        best = _best_view(world, start, yaw, name, rules, (centre, front) if averted and front is not None else None)
        reason = None if best is None else _find_reason(size, share, averted, best, rules)
        if best is None or reason is None or look not in (None, reason):
            continue
        angles = (
            {}
            if front is None
            else {
                "view_angle_deg": round(float(_measure_view_angles(start, centre, front)), 1),
                "best_view_angle_deg": round(float(_measure_view_angles(best.position, centre, front)), 1),
            }
        )
        return Episode(
            episode_id="",
            scene=world.name,
            start_position=to_position(start),
            start_yaw=yaw,
            goal_position=to_position(centre),
            goal_yaw=0.0,
            geodesic=float(world.navmesh.geodesic_distance(start, best.position)),
            info={
                "target": name,
                "category": category_of(instance),
                "difficulty": sum(share < bound for bound in HIDDEN),
                "visible": round(share, 4),
                "best_position": to_position(best.position),
                "best_primitives": best.primitives,
                "best_visible": round(best.share, 4),
                **({"first_look": reason, **angles} if rules.first_look == "balanced" else {}),
            },
        )
    return None


def _find_reason(size: float, share: float, averted: bool, best: _View, rules: EpisodeRules) -> str | None:
    """Return why the first view is hard where the best view resolves it; None if it is not, or where that does not."""
    if averted:
        return AVERTED_LOOK
    if best.size < rules.gain * size:
        return None
    if share <= rules.hidden:
        return HIDDEN_LOOK
    return SMALL_LOOK if size <= rules.small * best.size and size <= rules.tiny else None


def find_front(world: World, instance: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """Return the horizontal direction that an instance faces, float64 [3] of unit length.

    None if it is not known: in scenes other than the generated apartments, whose furniture is built to face its own
    +z, and of things that look alike from all sides.
    """
    if "layout" not in world.scene.attributes or category_of(instance) in FRONTLESS:
        return None
    ahead = np.asarray(instance["T_world_instance"], np.float64)[:3, 2] * [1.0, 0.0, 1.0]
    length = float(np.linalg.norm(ahead))
    return ahead / length if length > 0.5 else None  # less than 30 degrees off the vertical, it faces up or down


def _measure_view_angles(
    places: NDArray[np.float64], centre: NDArray[np.float64], front: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the degrees, 0 to 180, between a target's front and the horizontal directions to places [..., 3]."""
    ways = (places - centre) * [1.0, 0.0, 1.0]
    cosines = ways @ front / np.maximum(np.linalg.norm(ways, axis=-1), 1e-9)
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1, 1))))


def _are_averted(
    places: NDArray[np.float64], centre: NDArray[np.float64], front: NDArray[np.float64] | None, rules: EpisodeRules
) -> NDArray[np.bool_]:
    """Return whether a target is seen from the side or from behind at places [..., 3], and from nearby."""
    if rules.first_look != "balanced" or front is None:
        return np.zeros(places.shape[:-1], bool)
    away = np.hypot(*np.moveaxis((places - centre)[..., [0, 2]], -1, 0))
    return np.asarray((away <= rules.nearby) & (_measure_view_angles(places, centre, front) >= rules.averted))


def _starts(
    world: World,
    survey: Survey,
    target: Mapping[str, Any],
    key: int,
    rules: EpisodeRules,
    look: str | None,
) -> Iterator[tuple[NDArray[np.float64], float, float]]:
    """Yield places from which at least a little of the target is seen, with its size and visible share there.

    Only those that may be hard by the `look`; without one all, those where it is hidden first.
    """
    instance, centre = int(target["id"]), np.asarray(target["bounds"], np.float64).mean(axis=0)
    away = np.hypot(*(survey.points - centre)[:, [0, 2]].T)
    near = (away >= rules.nearest) & (away <= rules.farthest) & (survey.sizes[:, instance] > 0)
    if look == SMALL_LOOK:
        near &= survey.sizes[:, instance] <= 1.2 * rules.tiny  # which is a rough measure
    elif look == AVERTED_LOOK:
        near &= _are_averted(survey.points, centre, find_front(world, target), rules)
    close = np.flatnonzero(near)
    if not len(close):
        return
    points = survey.points[close[np.argsort(core.uniform(key, len(close)))][: rules.places]]
    sizes = measure_sizes(world, points)[:, instance]
    points, sizes = points[sizes >= rules.seen], sizes[sizes >= rules.seen]
    shares = np.minimum(1.0, sizes / np.maximum(measure_unoccluded_sizes(world, points, instance), 1e-9))
    # The hidden ones first, unless another look is asked for; those that are far or foreshortened only the best view
    # tells.
    later = shares > rules.hidden if look in (None, HIDDEN_LOOK) else shares <= rules.hidden
    for i in np.argsort(later, kind="stable")[: rules.attempts]:
        if look is not None and later[i]:
            return
        yield points[i], float(sizes[i]), float(shares[i])


@dataclass(frozen=True)
class _View:
    position: NDArray[np.float64]
    primitives: int
    size: float
    share: float


def _best_view(
    world: World,
    start: NDArray[np.float64],
    yaw: float,
    instance: int,
    rules: EpisodeRules,
    facing: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> _View | None:
    """Return where within the budget the target is seen largest, among places where it is seen clearly.

    Of those where it is large enough, it is the one with the greatest visible share. With its centre and its front
    given in `facing`, it is one from which the front is seen.
    """
    ends, primitives = _reachable(world, start, yaw, rules.budget)
    if facing is not None:
        seen = _measure_view_angles(ends, *facing) <= rules.facing
        ends, primitives = ends[seen], primitives[seen]
    if not len(ends):
        return None
    rough = measure_sizes(world, ends, COARSE)[:, instance]
    largest = np.argsort(-np.minimum(rough, rules.enough), kind="stable")[:6]
    largest = largest[rough[largest] >= rules.large / 2]
    if not len(largest):
        return None
    sizes = measure_sizes(world, ends[largest])[:, instance]
    shares = sizes / np.maximum(measure_unoccluded_sizes(world, ends[largest], instance), 1e-9)
    fit = np.flatnonzero((shares >= rules.clear) & (sizes >= rules.large))
    if not len(fit):
        return None
    best = max(fit, key=lambda i: (min(sizes[i], rules.enough), shares[i]))
    end = largest[best]
    return _View(ends[end], int(primitives[end]), float(sizes[best]), min(1.0, float(shares[best])))


def find_best_place(world: World, episode: Episode, rules: EpisodeRules = EpisodeRules()) -> NDArray[np.float64]:
    """Return where the target is seen best within the budget: as the episode says, else as measured; float64 [3]."""
    known = episode.info.get("best_position")
    if known is not None:
        return np.asarray(known, np.float64)
    start, target = np.asarray(episode.start_position, np.float64), int(episode.info["target"])
    best = _best_view(world, start, episode.start_yaw, target, rules)
    if best is not None:
        return best.position
    ends, _ = _reachable(world, start, episode.start_yaw, rules.budget)
    return np.asarray(ends[measure_sizes(world, ends, COARSE)[:, target].argmax()], np.float64)


def measure_clarity(
    world: World, place: NDArray[np.float64], instance: int, rules: EpisodeRules = EpisodeRules()
) -> float:
    """Return how well an instance is seen, 0 to 1: its visible share, times its size up to `rules.enough`."""
    points = np.asarray(place, np.float64)[None]
    size = float(measure_sizes(world, points)[0, instance])
    whole = float(measure_unoccluded_sizes(world, points, instance)[0]) if size else 0.0
    return min(1.0, size / whole) * min(1.0, size / rules.enough) if whole else 0.0


def _reachable(
    world: World, start: NDArray[np.float64], yaw: float, budget: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return every other place that a turn and then steps lead to, and the primitives to get there."""
    step = ActionSpace().forward_m
    found, spent = [start], [0]
    half = round(np.pi / ActionSpace().turn_rad)
    for turns in range(1 - half, half + 1):
        angle = yaw + turns * ActionSpace().turn_rad
        steps = np.arange(1, max(0, budget - abs(turns)) + 1)
        way = start + step * steps[:, None] * np.array([-np.sin(angle), 0.0, -np.cos(angle)])
        free = np.cumprod(world.navmesh.is_navigable(way)) if len(way) else np.zeros(0)
        for count in steps[: int(free.sum())][::-1][::2]:
            found.append(way[count - 1])
            spent.append(abs(turns) + int(count))
    return world.ground.put_down(np.stack(found)).astype(np.float64), np.array(spent)


def _number_episode(episode: Episode, index: int) -> Episode:
    return replace(episode, episode_id=f"{index:04d}")


def load(
    path: str | Path, scenes: str | Path = "", categories: Sequence[str] | None = None
) -> tuple[list[Episode], tuple[str, ...]]:
    """Return the episodes of a file and the labels that their answers are chosen from.

    These are `categories`, else what the file's header names, else for published episodes `PUBLISHED_CATEGORIES`, else
    the built-in list where it holds all targets, else the targets' own categories.

    Raises:
        FileError: see `wiw.datasets.episodes.load`; a target or category is missing or not among the choices. Names
            file, episode and field.
    """
    found = episode_file.load(path, scenes)
    for i, episode in enumerate(found):
        _check_fields(episode, f"{path}: episode {i}")
    named = categories or _header(path)
    present = {episode.info["category"] for episode in found}
    if named is None:
        published = any(episode.info.get("source") == habitat.PUBLISHED for episode in found)
        fixed = PUBLISHED_CATEGORIES if published else CATEGORIES
        named = fixed if present <= set(fixed) else sorted(present)
    for i, episode in enumerate(found):
        if episode.info["category"] not in named:
            raise FileError(
                f"{path}: episode {i}: info.category '{episode.info['category']}' is not among the categories "
                f"{', '.join(named)}; correct the file, or add it (categories=[...])"
            )
    return found, tuple(named)


def _header(path: str | Path) -> list[str] | None:
    body = episode_file.read_json(path)
    named = body.get("categories") if isinstance(body, Mapping) else None
    if named is not None and (not isinstance(named, list) or not all(isinstance(name, str) for name in named)):
        raise FileError(f"{path}: categories: expected a list of names, got {named!r}")
    return named


def _check_fields(episode: Episode, where: str) -> None:
    if not isinstance(episode.info, Mapping):
        raise FileError(f"{where}: info: expected an object with target and category, got {episode.info!r}")
    target, category = episode.info.get("target"), episode.info.get("category")
    if isinstance(target, bool) or not isinstance(target, int) or target < 1:
        raise FileError(f"{where}: info.target: expected the id of an instance (1, 2, ...), got {target!r}")
    if not isinstance(category, str) or not category:
        raise FileError(f"{where}: info.category: expected the target's category, got {category!r}")
