# SPDX-License-Identifier: Apache-2.0
"""`wiw submit` and `wiw cancel`."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.command_line import format_flags
from wiw.cli.parts import AgentFlags, TaskFlags
from wiw.cli.run import AGENT, SEARCH, SETTINGS, TASK, prepare_run
from wiw.errors import ArgumentError
from wiw.loop.config import AgentConfig
from wiw.runs.config import RunConfig
from wiw.runs.shards import Shard
from wiw.runs.submission import ClusterConfig

CLUSTER = ClusterConfig()


def submit(
    task: Positional[Annotated[str, arg(metavar="TASK")]] = "imagenav",
    /,
    *,
    shards: Annotated[int, arg(metavar="N")] = 8,
    jobs: Annotated[ClusterConfig, arg(name="")] = CLUSTER,
    dry_run: bool = False,
    parts: Annotated[AgentFlags, arg(name="")] = AGENT,
    arms: Annotated[str | None, arg(metavar="[NAME=]MODEL[?KEY=VALUE],...")] = None,
    rules: Annotated[TaskFlags, arg(name="")] = TASK,
    search: Annotated[AgentConfig, arg(name="")] = SEARCH,
    config: Annotated[RunConfig, arg(name="")] = SETTINGS,
) -> int:
    """Run an agent in shards, as an array of SLURM jobs. Takes the flags of `wiw run`; needs wiw[slurm].

    $ wiw submit imagenav --arms none,warp --episodes 400 --shards 8 --partition cpu --out runs/a
    $ wiw submit imagenav --world-model svd --shards 4 --partition gpu --gpus 1 --minutes 720 --out runs/b
    $ wiw submit imagenav --arms none,warp --episodes 8 --shards 2 --cluster local --out runs/c
    $ wiw status runs/a
    $ wiw merge runs/a --out runs/a
    $ wiw cancel runs/a

    Prints the command of each job, which a person can run by hand. A job writes its store on the node's own disk and
    copies it to a folder in --out, which all nodes must see. Before the time limit, or when it is preempted, a job
    stops, everything recorded, and is requeued. After a failure the same command submits what is left.

    Args:
        task: See `wiw list`.
        shards: Number of parts of the episodes, each a job.
        jobs: What a job asks of the cluster.
        dry_run: Whether to print the commands and submit nothing.
        parts: The agent.
        arms: As for `wiw run`.
        rules: What it is run on.
        search: Numbers of the search.
        config: How the run goes.
    """
    from wiw.runs.submission import submit_commands

    for name in ("shard", "resume"):
        if getattr(config, name):
            raise ArgumentError(f"submit: --{name} is what each job is given; leave it out")
    prepared = prepare_run(task, parts, arms, rules, search, config)
    folder, count = Path(prepared.settings.out or ""), prepared.count
    Shard(1, shards).select(count)
    parted = [Shard(number, shards) for number in range(1, shards + 1)]
    commands = {shard: _write_command(task, arms, (parts, rules, search), prepared.settings, shard) for shard in parted}
    _require_alone(folder, list(commands.values()))
    left = [command for shard, command in commands.items() if not _is_done(folder / shard.folder)]
    for command in left:
        print(shlex.join(["wiw", *command]))
    if left and not dry_run:
        submitted = submit_commands(folder, left, jobs, f"wiw-{folder.name}")
        print(f"\njobs    {submitted[0].id} to {submitted[-1].id}, output in {folder / 'jobs'}")
    print(f"then    wiw status {folder}\n        wiw merge {folder} --out {folder}")
    return 0


def cancel(run: Positional[Annotated[Path, arg(metavar="RUN")]], /) -> int:
    """Cancel the jobs of a run. Everything recorded is kept; `wiw submit` with the same flags goes on.

    $ wiw cancel runs/a

    Args:
        run: Folder that was given to `wiw submit` as --out.
    """
    from wiw.runs.submission import cancel as cancel_jobs

    told = cancel_jobs(run)
    print(f"{run}: told {len(told)} jobs to end")
    return 0


def _write_command(
    task: str, arms: str | None, flags: tuple[AgentFlags, TaskFlags, AgentConfig], settings: RunConfig, shard: Shard
) -> list[str]:
    """Return the command of a shard as arguments of `wiw`."""
    own = replace(
        settings,
        shard=str(shard),
        out=Path(settings.out or "") / shard.folder,
        scratch=settings.scratch or "auto",
        resume=True,
        progress=False,
    )
    named = [] if arms is None else ["--arms", arms]
    return ["run", task, *named, *(part for each in (*flags, own) for part in format_flags(each))]


def _require_alone(folder: Path, commands: list[list[str]]) -> None:
    """Check that a run is submitted as it was before, and that nothing else writes its shards.

    Raises:
        ArgumentError: other commands were submitted for it before, or jobs of it still wait or run.
    """
    from wiw.runs.submission import find_active, read_jobs

    before = [job.arguments for job in read_jobs(folder)]
    if before and not {tuple(command) for command in commands} >= set(before):
        raise ArgumentError(
            f"submit: {folder} was submitted with other flags, such as: {shlex.join(['wiw', *before[-1]])}; give the "
            "same ones, or another --out"
        )
    if active := find_active(folder):
        raise ArgumentError(
            f"submit: job {active[0].id} of {folder} is {active[0].state}, and {len(active)} in all; wait for them, or "
            f"`wiw cancel {folder}` first"
        )


def _is_done(shard: Path) -> bool:
    """Return whether a shard has ended all its episodes."""
    from wiw.runs.status import status
    from wiw.runs.store import store_path

    return store_path(shard).is_file() and all(store.state == "done" for store in status(shard).stores)
