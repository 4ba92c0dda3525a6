# SPDX-License-Identifier: Apache-2.0
"""`wiw submit` and `wiw cancel`."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from wiw.cli.command_line import format_flags
from wiw.cli.parts import AgentFlags, TaskFlags
from wiw.cli.run import AGENT, SEARCH, SETTINGS, TASK, PreparedRun, prepare_run
from wiw.errors import ArgumentError
from wiw.loop import keys
from wiw.loop.config import AgentConfig
from wiw.runs.config import RunConfig
from wiw.runs.hidden_secrets import SECRETS
from wiw.runs.shards import Shard
from wiw.runs.submission import FILE_NAME, ClusterConfig, ServerConfig, SubmittedJob

if TYPE_CHECKING:
    from wiw.runs.recipes import AgentRecipe

CLUSTER, SERVING = ClusterConfig(), ServerConfig()
SERVERS, VLM_SERVERS = "servers", "vlm-servers"
"""Subfolders of the run's folder in which servers of the world model and the language model announce themselves."""
IDLE, AWAIT_FIRST = "1800", "86400"
"""Seconds without a client after which a server exits: after one, and before the first, as shards may have to queue."""


def submit(
    task: Positional[Annotated[str, arg(metavar="TASK")]] = "imagenav",
    /,
    *,
    shards: Annotated[int, arg(metavar="N")] = 8,
    jobs: Annotated[ClusterConfig, arg(name="")] = CLUSTER,
    serving: Annotated[ServerConfig, arg(name="")] = SERVING,
    retry_errors: bool = False,
    dry_run: bool = False,
    parts: Annotated[AgentFlags, arg(name="")] = AGENT,
    arms: Annotated[str | None, arg(metavar="[NAME=]MODEL[?KEY=VALUE],...")] = None,
    rules: Annotated[TaskFlags, arg(name="")] = TASK,
    search: Annotated[AgentConfig, arg(name="")] = SEARCH,
    config: Annotated[RunConfig, arg(name="")] = SETTINGS,
) -> int:
    """Run an agent in shards, as an array of SLURM jobs. Takes the flags of `wiw run`; requires wiw[slurm].

    $ wiw submit imagenav --arms none,warp --episodes 400 --shards 8 --partition cpu --out runs/a
    $ wiw submit imagenav --world-model svd --shards 4 --partition gpu --gpus 1 --minutes 720 --out runs/b
    $ wiw submit imagenav --world-model svd --shards 16 --partition cpu --servers 4 --server-partition gpu --out runs/d
    $ wiw submit ar --policy vlm --vlm transformers:PATH --arms none,warp --shards 8 --vlm-servers 2 --out runs/e
    $ wiw submit imagenav --arms none,warp --episodes 8 --shards 2 --cluster local --out runs/c
    $ wiw status runs/a
    $ wiw merge runs/a --out runs/a
    $ wiw cancel runs/a

    Prints the command of each job, which can also be run by hand. A job writes its store on the node's own disk and
    copies it to a folder in --out, which all nodes must see. Shortly before its time limit, or when preempted, a job
    stops with everything recorded and is requeued. After an error the same command, with the same --out, submits what
    is left.

    Args:
        task: See `wiw list`.
        shards: Number of shards of the episodes, one job each.
        jobs: What the job of a shard requests from the cluster.
        serving: What the job of a server requests instead. A server exits after half an hour without a client, or after
            a day without a first one.
        retry_errors: Also submit finished shards whose episodes include infrastructure errors, to run these again.
        dry_run: Print the commands and submit nothing.
        parts: The agent.
        arms: As for `wiw run`.
        rules: The task's episodes and rules.
        search: The search's parameters.
        config: Settings of the run.
    """
    from wiw.runs.submission import submit_commands

    if shards < 1:
        raise ArgumentError(f"submit: expected --shards of at least 1, got {shards}")
    for name in ("shard", "resume"):
        if getattr(config, name):
            raise ArgumentError(f"submit: --{name} is set for each job; leave it out")
    if config.served is not None:
        raise ArgumentError("submit: --servers always serve --world-model; --served is for --engine ray only")
    if (given := format_flags(serving)) and not (config.servers or config.vlm_servers):
        raise ArgumentError(
            f"submit: {given[0]} is for the jobs of --servers and --vlm-servers: give their number with it"
        )
    prepared = prepare_run(task, parts, arms, rules, search, replace(config, salt=_find_salt(config)))
    _require_no_secrets(prepared)
    folder, count = Path(prepared.settings.out or ""), prepared.count
    Shard(1, shards).select(count)
    servers = _write_servers(folder, prepared, parts.world_model, jobs.cluster)
    if prepared.settings.servers:
        asked = _name_servers(folder, SERVERS)
        parts, arms = (
            replace(parts, world_model=asked, world_model_option=()),
            _ask_servers(prepared, asked),
        )
    if prepared.settings.vlm_servers:
        if any(option.startswith("vlm=") for option in (*parts.policy_option, *parts.revision_option)):
            raise ArgumentError(
                "submit: --vlm-servers serve the language model of --vlm; name it there, not as an option"
            )
        parts = replace(parts, vlm=_name_servers(folder, VLM_SERVERS))
    parted = [Shard(number, shards) for number in range(1, shards + 1)]
    commands = {shard: _write_command(task, arms, (parts, rules, search), prepared.settings, shard) for shard in parted}
    active = _require_alone(folder, [*servers, *commands.values()])
    left, errors = _list_left(folder, commands, retry_errors, str(prepared.settings.scratch or "auto"))
    absent = {command: gpus for command, gpus in servers.items() if left and command not in active}
    for command in [*absent, *left]:
        print(shlex.join(["wiw", *command]))
    if left and not dry_run:
        begun = _submit_servers(folder, absent, jobs, serving)
        submitted = submit_commands(folder, left, jobs, _name_jobs(folder), begun)
        print(f"\njobs    {submitted[0].id} to {submitted[-1].id}, output in {folder / 'jobs'}")
    if not left:
        print("all shards have finished: there is nothing to submit")
    if errors:
        print(f"{errors} episodes ended with an error: once its cause is fixed, add --retry-errors to run them again")
    print(f"then    wiw status {folder}\n        wiw merge {folder} --out {folder}")
    return 0


def cancel(run: Positional[Annotated[Path, arg(metavar="RUN")]], /) -> int:
    """Cancel the jobs of a run. Everything recorded is kept; `wiw submit` with the same flags continues.

    $ wiw cancel runs/a

    Args:
        run: Folder given to `wiw submit` as --out.
    """
    from wiw.runs.submission import cancel as cancel_jobs

    canceled = cancel_jobs(run)
    print(f"{run}: canceled {len(canceled)} jobs")
    return 0


def _find_salt(config: RunConfig) -> str:
    """Return the salt of all shards: the given one, that of an earlier submission, or a new one."""
    from wiw.runs.submission import read_jobs

    if config.salt is not None:
        return config.salt
    before = [job.arguments for job in read_jobs(Path(config.out))] if config.out is not None else []
    found = [own[own.index("--salt") + 1] for own in before if "--salt" in own]
    return found[0] if found else keys.draw_salt()


def _require_no_secrets(prepared: PreparedRun) -> None:
    """Check that no option is a secret: commands of jobs are printed, and kept in files that others can read.

    Raises:
        ArgumentError: one is.
    """
    agents = [prepared.agent, *prepared.recipes.values()]
    found = [name for options in [prepared.task.options, *map(vars, agents)] for name in _find_secrets(options)]
    if found:
        raise ArgumentError(
            f"submit: the option {found[0]}= is a secret, but the command of a job is kept in the run's folder, where "
            f"others can read it: leave it out and set {SECRETS[found[0]]}, which jobs inherit, or name a folder of "
            "announced servers (remote:FOLDER), whose files only you can read"
        )


def _find_secrets(options: Mapping[str, Any]) -> Iterator[str]:
    """Return the names of secrets among options, also in mappings inside, such as roles of policy vlm."""
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from _find_secrets(value)
        elif name in SECRETS and value is not None:
            yield name


def _write_command(
    task: str, arms: str | None, flags: tuple[AgentFlags, TaskFlags, AgentConfig], settings: RunConfig, shard: Shard
) -> list[str]:
    """Return the command of a shard as arguments of `wiw`."""
    own = replace(
        settings,
        **{name: getattr(SETTINGS, name) for name in ("servers", "server_gpus", "vlm_servers", "vlm_server_gpus")},
        shard=str(shard),
        out=Path(settings.out or "") / shard.folder,
        scratch=settings.scratch or "auto",
        resume=True,
        progress=False,
    )
    named = [] if arms is None else ["--arms", arms]
    return ["run", task, *named, *(part for each in (*flags, own) for part in format_flags(each))]


def _require_alone(folder: Path, commands: Sequence[Sequence[str]]) -> set[tuple[str, ...]]:
    """Check that a run is submitted with the same commands as before and no job writes its shards; return active jobs.

    Raises:
        ArgumentError: it was submitted with other commands before, or some of its shards are still waiting or running.
    """
    from wiw.runs.submission import find_active, read_jobs

    before = [job.arguments for job in read_jobs(folder) if job.arguments[0] != "resume"]
    if before and not {tuple(command) for command in commands} >= set(before):
        raise ArgumentError(
            f"submit: {folder} was submitted with other flags, such as: {shlex.join(['wiw', *before[-1]])}; give the "
            "same ones, or another --out"
        )
    active = find_active(folder)
    if shards := [job for job in active if job.arguments[0] in ("run", "resume")]:
        raise ArgumentError(
            f"submit: job {shards[0].id} of {folder} is {shards[0].state} ({len(shards)} active in all); wait for "
            f"them, or `wiw cancel {folder}` first{_explain_unknown(shards[0], folder)}"
        )
    return {job.arguments for job in active}


def _explain_unknown(job: SubmittedJob, folder: Path) -> str:
    """Return what to do if the cluster does not say, or no longer says, what became of a job."""
    if not job.state.startswith("UNKNOWN"):
        return ""
    return f"; if this does not change and the jobs have ended (see squeue), remove {folder / FILE_NAME}"


def _write_servers(folder: Path, prepared: PreparedRun, model: str, cluster: str) -> dict[tuple[str, ...], float]:
    """Return the commands of a run's servers, with the options that the run gives what they serve, and GPUs of each.

    Raises:
        ArgumentError: nothing is to be served, no arm has it, or arms have it with different options.
    """
    from wiw.runs.servers import write_commands, write_vlm_commands

    settings = replace(prepared.settings, served=model if prepared.settings.servers else None)
    if settings.servers and model == "none":
        raise ArgumentError("submit: --servers serve --world-model, but none is given; name one or omit --servers")
    kinds = {
        SERVERS: write_commands(prepared.built, prepared.recipes, settings),
        VLM_SERVERS: write_vlm_commands(prepared.recipes, settings),
    }
    host = "127.0.0.1" if cluster == "local" else "0.0.0.0"
    listen = ("--host", host, "--port", "0", "--idle", IDLE, "--await-first", AWAIT_FIRST)
    return {
        (*command.arguments, *listen, "--announce", str(folder / place / f"{number}.json")): command.gpus
        for place, commands in kinds.items()
        for command in commands
        for number in range(1, command.count + 1)
    }


def _submit_servers(
    folder: Path, commands: Mapping[tuple[str, ...], float], shards: ClusterConfig, config: ServerConfig
) -> list[SubmittedJob]:
    """Submit the servers, one array for those with the same number of GPUs; return their jobs."""
    from wiw.runs.submission import submit_commands

    begun = []
    for gpus in sorted({math.ceil(each) for each in commands.values()}):
        own = [command for command, each in commands.items() if math.ceil(each) == gpus]
        jobs = config.make_jobs(shards, len(own), gpus)
        begun += submit_commands(folder, own, jobs, f"{_name_jobs(folder)}-server")
    return begun


def _name_jobs(folder: Path) -> str:
    return f"wiw-{folder.name}"


def _name_servers(folder: Path, place: str) -> str:
    return f"remote:{(folder / place).expanduser().resolve()}"


def _ask_servers(prepared: PreparedRun, served: str) -> str:
    """Return the arms of a run with its model replaced by the served one, under the same names.

    Arms of the model with another policy, repeated, or as a placebo or with an error, ask the servers too.
    """
    own = str(prepared.agent.model)
    named = zip(prepared.arms or [own], prepared.recipes.items(), strict=True)
    return ",".join(_ask_servers_for_arm(text, name, agent, own, served) for text, (name, agent) in named)


def _ask_servers_for_arm(text: str, name: str, agent: AgentRecipe, own: str, served: str) -> str:
    from wiw.runs.arm_text import parse_arm

    arm = parse_arm(text)
    if agent.model != own or not arm.model.endswith(own):  # an arm that names no model takes --world-model
        return str(arm)
    return f"{name}={arm.model.removesuffix(own)}{served}"  # options are the servers', equal in all arms


def _list_left(
    folder: Path, commands: Mapping[Shard, list[str]], retry_errors: bool, scratch: str
) -> tuple[list[list[str]], int]:
    """Return the commands of shards that are not finished, and how many episodes with an error they do not repeat."""
    from wiw.runs.status import status
    from wiw.runs.store_file import store_path

    left, errors = [], 0
    for shard, command in commands.items():
        own = folder / shard.folder
        (found,) = status(own).stores if store_path(own).is_file() else (None,)
        if found is not None and found.errors and retry_errors:
            left.append(["resume", str(own), "--retry-errors", "--scratch", scratch, "--no-report"])
            continue
        errors += 0 if found is None else found.errors
        if found is None or found.state != "done":
            left.append(command)
    return left, errors
