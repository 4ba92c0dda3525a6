# SPDX-License-Identifier: Apache-2.0
"""Whether a world model keeps its contract: asked as the loop asks, and told in plain words what is wrong."""

from __future__ import annotations

import json
import sysconfig
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError, ConstructionError, ContractError
from wiw.evaluation.questions import Frames, Questions, Row
from wiw.loop.attempts import DEADLINE, ExitError, LateError, make_model
from wiw.loop.contract import check_model as check_needs
from wiw.types import Control, Space
from wiw.world_models.base import WorldModel

PRIMITIVES = ((FORWARD, TURN_LEFT, FORWARD, FORWARD), (FORWARD, TURN_LEFT, TURN_RIGHT, TURN_RIGHT), (FORWARD,) * 4)
"""No leading turns, which the loop makes itself. The first two begin alike, for models that say they are causal."""


def _poses(*places: tuple[float, float, float]) -> tuple[tuple[float, ...], ...]:
    """With the hand down, open, and shut at the last."""
    return tuple((*place, np.pi, 0.0, 0.0, float(i + 1 < len(places))) for i, place in enumerate(places))


POSES = (
    _poses((0.1, 0.0, 1.05), (0.15, 0.05, 1.0), (0.2, 0.15, 0.95), (0.2, 0.2, 0.85)),
    _poses((0.1, 0.0, 1.05), (0.15, 0.05, 1.0), (0.2, -0.1, 0.95), (0.2, -0.2, 0.85)),
    _poses((0.2, 0.0, 1.1), (0.25, 0.0, 1.05), (0.3, 0.0, 1.0), (0.3, 0.0, 0.95)),
)
"""Likewise of a gripper, over the table."""
PLANS: Mapping[Space, Any] = {"discrete": PRIMITIVES, "pose7": POSES}
LENGTH = 4
"""Actions of each."""
ALIKE = 2
"""Actions with which the first two begin."""
SHORT = 2
"""Actions of a second length, for models that take any."""
NOISE = 8
"""Levels of 255 up to which a difference may come of the order in which a GPU adds up."""
RUNS: Mapping[Space, tuple[str, int]] = {
    "discrete": ("100 episodes of ImageNav", 100 * 20 * 3),
    "pose7": ("200 episodes of manipulation", 200 * 3 * 5),
}
"""The paper's, in words, and the rows that it asks for: episodes, decisions and plans, roughly."""
LIBRARIES = (str(Path(__file__).parents[1]), *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")))
"""Folders of code that is nobody's own model."""
LONG_RUN = 24.0
"""Hours from which such a run is called slow."""


@dataclass(frozen=True)
class Finding:
    """One thing that was found out about a world model."""

    kind: str
    """"needs", "raised", "deadline", the kind of a `ContractError`, "frame 0", "inputs", "random", "batch", "causal",
    "plan", "describe", "version", or "slow"."""
    text: str
    """What is wrong, what was seen, and what to do."""
    serious: bool = True
    """Whether the contract is broken; else it is good to know."""

    def __str__(self) -> str:
        return self.text


def check_model(
    model: Any, scenes: str | Path = "apartments:val:1", *, deadline: float = DEADLINE, **options: Any
) -> list[Finding]:
    """Asks a world model a few rollouts as the loop would, and tells what is wrong with its answers.

        for finding in wiw.check_model(MyModel()):
            print(finding)

    Looked at are type, dtype, shape, number of frames and NaN, frame 0, what it does to its inputs and to earlier
    answers, whether the same seeds give the same frames, whether a row depends on those beside it, whether `causal` is
    true, whether the plan makes a difference, and how long it takes, if it answers at all.

    Args:
        model: as `wiw.world_model` takes it: name, `path.py:Class`, class, instance, "remote:ws://...".
        scenes: where the observations come from; of a model that takes poses, from the tables of manipulation.
        deadline: seconds that a call may take, after which it is not asked any more.
        options: what the model is made with.

    Returns:
        Findings, none where nothing is wrong; the contract is broken where one is `serious`.

    Raises:
        RegistryError: no such model; other errors of wiw where it cannot be made.
        ArgumentError: a deadline that is not above 0.
    """
    if not deadline > 0:
        raise ArgumentError(f"deadline: expected seconds above 0 (inf waits for ever), got {deadline}")
    try:
        made = make_model(model, deadline, **options)
    except ConstructionError as error:
        cause = error.__cause__
        text = f"{error}." if cause is None or error.kind == "deadline" else f"It cannot be made: {_told(cause)}."
        return [Finding(error.kind, text)]
    if made is None:
        raise ArgumentError("check-model: 'none' stands for no world model; see `wiw list` for those that there are")
    try:
        check_needs(made, LENGTH, made.accepts.space, semantics=True)
    except ArgumentError as error:
        return [Finding("needs", f"{error}.")]
    return list(_Check(made, str(scenes), deadline).findings())


class _Check:
    """One model under examination."""

    def __init__(self, model: WorldModel, scenes: str, deadline: float) -> None:
        self.model, self.accepts, self.deadline = model, model.accepts, deadline
        self.plans = PLANS[self.accepts.space]
        self.asking = Questions(model, scenes, deadline)
        self.row_seconds = 0.0

    def findings(self) -> Iterator[Finding]:
        """All there are, in the order in which they are found; the first broken answer ends the asking."""
        try:
            yield from self._answers()
        except ContractError as error:
            yield Finding(error.kind, f"{error}.")
        except LateError:
            yield Finding(
                "deadline",
                f"No answer in {self.deadline:g} s, so it was asked no more. In a run such a call is made three times, "
                "then its episode has failed. Does it wait for a download, a lock, a server or a prompt? If it is only "
                "slow, give it a longer deadline, here and in the run, or a smaller best_batch.",
            )
        except ExitError as error:
            yield Finding(
                "raised", f"`rollout` raised {_told(error.__cause__ or error)}. Only an Exception may leave it."
            )
        except Exception as error:
            yield Finding("raised", f"`rollout` raised {_told(error)}.")
        yield from self._identity()
        yield from self._speed()

    def _answers(self) -> Iterator[Finding]:
        steps = min(LENGTH, self.accepts.frames - 1 if self.accepts.frames else LENGTH)
        rows = self.asking.rows([plan[:steps] for plan in self.plans])
        self.asking.ask(rows[:1])  # the first call may load and compile
        frames = self.asking.ask(rows)
        self.row_seconds = self.asking.row_seconds
        yield from self._first_frames(rows, frames)
        again = list(self._again(rows, frames, steps))
        yield from again
        if not again:  # else every comparison would fail
            yield from self._alone(rows, frames, steps)
            yield from self._causal(rows)
        yield from self._plan(rows, frames, steps)
        yield from self._inputs()
        if not self.accepts.frames:
            self.asking.ask(self.asking.rows([plan[:SHORT] for plan in self.plans]))

    def _first_frames(self, rows: Sequence[Row], frames: Frames) -> Iterator[Finding]:
        off = np.abs(frames[:, 0].astype(np.int16) - np.stack([row.image for row in rows]))
        if off.any():
            yield Finding(
                "frame 0",
                f"Frame 0 is not the observation: it differs by up to {off.max()} of 255, {off.mean():.1f} on average. "
                "Frame k is what follows action k; put the observation in front: frames[:, 0] = observations.image.",
            )

    def _again(self, rows: Sequence[Row], frames: Frames, steps: int) -> Iterator[Finding]:
        shared = min(1, steps - 1)
        off = _off(self.asking.ask(rows, shared), frames, shared, steps)
        if off.any():
            yield _differing(
                "random",
                f"Asked twice with the same seeds, {_share(off)} differ, by up to {off.max()} of 255. Draw all noise "
                "from the row's own seed, as torch.Generator().manual_seed(int(seed)), switch dropout off (eval()), "
                "and keep nothing from one call to the next.",
                off,
            )

    def _alone(self, rows: Sequence[Row], frames: Frames, steps: int) -> Iterator[Finding]:
        shared, some = min(2, steps - 1), [len(rows) - 1, len(rows) // 2]
        alone = np.concatenate([self.asking.ask([rows[place]], shared) for place in some])
        off = _off(alone, frames[some], shared, steps)
        if off.any():
            yield _differing(
                "batch",
                f"A row depends on the rows beside it: alone, {_share(off)} differ from the same in a batch of "
                f"{min(len(rows), self.accepts.best_batch)}, by up to {off.max()} of 255. Draw each row's noise from "
                "its own seed, not the batch's from the first one, and mix no statistics over the batch (BatchNorm in "
                "training).",
                off,
            )

    def _causal(self, rows: Sequence[Row]) -> Iterator[Finding]:
        """Whether frames of a declared causal model stay the same when later primitives change."""
        alike = [
            (one, other)
            for one, other in _pairs(rows)
            if len(one.control.actions) >= LENGTH and _begin_alike(one.control, other.control)
        ]
        if not self.accepts.causal or not alike:
            return
        one, other = alike[0]
        answer = self.asking.ask([replace(other, seed=one.seed)])
        off = _off(answer, self.asking.ask([one]), 0, ALIKE)
        if off.any():
            yield _differing(
                "causal",
                f"It declares causal=True, but frames before a changed action change with it, by up to {off.max()} "
                "of 255; plans that begin alike would share frames that are not theirs. Declare causal=False.",
                off,
            )

    def _plan(self, rows: Sequence[Row], frames: Frames, steps: int) -> Iterator[Finding]:
        places = {id(row): place for place, row in enumerate(rows)}
        pairs = [(frames[places[id(one)]], frames[places[id(other)]]) for one, other in _pairs(rows)]
        if self.accepts.control == "image" or not pairs:
            return
        if all(np.array_equal(one[1 : 1 + steps], other[1 : 1 + steps]) for one, other in pairs):
            yield Finding(
                "plan",
                "Different plans gave the same frames, so it cannot tell an agent which one is better. Does `rollout` "
                f"read the control that it declares ('{self.accepts.control}')?",
                serious=False,
            )

    def _inputs(self) -> Iterator[Finding]:
        if self.asking.changed:
            changed = ", ".join(sorted(self.asking.changed))
            yield Finding("inputs", f"It changes what it is given: {changed}. Work on a copy.")
        if self.asking.reuses:
            yield Finding(
                "memory",
                "An answer lies in the memory of the one before, which is still looked at when the next call is made. "
                "Return an array of its own, as frames.copy().",
            )

    def _identity(self) -> Iterator[Finding]:
        try:
            json.dumps(self.model.describe())
        except Exception as error:
            yield Finding("describe", f"`describe` gives no JSON for the run's record: {_told(error)}.")
        if self.accepts.cacheable and not self.model.fingerprint():
            yield Finding(
                "version",
                "It declares cacheable=True, but no version, so nothing is cached. Give the class one, as "
                "`version = '1'`, and raise it whenever its answers change.",
            )

    def _speed(self) -> Iterator[Finding]:
        run, rows = RUNS[self.accepts.space]
        hours = self.row_seconds * rows / 3600
        if hours > LONG_RUN:
            yield Finding(
                "slow",
                f"A row takes {self.row_seconds:.3g} s. A run of {run} asks for about {rows} of them: "
                f"{hours:.0f} hours. Fewer denoising steps, a larger best_batch or `wiw "
                "serve` on a faster machine make it shorter; --cache asks nothing twice.",
                serious=False,
            )


def _begin_alike(one: Control, other: Control) -> bool:
    """Whether two plans have their first actions in common: primitives, or poses after that of the observation."""
    if one.ids is None or other.ids is None or len(one.ids) == len(one.actions):
        return np.array_equal(one.actions[:ALIKE], other.actions[:ALIKE])
    return np.array_equal(one.ids[: 1 + ALIKE], other.ids[: 1 + ALIKE])


def _pairs(rows: Sequence[Row]) -> list[tuple[Row, Row]]:
    """Rows with different plans from the same place."""
    return [(one, other) for one, other in combinations(rows, 2) if np.array_equal(one.image, other.image)]


def _off(found: Frames, expected: Frames, shared: int, steps: int) -> NDArray[np.int16]:
    """Absolute differences of the frames that are read."""
    read = slice(1 + shared, 1 + steps)
    return np.abs(found[:, read].astype(np.int16) - expected[:, read])


def _share(off: NDArray[np.int16]) -> str:
    return f"{sum(bool(row.any()) for row in off)} of {len(off)} rows"


def _differing(kind: str, text: str, off: NDArray[np.int16]) -> Finding:
    """A finding, which is no breach where it may be the order of additions on a GPU."""
    if off.max() > NOISE:
        return Finding(kind, text)
    return Finding(kind, f"{text} So little may come of the order in which a GPU adds up.", serious=False)


def _told(error: BaseException) -> str:
    """What was raised, and where: the last line before libraries were entered, which is the model's own."""
    frames = traceback.extract_tb(error.__traceback__)
    place = ([frame for frame in frames if not frame.filename.startswith(LIBRARIES)] or frames)[-1]
    return f"{type(error).__name__}: {error} ({Path(place.filename).name}, line {place.lineno}: {place.line})"
