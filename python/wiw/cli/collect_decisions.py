# SPDX-License-Identifier: Apache-2.0
"""`wiw collect decisions`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from wiw.cli.bars import Bars


def collect_decisions(
    *,
    scenes: Annotated[str, arg(metavar="SPEC")] = "apartments:val:20",
    out: Annotated[Path, arg(metavar="FILE")] = Path("decisions.parquet"),
    per_scene: Annotated[int, arg(metavar="N")] = 5,
    plans: Annotated[int, arg(metavar="M")] = 6,
    actions: Annotated[int, arg(metavar="K")] = 13,
    size: Annotated[tuple[int, int], arg(metavar="H W")] = (576, 1024),
    seed: Annotated[int, arg(metavar="N")] = 0,
) -> int:
    """Construct decisions between plans, with what each would truly lead to, to compare world models without a loop.

    $ wiw collect decisions --scenes apartments:val:20 --out decisions.parquet
    $ wiw train ltx-action --data data --decisions decisions.parquet --out runs/ltx

    A decision has an observation, a goal that is in sight of it, and plans that lead apart: turns to one of 16
    headings, then steps ahead as far as it is free. A model scores each plan by how near the panorama that it imagines
    at the end looks to that of the goal; the oracle scores the true one. Validation while training reports
    how well both orders agree, and how much further from the goal the model's choice ends than the best plan.

    Args:
        scenes: Scenes, which may be of any split: apartments:val:20, a mesh, a Gazebo world or scans, as in `wiw run`.
        out: New Parquet file: a row a plan, a row group a decision.
        per_scene: Decisions in each scene; fewer where there is no room for more.
        plans: Plans of each decision.
        actions: Most actions of a plan; at most those of the clips that a model is trained on.
        size: Height and width of the panoramas in pixels.
        seed: With scenes and options, it determines the decisions.
    """
    from wiw.datasets.decisions import save_decisions
    from wiw.datasets.parquet_files import require_pyarrow
    from wiw.training.construct_decisions import DecisionRules
    from wiw.training.construct_decisions import collect_decisions as collect

    require_pyarrow("stored decisions")
    rules = DecisionRules(plans=plans, actions=actions, size=size)
    with Bars() as bars:

        def show(name: str, done: int, total: int) -> None:
            bars.show("scenes", done, total, f"{done}/{total}")

        found = collect(scenes, per_scene, seed, rules, show)
    save_decisions(out, found)
    print(f"{len(found):,} decisions between {plans} plans each, in {len(set(found.scenes))} scenes: {out}")
    return 0
