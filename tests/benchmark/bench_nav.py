# SPDX-License-Identifier: Apache-2.0
"""Distance matrices over 1400 places: exact visibility graph against Detour asked pair by pair, and against a grid.

Detour is asked as Habitat asks it (both ends projected, corridor, taut string), by a loop in C++ on one thread; it gets
a random sample of the pairs each round and its time is scaled to all of them, each unordered pair once. The grid has
cells of 0.05 m with eight neighbours, SciPy's Dijkstra runs from some places and is scaled to all. "first" includes the
visibility graph, "again" has it from an earlier call.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from harness import Timing, measure, spread
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from wiw import scenes
from wiw.nav import NavMesh

PLACES = 1400
PAIRS = PLACES * (PLACES - 1) // 2
DETOUR_SAMPLE = 5000
GRID_SOURCES = 4
REPEATS = 9
TARGET = 60.0
APARTMENTS = (1, 2, 3)


def find_data() -> Path | None:
    default = Path(__file__).resolve().parents[3] / "shared" / "data"
    folder = Path(os.environ.get("WIW_TEST_DATA", default))
    return folder if folder.is_dir() else None


def places() -> Iterator[tuple[str, NavMesh]]:
    """The meshes to measure on; those whose input is not there are named and left out."""
    data = find_data()
    if data is None:
        print("nav_test, dungeon, small_house: left out, set WIW_TEST_DATA to the folder that holds them")
    else:
        for name in ("nav_test", "dungeon"):
            yield name, NavMesh.build(scenes.load(data / "nav" / f"{name}.obj"))
        yield "small_house", NavMesh.build(scenes.load(data / "small_house" / "worlds" / "small_house.world"))
    for seed in APARTMENTS:
        yield f"apartment {seed}", NavMesh.build(scenes.apartment(seed))


class Grid:
    """Cells whose centre is navigable, on one level: what one would write with SciPy."""

    def __init__(self, mesh: NavMesh, points: np.ndarray, cell: float = 0.05) -> None:
        low, high = mesh.islands[0].bounds
        self.shape = tuple(np.ceil((high - low)[[0, 2]] / cell).astype(int))
        x, z = np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij")
        level = np.full(x.size, np.median(points[:, 1]))
        centres = np.stack([low[0] + (x.ravel() + 0.5) * cell, level, low[2] + (z.ravel() + 0.5) * cell], 1)
        free = mesh.is_navigable(centres) & (mesh.island_of(centres) == 0)
        self.number = np.where(free, np.cumsum(free) - 1, -1).reshape(self.shape)
        self.cells = ((points[:, [0, 2]] - low[[0, 2]]) / cell).astype(int).clip(0, np.array(self.shape) - 1)
        self.node = self.number[tuple(self.cells.T)]
        rows, columns, lengths = zip(*self._neighbours(cell), strict=True)
        size = int(free.sum())
        entries = np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))
        self.graph = coo_matrix(entries, (size, size)).tocsr()

    def _neighbours(self, cell: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        n = self.number
        for dx, dz in ((1, 0), (0, 1), (1, 1), (1, -1)):
            a = n[: n.shape[0] - dx, max(0, -dz) : n.shape[1] - max(0, dz)]
            b = n[dx:, max(0, dz) : n.shape[1] + min(0, dz)]
            both = (a >= 0) & (b >= 0)
            yield a[both], b[both], np.full(both.sum(), cell * np.hypot(dx, dz))

    def distances(self, sources: np.ndarray) -> np.ndarray:
        return dijkstra(self.graph, directed=False, indices=self.node[sources])


def horizontal(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path[:, [0, 2]].astype(float), axis=0), axis=1).sum())


def compare_lengths(mesh: NavMesh, points: np.ndarray, exact: np.ndarray) -> str:
    """How much longer Detour's ways are, measured horizontally."""
    pairs = np.random.default_rng(1).integers(0, PLACES, (3000, 2))
    detour = [horizontal(mesh.shortest_path(points[a], points[b], metric="detour-uncapped")) for a, b in pairs]
    excess = np.array(detour) - exact[pairs[:, 0], pairs[:, 1]]
    return (
        f"Detour longer by > 1 cm on {100 * (excess > 0.01).mean():.1f} % of pairs, at most {excess.max():.2f} m; "
        f"exact longer by at most {max(0.0, -excess.min()):.1e} m"
    )


def grid_case(mesh: NavMesh, points: np.ndarray, exact: np.ndarray) -> tuple[Grid | None, str]:
    """The grid and its error; left out where it does not fit or would take minutes."""
    if np.ptp(points[:, 1]) > 0.5 or mesh.islands[0].area > 500:
        return None, "grid: left out, for level islands of at most 500 m2"
    grid = Grid(mesh, points)
    sources = np.flatnonzero(grid.node >= 0)[:GRID_SOURCES]
    usable = grid.node >= 0
    error = grid.distances(sources)[:, grid.node[usable]] / np.maximum(exact[sources][:, usable], 1.0) - 1
    far = exact[sources][:, usable] > 1
    return grid, f"grid longer by {100 * error[far & np.isfinite(error)].mean():.1f} % on average"


def fresh_meshes(mesh: NavMesh, count: int) -> list[NavMesh]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "copy.navmesh"
        mesh.save(path)
        return [NavMesh.load(path) for _ in range(count)]


def row(name: str, timing: Timing, scale: float, ours: Timing) -> None:
    ratios = f"{spread(scale * timing.cpu / ours.cpu, 1):>28}{spread(scale * timing.wall / ours.wall, 1):>28}"
    print(f"  {name:26}{spread(1e3 * scale * timing.cpu, 1):>32}{spread(1e3 * scale * timing.wall, 1):>32}{ratios}")


def bench(name: str, mesh: NavMesh) -> float:
    points = mesh.sample(PLACES, 0)
    exact = mesh.distance_matrix(points)
    assert np.isfinite(exact).all() and (exact == exact.T).all()
    grid, grid_note = grid_case(mesh, points, exact)
    rng = np.random.default_rng(0)
    copies = iter(fresh_meshes(mesh, REPEATS + 2))

    def ask_detour() -> None:
        a, b = rng.integers(0, PLACES, (2, DETOUR_SAMPLE))
        mesh.geodesic_distance(points[a], points[b], metric="detour")

    cases = {
        "first": lambda: next(copies).distance_matrix(points),
        "again": lambda: mesh.distance_matrix(points),
        "detour": ask_detour,
        "grid": None if grid is None else lambda: grid.distances(np.flatnonzero(grid.node >= 0)[:GRID_SOURCES]),
    }
    timings = measure(cases, repeats=REPEATS)
    island = mesh.islands[0]
    print(f"\n{name}: {island.area:.0f} m2, {island.polygons} polygons   (target: {TARGET:.0f}x Detour)")
    print(f"  {'':26}{'CPU ms':>32}{'wall ms':>32}{'x exact, first (CPU)':>28}{'x exact, first (wall)':>28}")
    row("exact, first", timings["first"], 1, timings["first"])
    row("exact, again", timings["again"], 1, timings["first"])
    row("Detour pair by pair", timings["detour"], PAIRS / DETOUR_SAMPLE, timings["first"])
    if "grid" in timings:
        row("grid, SciPy Dijkstra", timings["grid"], PLACES / GRID_SOURCES, timings["first"])
    print(f"  {compare_lengths(mesh, points, exact)}; {grid_note}")
    return float(np.median(PAIRS / DETOUR_SAMPLE * timings["detour"].cpu / timings["first"].cpu))


def main() -> None:
    ratios = {name: bench(name, mesh) for name, mesh in places()}
    worst = min(ratios, key=ratios.__getitem__)
    verdict = "met" if ratios[worst] >= TARGET else "MISSED"
    print(f"\nSlowest gain over Detour, CPU time: {ratios[worst]:.0f}x on {worst}; target {TARGET:.0f}x {verdict}")


if __name__ == "__main__":
    main()
