# SPDX-License-Identifier: Apache-2.0
"""Memory that two processes share: anonymous files (`memfd`), whose descriptors go over a Unix socket.

Unlike POSIX shared memory they need no room in `/dev/shm`, which containers make small, and vanish with the last
process that has them open, however it ends. They are sealed: neither side can shrink one under the other's feet, which
would end that side by SIGBUS.
"""

from __future__ import annotations

import fcntl
import itertools
import mmap
import os
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import InfrastructureError

ALIGNMENT = 64
"""Bytes at whose multiples arrays begin."""
ROUNDED = 2**20
"""Bytes of whose multiples segments are made, so that requests of nearly equal size share them."""
SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class SharedSegment:
    """One piece of shared memory, on the side that made it."""

    def __init__(self, name: int, size: int) -> None:
        self.name, self.size = name, size
        try:
            self.descriptor = os.memfd_create("wiw", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        except OSError as error:
            raise InfrastructureError(
                f"cannot create a descriptor for memory shared with a model's process: {error}"
            ) from error
        try:
            os.posix_fallocate(self.descriptor, 0, size)  # now, with an error: later it would be a signal
            fcntl.fcntl(self.descriptor, fcntl.F_ADD_SEALS, SEALS)
            self._memory = mmap.mmap(self.descriptor, size)
        except OSError as error:
            os.close(self.descriptor)
            raise InfrastructureError(
                f"cannot allocate memory shared with a model's process ({size} bytes): {error}"
            ) from error
        self._close = weakref.finalize(self, os.close, self.descriptor)
        self.leased = False

    def bytes(self) -> NDArray[np.uint8]:
        """Return the memory, uint8 [size]."""
        return np.frombuffer(self._memory, np.uint8)

    def lease(self, size: int) -> NDArray[np.uint8]:
        """Return the first bytes as an array; the segment is leased until nothing refers to it any more."""
        self.leased = True
        whole = self.bytes()
        weakref.finalize(whole, setattr, self, "leased", False)
        return whole[:size]


class SegmentPool:
    """The segments of one process, used again and again."""

    def __init__(self) -> None:
        self._names = itertools.count()
        self._segments: list[SharedSegment] = []

    def find(self, size: int) -> SharedSegment:
        """Return a free segment of at least so many bytes, made if there is none; free ones that are smaller go."""
        free = [segment for segment in self._segments if not segment.leased]
        fitting = [segment for segment in free if segment.size >= size]
        if fitting:
            return min(fitting, key=lambda segment: segment.size)
        self._segments = [segment for segment in self._segments if segment.leased]
        made = SharedSegment(next(self._names), max(ROUNDED, -(-size // ROUNDED) * ROUNDED))
        self._segments.append(made)
        return made

    def drop(self, segment: SharedSegment) -> None:
        """Leave a segment to the other side, which still reads it."""
        self._segments = [each for each in self._segments if each is not segment]

    @property
    def names(self) -> set[int]:
        """Names of all segments."""
        return {segment.name for segment in self._segments}


def map_segment(descriptor: int) -> Any:
    """Return the memory behind a descriptor, on the side that received it; the descriptor is closed."""
    memory = mmap.mmap(descriptor, os.fstat(descriptor).st_size)
    os.close(descriptor)
    return memory


def place(sizes: Sequence[int]) -> list[int]:
    """Return the offsets of arrays of these sizes in bytes, one after the other, and where the last one ends."""
    return [0, *itertools.accumulate(-(-size // ALIGNMENT) * ALIGNMENT for size in sizes)]
