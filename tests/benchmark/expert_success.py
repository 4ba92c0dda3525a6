# SPDX-License-Identifier: Apache-2.0
"""How many tables of each manipulation task their expert solves, with poses as they are and on the grid of `PoseGrid`.

The expert is asked anew where a plan was not enough, and may go to 15 poses.

python tests/benchmark/expert_success.py                    # 200 tables of each task from seed 50000; half an hour
python tests/benchmark/expert_success.py 20 7 insert_peg    # so many, from this seed, of this task
"""

from __future__ import annotations

import sys

from wiw.action import PoseGrid
from wiw.tabletop.kind import Kind
from wiw.tasks.manipulation import KINDS

POSES = 15
GRID = PoseGrid()


def solved(kind: Kind, seed: int, on_grid: bool) -> bool:
    """Whether the expert does what the table of a seed asks."""
    setup = kind.setup(seed, seed % kind.variations)
    bench, left = setup.bench(), POSES
    while left and not kind.succeeded(bench, setup):
        plan = kind.expert(bench.places(setup.objects), setup.target)
        for pose in (GRID.decode(GRID.encode(plan)) if on_grid else plan)[:left]:
            bench.go(pose)
            left -= 1
            if kind.succeeded(bench, setup):
                break
    return kind.succeeded(bench, setup)


def main() -> None:
    """Prints a line a task."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 50000
    for name in sys.argv[3:] or KINDS:
        seeds = range(first, first + count)
        free, grid = (sum(solved(KINDS[name], seed, on_grid) for seed in seeds) for on_grid in (False, True))
        print(f"{name:14}{free:5} of {count} as they are {grid:5} on the grid", flush=True)


if __name__ == "__main__":
    main()
