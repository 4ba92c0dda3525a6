# SPDX-License-Identifier: Apache-2.0
"""Fair timing on a noisy machine: all cases in one run, in shuffled order, reported as ratios with their spread."""

from __future__ import annotations

import importlib
import os
import random
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Seconds of each repeat: by the clock, and summed over all threads of the process."""

    wall: np.ndarray
    cpu: np.ndarray


def optional(module: str) -> ModuleType | None:
    """The peer if it is installed; its row of the table says "not installed" otherwise."""
    try:
        return importlib.import_module(module)
    except ImportError:
        return None


def measure(cases: Mapping[str, Callable[[], Any] | None], repeats: int = 15, warmup: int = 2) -> dict[str, Timing]:
    """Times every case `repeats` times; each round runs all of them in a new order. None marks an absent peer."""
    present = {name: case for name, case in cases.items() if case is not None}
    wall: dict[str, list[float]] = {name: [] for name in present}
    cpu: dict[str, list[float]] = {name: [] for name in present}
    order = list(present)
    shuffle = random.Random(0).shuffle
    for round_index in range(warmup + repeats):
        shuffle(order)
        for name in order:
            wall_start, cpu_start = time.perf_counter(), time.process_time()
            present[name]()
            seconds = time.perf_counter() - wall_start, time.process_time() - cpu_start
            if round_index >= warmup:
                wall[name].append(seconds[0])
                cpu[name].append(seconds[1])
    return {name: Timing(np.array(wall[name]), np.array(cpu[name])) for name in present}


def spread(values: Sequence[float] | np.ndarray, digits: int = 2) -> str:
    """Median [p25 p75]."""
    low, middle, high = np.percentile(np.asarray(values), [25, 50, 75])
    return f"{middle:.{digits}f} [{low:.{digits}f} {high:.{digits}f}]"


def report(title: str, cases: Mapping[str, Any], timings: Mapping[str, Timing], ours: str, target: str = "") -> None:
    """Prints milliseconds of each case and how many times longer than `ours` it took, round by round."""
    width = max(map(len, cases)) + 2
    busy = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    print(f"\n{title}   ({busy}{f'; target: {target}' if target else ''})")
    print(f"  {'':{width}}{'CPU ms':>26}{'wall ms':>26}{'x ours (CPU)':>24}{'x ours (wall)':>24}")
    for name in cases:
        if name not in timings:
            print(f"  {name:{width}}{'not installed':>26}")
            continue
        timing, base = timings[name], timings[ours]
        print(
            f"  {name:{width}}{spread(1e3 * timing.cpu):>26}{spread(1e3 * timing.wall):>26}"
            f"{spread(timing.cpu / base.cpu):>24}{spread(timing.wall / base.wall):>24}"
        )
