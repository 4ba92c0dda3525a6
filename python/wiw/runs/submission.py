# SPDX-License-Identifier: Apache-2.0
"""Submit commands as cluster jobs through submitit: one array, each element a command that can be run by hand.

A job is this module's `JobCommand`, which starts the command as a separate process. Before the time limit, and when
it is preempted with a warning, SLURM sends SIGUSR2: the command stops, everything recorded, and submitit requeues the
job. At SIGTERM the command stops likewise, and the job ends with an error; `--requeue` lets SLURM itself start the job
again where it was preempted, and not where it was cancelled, which the job cannot tell apart.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal

from tyro.conf import arg

from wiw.errors import ArgumentError, DependencyError, InfrastructureError, StoreError
from wiw.files import atomic_file
from wiw.json_text import parse_json
from wiw.runs.scratch import STOP_VARIABLE
from wiw.runs.status import status

SIGNAL_DELAY = 90
"""Seconds before the time limit at which SLURM sends SIGUSR2."""
PATIENCE = SIGNAL_DELAY - 15.0
"""Seconds that a command has for stopping, before its job is requeued; `wiw serve` takes 30 by default."""
STOP_SECONDS = PATIENCE - 5.0
"""Seconds after which `wiw run` ends though its store is still being copied to a shared disk."""
STOPPED = frozenset((os.EX_TEMPFAIL, -signal.SIGTERM))
"""Exit codes of commands that were told to stop."""
FILE_NAME = "jobs.json"
LOGS = "jobs"
"""Subfolder of the run's folder with submitit's files and the output of jobs."""
ACTIVE = frozenset(
    (
        *("PENDING", "CONFIGURING", "RUNNING", "SUSPENDED", "REQUEUED", "RESIZING", "COMPLETING", "READY"),
        "UNKNOWN",
    )
)
"""States of jobs that are or may be waiting or running: `sacct` does not know a new job for some seconds."""
OVER = frozenset(("COMPLETED", "CANCELLED", "FAILED", "OUT_OF_MEMORY", "BOOT_FAIL", "DEADLINE"))
"""States of jobs of SLURM that will not run again; after others, such as PREEMPTED or TIMEOUT, one may be requeued."""
ENDED = ("Invalid job id specified", "already completing or completed")
"""What `scancel` says of jobs that have ended."""
INVALID = 1
"""Exit code of a command that has ended with an invalid run, but also of one that has crashed."""


@dataclass(frozen=True, kw_only=True)
class ClusterConfig:
    """Resources that jobs request from the cluster. Anything not given is left to the cluster's defaults.

    Raises:
        ArgumentError: a number out of range.
    """

    cluster: Literal["slurm", "local"] = "slurm"
    """slurm, or local (processes on this machine, all at once, to try a submission)."""
    partition: Annotated[str | None, arg(metavar="NAME")] = None
    """SLURM partition."""
    minutes: Annotated[float, arg(metavar="N")] = 240
    """Time limit of a job in minutes; a job that reaches it is requeued and continues."""
    requeues: Annotated[int, arg(metavar="N")] = 50
    """How often a job may be requeued."""
    gpus: Annotated[int, arg(metavar="N")] = 0
    """GPUs per job."""
    cpus: Annotated[int | None, arg(metavar="N")] = None
    """Cores per job."""
    memory: Annotated[float | None, arg(metavar="GB")] = None
    """Memory per job in gigabytes."""
    parallel: Annotated[int, arg(metavar="N")] = 256
    """Maximum number of jobs of the array that run at the same time."""
    account: Annotated[str | None, arg(metavar="NAME")] = None
    """SLURM account."""
    qos: Annotated[str | None, arg(metavar="NAME")] = None
    """SLURM quality of service."""
    constraint: Annotated[str | None, arg(metavar="FEATURES")] = None
    """SLURM constraint on nodes."""

    def __post_init__(self) -> None:
        for name, least in (("minutes", 0.05), ("requeues", 0), ("gpus", 0), ("cpus", 1), ("parallel", 1)):
            value = getattr(self, name)
            if value is not None and not value >= least:
                raise ArgumentError(f"submit: expected {name} of at least {least}, got {value}")

    def list_parameters(self, name: str) -> dict[str, Any]:
        """Return the parameters of submitit's executor."""
        common = {
            "name": name,
            "timeout_min": self.minutes,
            "gpus_per_node": self.gpus or None,
            "cpus_per_task": self.cpus,
            "mem_gb": self.memory,
        }
        if self.cluster == "local":
            return {key: value for key, value in common.items() if value is not None and key != "mem_gb"}
        common["timeout_min"] = max(1, round(self.minutes))
        slurm = {
            "slurm_partition": self.partition,
            "slurm_account": self.account,
            "slurm_qos": self.qos,
            "slurm_constraint": self.constraint,
            "slurm_signal_delay_s": SIGNAL_DELAY,
            "slurm_array_parallelism": self.parallel,
            "slurm_additional_parameters": {"requeue": True},
        }
        return {key: value for key, value in {**common, **slurm}.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """Resources that the jobs of servers request instead of those of the shards, which run on other nodes.

    Raises:
        ArgumentError: a number out of range.
    """

    server_partition: Annotated[str | None, arg(metavar="NAME")] = None
    """SLURM partition for the jobs of --servers and --vlm-servers. Default: --partition."""
    server_cpus: Annotated[int | None, arg(metavar="N")] = None
    """Cores per server."""
    server_memory: Annotated[float | None, arg(metavar="GB")] = None
    """Memory per server in gigabytes."""
    server_constraint: Annotated[str | None, arg(metavar="FEATURES")] = None
    """SLURM constraint on the nodes of servers."""

    def make_jobs(self, shards: ClusterConfig, count: int, gpus: int) -> ClusterConfig:
        """Return what an array of `count` servers asks for; all run at the same time, as shards wait for all."""
        return replace(
            shards,
            partition=self.server_partition or shards.partition,
            cpus=self.server_cpus,
            memory=self.server_memory,
            constraint=self.server_constraint,
            parallel=count,
            gpus=gpus,
        )


class JobCommand:
    """A wiw command as a job: runs it, stops it when told to, and restarts it when requeued."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self.arguments = list(arguments)
        self._process: subprocess.Popen[bytes] | None = None
        self._is_told = False
        """Whether SIGTERM has come."""

    def __call__(self) -> int:
        """Run the command to completion and return its exit code.

        Raises:
            InfrastructureError: it was stopped, or failed: its exit code is not 0, nor that of an invalid run whose
                episodes have all ended.
        """
        signal.signal(signal.SIGTERM, self._forward_signal)  # before there is a command: submitit lets SIGTERM pass
        environment = {STOP_VARIABLE: f"{STOP_SECONDS:g}", **os.environ}
        process = subprocess.Popen([sys.executable, "-m", "wiw.cli", *self.arguments], env=environment)
        self._process = process
        if self._is_told:
            process.terminate()
        while (code := process.poll()) is None:  # wait() holds a lock that `checkpoint` would wait for
            time.sleep(0.1)
        if self._is_told and code in STOPPED:
            raise InfrastructureError(
                f"stopped by SIGTERM, with everything recorded kept: {self}. SLURM starts it again if it has preempted "
                "the job; otherwise submit it again to continue"
            )
        if code != 0 and not (code == INVALID and _has_run_all(self.arguments)):
            raise InfrastructureError(f"exit code {code} of: {self}; its output says why. Submit it again to continue")
        return code

    def checkpoint(self) -> Any:
        """Stop the command and return it for requeueing; submitit calls this on SIGUSR2."""
        from submitit.helpers import DelayedSubmission

        process = self._process
        if process is not None:
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGTERM)
            _wait_for_end(process.pid)
        return DelayedSubmission(type(self)(self.arguments))

    def __getstate__(self) -> dict[str, Any]:
        return {"arguments": self.arguments, "_process": None, "_is_told": False}

    def __str__(self) -> str:
        return shlex.join(["wiw", *self.arguments])

    def _forward_signal(self, number: int, frame: FrameType | None) -> None:
        self._is_told = True
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, number)


def _has_run_all(arguments: Sequence[str]) -> bool:
    """Return whether all episodes of the run that a command writes have ended."""
    before = "resume" if arguments[0] == "resume" else "--out"
    if before not in arguments:
        return False
    try:
        found = status(arguments[list(arguments).index(before) + 1])
    except StoreError:
        return False
    return all(store.state == "done" for store in found.stores)


def _wait_for_end(process: int) -> None:
    """Wait until a child has ended, and kill it if it takes too long; its exit code is read elsewhere."""
    deadline = time.monotonic() + PATIENCE
    with suppress(ChildProcessError):  # its exit code was taken already
        while os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
            if time.monotonic() > deadline:
                os.kill(process, signal.SIGKILL)
            time.sleep(0.05)


@dataclass(frozen=True)
class SubmittedJob:
    """A job of a run."""

    cluster: str
    id: str
    arguments: tuple[str, ...]
    """Arguments of `wiw`."""
    state: str = ""
    """State reported by the cluster; empty if it was not queried."""


def submit_commands(
    run: str | Path,
    commands: Sequence[Sequence[str]],
    config: ClusterConfig,
    name: str = "wiw",
    after: Sequence[SubmittedJob] = (),
) -> list[SubmittedJob]:
    """Submit wiw commands as one array of jobs, and record them in the run's folder.

    Args:
        run: its folder, which all machines of the cluster see.
        commands: arguments of `wiw`, as in ["run", "imagenav", "--shard", "1/8"].
        config: what each job asks for.
        name: of the jobs.
        after: SLURM jobs that must have begun before any of these does, such as servers.

    Raises:
        DependencyError: submitit is not installed.
        InfrastructureError: this machine has no SLURM, or it refuses.
    """
    submitit = _import_submitit()
    folder = Path(run).expanduser().resolve()
    try:
        timeouts = {} if config.cluster == "local" else {"slurm_max_num_timeout": config.requeues}
        executor = submitit.AutoExecutor(folder / LOGS, cluster=config.cluster, **timeouts)
        begun = {"slurm_dependency": ":".join(("after", *(job.id for job in after)))} if after else {}
        executor.update_parameters(**config.list_parameters(name), **(begun if config.cluster == "slurm" else {}))
        with executor.batch():
            made = [executor.submit(JobCommand(arguments)) for arguments in commands]
    except (RuntimeError, OSError, submitit.core.utils.FailedSubmissionError) as error:
        raise InfrastructureError(
            f"the jobs cannot be submitted: {error}; expected a machine on which sbatch works. To try the commands on "
            "this machine, give --cluster local"
        ) from error
    jobs = [
        SubmittedJob(config.cluster, str(job.job_id), tuple(arguments))
        for job, arguments in zip(made, commands, strict=True)
    ]
    _write_jobs(folder, [*read_jobs(folder), *jobs])
    return jobs


def read_jobs(run: str | Path) -> list[SubmittedJob]:
    """Return the jobs submitted for a run, oldest first, possibly none.

    Raises:
        StoreError: the list of jobs is damaged.
    """
    path = Path(run).expanduser() / FILE_NAME
    if not path.is_file():
        return []
    try:
        return [SubmittedJob(each["cluster"], each["id"], tuple(each["arguments"])) for each in _parse(path)]
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{path} is damaged ({error}); remove it, and check the cluster for its jobs") from error


def find_states(run: str | Path) -> list[SubmittedJob]:
    """Return the jobs of a run with their states, as reported by the cluster.

    Raises:
        StoreError: the list of jobs is damaged.
    """
    folder = Path(run).expanduser().resolve()
    return [SubmittedJob(job.cluster, job.id, job.arguments, _find_state(folder, job)) for job in read_jobs(folder)]


def find_active(run: str | Path) -> list[SubmittedJob]:
    """Return the jobs of a run that are waiting or running according to the cluster, and those it does not know.

    Raises:
        StoreError: the list of jobs is damaged.
    """
    return [job for job in find_states(run) if job.state.partition(" ")[0] in ACTIVE]


def cancel(run: str | Path) -> list[SubmittedJob]:
    """Cancel all jobs of a run that run, or may still run, and return them; everything recorded is kept.

    Raises:
        StoreError: no jobs were submitted for it, or the list of them is damaged.
        InfrastructureError: SLURM cannot be asked to.
    """
    folder = Path(run).expanduser().resolve()
    jobs = read_jobs(folder)
    if not jobs:
        raise StoreError(f"no jobs of {run}: expected a folder of `wiw submit` with {FILE_NAME} in it")
    told = [job for job in find_active(folder) if job.cluster == "local" and _end_controller(job.id)]
    left = [job for job in find_states(folder) if job.cluster == "slurm" and job.state.partition(" ")[0] not in OVER]
    arrays = dict.fromkeys(map(_name_array, left))
    said = {array: _cancel_array(array) for array in arrays}
    if failed := {array: text for array, text in said.items() if text and not _has_ended(text)}:
        raise InfrastructureError(
            f"scancel {' '.join(failed)}: {'; '.join(failed.values())}; expected a machine of the cluster from which "
            "the jobs were submitted"
        )
    return told + [job for job in left if not said[_name_array(job)]]


def _parse(path: Path) -> list[Mapping[str, Any]]:
    return list(parse_json(path.read_text()))


def _write_jobs(folder: Path, jobs: Sequence[SubmittedJob]) -> None:
    listed = [{"cluster": job.cluster, "id": job.id, "arguments": list(job.arguments)} for job in jobs]
    with atomic_file(folder / FILE_NAME) as file:
        file.write_text(json.dumps(listed, indent=1))


def _import_submitit() -> Any:
    try:
        import submitit
    except ModuleNotFoundError:
        raise DependencyError("submitting jobs needs submitit: pip install 'wiw[slurm]'") from None
    return submitit


def _find_state(folder: Path, job: SubmittedJob) -> str:
    if job.cluster == "local":
        return "RUNNING" if _is_controller(job.id) else "ENDED"
    try:
        return str(_import_submitit().SlurmJob(folder / LOGS, job.id).state)
    except (DependencyError, OSError) as error:
        return f"UNKNOWN ({error})"


def _name_array(job: SubmittedJob) -> str:
    return job.id.partition("_")[0]


def _cancel_array(array: str) -> str:
    """Cancel what is left of an array of SLURM jobs; return why that is impossible, if so."""
    try:
        done = subprocess.run(["scancel", array], check=False, capture_output=True, text=True)
    except OSError as error:
        return str(error)
    return "" if done.returncode == 0 else done.stderr.strip() or f"exit code {done.returncode}"


def _has_ended(text: str) -> bool:
    """Return whether scancel says that all jobs of an array have ended; SLURM forgets them after some minutes."""
    return any(each in text for each in ENDED)


def _end_controller(process: str) -> bool:
    """Tell the process that watches a local job to end it; return whether it was found."""
    if not _is_controller(process):
        return False
    with suppress(ProcessLookupError):
        os.kill(int(process), signal.SIGTERM)
    return True


def _is_controller(process: str) -> bool:
    """Return whether a process is one that watches a local job, as process ids are reused."""
    try:
        return b"submitit.local._local" in Path("/proc", process, "cmdline").read_bytes()
    except OSError:
        return False
