# SPDX-License-Identifier: Apache-2.0
"""Cost of a view when many environments of one scene are drawn in one call, by batch size and back end.

`gpu` packs all views of a call into one buffer and reads it back once. Its line says on what it ran: llvmpipe is a
processor's OpenGL and says nothing about a GPU.
"""

from __future__ import annotations

import time

import numpy as np
from harness import spread

from wiw import scenes
from wiw.errors import BackendError
from wiw.render import Renderer

SIZE, HFOV, BATCHES, ROUNDS = (144, 256), 105.0, (1, 16, 64, 256), 5


def make_poses(count: int) -> np.ndarray:
    """Places in a row, each looking another way."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angle)
    poses[:, 0, 2], poses[:, 2, 0] = np.sin(angle), -np.sin(angle)
    poses[:, :3, 3] = np.array([2.0, 1.0, 2.0]) + 0.5 * np.arange(count)[:, None] / count
    return poses


def time_views(renderer: Renderer, poses: np.ndarray, batch: int) -> tuple[float, float]:
    """Milliseconds of one of all views, by the clock and summed over threads."""
    wall, cpu = time.perf_counter(), time.process_time()
    for first in range(0, len(poses), batch):
        renderer.perspective(poses[first : first + batch], SIZE, HFOV)
    scale = 1e3 / len(poses)
    return scale * (time.perf_counter() - wall), scale * (time.process_time() - cpu)


def main() -> None:
    scene = scenes.apartment(0, "val")
    poses = make_poses(max(BATCHES))
    print(f"{SIZE[0]}x{SIZE[1]} colour, depth and ids of an apartment of {scene.triangle_count} triangles; ms a view")
    for backend in ("cpu", "gpu"):
        try:
            renderer = Renderer(scene, backend)
        except BackendError as error:
            print(f"  {backend}: not run: {error}")
            continue
        print(f"  {renderer.description}")
        time_views(renderer, poses[:16], 16)
        times = {batch: [] for batch in BATCHES}
        for _ in range(ROUNDS):
            for batch in BATCHES:
                times[batch].append(time_views(renderer, poses, batch))
        for batch in BATCHES:
            wall, cpu = np.transpose(times[batch])
            ratio = np.divide(cpu, np.transpose(times[1])[1])
            print(
                f"    {batch:4} views a call: CPU {spread(cpu)}, wall {spread(wall)}; CPU x one a call {spread(ratio)}"
            )


if __name__ == "__main__":
    main()
