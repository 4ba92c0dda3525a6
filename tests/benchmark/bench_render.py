# SPDX-License-Identifier: Apache-2.0
"""Rendering against the renderers a user could pick instead, on the same triangles and texture.

Colour, metric depth and instance ids as NumPy arrays: 480x480 views of 90 degrees, and 576x1024 panoramas (six faces of
384x384 and a conversion for peers without an equirectangular camera). Lean peers draw less: see what each says that it
draws. Every renderer runs in its own process, one at a
time, in shuffled order; the figure is CPU time a frame summed over all threads, and beside it wall time.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import render_scene
from harness import spread
from render_peers import environments

HERE = Path(__file__).parent
SIZES = (20_000, 200_000, 2_000_000)
TARGETS = {"perspective": 4.0, "panorama": 5.0}
LEAN_TARGETS = {"perspective": 2.5, "panorama": 3.5}
GROWTH = 2.5
OURS = {"wiw cpu avx512": "avx512", "wiw cpu avx2": "avx2", "wiw cpu scalar": "scalar"}
PEERS = ("moderngl", "mujoco", "pyrender", "open3d", "pybullet:tiny", "pybullet:egl")
LEAN = ("moderngl:lean-untextured", "moderngl:lean-textured")
PYBULLET_MAX = 500_000  # triangles: beyond, loading takes minutes


@dataclass
class Row:
    name: str
    process: subprocess.Popen | None = None
    note: str = ""
    figures: dict[str, list[dict[str, float]]] = field(default_factory=lambda: {"perspective": [], "panorama": []})

    def ask(self, line: str) -> dict:
        assert self.process is not None and self.process.stdin and self.process.stdout
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline() or "{}")

    def values(self, kind: str, clock: str) -> np.ndarray:
        return np.array([figure[clock] for figure in self.figures[kind]])


def start(name: str, worker: str, python: str, scene: Path, **environment: str) -> Row:
    process = subprocess.Popen(
        [python, HERE / "render_worker.py", worker, scene],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, **environment},
    )  # fmt: skip
    assert process.stdout
    line = process.stdout.readline()
    if not line:
        _, errors = process.communicate()
        return Row(name, note="does not run: " + (errors.strip().splitlines() or ["no message"])[-1][:90])
    return Row(name, process, json.loads(line)["description"])


def start_all(scene: Path, triangles: int, peers: list[str], install: bool) -> list[Row]:
    rows = [start(name, "wiw", sys.executable, scene, WIW_ISA=isa) for name, isa in OURS.items()]
    rows.append(start("wiw gpu", "wiw:gpu", sys.executable, scene))
    for worker in peers:
        if worker.startswith("pybullet") and triangles > PYBULLET_MAX:
            rows.append(Row(worker, note="not run: loads for minutes"))
            continue
        python = environments.python_for(worker.split(":")[0], install)
        rows.append(start(worker, worker, python, scene) if python else Row(worker, note="not installed"))
    return rows


def run_rounds(rows: list[Row], repeats: int) -> None:
    jobs = [(row, kind) for row in rows if row.process for kind in TARGETS]
    for round_index in range(repeats + 1):  # the first round warms up
        random.Random(round_index).shuffle(jobs)
        for row, kind in jobs:
            answer = row.ask(kind)
            if round_index > 0 and answer:
                row.figures[kind].append(answer)


def agreement(rows: list[Row], kind: str, folder: Path) -> dict[str, str]:
    """How far each peer's first picture is from ours: so that nobody is timed drawing something else."""
    pictures = {}
    for row in rows:
        if row.process:
            path = folder / f"{row.name}-{kind}.npz".replace(":", "-").replace(" ", "-")
            row.ask(f"save {kind} {path}")
            if path.exists():
                pictures[row.name] = np.load(path)
    ours = next(iter(pictures.values()))
    same = {}
    for name, picture in pictures.items():
        if picture["ids"].shape != ours["ids"].shape:
            same[name] = "another shape"
            continue
        other_ids = np.mean(picture["ids"] != ours["ids"])
        same[name] = f"{other_ids:7.2%} {np.median(np.abs(picture['depth'] - ours['depth'])):9.1e} m"
    return same


def describe(rows: list[Row]) -> None:
    print("\nWhat each draws:")
    for row in rows:
        print(f"  {row.name:25}{row.note}")


def report(rows: list[Row], kind: str, triangles: int, same: dict[str, str]) -> None:
    base = next((row for row in rows if row.figures[kind]), None)
    if base is None:
        return
    print(f"\n{kind}, {triangles} triangles: ms a frame; ratios to {base.name}, round by round")
    print(f"  {'':25}{'CPU ms':>24}{'wall ms':>24}{'x ours (CPU)':>22}{'x ours (wall)':>22}  other ids, |depth|")
    for row in rows:
        if not row.figures[kind]:
            print(f"  {row.name:25}{row.note}")
            continue
        columns = [spread(row.values(kind, "cpu")), spread(row.values(kind, "wall"))]
        columns += [spread(row.values(kind, c) / base.values(kind, c)) for c in ("cpu", "wall")]
        print(
            f"  {row.name:25}{columns[0]:>24}{columns[1]:>24}{columns[2]:>22}{columns[3]:>22}  {same.get(row.name, '')}"
        )


def verdict(rows: list[Row], kind: str, peers: tuple[str, ...], target: float) -> None:
    ours, drawn = rows[0], [row for row in rows if row.name in peers and row.figures[kind]]
    if not drawn or not ours.figures[kind]:
        print(f"  {kind}: none of {', '.join(peers)} to compare with")
        return
    fastest = min(drawn, key=lambda row: np.median(row.values(kind, "cpu")))
    ratio = fastest.values(kind, "cpu") / ours.values(kind, "cpu")
    print(f"  {kind}: {spread(ratio)} x over {fastest.name}, the fastest of {len(drawn)} (target {target:g} x)")


def bench_size(triangles: int, arguments: argparse.Namespace) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.npz"
        arrays = render_scene.make(triangles)
        if arguments.unordered:
            arrays = render_scene.unordered(arrays)
        render_scene.save(arrays, scene)
        rows = start_all(scene, triangles, arguments.peers, arguments.install)
        describe(rows)
        try:
            run_rounds(rows, arguments.repeats)
            for kind in TARGETS:
                report(rows, kind, len(arrays.triangles), agreement(rows, kind, Path(folder)))
        finally:
            for row in rows:
                if row.process:
                    row.process.kill()
                    row.process.wait()
    for kind, target in TARGETS.items():
        verdict(rows, kind, PEERS, target)
        for lean in LEAN:
            verdict(rows, kind, (lean,), LEAN_TARGETS[kind])
    return {kind: float(np.median(rows[0].values(kind, "cpu"))) for kind in TARGETS if rows[0].figures[kind]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="triangles")
    parser.add_argument("--unordered", action="store_true", help="one mesh whose triangles come in random order")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--peers", nargs="*", default=[*PEERS, *LEAN])
    parser.add_argument("--no-install", dest="install", action="store_false", help="only peers installed already")
    arguments = parser.parse_args([] if __name__ != "__main__" else None)
    ours = {size: bench_size(size, arguments) for size in arguments.sizes}
    if len(ours) > 1:
        least, most = min(ours), max(ours)
        for kind in TARGETS:
            if kind in ours[least] and kind in ours[most]:
                growth = ours[most][kind] / ours[least][kind]
                print(f"growth of {kind} from {least} to {most} triangles: {growth:.2f} x (target at most {GROWTH} x)")


if __name__ == "__main__":
    main()
