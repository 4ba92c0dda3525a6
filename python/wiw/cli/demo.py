# SPDX-License-Identifier: Apache-2.0
"""`wiw demo`."""

from __future__ import annotations

import shutil
import textwrap
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.world_models.base import Requirements


@dataclass(frozen=True)
class Part:
    """One task in the demo."""

    task: str
    policy: str
    arms: tuple[str, ...]
    episodes: int
    about: str
    """The story, as the beginning of a sentence that ends with the number of world models."""
    more: str
    """A command for more of the same."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the task."""
    requires: Requirements = field(default_factory=Requirements)
    """Packages that the policy needs."""


TORCH = Requirements(("torch", "safetensors"), "torch")
PARTS = (
    Part(
        "imagenav",
        "matcher",
        ("none", "copy", "warpnet", "warp", "oracle"),
        4,
        "An agent looks for the place where a photograph was taken: 4 episodes in 2 generated apartments",
        "wiw run imagenav --arms none,copy,warpnet,warp,oracle --episodes 100",
        {"scenes": "apartments:val:2", "per_scene": 2},
    ),
    Part(
        "ar",
        "recogniser",
        ("none", "warp", "oracle"),
        4,
        "An agent looks at an object from several sides until it recognises it: 4 episodes in 2 generated apartments",
        "wiw run ar --arms none,copy,warp,oracle --episodes 100",
        {"scenes": "apartments:val:2", "per_scene": 2},
        TORCH,
    ),
    Part(
        "aeqa",
        "explorer",
        ("none", "oracle"),
        2,
        "An agent explores a home until it can answer a question about it: 2 questions in 2 generated apartments",
        "wiw run aeqa --arms none,warp,oracle --episodes 100",
        {"scenes": "apartments:val:2", "per_scene": 2},
        TORCH,
    ),
    Part(
        "manipulation",
        "scripted",
        ("none", "copy", "oracle"),
        4,
        "A robot arm pushes buttons in a given order: 4 episodes",
        "wiw run manipulation --arms none,copy,armnet,oracle",
        {"tasks": "push_buttons"},
    ),
)


READY = "docs/report-imagenav.html in the source tree is a finished report of 100 episodes."
WORKERS = 2
"""Processes that share the arms of a task."""


def demo(*, out: Annotated[Path | None, arg(metavar="DIR")] = None) -> int:
    """Run all four tasks, each with several world models: three in generated apartments, one with a robot arm.

    Image-Goal Navigation, Active Recognition, Active Embodied Question Answering, Robotic Manipulation.

    Before each decision an agent imagines where its candidate plans would lead. The world models differ in what they
    imagine: nothing at all (none), the present view, unchanged (copy, the floor), a view predicted by a small network
    (warpnet; needs torch), the present view warped by true depth (warp), or the true future (oracle, a reference).

    $ wiw demo

    Args:
        out: Folder for the runs, one per task. Default: runs/demo-TIME-XXXX.
    """
    from wiw.runs.config import name_folder

    begin = time.perf_counter()
    folder = out or name_folder("demo")
    parts = [part for part in PARTS if _can_run(part)]
    codes = [_run(part, folder / part.task) for part in parts]
    print(f"\ntook    {time.perf_counter() - begin:.0f} s\n")
    _print_wrapped(f"Open these pages in a browser. {READY}")
    for part in parts:
        print(f"        {folder / part.task / 'report.html'}")
    print("\nFor firmer numbers, run more episodes:")
    for part in parts:
        print(f"        {part.more}")
    return max(codes)


def _can_run(part: Part) -> bool:
    """Return whether a part's policy can run here; if not, print what is missing."""
    if missing := part.requires.missing():
        _print_left_out(f"{part.task} with policy {part.policy}", missing, part.requires.extra)
    return not missing


def _print_left_out(what: str, missing: list[str], extra: str) -> None:
    print(f"{what} is skipped: {', '.join(missing)} not installed (pip install 'wiw[{extra}]')\n")


def _print_wrapped(text: str) -> None:
    """Print a text wrapped to the width of the terminal."""
    print(textwrap.fill(text, shutil.get_terminal_size().columns - 1, break_on_hyphens=False, break_long_words=False))


def _run(part: Part, folder: Path) -> int:
    """Run one part, with its table and report; return its exit code."""
    from wiw.cli.run import finish
    from wiw.cli.stop import stoppable
    from wiw.runs.recipes import AgentRecipe, TaskRecipe
    from wiw.studies.evaluate import evaluate

    arms = _choose_arms(part.arms)
    print()
    _print_wrapped(f"{part.about}, {len(arms)} world models.")
    print()
    task, agent = TaskRecipe(part.task, part.options), AgentRecipe(part.policy)

    def work() -> Any:
        return evaluate(task, agent, part.episodes, out=folder, workers=WORKERS, arms=arms, live=part.episodes)

    return finish(stoppable(work, folder), report=True, remark=f"A demonstration with only a few episodes. {READY}")


def _choose_arms(names: tuple[str, ...]) -> list[str]:
    """Return the arms that can run here; print which is skipped, and why."""
    from wiw.registry import WORLD_MODELS

    arms = []
    for name in names:
        requires = getattr(WORLD_MODELS.find(name), "requires", Requirements())
        if missing := requires.missing():
            _print_left_out(name, missing, requires.extra)
        else:
            arms.append(name)
    return arms
