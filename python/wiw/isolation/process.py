# SPDX-License-Identifier: Apache-2.0
"""The parent's side: a fresh interpreter that runs somebody else's code, and calls of functions in it.

Requests are pickled, since the child may trust its parent, with their arrays in shared memory. Replies are msgpack and
are read as such: the parent runs nothing that the child sends.
"""

from __future__ import annotations

import math
import mmap
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from wiw.errors import InfrastructureError, find_error_class
from wiw.isolation.connection import receive, send
from wiw.isolation.failures import EndedError, ExitError, LateError, RaisedError
from wiw.isolation.segments import SegmentPool, SharedSegment, place
from wiw.json_text import MOST_LEVELS, is_too_deep
from wiw.process_limits import find_memory_limit, make_child_environment

STARTING = 120.0
"""Seconds in which a child has to be there; it takes half of one on an idle machine."""
LOOK = 0.1
"""Seconds between two looks at the memory of a child that computes."""
SMALL = 2048
"""Bytes of an array up to which it goes with the message."""


class ChildProcess:
    """A process that calls functions on one thing of somebody else's; started by the first call.

    Args:
        memory_gb: most gigabytes of memory that it may take, looked at while it computes; None means three quarters of
            the machine's. Processes that it starts are not counted: after a fork they seem to take what they share.
    """

    def __init__(self, memory_gb: float | None = None) -> None:
        self._most = find_memory_limit() if memory_gb is None else int(memory_gb * 1e9)
        self._lock = threading.Lock()
        self._pool = SegmentPool()
        self._known: set[int] = set()
        """Segments that the child has."""
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: socket.socket | None = None
        self._owner = os.getpid()
        self._end: weakref.finalize[Any, Any] | None = None

    @property
    def alive(self) -> bool:
        """Whether the process is there, and is this one's: not that of the process which this one was forked from."""
        return self._process is not None and self._owner == os.getpid() and not _has_ended(self._process)

    def call(
        self, function: Callable[..., Any], *arguments: Any, seconds: float = math.inf, answer: int = 0
    ) -> tuple[Any, NDArray[np.uint8]]:
        """Call `function(host, *arguments)` in the child; see `wiw.isolation.child.Host`.

        Args:
            function: of a module, as the child imports it by name.
            arguments: anything that can be pickled.
            seconds: how long it may take; the child is killed after that.
            answer: bytes of shared memory for arrays of the answer.

        Returns:
            What the function returns, plain values, and the memory that it has filled: nobody else's while the array is
            referred to.

        Raises:
            LateError: there is no answer in time.
            EndedError: the process has ended; the message says how.
            ExitError: the code tried to end it.
            RaisedError: the code raised an exception; one of wiw's own is raised as it is.
        """
        with self._lock:
            if self._process is None or self._owner != os.getpid():
                self._start()
            elif not self.alive:  # just now: another process would not have what was made in this one
                raise EndedError(self._describe_end())
            try:
                message, segments, memory = self._pack(function, arguments, answer)
                until = None if math.isinf(seconds) else time.monotonic() + seconds
                assert self._connection is not None
                send(self._connection, message, [segment.descriptor for segment in segments], until)
                self._known |= {segment.name for segment in segments}
                reply = self._receive(until)
            except TimeoutError:
                self.kill()
                raise LateError(f"no answer within {seconds:.3g} s (deadline); its process was killed") from None
            except (EOFError, OSError):
                raise EndedError(self._describe_end()) from None
            except BaseException:  # stopped in the middle of a reply, which nobody could make sense of later
                self.kill()
                raise
        if reply.get("held"):
            self._pool.drop(self._request)
        if "error" in reply:
            raise _build_error(reply["error"])
        return reply.get("value"), memory

    def kill(self) -> None:
        """End the process and all that it has started, at once; the next call starts another one."""
        if self._end is not None:
            self._end()
        self._process = self._connection = self._end = None
        self._pool, self._known = SegmentPool(), set()

    def _start(self) -> None:
        self.kill()
        try:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
            command = [sys.executable, "-m", "wiw.isolation.child", str(theirs.fileno()), str(os.getpid())]
            with theirs:
                process = _starter().submit(_open, command, theirs.fileno()).result()
        except OSError as error:  # out of descriptors or processes
            raise InfrastructureError(f"a model's process could not start: {error}") from error
        self._process, self._connection, self._owner = process, ours, os.getpid()
        self._end = weakref.finalize(self, _end, process, ours, os.getpid())
        try:
            message = pickle.dumps((sys.path, str(Path.cwd())))
            send(ours, message)
            self._receive(time.monotonic() + STARTING)
        except (TimeoutError, EOFError, OSError):
            raise InfrastructureError(f"a model's process could not start: {self._describe_end()}") from None

    def _pack(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], answer: int
    ) -> tuple[bytes, list[SharedSegment], NDArray[np.uint8]]:
        """Return the request, the segments that are new to the child, and the memory of the answer."""
        arrays: list[NDArray[np.uint8]] = []
        body = pickle.dumps((function, arguments), protocol=5, buffer_callback=lambda each: _take_out(each, arrays))
        *offsets, size = place([array.nbytes for array in arrays])
        used = []
        if arrays:
            self._request = self._pool.find(size)
            used.append(self._request)
            memory = self._request.lease(size)
            for offset, array in zip(offsets, arrays, strict=True):
                memory[offset : offset + array.nbytes] = array
        given: NDArray[np.uint8] = np.empty(0, np.uint8)
        if answer:
            segment = self._pool.find(answer)
            used.append(segment)
            given = segment.lease(answer)
        new = [segment for segment in used if segment.name not in self._known]
        spans = [(offset, array.nbytes) for offset, array in zip(offsets, arrays, strict=True)]
        head = {
            "new": [segment.name for segment in new],
            "kept": [segment.name for segment in used] + sorted(self._pool.names),
            "request": used[0].name if arrays else None,
            "spans": spans,
            "answer": (used[-1].name, answer) if answer else None,
        }
        return pickle.dumps((head, body)), new, given

    def _receive(self, until: float | None) -> dict[str, Any]:
        """Return the child's reply, of plain values whatever the child has sent."""
        assert self._connection is not None
        self._await_reply(until)
        data, descriptors = receive(self._connection, until)
        for descriptor in descriptors:  # nothing that a child would have to give
            os.close(descriptor)
        try:
            reply = msgpack.unpackb(data, strict_map_key=False)
        except Exception as error:
            raise OSError(f"not valid msgpack: {error}") from None
        if not isinstance(reply, dict) or is_too_deep(reply):
            raise OSError(f"expected a map of at most {MOST_LEVELS} levels")
        return reply

    def _await_reply(self, until: float | None) -> None:
        """Wait for the begin of a reply, with a look at the child's memory now and then.

        A limit of the kernel's would also count what the driver of a GPU merely reserves. Neither counts what the
        child's own children take.

        Raises:
            TimeoutError: there is none in time.
            EndedError: the child takes more memory than it may; it is killed.
        """
        assert self._connection is not None and self._process is not None
        poll = select.poll()
        poll.register(self._connection, select.POLLIN)
        while True:
            left = math.inf if until is None else until - time.monotonic()
            if left <= 0:
                raise TimeoutError
            if poll.poll(1e3 * min(left, LOOK)):
                return
            if (taken := _read_own_memory(self._process.pid)) > self._most:
                self.kill()
                raise EndedError(
                    f"its process took {taken / 1e9:.1f} GB of memory, more than the limit of {self._most / 1e9:.1f} "
                    "(memory_gb), and was killed"
                )

    def _describe_end(self) -> str:
        """Return how the process has ended, in words; end it where it has only closed its connection."""
        process = self._process
        assert process is not None
        give_up = time.monotonic() + 1.0
        while not (ended := _has_ended(process)) and time.monotonic() < give_up:
            time.sleep(0.01)
        self.kill()
        code = process.returncode
        if not ended:
            return "its process closed its connection, or sent something that is not a reply"
        if code >= 0:
            return f"its process ended with exit code {code}"
        name = signal.Signals(-code).name
        return f"its process ended with {name}" + (", perhaps out of memory" if name == "SIGKILL" else "")


def _has_ended(process: subprocess.Popen[bytes]) -> bool:
    """Return whether a process has ended, and leave its exit code: until that is taken its group can be killed."""
    try:
        flags = os.WEXITED | os.WNOWAIT | os.WNOHANG
        return process.returncode is not None or os.waitid(os.P_PID, process.pid, flags) is not None
    except ChildProcessError:
        return True


def _read_own_memory(process: int) -> int:
    """Return the bytes in memory that a process shares with nobody."""
    try:
        resident, shared = Path(f"/proc/{process}/statm").read_text().split()[1:3]
    except (OSError, ValueError):  # it has ended
        return 0
    return (int(resident) - int(shared)) * mmap.PAGESIZE


@cache
def _starter() -> ThreadPoolExecutor:
    """Return the thread that starts all children: the kernel takes the end of that thread for the parent's."""
    return ThreadPoolExecutor(1, "wiw isolation")


os.register_at_fork(after_in_child=_starter.cache_clear)  # a forked process does not have that thread


def _open(command: list[str], descriptor: int) -> subprocess.Popen[bytes]:
    """Start a child in its own process group, without input; its output goes to standard error."""
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=2,
        pass_fds=(descriptor,),
        start_new_session=True,
        env=make_child_environment(),
    )


def _end(process: subprocess.Popen[bytes], connection: socket.socket, owner: int) -> None:
    """Kill a child and all of its group; in a process forked from its parent, only let go of it."""
    connection.close()
    if process.returncode is None and os.getpid() == owner:  # not waited for yet, so its number is nobody else's
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        with suppress(ProcessLookupError):
            process.kill()
        process.wait()


def _take_out(buffer: pickle.PickleBuffer, arrays: list[NDArray[np.uint8]]) -> bool:
    """Take a large array out of a message; return whether it stays in it."""
    array = np.frombuffer(buffer.raw(), np.uint8)
    if array.nbytes <= SMALL:
        return True
    arrays.append(array)
    return False


def _build_error(message: Any) -> Exception:
    """Return the exception that a child has reported: one of wiw's own, or a substitute for a foreign one."""
    message = message if isinstance(message, dict) else {}
    text = str(message.get("text", ""))
    name, kind = str(message.get("type", "")), message.get("kind")
    if name == "ExitError":
        return ExitError(text)
    own = find_error_class(name)
    if own is None:
        return RaisedError(text)
    try:
        error: Exception = own(text, kind) if isinstance(kind, str) else own(text)
    except TypeError:  # it takes more than the child reports
        return RaisedError(text)
    return error
