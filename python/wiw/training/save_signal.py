# SPDX-License-Identifier: Apache-2.0
"""SIGUSR1, at which a training writes its state, from the start of the command to its end: no step must be under way.

Nothing heavy is imported here: the signal may come while torch is.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class HeldSignal:
    """A handler that keeps a signal until it is taken."""

    def __init__(self) -> None:
        self._has_come = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Note the signal."""
        self._has_come = True

    def take(self) -> bool:
        """Return whether the signal has come, once."""
        has_come, self._has_come = self._has_come, False
        return has_come


@contextmanager
def hold_save_signal() -> Iterator[None]:
    """Keep SIGUSR1 for the first step that follows, as long as the context lasts; after the last one it does nothing.

    Outside, it ends the process. Within another such context, or in another thread than the main one, nothing changes.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or isinstance(signal.getsignal(signal.SIGUSR1), HeldSignal):
        yield
        return
    earlier = signal.signal(signal.SIGUSR1, HeldSignal())
    try:
        yield
    finally:
        signal.signal(signal.SIGUSR1, earlier)
