# SPDX-License-Identifier: Apache-2.0
"""Hours of the paper's tables on 1, 8 and 64 GPUs, on paper, from the seconds that a GPU takes for one rollout.

For each arm with a world model:

    hours = (episodes x decisions x candidates x seconds / (GPUs x efficiency) + loading) / 3600

Episodes and arms are the paper's; so are decisions, from its mean trajectories (of ImageNav actions, three a decision);
of A-EQA, whose table has metres, the most that 250 actions allow is taken. Candidates are those of preset paper. Arms
run one after the other, each on all GPUs, which load its weights at once. Not counted: language models, which have GPUs
of their own, the environments, which are on CPUs meanwhile, and Runway, which is on its maker's machines. Identical
plans and plans that only turn are not rolled out, so the true number is smaller.

python tests/benchmark/paper_hours.py             # a rollout takes 1, 10 and 60 s
python tests/benchmark/paper_hours.py 2.5 --efficiency 0.9 --loading 120
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

from wiw.registry import TASKS

GPUS = (1, 8, 64)


@dataclass(frozen=True)
class Table:
    """The arms with a world model of one task."""

    task: str
    arms: int
    episodes: int
    decisions: float
    """Decisions of an episode, on average."""

    @property
    def candidates(self) -> int:
        return int(TASKS.make(self.task, preset="paper").defaults["candidates"])

    @property
    def rollouts(self) -> float:
        """Sum over all arms."""
        return self.arms * self.episodes * self.decisions * self.candidates

    def hours(self, seconds: float, gpus: int, efficiency: float, loading: float) -> float:
        return (self.rollouts * seconds / (gpus * efficiency) + self.arms * loading) / 3600


TABLES = (
    Table("ar", 18, 551, 5.2),  # mean trajectories of 4.7 to 5.7
    Table("imagenav", 18, 144, 47.0 / 3),  # 44.6 to 58.7 actions
    Table("aeqa", 16, 184, 17.0),
    Table("manipulation", 9, 200, (7 * 2.45 + 2 * 4.6) / 9),  # VLM and 3D diffusion policy
)


def format_table(seconds: Sequence[float], efficiency: float, loading: float) -> list[str]:
    lines = [f"{'':14}{'arms':>6}{'episodes':>10}{'decisions':>11}{'candidates':>12}{'rollouts':>10}"]
    lines += [
        f"{each.task:14}{each.arms:6}{each.episodes:10}{each.decisions:11.1f}{each.candidates:12}{each.rollouts:10,.0f}"
        for each in TABLES
    ]
    lines += [f"{'all':14}{sum(each.arms for each in TABLES):6}{sum(each.rollouts for each in TABLES):43,.0f}", ""]
    lines += [f"{'seconds':14}" + "".join(f"{f'{gpus} GPU' + 's' * (gpus > 1):>16}" for gpus in GPUS)]
    for each in seconds:
        hours = [sum(table.hours(each, gpus, efficiency, loading) for table in TABLES) for gpus in GPUS]
        lines.append(f"{each:<14g}" + "".join(f"{f'{value:,.0f} h':>16}" for value in hours))
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("seconds", nargs="*", type=float, default=[1.0, 10.0, 60.0], help="of a GPU, for one rollout")
    parser.add_argument("--efficiency", type=float, default=0.92, help="share of full batches that the run reaches")
    parser.add_argument("--loading", type=float, default=300.0, help="seconds in which a GPU loads the weights")
    given = parser.parse_args()
    print(f"\nefficiency {given.efficiency:g}, loading {given.loading:g} s")
    print("\n".join(format_table(given.seconds, given.efficiency, given.loading)))


if __name__ == "__main__":
    main()
