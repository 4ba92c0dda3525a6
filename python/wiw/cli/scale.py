# SPDX-License-Identifier: Apache-2.0
"""`wiw scale`."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from wiw.cli.options import Options, default_policy, model_options, policy_options, semantics_options, task_options
from wiw.runs.config import RunConfig

Name = Annotated[str, arg(metavar="NAME")]
Count = Annotated[int, arg(metavar="N")]
Values = Annotated[str | None, arg(metavar="A,B,...")]
SETTINGS = RunConfig()
"""What holds where the command line says nothing."""


def scale(
    task: Positional[Annotated[str, arg(metavar="TASK")]] = "imagenav",
    /,
    *,
    world_model: Name = "warp",
    world_model_option: Options = (),
    policy: Annotated[str | None, arg(metavar="NAME")] = None,
    policy_option: Options = (),
    revision: Annotated[str | None, arg(metavar="NAME")] = None,
    candidates: Values = None,
    imagine_fraction: Values = None,
    tasks: Annotated[str | None, arg(metavar="all|A,B,...")] = None,
    robot: Annotated[Path | None, arg(metavar="URDF")] = None,
    scenes: Annotated[str | None, arg(metavar="SPEC")] = None,
    horizon: Annotated[int | None, arg(metavar="L")] = None,
    preset: Annotated[str | None, arg(metavar="NAME|FILE")] = None,
    task_option: Options = (),
    backend: Literal["auto", "cpu", "gpu"] | None = None,
    vlm: Annotated[str | None, arg(metavar="URL")] = None,
    vlm_model: Annotated[str | None, arg(metavar="NAME")] = None,
    semantics: Annotated[str | None, arg(metavar="NAME")] = None,
    semantics_option: Options = (),
    config: Annotated[RunConfig, arg(name="")] = SETTINGS,
) -> int:
    """Success against the number of futures that a world model imagines, all amounts on the same episodes.

      $ wiw scale imagenav --world-model warp --candidates 1,2,4,8
      $ wiw scale imagenav --world-model my_model.py:MyModel --imagine-fraction 0,0.25,0.5,0.75,1

    The amounts are nested: fewer candidates are the first of the most, and a smaller share of decisions is part of a
    larger one. Writes scale.json and scale.svg beside the run, which `wiw resume` and `wiw report` know as any other.

    Args:
        task: See `wiw list`.
        world_model: Name, path.py:Class or package.module:Class. See `wiw list`.
        world_model_option: An option of the model, such as weights=FOLDER or steps=30; may be given again.
        policy: Proposes plans; name or path.py:Class. If not given, the task's: matcher, for ar
            recogniser, for manipulation scripted.
        policy_option: An option of --policy, such as weights=FILE; may be given again.
        revision: Scores imagined futures; the policy's own choice if not given.
        candidates: Plans imagined at each decision; 1,2,4,8 if neither this nor --imagine-fraction is given.
        imagine_fraction: Shares of decisions for which the world model is consulted, from 0 to 1.
        tasks: For manipulation: which of its tasks, taken in turn; all of them if not given.
        robot: For manipulation: description of an arm to work with, as in `wiw run`.
        scenes: apartments:train|val|test[[:FIRST]:END], a mesh (GLB, glTF, OBJ, PLY, DAE), or a Gazebo world;
            apartments:val if not given.
        horizon: Primitives or poses in a plan; the task's own number if not given.
        preset: Rules of the task: paper, official (its published code), or a YAML file of your own; paper if not
            given. See `wiw list`.
        task_option: A rule of the preset, such as decisions=10, or another option of the task, such as per_scene=2; may
            be given again.
        backend: Renderer; auto if not given.
        vlm: For policy vlm, as in `wiw run`.
        vlm_model: Likewise.
        semantics: Tells world models that need it what each pixel is, as in `wiw run`.
        semantics_option: An option of --semantics; may be given again.
        config: How the run goes; a folder as cache is shared by the amounts.
    """
    from wiw.cli.run import stoppable, vlm_options
    from wiw.runs.recipes import AgentRecipe, TaskRecipe, absolute
    from wiw.studies.scale import scale as run_scale

    policy = policy or default_policy(task)
    model = None if world_model == "none" else absolute(world_model)
    agent = AgentRecipe(
        absolute(policy), model, revision and absolute(revision), horizon=horizon,
        model_options=model_options(model, world_model_option), semantics=semantics and absolute(semantics),
        semantics_options=semantics_options(semantics, semantics_option),
        policy_options=policy_options(
            absolute(policy), policy_option, vlm_options({"vlm": vlm, "model": vlm_model}, [policy, revision or ""])
        ),
    )  # fmt: skip
    seed = config.seed or 0
    flags = {"tasks": tasks, "scenes": scenes, "seed": seed, "preset": preset, "backend": backend, "robot": robot}
    recipe = TaskRecipe(task, task_options(task, task_option, flags))
    folder = Path(config.out or Path("runs") / f"scale-{datetime.now():%Y%m%d-%H%M%S}")
    settings = replace(config, seed=seed, out=folder)
    counts, shares = _numbers(candidates, int, "candidates"), _numbers(imagine_fraction, float, "imagine-fraction")
    found = stoppable(lambda: run_scale(recipe, agent, counts, shares, config=settings), folder)
    found.summary()
    for path in found.save():
        print(path)
    problems = found.log.numbers().invalid
    for reason in problems:
        print(f"INVALID RUN, do not report: {reason}")
    return 1 if problems else 0


def _numbers(text: str | None, kind: Any, name: str) -> list[Any] | None:
    from wiw.errors import ArgumentError

    if text is None:
        return None
    try:
        return [kind(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise ArgumentError(f"--{name}: expected numbers as in 1,2,4, got '{text}'") from None
