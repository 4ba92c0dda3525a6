# SPDX-License-Identifier: Apache-2.0
"""The thread in which the model lives: batches in, frames out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ContractError, read_text
from wiw.json_text import escape_surrogates
from wiw.serving.queue import Job, Queue
from wiw.wire.messages import Refusal
from wiw.wire.rows import Row, stack
from wiw.world_models.base import WorldModel, answer_deadline, check_rollout

Outcome = NDArray[np.uint8] | Refusal
"""Frames of a row, or why there are none."""
PICTURE_BREACHES = ("frame 0", "channels", "scale")
"""Kinds of breaches of a model's contract that are one row's, and not of all that the model returned."""
Report = Callable[[Sequence[Job], Sequence[Outcome]], None]


class Worker(threading.Thread):
    """Takes batches from a queue until it ends. One thread for all calls: libraries keep state by thread."""

    def __init__(self, model: WorldModel, queue: Queue, report: Report) -> None:
        super().__init__(daemon=True, name="wiw served model")
        self._model, self._queue, self._report = model, queue, report
        self.busy_since: float | None = None
        self.batches, self.rows, self.busy_seconds = 0, 0, 0.0

    def run(self) -> None:
        """Work until the queue has ended."""
        while (batch := self._queue.take()) is not None:
            begin = self.busy_since = time.monotonic()
            with answer_deadline(max(job.expires for job in batch) - begin):
                outcomes = self._answers([job.row for job in batch])
            seconds, self.busy_since = time.monotonic() - begin, None
            self.batches, self.rows, self.busy_seconds = (
                self.batches + 1,
                self.rows + len(batch),
                self.busy_seconds + seconds,
            )
            self._queue.batch_seconds = seconds
            self._report(batch, outcomes)

    def _answers(self, rows: Sequence[Row]) -> list[Outcome]:
        """Return what the model gives for each row.

        Where it raises, or shows another place than a row does, each half of the batch is computed again: a row that it
        cannot do fails alone, whoever asked for the others, and too many rows for the memory become fewer.
        """
        try:
            frames = check_rollout(self._model, *stack(rows))
        except BaseException as error:  # SystemExit too: the thread has to go on
            is_of_all = isinstance(error, ContractError) and error.kind not in PICTURE_BREACHES
            if is_of_all or len(rows) == 1:
                return [_refuse(error)] * len(rows)
            half = len(rows) // 2
            return [*self._answers(rows[:half]), *self._answers(rows[half:])]
        return [  # copies: they are encoded while the model goes on, and it may use its memory again
            answer[1 + row.control.shared : 1 + row.control.length].copy()
            for row, answer in zip(rows, frames, strict=True)
        ]


def _refuse(error: BaseException) -> Refusal:
    kind, text = "raised", f"{type(error).__name__}: {read_text(error)}"
    if isinstance(error, ContractError):
        kind, text = error.kind, str(error)
    return Refusal(b"", kind, escape_surrogates(text))  # a file's name need not be UTF-8
