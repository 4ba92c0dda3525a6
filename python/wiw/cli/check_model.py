# SPDX-License-Identifier: Apache-2.0
"""`wiw check-model`."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.options import Options, model_options

MARKS = {
    "passed": "[green]passed [/]",
    "wrong": "[red]wrong  [/]",
    "note": "[yellow]note   [/]",
    "skipped": "[dim]skipped[/]",
}


def check_model(
    model: Positional[Annotated[str, arg(metavar="MODEL")]],
    /,
    *,
    world_model_option: Options = (),
    scenes: Annotated[str, arg(metavar="SPEC")] = "apartments:val:1",
    deadline: Annotated[float, arg(metavar="SECONDS")] = 300.0,
) -> int:
    """Request a few rollouts from a world model and say in plain words what is wrong with them.

    $ wiw check-model my_model.py:MyModel
    $ wiw check-model svd --world-model-option steps=2
    $ wiw check-model remote:ws://127.0.0.1:8765

    Every check is listed with its result: type, dtype, shape, number of frames and NaN; frame 0; channel order, scale,
    orientation and temporal order of the frames, compared with the agent's true views; networks left in training mode;
    whether the model modifies its inputs or earlier outputs; whether the same seeds give the same frames, whether a row
    depends on the others in its batch, whether `causal` holds, whether the plan makes a difference; and how long a
    rollout takes. Exit code 1 if the contract is broken.

    Args:
        model: Name, path.py:Class, package.module:Class, or remote:ws://HOST:PORT. See `wiw list`.
        world_model_option: An option of the model, such as weights=FOLDER or steps=30; may be repeated.
        scenes: Source of the observations: apartments:val:1, a mesh, a Gazebo world or scans, as in `wiw run`. Models
            controlled by gripper poses are shown manipulation tables instead.
        deadline: Time limit in seconds for a call to the model or its constructor, as in `wiw run`.
    """
    from rich.console import Console
    from rich.markup import escape

    from wiw.studies import model_check

    options = model_options(model, world_model_option)
    checks = model_check.examine_model(model, scenes, deadline=deadline, **options)
    console = Console(highlight=False, soft_wrap=True)
    for check in checks:
        question = escape(check.detail or model_check.CHECKS[check.name])
        because = escape(f" ({check.skipped})") if check.skipped else ""
        console.print(f"{MARKS[check.result]}  [bold]{check.name:<12}[/]  {question}{because}")
        for finding in check.findings:
            console.print(f"{'':>9}{escape(finding.kind)}: {escape(finding.text)}")
    broken = any(check.result == "wrong" for check in checks)
    console.print(f"{escape(model)} {'breaks its contract' if broken else 'keeps its contract'}")
    return int(broken)
