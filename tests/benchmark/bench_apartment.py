# SPDX-License-Identifier: Apache-2.0
"""Time to plan, furnish, draw the textures of and bake one apartment, over several seeds."""

from __future__ import annotations

import os
import time

import numpy as np
from harness import spread

from wiw import scenes

SEEDS = 5
TARGET_WALL, TARGET_CPU = 5.0, 9.0  # seconds on two free cores


def main() -> None:
    wall, cpu, rows = [], [], []
    for seed in range(SEEDS):
        started, used = time.perf_counter(), time.process_time()
        scene = scenes.apartment(seed, "val", cache=False)
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - used)
        facts = f"{len(scene.rooms)} rooms, {scene.attributes['area_m2']} m2, {scene.triangle_count} triangles"
        rows.append(f"  seed {seed}: {wall[-1]:6.2f} s wall {cpu[-1]:6.2f} s CPU   {facts}")
    machine = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    print(f"apartment ({machine}); targets {TARGET_WALL:g} s wall, {TARGET_CPU:g} s CPU")
    print("\n".join(rows))
    print(
        f"  wall {spread(np.array(wall))} s, CPU {spread(np.array(cpu))} s; most {max(wall):.2f} and {max(cpu):.2f} s"
    )


if __name__ == "__main__":
    main()
