# SPDX-License-Identifier: Apache-2.0
"""`wiw run` and `wiw resume`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from wiw.cli.parts import AgentFlags, TaskFlags
from wiw.cli.stop import stoppable
from wiw.cli.terminal import printable
from wiw.errors import read_last_line
from wiw.loop.config import AgentConfig
from wiw.runs.config import ResumeConfig, RunConfig, name_folder
from wiw.runs.shards import Shard

if TYPE_CHECKING:
    from wiw.runs.recipes import AgentRecipe, TaskRecipe
    from wiw.tasks.base import Task

AGENT, TASK, SEARCH, SETTINGS, UNCHANGED = AgentFlags(), TaskFlags(), AgentConfig(), RunConfig(), ResumeConfig()
"""The defaults of the command line."""
MaybeCount = Annotated[int | None, arg(metavar="N")]


def run(
    task: Positional[Annotated[str, arg(metavar="TASK")]] = "imagenav",
    /,
    *,
    parts: Annotated[AgentFlags, arg(name="")] = AGENT,
    arms: Annotated[str | None, arg(metavar="[NAME=]MODEL[?KEY=VALUE],...")] = None,
    noise_floor: bool = False,
    rules: Annotated[TaskFlags, arg(name="")] = TASK,
    report: bool = True,
    dry_run: bool = False,
    search: Annotated[AgentConfig, arg(name="")] = SEARCH,
    config: Annotated[RunConfig, arg(name="")] = SETTINGS,
) -> int:
    """Run an agent on a task, with one world model or with several on the same episodes.

    $ wiw run imagenav --world-model warp --episodes 50
    $ wiw run imagenav --arms none,copy,warp,oracle --workers 2 --out runs/first
    $ wiw run imagenav --world-model my_model.py:MyModel --arms none,oracle,heuristic+none
    $ wiw run imagenav --arms none,big=warpnet?weights=big.safetensors,small=warpnet?weights=small.safetensors,oracle
    $ wiw run imagenav --scenes house.glb --world-model warp
    $ wiw run imagenav --preset foresight --tier all --episodes 180 --arms none,warp,oracle
    $ wiw run imagenav --episode-file val.json.gz --scene-folder scans
    $ wiw run ar --policy vlm --vlm http://localhost:8000/v1 --world-model warp
    $ wiw run manipulation --tasks push_buttons,stack_cups --episodes 40 --arms none,copy,oracle
    $ wiw run ar --preset official --policy vlm --world-model svd --dry-run
    $ wiw run imagenav --arms none,warp --episodes 400 --until "warp-none excludes 0"
    $ wiw run imagenav --arms none,warp --episodes 400 --salt 7f3a --shard 3/8 --out runs/a/3 --resume
    $ wiw run imagenav --policy isolated:my_policy.py:MyPolicy --world-model my_model.py:MyModel

    Ctrl-C (exit code 130) or SIGTERM (75, within 6 seconds; with --scratch within 60, in which the store is copied)
    stops a run without losing anything recorded; `wiw resume` continues it.

    Args:
        task: Name of the task; see `wiw list`.
        parts: The agent.
        arms: World models to run on the same episodes, or POLICY+MODEL for one with another policy; --world-model is
            added if it is not among them. placebo-shuffled and placebo-swapped let that model (or warp) compute as
            much, but imagine other plans, or from another episode; placebo-blind gives a text model an empty prompt;
            placebo-shuffled:MODEL uses another model. error-KIND@DOSE, such as error-blur@16, adds an error to the
            oracle's futures (`wiw list errors`); error-blur@16:MODEL adds it to another model's. NAME=MODEL?KEY=VALUE
            names an arm and sets options of its model, separated by & (quote it), in addition to --world-model-option.
        noise_floor: Also rerun the arm of --world-model, or the last of --arms, with other random numbers
            (reseeded:MODEL, which --arms also accepts): the report says how much the arm differs from itself.
        rules: The task's episodes and rules.
        report: Whether to write report.html at the end; shards have none.
        dry_run: Run nothing; print what the preset sets and where the run would depart from the paper.
        search: The search's parameters.
        config: Settings of the run.
    """
    from wiw.cli.announcement import announce_protocol

    arms = add_noise_floor(arms, parts.world_model) if noise_floor else arms
    made = prepare_run(task, parts, arms, rules, search, config)
    if dry_run:
        announce_protocol(made.built, made.recipes, made.count)
        return 0
    from wiw.studies.evaluate import evaluate  # after the announcement: it takes seconds to load

    folder = Path(made.settings.out or "")
    work = lambda: evaluate(made.task, made.agent, arms=made.arms, config=made.settings)  # noqa: E731
    return finish(stoppable(work, folder), report)


def add_noise_floor(arms: str | None, world_model: str) -> str:
    """Return the arms with one more, which repeats the arm of the world model, or the last one."""
    from wiw.runs.arm_text import parse_arm, split_arms
    from wiw.runs.recipes import RESEEDED

    texts = [world_model] if arms is None else split_arms(arms)
    repeated = parse_arm(world_model if world_model != "none" else texts[-1])
    policy, plus, model = repeated.model.rpartition("+")
    name = "" if repeated.name is None else f"{RESEEDED}-{repeated.name}="
    again = replace(repeated, name=None, model=f"{policy}{plus}{RESEEDED}:{model}")
    return ",".join([*texts, f"{name}{again}"])


@dataclass(frozen=True)
class PreparedRun:
    """A run as described by its flags."""

    task: TaskRecipe
    agent: AgentRecipe
    arms: list[str] | None
    settings: RunConfig
    """With seed and folder."""
    built: Task
    recipes: Mapping[str, Any]
    """Agents by arm."""

    @property
    def count(self) -> int:
        """Number of episodes."""
        return self.built.default_episodes if self.settings.episodes is None else self.settings.episodes


def prepare_run(
    task: str, parts: AgentFlags, arms: str | None, rules: TaskFlags, search: AgentConfig, config: RunConfig
) -> PreparedRun:
    """Check the flags of a run, announce it, and return what they describe.

    Raises:
        Error: an unknown or unsuitable part, or a setting out of range.
    """
    from wiw.cli.announcement import announce
    from wiw.runs.arm_text import parse_arm
    from wiw.runs.recipes import arm_recipes

    names = _split_arms(arms, parts.world_model)
    policies = [parse_arm(name).model.partition("+")[0] for name in names or []]
    recipe, agent = rules.make_recipe(task, config.seed), parts.make_recipe(task, rules.preset, search, policies)
    folder = Path(config.out or name_folder(task.rpartition(":")[2]))
    if config.out is None and config.shard is not None:
        folder = folder / Shard.parse(config.shard).folder
    built, recipes = recipe.build(), arm_recipes(agent, names)
    settings = replace(config, seed=built.seed if config.seed is None else config.seed, out=folder)
    announce(built, recipes, settings)
    return PreparedRun(recipe, agent, names, settings, built, recipes)


def resume(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    workers: MaybeCount = None,
    retry_errors: bool = False,
    scratch: Annotated[Path | None, arg(metavar="DIR")] = None,
    engine: Literal["processes", "ray"] | None = None,
    address: Annotated[str | None, arg(metavar="ADDRESS")] = None,
    report: bool = True,
    config: Annotated[ResumeConfig, arg(name="")] = UNCHANGED,
) -> int:
    """Resume a run that was stopped: only the episodes that have not finished are run.

    $ wiw resume runs/first
    $ wiw resume runs/first --retry-errors --deadline 1200

    Everything that scores or measurements depend on stays as it was when the run was started.

    Args:
        run: The run's folder.
        workers: Number of processes. Default: as many as before.
        retry_errors: Whether to rerun episodes that ended with an infrastructure error.
        scratch: Folder on a local disk, such as /tmp, where the store is written during the run; needed if the run's
            folder is on a network file system. What a killed process left in an earlier one is taken in.
        engine: As for `wiw run`. Default: the engine it was started with.
        address: Ray cluster. Default: the one it was started with.
        report: Whether to write report.html at the end.
        config: Settings that may change.
    """
    from wiw.studies.evaluate import resume_run

    place = {name: value for name, value in (("engine", engine), ("address", address)) if value is not None}
    again = {"retry_errors": retry_errors, "scratch": scratch, "engine": place, **config.to_json()}
    return finish(stoppable(lambda: resume_run(run, workers, **again), run), report)


def finish(log: Any, report: bool, remark: str = "") -> int:
    """Print tables and errors, and write the report with a remark; return 1 if the run is invalid."""
    from wiw.report.page import write_report
    from wiw.report.tables import print_fidelity

    numbers = log.summary()
    print_fidelity(log)
    errors = [episode for episode in log.episodes if episode["status"] == "error"]
    if errors:
        count = "1 infrastructure error" if len(errors) == 1 else f"{len(errors)} infrastructure errors"
        print(f"\n{count}, excluded from scores. The first:", file=sys.stderr)
        for first in {episode["arm"]: episode for episode in reversed(errors)}.values():
            cause = printable(read_last_line(first["error"]))
            print(f"{first['arm']} episode {first['episode']}: {cause}", file=sys.stderr)
        print(f"Once the cause is fixed:  {log.store.resume_command} --retry-errors", file=sys.stderr)
    print(f"\nset-up  {log.store.info.get('preparation_seconds', 0.0):.1f} s to prepare scenes and episodes")
    if log.store.shard is not None:
        print(f"shard   {log.store.shard}; merge all shards with `wiw merge`")
    elif report:
        print(f"report  {write_report(log, log.path / 'report.html', remark=remark, summary=numbers)}")
    print(f"run     {log.path}")
    return 1 if numbers.invalid else 0


def _split_arms(arms: str | None, world_model: str) -> list[str] | None:
    from wiw.runs.arm_text import parse_arm, split_arms
    from wiw.runs.recipes import absolute, make_arm_absolute

    if arms is None:
        return None
    texts = [make_arm_absolute(text) for text in split_arms(arms)]
    own = absolute(world_model)
    parsed = map(parse_arm, texts)
    is_among = own == "none" or any(arm.model == own and not arm.options for arm in parsed)
    return texts if is_among else [*texts, own]
