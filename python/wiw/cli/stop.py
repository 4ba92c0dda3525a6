# SPDX-License-Identifier: Apache-2.0
"""Handle SIGTERM and SIGUSR2: close the run within seconds, whatever it is doing, with an exit code for "resume me".

Only a store that is written on a local disk gets longer, as it is copied to its own folder.
"""

from __future__ import annotations

import atexit
import math
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from wiw.errors import ArgumentError, Error
from wiw.runs.scratch import STOP_VARIABLE, copy_unclosed, has_unclosed
from wiw.training.launcher import count_started

EXIT_RESUME = 75
"""EX_TEMPFAIL: whatever stopped the run, such as a batch system, may call `wiw resume`."""
STOPPING = (signal.SIGTERM, signal.SIGUSR2)
"""SIGUSR2 is what SLURM sends to all processes of submitit's jobs before their time is up."""
GRACE = 4.0
"""Seconds for an orderly shutdown; then the process exits, which loses nothing, as every record is already on disk."""
STOP_SECONDS = 60.0
"""Seconds after which the process exits even if a store is still being copied, whose last whole copy then remains;
$WIW_STOP_SECONDS is another number, for a batch system that gives a job less or more."""
LAST = 1.0
"""Seconds to end in once the store is copied."""


class Terminated(BaseException):
    """SIGTERM or SIGUSR2 was received; raised so that everything is closed on the way out."""


def end_process(code: int) -> NoReturn:
    """End the process with an exit code, even while threads of models are still inside compiled code.

    Python's shutdown ends such a thread when it returns from a call, by unwinding its C++ frames; if these do not allow
    that, the process aborts (SIGABRT) instead of returning its exit code. The same happens at times to the processes
    that torchrun starts, whose threads of torch.distributed Python does not know. So once the exit handlers have run
    and the output is flushed, the process ends without a shutdown if any other thread may be alive.
    """
    if threading.active_count() == 1 and count_started() == 1:
        sys.exit(code)
    atexit._run_exitfuncs()  # prints what a handler raises, and goes on
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # a closed pipe, a closed stream
            stream.flush()
    os._exit(code)


@contextmanager
def raise_on_stop_signals() -> Iterator[None]:
    """Raise `Terminated` at the first of `STOPPING`; end the process if the work does not react, as inside a model.

    Python runs signal handlers only between its own instructions, so a thread, notified through a pipe, enforces the
    end. Where the work does not react within `GRACE`, it also copies stores from a local disk to their own folders.

    Raises:
        ArgumentError: $WIW_STOP_SECONDS is no number of seconds.
    """
    seconds = _read_stop_seconds()
    watch, tell = os.pipe()
    os.set_blocking(tell, False)
    done = threading.Event()
    guard = threading.Thread(target=_guard, args=(watch, done, seconds), daemon=True)
    handlers = {number: signal.signal(number, _terminate) for number in STOPPING}
    earlier = signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    guard.start()
    try:
        yield
    finally:
        done.set()
        signal.set_wakeup_fd(earlier)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        os.close(tell)
        guard.join()
        os.close(watch)


def _terminate(number: int, frame: FrameType | None) -> None:
    for each in STOPPING:
        signal.signal(each, _note)  # a second one must not disturb the closing
    raise Terminated


def _note(number: int, frame: FrameType | None) -> None:
    """Do nothing. Python complains about a signal that arrives and is then ignored with `SIG_IGN`."""


def _read_stop_seconds() -> float:
    text = os.environ.get(STOP_VARIABLE, "")
    try:
        seconds = float(text or STOP_SECONDS)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds < math.inf:
        raise ArgumentError(f"{STOP_VARIABLE}={text}: expected a number of seconds, such as 60: change or unset it")
    return seconds


def _guard(watch: int, done: threading.Event, seconds: float) -> None:
    while number := os.read(watch, 1):
        if number[0] in STOPPING and not done.wait(GRACE) and not _wait_for_copies(done, seconds - GRACE):
            for worker in multiprocessing.active_children():
                worker.kill()
            print(
                "wiw: stopped at once; everything recorded is kept. Continue a run with `wiw resume`, collecting or "
                "training with the same command",
                file=sys.stderr,
            )
            sys.stderr.flush()
            os._exit(EXIT_RESUME)


def _wait_for_copies(done: threading.Event, seconds: float) -> bool:
    """Have stores copied from a local disk in at most some seconds; return whether the work has ended meanwhile."""
    if not has_unclosed():
        return False
    copying = threading.Thread(target=_copy_stores, daemon=True)
    copying.start()
    copying.join(max(0.0, seconds))
    return done.wait(LAST)


def _copy_stores() -> None:
    try:
        copy_unclosed()
    except Error as error:
        print(f"wiw: {error}", file=sys.stderr, flush=True)


def stoppable(work: Callable[[], Any], folder: Path, command: str = "resume") -> Any:
    """Run `work` on a run's folder; if it is stopped, print the command that resumes it."""
    from wiw.runs.store import find_resume_command
    from wiw.runs.store_file import store_path

    try:
        return work()
    except BaseException as stop:
        if not isinstance(stop, Exception | SystemExit) and store_path(folder).exists():
            again = find_resume_command(folder) if command == "resume" else f"wiw {command} {folder}"
            print(f"\nstopped; everything so far is kept. Continue with:  {again}", file=sys.stderr)
        raise


@contextmanager
def announce_resume(aloud: bool = True) -> Iterator[None]:
    """Run work that keeps finished parts; if it is stopped and `aloud`, print that the same command resumes it."""
    try:
        yield
    except (KeyboardInterrupt, Terminated):
        if aloud:
            print("\nstopped. Repeat the command to resume; finished parts are kept", file=sys.stderr)
        raise
