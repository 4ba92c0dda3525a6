# SPDX-License-Identifier: Apache-2.0
"""A checkpoint that is also written on a signal to stop: batch systems send SIGTERM or SIGUSR1."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any

from wiw.errors import ArgumentError
from wiw.training.checkpoint import Checkpoint, ResumableTrainer, TrainingState
from wiw.training.post_training import distributed
from wiw.training.save_signal import HeldSignal

STOPPING = (signal.SIGTERM, signal.SIGINT)
"""Signals after which the training stops, once its state is written; after SIGUSR1 it continues."""


class SignalledCheckpoint(Checkpoint):
    """Write the state at the end of the step in which a signal comes; see `Checkpoint`.

    Within `watch`, SIGUSR1 writes the state, also one that `hold_save_signal` has kept. SIGTERM and SIGINT (Ctrl-C)
    write it, and then do what they would have done without this; a second one does so at once.

    With several processes, a signal to any of them is one to all. They have to call `save_if_due` alike. The first one
    writes; a second signal is ignored, since torchrun hands on what a batch system sends to each process itself.
    """

    _pending = 0

    def load(self) -> TrainingState | None:
        """Read the file; None if there is none.

        Raises:
            ArgumentError: it belongs to another training, or only some processes find it.
            FileError: it is damaged.
        """
        if len(set(distributed.collect(self.path.exists()))) > 1:
            raise ArgumentError(
                f"{self.path} exists on some machines only: expected a folder that all share; choose one with --out"
            )
        return super().load()

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Hold back the signals until the end of a step, as long as the context lasts; only in the main thread."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        self._earlier: dict[int, Any] = {
            number: signal.signal(number, self._note) for number in (*STOPPING, signal.SIGUSR1)
        }
        held = self._earlier[signal.SIGUSR1]
        if isinstance(held, HeldSignal) and held.take():  # it came before there was a step
            self._pending = signal.SIGUSR1
        wakeup = signal.set_wakeup_fd(-1)  # its reader may end the process before a long step has
        try:
            yield
        finally:
            signal.set_wakeup_fd(wakeup)
            for number, handler in self._earlier.items():
                signal.signal(number, handler)

    def save_if_due(self, trainer: ResumableTrainer, epochs: int, step: int) -> None:
        """Write the file if a signal has come or the last write was long enough ago; then stop, if the signal says so.

        Raises:
            FileError: it cannot be written.
        """
        told, due = zip(*distributed.collect((self._pending, self.is_due())), strict=True)
        number = max(told, key=lambda each: (each in STOPPING, each))
        if self._pending == number:
            self._pending = 0
        if number or any(due):
            self.save(trainer, epochs, step)
        if number in STOPPING:
            signal.signal(number, self._earlier[number])
            signal.raise_signal(number)

    def write(self, state: Mapping[str, Any], epochs: int, step: int) -> None:
        """Write the file in the first process; the others wait for it.

        Raises:
            FileError: it cannot be written.
        """
        distributed.call_on_main(lambda: super(SignalledCheckpoint, self).write(state, epochs, step))

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._pending not in STOPPING:
            self._pending = number
        if number in STOPPING and distributed.count_processes() == 1:
            signal.signal(number, self._earlier[number])
