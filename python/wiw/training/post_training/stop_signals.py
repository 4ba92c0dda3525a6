# SPDX-License-Identifier: Apache-2.0
"""A checkpoint that is also written when the process is told to stop: batch systems send SIGTERM or SIGUSR1."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from wiw.training.checkpoint import Checkpoint, ResumableTrainer

STOPPING = (signal.SIGTERM, signal.SIGINT)
"""Signals after which the training stops, once its state is written; after SIGUSR1 it goes on."""


class SignalledCheckpoint(Checkpoint):
    """Write the state at the end of the step in which a signal comes; see `Checkpoint`.

    Within `watch`, SIGUSR1 writes the state. SIGTERM and SIGINT (Ctrl-C) write it, and then do what they would have
    done without this; a second one does so at once.
    """

    _pending: signal.Signals | None = None

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Hold back the signals until the end of a step, as long as the context lasts; only in the main thread."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        self._earlier: dict[int, Any] = {
            number: signal.signal(number, self._note) for number in (*STOPPING, signal.SIGUSR1)
        }
        wakeup = signal.set_wakeup_fd(-1)  # its reader may end the process before a long step has
        try:
            yield
        finally:
            signal.set_wakeup_fd(wakeup)
            for number, handler in self._earlier.items():
                signal.signal(number, handler)

    def save_if_due(self, trainer: ResumableTrainer, epochs: int, step: int) -> None:
        """Write the file if a signal has come or the last write was long enough ago; then stop, if so told.

        Raises:
            FileError: it cannot be written.
        """
        if self._pending is None:
            super().save_if_due(trainer, epochs, step)
            return
        number, self._pending = self._pending, None
        self.save(trainer, epochs, step)
        if number in STOPPING:
            signal.signal(number, self._earlier[number])
            signal.raise_signal(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._pending = signal.Signals(number)
        if number in STOPPING:
            signal.signal(number, self._earlier[number])
