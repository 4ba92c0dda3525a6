# SPDX-License-Identifier: Apache-2.0
"""Start a training on several GPUs: on this machine with torchrun, on several machines with torchrun in a SLURM job.

Each process runs the same command. torchrun tells each one its rank through environment variables.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.errors import ArgumentError, DependencyError, InfrastructureError

PORT = 29500
"""Port of the first machine, where torchrun's agents meet."""
STOP_SECONDS = 600
"""Seconds that a stopped training has for finishing its step and writing its state: before torchrun kills its
processes, and between SLURM's signal and the time limit."""


@dataclass(frozen=True, kw_only=True)
class ProcessLayout:
    """The processes of a training, and the resources of their SLURM job, if any.

    Raises:
        ArgumentError: a number out of range.
    """

    gpus: Annotated[int, arg(metavar="N")] = 1
    """GPUs per machine to train a video model on, one process each; processes on the CPU if there are none."""
    nodes: Annotated[int, arg(metavar="N")] = 1
    """Number of machines. With several, or with a partition, training is submitted as a SLURM job, which requires
    wiw[slurm]."""
    partition: Annotated[str | None, arg(metavar="NAME")] = None
    """SLURM partition."""
    hours: Annotated[float, arg(metavar="N")] = 24.0
    """Time limit of the SLURM job in hours; a job that reaches it is requeued and resumes."""
    requeues: Annotated[int, arg(metavar="N")] = 50
    """How often the job may be requeued."""
    cpus: Annotated[int | None, arg(metavar="N")] = None
    """Cores per machine."""
    memory: Annotated[float | None, arg(metavar="GB")] = None
    """Memory per machine in gigabytes."""
    account: Annotated[str | None, arg(metavar="NAME")] = None
    """SLURM account."""
    qos: Annotated[str | None, arg(metavar="NAME")] = None
    """SLURM quality of service."""
    constraint: Annotated[str | None, arg(metavar="FEATURES")] = None
    """SLURM constraint on nodes."""

    def __post_init__(self) -> None:
        for name, least in (("gpus", 1), ("nodes", 1), ("hours", 0.5), ("requeues", 0), ("cpus", 1)):
            value = getattr(self, name)
            if value is not None and not value >= least:
                raise ArgumentError(f"expected --{name} of at least {least}, got {value}")
        of_jobs = (each for each in fields(self) if each.name not in ("gpus", "nodes", "partition"))
        given = [f"--{each.name}" for each in of_jobs if getattr(self, each.name) != each.default]
        if given and not self.is_job:
            raise ArgumentError(
                f"{', '.join(given)}: only for SLURM jobs; name a --partition, or leave this out to train on this "
                "machine"
            )

    @property
    def count(self) -> int:
        """Number of processes."""
        return self.gpus * self.nodes

    @property
    def is_job(self) -> bool:
        """Whether the training is a SLURM job."""
        return self.nodes > 1 or self.partition is not None

    def list_parameters(self, name: str) -> dict[str, Any]:
        """Return the parameters of submitit's executor."""
        found = {
            "name": name,
            "nodes": self.nodes,
            "tasks_per_node": 1,
            "gpus_per_node": self.gpus,
            "cpus_per_task": self.cpus,
            "mem_gb": self.memory,
            "timeout_min": round(60 * self.hours),
            "slurm_partition": self.partition,
            "slurm_account": self.account,
            "slurm_qos": self.qos,
            "slurm_constraint": self.constraint,
            "slurm_signal_delay_s": STOP_SECONDS,
            "slurm_additional_parameters": {"requeue": True},
        }
        return {key: value for key, value in found.items() if value is not None}


def count_started() -> int:
    """Return how many processes torchrun has started of this program, with this one; 1 where it was not torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def require_single_process(what: str, instead: str) -> None:
    """Check that torchrun has not started what runs, or starts processes, by itself.

    Args:
        what: for the message.
        instead: for the message, a clause that says what to do.

    Raises:
        ArgumentError: torchrun has started several processes of this program.
    """
    if count_started() > 1:
        raise ArgumentError(f"{what}: expected a single process, got {count_started()} from torchrun; {instead}")


def write_command(arguments: Sequence[str], layout: ProcessLayout) -> str:
    """Return the command that a person can run by hand, on each machine; HOST stands for the first one's name."""
    return shlex.join(["torchrun", *list_options(layout, "HOST", "wiw"), *_list_module(arguments)])


def list_options(layout: ProcessLayout, host: str, name: str) -> list[str]:
    """Return torchrun's options, for machines that meet at a host under a name."""
    processes = ["--nproc-per-node", str(layout.gpus)]
    if layout.nodes == 1:
        return ["--standalone", *processes]
    meeting = ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"{host}:{PORT}", "--rdzv-id", name]
    return ["--nnodes", str(layout.nodes), *processes, *meeting]


def run_processes(arguments: Sequence[str], layout: ProcessLayout) -> int:
    """Run a command of wiw on several processes of this machine, and return its exit code.

    SIGTERM and Ctrl-C are passed on to all processes, and do once these have ended what they would have done.
    """
    from torch.distributed import run
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

    os.environ |= {key: os.environ.get(key, value) for key, value in _list_settings(layout).items()}
    stopped, code = 0, 0
    with _release_signals():
        try:
            run.run(run.parse_args([*list_options(layout, "localhost", "wiw"), *_list_module(arguments)]))
        except ChildFailedError as error:
            code = max(1, error.get_first_failure()[1].exitcode)
        except SignalException as stop:
            stopped = stop.sigval
    if stopped:
        signal.raise_signal(stopped)
    return code


@contextmanager
def _release_signals() -> Iterator[None]:
    """Let torchrun handle signals, as long as the context lasts."""
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
    earlier = {number: signal.getsignal(number) for number in numbers}
    wakeup = signal.set_wakeup_fd(-1)  # its reader may end the process before the others have ended
    try:
        yield
    finally:
        signal.set_wakeup_fd(wakeup)
        for number, handler in earlier.items():
            signal.signal(number, handler)


def _list_settings(layout: ProcessLayout) -> dict[str, str]:
    """Return environment variables of torchrun: the time for stopping, and threads for each process."""
    threads = max(1, len(os.sched_getaffinity(0)) // layout.gpus)
    return {"TORCH_ELASTIC_SHUTDOWN_TIMEOUT": str(STOP_SECONDS), "OMP_NUM_THREADS": str(threads)}


def _list_module(arguments: Sequence[str]) -> list[str]:
    return ["-m", "wiw.cli", *arguments]


def submit_job(arguments: Sequence[str], layout: ProcessLayout, folder: str | Path) -> str:
    """Submit a command of wiw as a SLURM job with a process per GPU, and return the job's number.

    Raises:
        DependencyError: submitit is not installed.
        InfrastructureError: this machine has no SLURM, or it refuses.
    """
    try:
        import submitit
    except ModuleNotFoundError:
        raise DependencyError("submitting jobs needs submitit: pip install 'wiw[slurm]'") from None
    place = Path(folder).expanduser().resolve()
    try:
        executor = submitit.AutoExecutor(place, cluster="slurm", slurm_max_num_timeout=layout.requeues)
        executor.update_parameters(**layout.list_parameters(f"wiw-{arguments[1]}"))
        return str(executor.submit(TrainingJob(arguments, layout)).job_id)
    except (RuntimeError, OSError, submitit.core.utils.FailedSubmissionError) as error:
        raise InfrastructureError(
            f"the job cannot be submitted: {error}; expected a machine on which sbatch works. --dry-run prints the "
            "command to run on each machine by hand"
        ) from error


class TrainingJob:
    """A SLURM job: on each of its machines, torchrun with the command; stopped and requeued before the time limit."""

    def __init__(self, arguments: Sequence[str], layout: ProcessLayout) -> None:
        self.arguments, self.layout = list(arguments), layout
        self._process: subprocess.Popen[bytes] | None = None

    def __call__(self) -> int:
        """Run the command to its end on this machine, and return its exit code.

        Raises:
            InfrastructureError: it failed.
        """
        import submitit

        job = submitit.JobEnvironment()
        options = list_options(self.layout, job.hostnames[0], f"wiw-{job.job_id}")
        command = [sys.executable, "-m", "torch.distributed.run", *options, *_list_module(self.arguments)]
        environment = {**_list_settings(self.layout), **os.environ}
        handler = signal.signal(
            signal.SIGUSR2, signal.SIG_IGN
        )  # SLURM sends it to all processes; children inherit this
        try:
            self._process = subprocess.Popen(command, env=environment)
        finally:
            signal.signal(signal.SIGUSR2, handler)
        while (code := self._process.poll()) is None:  # wait() holds a lock that `checkpoint` would wait for
            time.sleep(0.1)
        if code:
            raise InfrastructureError(
                f"exit code {code} of: {shlex.join(command)}; its output says why. Submit it again to resume"
            )
        return code

    def checkpoint(self) -> Any:
        """Stop the training on all machines and return it, to be resumed; submitit calls this at SIGUSR2."""
        from submitit.helpers import DelayedSubmission

        if self._process is not None:
            self._process.terminate()
            while _runs(self._process.pid):
                time.sleep(0.1)
        return DelayedSubmission(type(self)(self.arguments, self.layout))

    def __getstate__(self) -> dict[str, Any]:
        return {"arguments": self.arguments, "layout": self.layout, "_process": None}


def _runs(child: int) -> bool:
    """Return whether a child runs; somebody else takes its exit code."""
    try:
        return os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None
    except ChildProcessError:
        return False
