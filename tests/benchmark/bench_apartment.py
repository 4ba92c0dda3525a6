# SPDX-License-Identifier: Apache-2.0
"""Time to plan, furnish, draw the textures of and bake one apartment, over several seeds.

With another checkout's Python, both take turns, each apartment in a process of its own, and the ratio is printed:

python tests/benchmark/bench_apartment.py
python tests/benchmark/bench_apartment.py --against /path/to/another/checkout/.venv/bin/python
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys

import numpy as np
from harness import spread

SEEDS = 5
TARGET_WALL, TARGET_CPU = 5.0, 9.0  # seconds on two free cores
MAKE = """
import json, sys, time
from wiw import scenes
started, used = time.perf_counter(), time.process_time()
scene = scenes.apartment(int(sys.argv[1]), "val", cache=False)
seconds = time.perf_counter() - started, time.process_time() - used
facts = f"{len(scene.rooms)} rooms, {scene.attributes['area_m2']} m2, {scene.triangle_count} triangles"
print(json.dumps([*seconds, facts]))
"""


def make_apartment(python: str, seed: int) -> tuple[float, float, str]:
    """Return wall-clock and CPU seconds of an apartment's generation, and what it has."""
    wall, cpu, facts = json.loads(subprocess.check_output([python, "-c", MAKE, str(seed)]))
    return wall, cpu, facts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", metavar="PYTHON", help="Python of another checkout")
    against = parser.parse_args().against
    machine = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    print(f"apartment ({machine}); targets {TARGET_WALL:g} s wall, {TARGET_CPU:g} s CPU")
    wall, cpu, ratio = [], [], []
    for seed in range(SEEDS):
        one, used, facts = make_apartment(sys.executable, seed)
        wall.append(one)
        cpu.append(used)
        beside = ""
        if against is not None:
            other = make_apartment(against, seed)[1]
            ratio.append(other / used)
            beside = f"   there {other:6.2f} s CPU, {ratio[-1]:.2f} x"
        print(f"  seed {seed}: {one:6.2f} s wall {used:6.2f} s CPU   {facts}{beside}", flush=True)
    print(
        f"  wall {spread(np.array(wall))} s, CPU {spread(np.array(cpu))} s; most {max(wall):.2f} and {max(cpu):.2f} s"
    )
    if ratio:
        print(f"  the other checkout takes {spread(np.array(ratio))} times the CPU")


if __name__ == "__main__":
    main()
