# SPDX-License-Identifier: Apache-2.0
"""Recording of navigation data: a segment beside plainer ways of recording it, and a whole collection by N workers.

The plainer ways render a panorama for every frame, turns included, and leave the compression of depth to OpenCV's
defaults or set it to zlib's own default, 6. All of them have one thread. A worker's efficiency is the CPU time of one
worker over that of N, start-up included, since on a machine with other work the clock says nothing.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ["WIW_NUM_THREADS"] = "1"

import cv2
import numpy as np
from harness import measure, report

from wiw.datasets.navigation import NavigationData
from wiw.datasets.navigation_segment import DEPTH_UNITS, encode_color
from wiw.datasets.worlds import World, world
from wiw.training.navigation_recording import NavigationCollection, record_segment
from wiw.training.traversal import plan_scene

SCENES, SPEC = 4, "apartments:train:4"
WORKERS = (1, 2, 4)


def record_plainly(place: World, poses: np.ndarray, compression: list[int]) -> int:
    """Render and encode every frame; return the bytes."""
    size = 0
    for pose in poses:
        seen = place.renderer.panorama(pose[None], outputs=("color", "depth"))
        units = np.clip(np.rint(seen["depth"][0] * DEPTH_UNITS), 0, 65535).astype(np.uint16)
        size += len(encode_color(seen["color"][0], False)) + len(cv2.imencode(".png", units, compression)[1])
    return size


def compare_segment() -> None:
    place = world("apartments:train/1", "cpu")
    options = NavigationCollection(backend="cpu")
    (traversal, *_) = plan_scene(place.navmesh, place.name, 0, 0, options.rules)
    index = int(np.argsort([len(segment) for segment in traversal.segments])[len(traversal.segments) // 2])
    segment = record_segment(place, place.name, 0, 0, traversal, index, options)
    cases = {
        "ours": lambda: record_segment(place, place.name, 0, 0, traversal, index, options),
        "every frame, OpenCV's PNG": lambda: record_plainly(place, segment.poses, []),
        "every frame, PNG 6": lambda: record_plainly(place, segment.poses, [cv2.IMWRITE_PNG_COMPRESSION, 6]),
    }
    title = f"A segment of {len(segment)} frames, 576 x 1024, colour and depth, one thread"
    timings = measure(cases, repeats=5, warmup=1)
    report(title, cases, timings, ours="ours", target="25 frames a second and core")
    print(f"  ours: {len(segment) / np.median(timings['ours'].cpu):.1f} frames per CPU second")


def collect_apart(folder: Path, workers: int) -> tuple[float, float]:
    """Collect in processes of their own; return seconds by the clock and of CPU."""
    script = folder / "collect.py"
    script.write_text(
        "import sys, wiw\nif __name__ == '__main__':\n"
        f"    wiw.collect_navigation(sys.argv[1], {SPEC!r}, backend='cpu', workers=int(sys.argv[2]))\n"
    )
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, str(script), str(folder / f"data{workers}"), str(workers)], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.perf_counter() - began, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def compare_workers() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(f"\n{SPEC} to disk, one thread a worker   (target: 25 frames a second and core; 1 to N 90 % efficient)")
        first = 0.0
        for workers in WORKERS:
            wall, cpu = collect_apart(folder, workers)
            totals = NavigationData(folder / f"data{workers}").meta["totals"]
            first = first or cpu
            print(
                f"  {workers} workers: {totals['frames']} frames, {totals['bytes'] / 1e9:.2f} GB, wall {wall:.1f} s, "
                f"CPU {cpu:.1f} s, {totals['frames'] / cpu:.1f} frames per CPU second, efficiency {first / cpu:.2f}"
            )


def main() -> None:
    cv2.setNumThreads(1)
    compare_segment()
    compare_workers()


if __name__ == "__main__":
    main()
