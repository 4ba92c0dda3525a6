# SPDX-License-Identifier: Apache-2.0
"""`wiw demo`."""

from __future__ import annotations

import time
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.world_models.base import Requirements

ARMS = ("none", "copy", "warpnet", "warp", "oracle")
SCENES, PER_SCENE = 2, 2


def demo(*, out: Annotated[Path | None, arg(metavar="DIR")] = None) -> int:
    """Image-Goal Navigation in generated apartments, with five world models on the same few episodes.

    An agent sees a photograph and looks for the place where it was taken. Before each decision it imagines where its
    candidate plans would lead: not at all (none), into a world where nothing moves (copy, the floor), into what a
    small network makes of its view (warpnet; needs torch), into its view warped by true depth (warp), or into the true
    future (oracle, the ceiling).

    $ wiw demo

    Args:
        out: Folder of the run; runs/demo-TIME if not given.
    """
    from wiw.cli.run import finish
    from wiw.cli.stop import stoppable
    from wiw.evaluation.evaluate import evaluate
    from wiw.evaluation.recipes import AgentRecipe, TaskRecipe

    begin = time.perf_counter()
    arms = _arms()
    print(
        f"An agent looks for the place where a photograph was taken: {SCENES * PER_SCENE} episodes in {SCENES} "
        f"generated apartments, {len(arms)} world models.\n"
    )
    task = TaskRecipe("imagenav", {"scenes": f"apartments:val:{SCENES}", "per_scene": PER_SCENE})
    folder = out or Path("runs") / f"demo-{datetime.now():%Y%m%d-%H%M%S}"

    def work() -> Any:
        return evaluate(
            task, AgentRecipe("matcher"), SCENES * PER_SCENE, out=folder, arms=arms, live=SCENES * PER_SCENE
        )

    code = finish(stoppable(work, folder), report=True)
    print(
        f"took    {time.perf_counter() - begin:.0f} s. More episodes say more:  "
        f"wiw run imagenav --arms {','.join(arms)} --episodes 100"
    )
    return code


def _arms() -> list[str]:
    """Those that can run here; says which is left out, and why."""
    from wiw.registry import WORLD_MODELS

    arms = []
    for name in ARMS:
        requires = getattr(WORLD_MODELS.find(name), "requires", Requirements())
        if missing := requires.missing():
            print(f"{name} is left out: {', '.join(missing)} not installed (pip install 'wiw[{requires.extra}]')\n")
        else:
            arms.append(name)
    return arms
