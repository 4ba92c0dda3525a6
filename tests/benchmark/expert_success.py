# SPDX-License-Identifier: Apache-2.0
"""How many tables of each manipulation task their expert solves, with poses as they are and on the grid of `PoseGrid`.

The expert is asked anew where a plan was not enough, and may go to 15 poses.

python tests/benchmark/expert_success.py                    # 200 tables of each task from seed 50000; half an hour
python tests/benchmark/expert_success.py 20 7 insert_peg    # so many, from this seed, of this task
python tests/benchmark/expert_success.py --robot panda.urdf # with another arm than the project's own
"""

from __future__ import annotations

import argparse

from wiw.action import PoseGrid
from wiw.tabletop.base import TabletopTask
from wiw.tabletop.robot import Robot, load_robot
from wiw.tasks.manipulation import TABLETOP_TASKS

POSES = 15
GRID = PoseGrid()


def solved(kind: TabletopTask, seed: int, on_grid: bool, robot: Robot | None) -> bool:
    """Whether the expert does what the table of a seed asks."""
    setup = kind.create_setup(seed, seed % kind.variations)
    bench, left = setup.build_workbench(robot=robot), POSES
    while left and not kind.is_success(bench, setup):
        plan = kind.plan_expert(bench.get_poses(setup.objects), setup.target)
        for pose in (GRID.decode(GRID.encode(plan)) if on_grid else plan)[:left]:
            bench.move_to(pose)
            left -= 1
            if kind.is_success(bench, setup):
                break
    return kind.is_success(bench, setup)


def main() -> None:
    """Prints a line a task."""
    parser = argparse.ArgumentParser()
    parser.add_argument("count", type=int, nargs="?", default=200)
    parser.add_argument("first", type=int, nargs="?", default=50000)
    parser.add_argument("tasks", nargs="*", default=list(TABLETOP_TASKS))
    parser.add_argument("--robot")
    given = parser.parse_args()
    robot, seeds = given.robot and load_robot(given.robot), range(given.first, given.first + given.count)
    for name in given.tasks:
        free, grid = (
            sum(solved(TABLETOP_TASKS[name], seed, on_grid, robot) for seed in seeds) for on_grid in (False, True)
        )
        print(f"{name:14}{free:5} of {given.count} as they are {grid:5} on the grid", flush=True)


if __name__ == "__main__":
    main()
