# SPDX-License-Identifier: Apache-2.0
"""`wiw run` and `wiw resume`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from wiw.cli.parts import AgentFlags, TaskFlags
from wiw.cli.stop import stoppable
from wiw.cli.terminal import printable
from wiw.loop.config import AgentConfig
from wiw.runs.config import ResumeConfig, RunConfig
from wiw.runs.shards import Shard

if TYPE_CHECKING:
    from wiw.runs.recipes import AgentRecipe, TaskRecipe
    from wiw.tasks.base import Task

AGENT, TASK, SEARCH, SETTINGS, UNCHANGED = AgentFlags(), TaskFlags(), AgentConfig(), RunConfig(), ResumeConfig()
"""What holds where the command line says nothing."""
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

    Ctrl-C (exit code 130) or SIGTERM (75, within 6 seconds) stops a run without loss; `wiw resume` continues it.

    Args:
        task: See `wiw list`.
        parts: The agent.
        arms: World models to run on the same episodes, or POLICY+MODEL for one with another policy; --world-model joins
            them if it is not among them. placebo-shuffled and placebo-swapped let it (or warp) imagine as much, but
            other plans, or from elsewhere; placebo-blind asks a text model with an empty prompt; placebo-shuffled:MODEL
            names another. error-KIND@DOSE lets the futures of the oracle have an error, as error-blur@16 (`wiw list
            errors`), error-blur@16:MODEL those of another model. NAME=MODEL?KEY=VALUE names an arm and gives its model
            options, several with & between them (in quotes), besides those of --world-model-option.
        noise_floor: Also run the arm of --world-model, or the last of --arms, once more with other random numbers
            (reseeded:MODEL, which --arms takes too): the report says how much it differs from itself.
        rules: What it is run on.
        report: Whether to write report.html at the end; none of a shard.
        dry_run: Whether to run nothing, and print what the preset sets and where the run would depart from the paper.
        search: Numbers of the search.
        config: How the run goes.
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
    """Return the text of the arms with one more, which repeats the arm of the world model, or the last one."""
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
    """A run as its flags describe it."""

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
        Error: a part that is not known or does not fit, or a setting out of range.
    """
    from wiw.cli.announcement import announce
    from wiw.runs.arm_text import parse_arm
    from wiw.runs.recipes import arm_recipes

    seed = config.seed or 0
    names = _split_arms(arms, parts.world_model)
    policies = [parse_arm(name).model.partition("+")[0] for name in names or []]
    recipe, agent = rules.make_recipe(task, seed), parts.make_recipe(task, rules.preset, search, policies)
    folder = Path(config.out or Path("runs") / f"{task.rpartition(':')[2]}-{datetime.now():%Y%m%d-%H%M%S}")
    if config.out is None and config.shard is not None:
        folder = folder / Shard.parse(config.shard).folder
    settings, built, recipes = replace(config, seed=seed, out=folder), recipe.build(), arm_recipes(agent, names)
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
    """Go on with a run that was stopped: only the episodes that have not ended are run.

    $ wiw resume runs/first
    $ wiw resume runs/first --retry-errors --deadline 1200

    All that scores or measurements depend on stays as the run was begun.

    Args:
        run: The run's folder.
        workers: Processes; as many as it was begun with if not given.
        retry_errors: Whether to rerun episodes that ended with an infrastructure error.
        scratch: Folder on a local disk, such as /tmp, where the store is written while the run goes on; needed where
            the run's folder is on a network file system.
        engine: As for `wiw run`; what it was begun with if not given.
        address: Ray cluster; the one it was begun with if not given.
        report: Whether to write report.html at the end.
        config: What may change.
    """
    from wiw.studies.evaluate import resume_run

    place = {name: value for name, value in (("engine", engine), ("address", address)) if value is not None}
    again = {"retry_errors": retry_errors, "scratch": scratch, "engine": place, **config.to_json()}
    return finish(stoppable(lambda: resume_run(run, workers, **again), run), report)


def finish(log: Any, report: bool, remark: str = "") -> int:
    """Print tables and errors, write the report, with a remark; return 1 if the run is invalid."""
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
    if log.store.shard is not None:
        print(f"shard   {log.store.shard}; merge all of them with `wiw merge`")
    elif report:
        print(f"report  {log.report(remark=remark)}")
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
