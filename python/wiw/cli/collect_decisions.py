# SPDX-License-Identifier: Apache-2.0
"""`wiw collect decisions`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from wiw.cli.announcement import count_noun
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
    """Construct decisions between plans with known outcomes, to compare world models without running episodes.

    $ wiw collect decisions --scenes apartments:val:20 --out decisions.parquet
    $ wiw train ltx-action --data data --decisions decisions.parquet --out runs/ltx

    A decision consists of an observation, a goal within sight, and plans that lead to different places: turn to one of
    16 headings, then step ahead as far as the way is free. A model scores each plan by how similar the panorama it
    imagines at the end is to the goal's; the oracle uses the true panorama. Validation during training reports how well
    the two rankings agree, and how much further from the goal the model's choice ends than the best plan.

    Args:
        scenes: Scenes of any split: apartments:val:20, a mesh, a Gazebo world or scans, as in `wiw run`.
        out: New Parquet file, with one row per plan and one row group per decision.
        per_scene: Decisions per scene; fewer if there is no room for more.
        plans: Plans per decision.
        actions: Maximum number of actions in a plan; no more than in the clips that a model is trained on.
        size: Height and width of the panoramas in pixels.
        seed: Together with scenes and options, it determines the decisions.
    """
    from wiw.datasets.decisions import save_decisions
    from wiw.datasets.parquet_files import require_pyarrow
    from wiw.errors import ArgumentError
    from wiw.training.construct_decisions import DecisionRules
    from wiw.training.construct_decisions import collect_decisions as collect

    if out.exists():
        raise ArgumentError(f"collect: {out} already exists; remove it, or choose another name with --out")
    require_pyarrow("stored decisions")
    rules = DecisionRules(plans=plans, actions=actions, size=size)
    with Bars() as bars:

        def show(name: str, done: int, total: int) -> None:
            bars.show("scenes", done, total, f"{done}/{total}")

        found = collect(scenes, per_scene, seed, rules, show)
    save_decisions(out, found)
    places = count_noun(len(set(found.scenes)), "scene")
    print(f"{count_noun(len(found), 'decision')} between {plans} plans each, in {places}: {out}")
    return 0
