# SPDX-License-Identifier: Apache-2.0
"""The child's side: calls functions that its parent names on one thing of somebody else's, one after the other."""

from __future__ import annotations

import faulthandler
import mmap
import os
import pickle
import signal
import socket
import sys
import weakref
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from wiw import errors
from wiw.isolation.connection import receive, send
from wiw.isolation.segments import map_segment
from wiw.process_limits import end_with_parent

FIRST_TO_GO = 500
"""Out of 1000: where memory runs out, the kernel ends this process rather than the run's."""


class Host:
    """State that the functions of a call work on.

    Attributes:
        thing: class, factory or object that was loaded.
        make: makes an instance of it.
        made: that instance.
        memories: of its live episodes, by number, where it is a policy.
        answer: memory for arrays of the answer, uint8 [bytes], during a call that asks for it.
    """

    def __init__(self) -> None:
        self.thing: Any = None
        self.make: Any = None
        self.made: Any = None
        self.memories: dict[int, Any] = {}
        self.answer: NDArray[np.uint8] = np.empty(0, np.uint8)


def main() -> None:
    """Serve calls until the parent closes the connection."""
    connection = socket.socket(fileno=int(sys.argv[1]))
    connection.set_inheritable(False)
    end_with_parent(int(sys.argv[2]))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(FIRST_TO_GO))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    sys.argv[:] = ["wiw"]
    data, _ = receive(connection)
    sys.path[:], folder = pickle.loads(data)  # noqa: S301 - from the parent, as all that is pickled here
    os.chdir(folder)
    send(connection, msgpack.packb({}))
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        _serve(connection)
    os._exit(0)  # without Python's shutdown: threads of a model may be in compiled code, or wait for ever


def _serve(connection: socket.socket) -> None:
    host, memories = Host(), dict[int, mmap.mmap]()
    while True:
        data, descriptors = receive(connection)
        head, body = pickle.loads(data)  # noqa: S301
        memories |= {name: map_segment(each) for name, each in zip(head["new"], descriptors, strict=True)}
        for name in memories.keys() - set(head["kept"]):
            del memories[name]
        reply, held = _answer(host, head, body, memories)
        send(connection, msgpack.packb({**reply, "held": held}))


def _answer(
    host: Host, head: dict[str, Any], body: bytes, memories: dict[int, mmap.mmap]
) -> tuple[dict[str, Any], bool]:
    """Return the reply to a call, and whether its arrays are still referred to."""
    arrays, watched = list[NDArray[np.uint8]](), None
    if head["request"] is not None:
        whole = np.frombuffer(memories[head["request"]], np.uint8)  # the base of all views, as numpy has it
        arrays, watched = [whole[offset : offset + size] for offset, size in head["spans"]], weakref.ref(whole)
        del whole
    if head["answer"] is not None:
        name, size = head["answer"]
        host.answer = np.frombuffer(memories[name], np.uint8)[:size]
    reply = _call(host, body, arrays)
    arrays.clear()
    host.answer = np.empty(0, np.uint8)
    return reply, watched is not None and watched() is not None


def _call(host: Host, body: bytes, arrays: list[NDArray[np.uint8]]) -> dict[str, Any]:
    try:
        function, arguments = pickle.loads(body, buffers=arrays)  # noqa: S301
        value = function(host, *arguments)
        del arguments
        return {"value": value}
    except errors.Error as error:
        return {"error": {"type": type(error).__name__, "text": str(error), "kind": getattr(error, "kind", None)}}
    except Exception as error:
        return {"error": {"type": "", "text": errors.describe_exception(error)}}
    except BaseException as error:
        text = f"{error!r}, as if to end the process; a model that cannot answer should raise an Exception"
        return {"error": {"type": "ExitError", "text": text}}


if __name__ == "__main__":
    main()
