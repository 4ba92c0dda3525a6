# SPDX-License-Identifier: Apache-2.0
"""Tiers of Image-Goal Navigation, and the ways on that `beyond` is about, against a slow twin that renders nothing."""

from __future__ import annotations

import math
import pickle
import re
from collections import Counter, deque
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import LineAgent, LineTask

from boxes import write_boxes
from wiw.cli.app import main
from wiw.datasets import episodes as episode_file
from wiw.datasets.imagenav import RULES, TIERS, EpisodeRules, generate
from wiw.datasets.ways_on import (
    APART,
    AROUND,
    CELL,
    LEAST_AREA,
    NO_FORK,
    PAST,
    SEEN_AROUND,
    TWO_CORNERS,
    find_broken_rule,
    find_ways_on,
    survey_view,
)
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, EpisodesError
from wiw.report.export import tables
from wiw.runs.pictures import spread_evenly
from wiw.studies.evaluate import run_arms
from wiw.tasks.imagenav import ImageNav
from wiw.types import Episode

WALLS = [  # x and z of two corners, metres: four rooms, each with a door to a corridor along x
    (-5.1, -4.1, 5.1, -4), (-5.1, 4, 5.1, 4.1), (-5.1, -4, -5, 4), (5, -4, 5.1, 4),
    (-5, -0.75, -3, -0.65), (-2.1, -0.75, 2, -0.65), (2.9, -0.75, 5, -0.65),
    (-5, 0.65, -1.5, 0.75), (-0.6, 0.65, 3, 0.75), (3.9, 0.65, 5, 0.75),
    (-0.05, -4, 0.05, -0.75), (0.45, 0.75, 0.55, 4),
    (-4.6, -3, -3.8, -2.6), (1.2, -3.4, 1.6, -2.4), (-3, 2.4, -2.2, 2.8),  # cupboards
]  # fmt: skip
COLORS = {"floor": (0.6, 0.5, 0.4), "wall": (0.8, 0.8, 0.7)}
PLACES = [(-4.5, 0), (3, -1.4), (-1, 1.4), (0.5, 0), (-2.5, -2)]
"""Where no way on is as large as `LEAST_AREA`, or begins where another does, give or take what pixels tell."""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> str:
    boxes: dict[str, Any] = {
        f"wall_{i}": ("wall", (x0, 0, z0), (x1, 2.5, z1)) for i, (x0, z0, x1, z1) in enumerate(WALLS)
    }
    boxes["floor"] = ("floor", (-5, -0.1, -4), (5, 0, 4))
    path = tmp_path_factory.mktemp("home") / "home.obj"
    write_boxes(path, boxes, COLORS)
    return str(path)


def stand(place: Any, x: float, z: float) -> Any:
    return place.ground.put_down(place.navmesh.snap(np.array([x, 0.1, z], np.float32))).astype(float)


# -- the slow twin: walls as rectangles, one ray and one cell after another --------------------------------------------


def sees(a: Any, b: Any) -> bool:
    """Whether the segment between two points of the plane meets no wall: the slab test."""
    for x0, z0, x1, z1 in WALLS:
        near, far = 0.0, 1.0
        for start, way, low, high in ((a[0], b[0] - a[0], x0, x1), (a[1], b[1] - a[1], z0, z1)):
            if abs(way) < 1e-12:
                near, far = (near, far) if low < start < high else (1.0, 0.0)
                continue
            ends = sorted(((low - start) / way, (high - start) / way))
            near, far = max(near, ends[0]), min(far, ends[1])
        if near < far:
            return False
    return True


def is_at_a_rim(start: Any, point: Any) -> bool:
    """Whether a shadow's rim lies within 1.5 degrees of a point and 0.1 m, as far as pixels and cells are wide."""
    way = (point - start)[[0, 2]]
    length = np.linalg.norm(way) + np.array([-0.1, 0.0, 0.1])
    angle = np.arctan2(way[1], way[0]) + np.radians([-1.5, -0.75, 0.0, 0.75, 1.5])
    around = {sees(start[[0, 2]], start[[0, 2]] + r * np.array([np.cos(a), np.sin(a)])) for r in length for a in angle}
    return len(around) == 2


def flood(first: tuple[int, int], inside: set[tuple[int, int]]) -> set[tuple[int, int]]:
    found, queue = {first}, deque([first])
    while queue:
        r, c = queue.popleft()
        for cell in ((r + i, c + j) for i in (-1, 0, 1) for j in (-1, 0, 1)):
            if cell in inside and cell not in found:
                found.add(cell)
                queue.append(cell)
    return found


class Twin:
    """Everything that `find_broken_rule` asks, from the walls and the cells where one can stand."""

    def __init__(self, place: Any, view: Any, start: Any) -> None:
        self.place, self.start, self.view, self.origin = place, start, view, view.origin
        self.free = {tuple(cell) for cell in np.argwhere(view.free).tolist()}
        self.seen = {cell for cell in self.free if sees(start[[0, 2]], self.at(cell)[[0, 2]])}
        hidden = self.free - self.seen
        own = flood(self.cell(start), self.seen)
        self.ways = []
        while hidden:
            part = flood(next(iter(hidden)), hidden)
            hidden -= part
            beginnings = [c for c in part if any((c[0] + i, c[1] + j) in own for i in (-1, 0, 1) for j in (-1, 0, 1))]
            if len(part) * CELL**2 >= LEAST_AREA and beginnings:
                self.ways.append((part, min(beginnings, key=lambda c: self.walk(self.at(c), start))))

    def at(self, cell: tuple[int, int]) -> Any:
        return self.origin + np.array([cell[1], 0, cell[0]]) * CELL

    def cell(self, point: Any) -> tuple[int, int]:
        away = self.origin[[2, 0]] - point[[2, 0]]
        return min(self.free, key=lambda cell: (cell[0] * CELL + away[0]) ** 2 + (cell[1] * CELL + away[1]) ** 2)

    def walk(self, a: Any, b: Any) -> float:
        return float(self.place.navmesh.geodesic_distance(a, b))

    def broken_rule(self, goal: Any) -> str | None:
        around = [cell for cell in self.seen if math.dist(self.at(cell)[[0, 2]], goal[[0, 2]]) <= AROUND]
        if any(self.walk(self.at(cell), goal) <= AROUND for cell in around):
            return SEEN_AROUND
        own = [way for way in self.ways if self.cell(goal) in way[0]]
        if not own or all(self.walk(self.at(own[0][1]), self.at(way[1])) < APART for way in self.ways):
            return NO_FORK
        path = np.asarray(self.place.navmesh.shortest_path(self.start, goal), float)
        walked, left_at = 0.0, None
        for one, other in pairwise(path):
            length = math.dist(one[[0, 2]], other[[0, 2]])
            for along in np.arange(0, length, 0.02):
                point = one + (other - one) * along / length
                if left_at is None and not sees(self.start[[0, 2]], point[[0, 2]]):
                    left_at = walked + along
                if left_at is not None and walked + along >= left_at + PAST:
                    return None if sees(point[[0, 2]], goal[[0, 2]]) else TWO_CORNERS
            walked += length
        return None


@cache
def make_twin(home: str, x: float, z: float) -> Twin:
    place = world(home, "cpu")
    start = stand(place, x, z)
    return Twin(place, survey_view(place, start), start)


def test_the_floor_in_view_and_the_ways_on_are_those_of_a_slow_twin(home: str) -> None:
    place = world(home, "cpu")
    for x, z in PLACES:
        twin = make_twin(home, x, z)
        start, view = twin.start, twin.view
        other = {tuple(cell) for cell in np.argwhere(view.seen).tolist()} ^ twin.seen
        assert all(is_at_a_rim(start, twin.at(cell)) for cell in other) and len(other) < 0.03 * len(twin.free)
        assert 0.1 < len(twin.seen) / len(twin.free) < 0.6
        ways = find_ways_on(place, start, view)
        ours = sorted(way.area for way in ways)
        assert ours == pytest.approx(sorted(len(cells) * CELL**2 for cells, _ in twin.ways), rel=0.15, abs=0.3)
        for way in ways:
            same = max(twin.ways, key=lambda each: sum(bool(way.cells[cell]) for cell in each[0]))
            assert np.linalg.norm(way.beginning - twin.at(same[1])) < 0.3


def test_pairs_break_the_rules_of_beyond_that_the_slow_twin_finds_broken(home: str) -> None:
    place, found = world(home, "cpu"), Counter[tuple[str | None, str | None]]()
    goals = place.ground.put_down(place.navmesh.sample(24, 3)).astype(float)
    for x, z in PLACES[:3]:
        twin = make_twin(home, x, z)
        start = twin.start
        for goal in goals:
            if not sees(start[[0, 2]], goal[[0, 2]]):
                found[find_broken_rule(place, start, goal), twin.broken_rule(goal)] += 1
    agreed = Counter({mine: count for (mine, theirs), count in found.items() if mine == theirs})
    assert agreed.total() >= 0.95 * found.total(), found  # rims of shadows may tip a rule
    assert all(agreed[rule] >= 2 for rule in (None, SEEN_AROUND, NO_FORK, TWO_CORNERS)), agreed


def test_the_rules_of_beyond_where_they_can_be_told_by_eye(home: str) -> None:
    place = world(home, "cpu")
    middle, behind_the_door = stand(place, -1, 0), stand(place, 1.2, 2.5)
    assert (
        find_broken_rule(place, middle, behind_the_door) is None
    )  # the corridor has several doors, this is behind one
    assert find_broken_rule(place, stand(place, -0.5, 1.2), stand(place, -1, -0.1)) == SEEN_AROUND
    assert find_broken_rule(place, stand(place, -4.4, -3.5), stand(place, 4.5, -1.2)) == NO_FORK  # one door leads out
    assert find_broken_rule(place, stand(place, 2.4, -1.2), stand(place, -4.6, 3.5)) == TWO_CORNERS


# -- the tiers ---------------------------------------------------------------------------------------------------------


def test_episodes_of_a_tier_keep_its_rules_and_spread_over_its_lengths(home: str) -> None:
    place, rules = world(home, "cpu"), {"goal_depth": 0.5, "goal_instances": 1}
    made = generate(place, 4, 7, EpisodeRules(tier="all", **rules))
    assert [episode.tier for episode in made] == [*TIERS] * 4
    for name, tier in TIERS.items():
        own = [episode for episode in made if episode.tier == name]
        share = (tier.longest - tier.shortest) / 4
        assert [int((episode.geodesic - tier.shortest) / share) for episode in own] == [0, 1, 2, 3]
        for episode in own:
            start, goal = (np.array(place) for place in (episode.start_position, episode.goal_position))
            assert not sees(start[[0, 2]], goal[[0, 2]]) and episode.info["ideal_primitives"] <= tier.budget
            assert name != "beyond" or find_broken_rule(place, start, goal) is None
    assert made == generate(place, 4, 7, EpisodeRules(tier="all", **rules))
    assert made[0] != generate(place, 4, 8, EpisodeRules(tier="all", **rules))[0]


def test_a_scene_from_which_a_tier_cannot_be_made_says_which_rule_is_not_met(two_rooms: str) -> None:
    rules = {"goal_depth": 0.3, "goal_instances": 1, "attempts": 20}
    with pytest.raises(
        EpisodesError,
        match=r"tier 'beyond', no start and goal among 200.*rule that the best attempts broke.*attempts=200\)",
    ) as no:
        generate(world(two_rooms, "cpu"), 1, 0, EpisodeRules(tier="beyond", **rules))
    assert no.value.rule == NO_FORK in RULES  # two rooms and one door: nowhere does the way fork
    assert pickle.loads(pickle.dumps(no.value)).rule == NO_FORK
    with pytest.raises(ArgumentError, match=r"tier 'near' sets shortest, longest and budget.*got longest"):
        ImageNav(tier="near", longest=4.0)
    with pytest.raises(ArgumentError, match="tier: expected one of any, near, far, beyond, all, got 'next'"):
        ImageNav(tier="next")


def test_tiers_are_generated_from_the_command_line(home: str, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "tiers.json"
    more = ["--task-option", "goal_depth=0.5", "--task-option", "goal_instances=1", "--per-scene", "1"]
    command = ["episodes", "imagenav", "--scenes", home, "--tier", "all", "--episodes", "6", *more]
    assert main([*command, "--out", str(out)]) == 0
    made = episode_file.load(out)
    assert [episode.tier for episode in made] == [*TIERS] * 2 and len({e.goal_position for e in made}) == 6
    task = ImageNav(scenes=home, tier="all", per_scene=1, goal_depth=0.5, goal_instances=1)
    assert task.episodes(6) == made and task.describe()["generator"]["tier"] == "all"
    assert "tier" not in str(ImageNav(scenes=home).describe())


# -- tables of tiers ---------------------------------------------------------------------------------------------------


class TieredLine(LineTask):
    def episodes(self, count: int) -> list[Episode]:
        return [replace(each, info={"tier": ("near", "far")[i % 2]}) for i, each in enumerate(super().episodes(count))]


def test_each_tier_has_tables_of_its_own(tmp_path: Path) -> None:
    arms = {"none": LineAgent(drive=0.5), "fast": LineAgent(drive=0.9)}
    log = run_arms(TieredLine(), arms, 12, out=tmp_path / "run", progress=False, keep_images=0)
    numbers = log.numbers()
    assert list(numbers.tiers) == ["near", "far"]
    for first, (name, own) in enumerate(numbers.tiers.items()):
        wanted = [
            row["metrics"]["success"] for row in log.episodes if row["arm"] == "fast" and row["episode"] % 2 == first
        ]
        assert own["fast"].done == own["fast"].total == 6 and len(wanted) == 6
        assert own["fast"].estimates["success"].value == pytest.approx(100 * sum(wanted) / 6)
        assert own.difference("fast", "none").estimate.n == 6 and f"Tier {name}" in str(numbers)
    page = log.report().read_text()
    leads = re.findall(r"<b>Tier (\w+)\.</b> With fast, the agent succeeded in [\d.]+ % of 6 episodes", page)
    assert leads == ["near", "far"] and page.count('<h2 class="tier"') == 3
    lines = tables(log)["tiers"]
    assert [(line["tier"], line["arm"], line["n"]) for line in lines][:3] == [
        ("near", "none", 6),
        ("near", "fast", 6),
        ("far", "none", 6),
    ]
    assert spread_evenly(log.store.episodes(), 1) == [0, 1]  # pictures of each tier
    plain = run_arms(LineTask(), arms, 4, out=tmp_path / "plain", progress=False, keep_images=0)
    assert not plain.numbers().tiers and "tiers" not in tables(plain) and "All tiers" not in str(plain.numbers())
