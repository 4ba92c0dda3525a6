# SPDX-License-Identifier: Apache-2.0
"""The state of a training in a file: what is written, what cannot be read, and what stays in memory."""

from __future__ import annotations

import errno
import math
import signal
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch", reason="needs wiw[torch]")

import torch

from wiw.errors import FileError, TrainingError
from wiw.training.checkpoint import Checkpoint, ResumableTrainer, TrainingState, _StateFile
from wiw.training.post_training.stop_signals import SignalledCheckpoint
from wiw.training.trainer import apply_gradients, run_training


class Counter(ResumableTrainer):
    """Counts its steps; its state has one tensor."""

    stateful_parts = ()

    def __init__(self, watched: list[weakref.ref[Any]] | None = None) -> None:
        self.watched = watched or []

    def train_step(self, learning_rate: float) -> float:
        assert all(each() is None for each in self.watched)
        self.step_count += 1
        return 0.0


@dataclass(frozen=True)
class Recipe:
    epochs: int = 2
    rate: float = 1.0


def test_what_is_written_is_read(tmp_path: Path) -> None:
    state = {"count": 3, "weights": torch.arange(5)}
    Checkpoint(tmp_path / "state", {"a": 1}).write(state, 2, 3)
    found = Checkpoint(tmp_path / "state", {"a": 1}).load()
    assert found is not None and (found.epochs, found.step) == (2, 3)
    torch.testing.assert_close(found.state["weights"], state["weights"])
    assert [each.name for each in tmp_path.iterdir()] == ["state"]


def test_a_full_disk_is_the_error_of_the_system() -> None:
    with pytest.raises(OSError) as caught, _StateFile(Path("/dev/full").open("wb")) as file:
        torch.save({"weights": torch.zeros(100_000)}, file)
    assert caught.value.errno == errno.ENOSPC


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ESTALE, "Stale file handle"),
        MemoryError(),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 5 bytes."),
    ],
)
def test_a_state_that_cannot_be_read_now_is_not_called_damaged(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = Checkpoint(tmp_path / "state", {})
    checkpoint.write({}, 1, 1)

    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(torch, "load", fail)
    with pytest.raises(FileError, match=r"cannot be read .* mend this, then repeat the command") as caught:
        checkpoint.load()
    assert "delete" not in str(caught.value)


@pytest.mark.parametrize("kept", [0, 10, 400])
def test_a_state_cut_short_is_damaged(kept: int, tmp_path: Path) -> None:
    path = tmp_path / "state"
    Checkpoint(path, {}).write({"weights": torch.zeros(1000)}, 1, 1)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(FileError, match=r"damaged .* delete it to start again"):
        Checkpoint(path, {}).load()


def test_a_resumed_training_keeps_no_second_copy_of_its_state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    checkpoint, watched = Checkpoint(tmp_path / "state", {}), list[weakref.ref[Any]]()

    def load() -> TrainingState:
        held = torch.zeros(3)
        watched.append(weakref.ref(held))
        return TrainingState(2, 1, {"count": 1, "held": held})

    monkeypatch.setattr(checkpoint, "load", load)
    trainer, _ = run_training(lambda: Counter(watched), Recipe(), 2, None, lambda _: 1.0, lambda *_: None, checkpoint)
    assert trainer.step_count == 4 and len(watched) == 1


class StoppedError(Exception):
    """Raised by the handler that was there before."""


def test_the_state_before_a_loss_that_is_not_finite_is_kept(tmp_path: Path) -> None:
    class Diverging(Counter):
        def train_step(self, learning_rate: float) -> float:
            super().train_step(learning_rate)
            return math.nan if self.step_count == 3 else 0.0

    checkpoint = Checkpoint(tmp_path / "state", {}, seconds=0)
    with pytest.raises(TrainingError, match="step 3: the loss is not finite"):
        run_training(Diverging, Recipe(), 4, None, lambda _: 1.0, lambda *_: None, checkpoint)
    found = checkpoint.load()
    assert found is not None and found.step == 2


def test_a_gradient_that_is_not_finite_changes_no_weight(tmp_path: Path) -> None:
    class Sudden(ResumableTrainer):
        stateful_parts = ("network", "optimiser")

        def __init__(self) -> None:
            self.network = torch.nn.Linear(2, 1)
            self.optimiser = torch.optim.AdamW(self.network.parameters())

        def train_step(self, learning_rate: float) -> float:
            loss = self.network(torch.ones(1, 2)).sum().square()
            loss.backward()
            if self.step_count == 1:
                self.before = [value.detach().clone() for value in self.network.parameters()]
                self.network.weight.grad[0, 0] = math.inf
            apply_gradients(self.optimiser, self.network, learning_rate)
            self.step_count += 1
            return float(loss.detach())

    trainer = Sudden()
    with pytest.raises(TrainingError, match="step 2: a gradient is not finite"):
        run_training(lambda: trainer, Recipe(), 2, None, lambda _: 0.1, lambda *_: None)
    assert all(map(torch.equal, trainer.network.parameters(), trainer.before))


@pytest.mark.parametrize("later", [signal.SIGUSR1, None])
def test_a_signal_to_stop_outlives_one_to_save(later: int | None, tmp_path: Path) -> None:
    def stop(*_: Any) -> None:
        raise StoppedError

    earlier = signal.signal(signal.SIGTERM, stop)
    checkpoint = SignalledCheckpoint(tmp_path / "state", {}, 1e9)
    try:
        with pytest.raises(StoppedError), checkpoint.watch():
            signal.raise_signal(signal.SIGTERM)
            if later is not None:
                signal.raise_signal(later)
            checkpoint.save_if_due(Counter(), 1, 1)
    finally:
        signal.signal(signal.SIGTERM, earlier)
    assert checkpoint.path.exists()
