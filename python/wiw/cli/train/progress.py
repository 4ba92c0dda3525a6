# SPDX-License-Identifier: Apache-2.0
"""Show the progress of a training: a bar in a terminal, one line per minute elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Mapping
from typing import Any

from wiw.cli.bars import Bars

LINE_SECONDS = 60.0
"""Seconds between progress lines if the output is not a terminal."""


class TrainingProgress:
    """Steps, loss, speed and memory, with the time left.

    Args:
        batch: number of units per step.
        unit: unit in which speed is counted.
    """

    def __init__(self, batch: int = 1, unit: str = "steps") -> None:
        self._batch, self._unit, self._bars = batch, unit, Bars()

    def __enter__(self) -> TrainingProgress:
        self._began = self._said = time.monotonic()
        self._first: int | None = None
        return self

    def __exit__(self, *_: object) -> None:
        if self._first is not None:
            self._bars.__exit__()

    def show_validation(self, step: int, found: Mapping[str, float]) -> None:
        """Print the results of a validation."""
        print(f"validation: step {step:,}, {describe_validation(found)}", file=sys.stderr, flush=True)

    def __call__(self, step: int, steps: int, loss: float) -> None:
        now = time.monotonic()
        if self._first is None:  # the first step warms up, and comes after data and weights were loaded
            self._first, self._began = step, now
            self._bars.__enter__()
        if sys.stderr.isatty() or now - self._said >= LINE_SECONDS or step == steps:
            self._show(step, steps, loss, now)
        if step == steps:
            self._bars.__exit__()

    def _show(self, step: int, steps: int, loss: float, now: float) -> None:
        done = step - (self._first or 0)
        rate = done / (now - self._began) if done else 0.0
        text = (
            f"step {step:,}/{steps:,}, loss {loss:.4f}, {rate * self._batch:.2f} {self._unit}/s, {_describe_memory()}"
        )
        if sys.stderr.isatty():
            self._bars.show("training", step, steps, text)
            return
        left = f", {(steps - step) / rate / 60:.0f} min left" if rate and step < steps else ""
        print(f"training: {text}{left}", file=sys.stderr, flush=True)
        self._said = now


def describe_validation(found: Mapping[str, float]) -> str:
    """Return the main figures of a validation."""
    texts = [f"PSNR {found['psnr']:.2f} dB"] if "psnr" in found else []
    if "gap" in found:
        texts.append(f"control gap {found['gap']:.2f} dB")
    if "gap/displacements" in found:
        texts.append(f"gap of displacements {found['gap/displacements']:.2f} dB")
    if "rank" in found:
        texts.append(f"rank agreement {found['rank']:.2f}")
    return ", ".join(texts) or "no clip moves the camera"


def track_items(items: Iterable[Any], text: str, total: int) -> Any:
    """Iterate over items with a bar in a terminal."""
    from rich.console import Console
    from rich.progress import track

    return track(items, text, total, console=Console(stderr=True), disable=not sys.stderr.isatty() or not total)


def _describe_memory() -> str:
    """Describe the peak memory so far, of the GPU if there is one."""
    import resource

    import torch

    if torch.cuda.is_available() and torch.cuda.is_initialized():
        return f"{torch.cuda.max_memory_allocated() / 2**30:.1f} GB of GPU memory"
    scale = 1 if sys.platform == "darwin" else 1024
    return f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 2**30:.1f} GB of memory"
