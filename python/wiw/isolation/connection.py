# SPDX-License-Identifier: Apache-2.0
"""Messages between a process and its child over a Unix socket: their length, their bytes, and descriptors of memory."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Sequence

HEAD = struct.Struct("<QI")
"""Bytes of the message, and descriptors that come with it."""
MOST_BYTES = 2**28
"""Maximum size of a message in bytes; frames and images go through shared memory instead."""
MOST_DESCRIPTORS = 64


def send(
    connection: socket.socket, message: bytes, descriptors: Sequence[int] = (), until: float | None = None
) -> None:
    """Send a message.

    Raises:
        TimeoutError: the other side has not taken it by the time `until` of `time.monotonic`.
        OSError: it has closed the connection.
    """
    head = HEAD.pack(len(message), len(descriptors))
    _set_timeout(connection, until)
    if descriptors:
        socket.send_fds(connection, [head], list(descriptors))
        connection.sendall(message)
    else:
        connection.sendall(head + message)


def receive(connection: socket.socket, until: float | None = None) -> tuple[bytearray, list[int]]:
    """Return a message and its descriptors.

    Raises:
        TimeoutError: there is none by the time `until` of `time.monotonic`.
        EOFError: the other side has closed the connection.
        OSError: the message is too long.
    """
    _set_timeout(connection, until)
    data, descriptors, _, _ = socket.recv_fds(connection, HEAD.size, MOST_DESCRIPTORS)
    head = bytearray(data)
    if not head:
        raise EOFError
    head += _receive_exactly(connection, HEAD.size - len(head), until)
    length, count = HEAD.unpack(bytes(head))
    if length > MOST_BYTES or count != len(descriptors):
        raise OSError(f"expected a message of at most {MOST_BYTES} bytes and its descriptors, got {length} bytes")
    return _receive_exactly(connection, length, until), list(descriptors)


def _receive_exactly(connection: socket.socket, length: int, until: float | None) -> bytearray:
    data = bytearray(length)
    left = memoryview(data)
    while left:
        _set_timeout(connection, until)
        taken = connection.recv_into(left)
        if taken == 0:
            raise EOFError
        left = left[taken:]
    return data


def _set_timeout(connection: socket.socket, until: float | None) -> None:
    seconds = None if until is None else until - time.monotonic()
    if seconds is not None and seconds <= 0:
        raise TimeoutError
    connection.settimeout(seconds)
