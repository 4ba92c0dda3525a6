# SPDX-License-Identifier: Apache-2.0
"""`wiw run` and `wiw resume`."""

from __future__ import annotations

import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from wiw.cli.options import Options, default_policy, model_options, policy_options, semantics_options, task_options
from wiw.cli.stop import stoppable
from wiw.cli.terminal import printable
from wiw.loop.config import AgentConfig
from wiw.runs.config import RunConfig

SEARCH, SETTINGS = AgentConfig(), RunConfig()
"""What holds where the command line says nothing."""
Name = Annotated[str, arg(metavar="NAME")]
MaybeName = Annotated[str | None, arg(metavar="NAME")]
Count = Annotated[int, arg(metavar="N")]
MaybeCount = Annotated[int | None, arg(metavar="N")]
Folder = Annotated[Path | None, arg(metavar="DIR")]


def run(
    task: Positional[Annotated[str, arg(metavar="TASK")]] = "imagenav",
    /,
    *,
    world_model: Name = "none",
    world_model_option: Options = (),
    policy: MaybeName = None,
    policy_option: Options = (),
    revision: MaybeName = None,
    arms: Annotated[str | None, arg(metavar="A,B,...")] = None,
    tasks: Annotated[str | None, arg(metavar="all|A,B,...")] = None,
    scenes: Annotated[str | None, arg(metavar="SPEC")] = None,
    per_scene: MaybeCount = None,
    episode_file: Annotated[Path | None, arg(metavar="FILE")] = None,
    scene_folder: Folder = None,
    motion: Literal["refuse", "slide"] | None = None,
    robot: Annotated[Path | None, arg(metavar="URDF")] = None,
    preset: Annotated[str | None, arg(metavar="NAME|FILE")] = None,
    task_option: Options = (),
    backend: Literal["auto", "cpu", "gpu"] | None = None,
    vlm: Annotated[str | None, arg(metavar="URL")] = None,
    vlm_model: MaybeName = None,
    vlm_prices: Annotated[Path | None, arg(metavar="FILE")] = None,
    prompts: Folder = None,
    semantics: MaybeName = None,
    semantics_option: Options = (),
    report: bool = True,
    search: Annotated[AgentConfig, arg(name="")] = SEARCH,
    config: Annotated[RunConfig, arg(name="")] = SETTINGS,
) -> int:
    """Run an agent on a task, with one world model or with several on the same episodes.

    $ wiw run imagenav --world-model warp --episodes 50
    $ wiw run imagenav --arms none,copy,warp,oracle --workers 2 --out runs/first
    $ wiw run imagenav --world-model my_model.py:MyModel --arms none,oracle,heuristic+none
    $ wiw run imagenav --scenes house.glb --world-model warp
    $ wiw run imagenav --episode-file val.json.gz --scene-folder scans
    $ wiw run ar --policy vlm --vlm http://localhost:8000/v1 --world-model warp
    $ wiw run manipulation --tasks push_buttons,stack_cups --episodes 40 --arms none,copy,oracle

    Ctrl-C (exit code 130) or SIGTERM (75, within 5 seconds) stops a run without loss; `wiw resume` continues it.

    Args:
        task: See `wiw list`.
        world_model: Name, path.py:Class or package.module:Class. See `wiw list`.
        world_model_option: An option of --world-model, such as weights=FOLDER or steps=30; may be given again.
        policy: Proposes plans; name or path.py:Class. If not given, the task's: matcher, for ar
            recogniser, for manipulation scripted.
        policy_option: An option of --policy, such as weights=FILE; may be given again.
        revision: Scores imagined futures; the policy's own choice if not given.
        arms: World models to run on the same episodes, or POLICY+MODEL for one with another policy; --world-model joins
            them if it is not among them. placebo-shuffled and placebo-swapped let it (or warp) imagine as much, but
            other plans, or from elsewhere; placebo-shuffled:MODEL names another.
        tasks: For manipulation: which of its tasks, taken in turn; all of them if not given.
        scenes: apartments:train|val|test[[:FIRST]:END], a mesh (GLB, glTF, OBJ, PLY, DAE), or a Gazebo world;
            apartments:val if not given.
        per_scene: Episodes generated in a scene before the next one's turn; the task's own number if not given.
        episode_file: Episodes to run instead of generated ones, from `wiw episodes`, habitat-lab or World-in-World.
        scene_folder: Folder of the scene paths in that file; if not given, for files of wiw the file's own folder.
        motion: What happens to a blocked move; the preset's rule if not given.
        robot: For manipulation: description of an arm to work with; the Franka Panda, of simple shapes, if not given.
        preset: Rules of the task: paper, official (its published code), or a YAML file of your own; paper if not
            given. See `wiw list`.
        task_option: A rule of the preset, such as decisions=10, or another option of the task, such as
            categories=bed,sofa; may be given again.
        backend: Renderer; auto if not given.
        vlm: For policy vlm: an OpenAI-compatible server, transformers:PATH, replay:RUN, or mock;
            http://localhost:8000/v1 if not given.
        vlm_model: Its name at the server, or a preset of `wiw list`; not needed where the server has one model.
        vlm_prices: YAML file of `model: [read, written]`, dollars per million tokens, for the costs.
        semantics: Source of semantic labels for world models that need them: simulator, rednet, or path.py:Class.
        semantics_option: An option of --semantics, such as weights=FILE; may be given again.
        prompts: Folder of templates that replace the shipped ones; laid out as wiw/policies/vlm/prompts.
        report: Whether to write report.html at the end.
        search: Numbers of the search.
        config: How the run goes.
    """
    from wiw.cli.announcement import announce
    from wiw.errors import ArgumentError
    from wiw.runs.recipes import AgentRecipe, TaskRecipe, absolute, arm_recipes

    if search.width is not None and search.depth == 1:
        raise ArgumentError("--width: a search of one level extends no plan; give --depth 2 or more, or leave it out")
    seed = config.seed or 0
    flags = {
        "tasks": tasks, "scenes": scenes, "seed": seed, "preset": preset, "backend": backend, "motion": motion,
        "per_scene": per_scene, "episode_file": episode_file, "scene_folder": scene_folder, "robot": robot,
    }  # fmt: skip
    recipe = TaskRecipe(task, task_options(task, task_option, flags))
    policy = policy or default_policy(task)
    model = None if world_model == "none" else absolute(world_model)
    names = _arms(arms, world_model)
    speaking = [policy, revision or "", *(name.partition("+")[0] for name in names or [])]
    asked = {"vlm": vlm, "model": vlm_model, "prices": vlm_prices, "prompts": prompts}
    agent = AgentRecipe(
        absolute(policy), model, revision and absolute(revision), **search.numbers,
        model_options=model_options(model, world_model_option), semantics=semantics and absolute(semantics),
        semantics_options=semantics_options(semantics, semantics_option),
        policy_options=policy_options(absolute(policy), policy_option, vlm_options(asked, speaking)),
    )  # fmt: skip
    folder = Path(config.out or Path("runs") / f"{task.rpartition(':')[2]}-{datetime.now():%Y%m%d-%H%M%S}")
    settings = replace(config, seed=seed, out=folder)
    announce(recipe.build(), arm_recipes(agent, names), settings)
    from wiw.studies.evaluate import evaluate  # after the announcement: it takes seconds to load

    return finish(stoppable(lambda: evaluate(recipe, agent, arms=names, config=settings), folder), report)


def resume(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    workers: MaybeCount = None,
    retry_errors: bool = False,
    report: bool = True,
) -> int:
    """Go on with a run that was stopped: only the episodes that have not ended are run.

    $ wiw resume runs/first

    Args:
        run: The run's folder.
        workers: Processes; as many as it was begun with if not given.
        retry_errors: Whether to rerun episodes that ended with an infrastructure error.
        report: Whether to write report.html at the end.
    """
    from wiw.studies.evaluate import resume_run

    return finish(stoppable(lambda: resume_run(run, workers, retry_errors=retry_errors), run), report)


def finish(log: Any, report: bool) -> int:
    """Print tables and errors, write the report; return 1 if the run is invalid."""
    from wiw.report.tables import print_fidelity

    numbers = log.summary()
    print_fidelity(log)
    errors = [episode for episode in log.episodes if episode["status"] == "error"]
    if errors:
        count = "1 infrastructure error" if len(errors) == 1 else f"{len(errors)} infrastructure errors"
        first, cause = errors[0], errors[0]["error"].strip().splitlines()[-1]
        print(
            f"\n{count}, excluded from scores. "
            f"The first, {first['arm']} episode {first['episode']}: {printable(cause)}",
            file=sys.stderr,
        )
        print(f"Once the cause is fixed:  wiw resume {log.path} --retry-errors", file=sys.stderr)
    print(f"\nset-up  {log.store.info.get('preparation_seconds', 0.0):.1f} s for scenes and episodes")
    if report:
        print(f"report  {log.report()}")
    print(f"run     {log.path}")
    return 1 if numbers.invalid else 0


def vlm_options(given: dict[str, Any], policies: list[str]) -> dict[str, Any]:
    """Return options of policy vlm; its own address, so that the record says where it asked."""
    from wiw.errors import ArgumentError

    named = {name: value for name, value in given.items() if value is not None}
    if "vlm" not in policies:
        if named:
            raise ArgumentError("--vlm, --vlm-model, --vlm-prices and --prompts are for policy vlm: give --policy vlm")
        return {}
    paths = {name: str(value.expanduser().resolve()) for name, value in named.items() if isinstance(value, Path)}
    return {"vlm": {"vlm": "http://localhost:8000/v1", **named, **paths}}


def _arms(arms: str | None, world_model: str) -> list[str] | None:
    from wiw.runs.recipes import absolute

    if arms is None:
        return None
    names = [absolute(name.strip()) for name in arms.split(",") if name.strip()]
    own = absolute(world_model)
    return names if own in names or own == "none" else [*names, own]
