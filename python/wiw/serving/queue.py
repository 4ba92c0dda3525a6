# SPDX-License-Identifier: Apache-2.0
"""The queue of rows that wait for the model, and the choice of the next batch."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from wiw.wire.rows import Row

ANNOUNCED = 1.0
"""Seconds for which a batch waits for rows that a client has announced, counted from the latest arrival."""
LONGEST = 1.0
"""Most seconds for which a batch waits for rows that nobody has announced."""


@dataclass(eq=False)
class Job:
    """A row that waits or is computed."""

    id: bytes
    row: Row
    arrived: float
    expires: float
    askers: set[Hashable] = field(default_factory=set)


class Queue:
    """First come, first served, in batches of rows that fit together. Filled by one thread, emptied by another.

    A batch that is not full waits a little: for rows that a client has announced, and, where clients are connected that
    have asked for nothing, for a share of the time that a batch takes.

    Args:
        batch: rows of a full batch.
        most: rows that may wait.
        window: that share; 0 never waits for rows that nobody announced.
        clock: seconds.
    """

    def __init__(self, batch: int, most: int, window: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.batch, self.most, self.window, self._clock = batch, most, window, clock
        self.batch_seconds = 0.0
        """What the last batch took."""
        self._jobs: list[Job] = []
        self._coming: dict[Hashable, int] = {}
        """Rows that each client has announced."""
        self._unanswered: Counter[Hashable] = Counter()
        """Rows of each client that wait or are computed."""
        self._latest = -math.inf
        self._ending = False
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._jobs)

    def join(self, client: Hashable) -> None:
        """Add a client, which may ask from now on."""
        with self._changed:
            self._coming[client] = 0

    def leave(self, client: Hashable) -> list[Job]:
        """Remove a client that has gone. Return the jobs that nobody wants any more."""
        with self._changed:
            self._coming.pop(client, None)
            self._unanswered.pop(client, None)
            for job in self._jobs:
                job.askers.discard(client)
            orphans = [job for job in self._jobs if not job.askers]
            self._jobs = [job for job in self._jobs if job.askers]
            self._changed.notify()
            return orphans

    def put(self, job: Job, client: Hashable, rest: int = 0) -> bool:
        """Take a job of a client that announces `rest` more; False where the queue is full."""
        with self._changed:
            self._coming[client] = rest
            full = len(self._jobs) >= self.most
            if not full:
                self._latest = self._clock()
                self._unanswered[client] += 1
                self._jobs.append(job)
            self._changed.notify()
            return not full

    def announce(self, client: Hashable, rest: int) -> None:
        """Note that a client announces `rest` more rows, whatever became of its latest."""
        with self._changed:
            self._coming[client] = rest
            self._changed.notify()

    def share(self, client: Hashable) -> None:
        """Note that a client requests a row that another one has already requested."""
        with self._changed:
            self._unanswered[client] += 1

    def count_answer(self, client: Hashable) -> None:
        """Count one more answer for a client."""
        with self._changed:
            if client in self._unanswered:
                self._unanswered[client] -= 1

    def take_expired(self) -> list[Job]:
        """Take out the jobs whose clients wait no more."""
        with self._changed:
            now = self._clock()
            late = [job for job in self._jobs if job.expires <= now]
            self._jobs = [job for job in self._jobs if job.expires > now]
            self._changed.notify()
            return late

    def take(self) -> list[Job] | None:
        """Return the next batch, as soon as it is due; None when the queue has ended and is empty."""
        with self._changed:
            while True:
                batch, wait = self.find_due()
                if batch and wait <= 0:
                    taken = set(map(id, batch))
                    self._jobs = [job for job in self._jobs if id(job) not in taken]
                    return batch
                if self._ending and not self._jobs:
                    return None
                self._changed.wait(wait if batch else None)

    def end(self) -> None:
        """End the queue: the queue is closed."""
        with self._changed:
            self._ending = True
            self._changed.notify()

    def find_due(self) -> tuple[list[Job], float]:
        """Return the batch so far, and the seconds until it is taken even if it is not full."""
        now = self._clock()
        waiting = [job for job in self._jobs if job.expires > now]
        if not waiting:
            return [], math.inf
        first = waiting[0]
        batch = [job for job in waiting if job.row.shape == first.row.shape][: self.batch]
        if len(batch) == self.batch or self._ending:
            return batch, 0.0
        if any(self._coming.values()):
            return batch, self._latest + ANNOUNCED - now
        if all(self._unanswered[client] > 0 for client in self._coming):
            return batch, 0.0
        return batch, first.arrived + min(LONGEST, self.window * self.batch_seconds) - now
