# SPDX-License-Identifier: Apache-2.0
"""Check a world model's contract with requests like the loop's, and report findings in plain words."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError, ConstructionError, ContractError, describe_exception
from wiw.isolation.failures import EndedError, ExitError, LateError, RaisedError
from wiw.loop.attempts import DEADLINE, make_model
from wiw.loop.history import Frame, stack_histories
from wiw.loop.plan_space import plan_space
from wiw.studies.frame_faults import describe_alteration, mean_correlation, measure_jump_fraction, swap_turns
from wiw.studies.model_networks import find_place_of_computation, find_training_networks
from wiw.studies.model_queries import Frames, ModelQueries, Row
from wiw.types import GRIPPER_POSES, PRIMITIVES, Control, History
from wiw.world_models.base import WorldModel
from wiw.world_models.pictures import CLOSE, OTHER
from wiw.world_models.remote.model import Remote

WALKS = ((FORWARD, TURN_LEFT, FORWARD, FORWARD), (FORWARD, TURN_LEFT, TURN_RIGHT, TURN_RIGHT), (FORWARD,) * 4)
"""Plans without leading turns, which the loop makes itself. The first two share a beginning, for causal models."""


def _poses(*places: tuple[float, float, float]) -> tuple[tuple[float, ...], ...]:
    """Return poses with the hand down, open until the last, which is closed."""
    return tuple((*place, np.pi, 0.0, 0.0, float(i + 1 < len(places))) for i, place in enumerate(places))


POSES = (
    _poses((0.1, 0.0, 1.05), (0.15, 0.05, 1.0), (0.2, 0.15, 0.95), (0.2, 0.2, 0.85)),
    _poses((0.1, 0.0, 1.05), (0.15, 0.05, 1.0), (0.2, -0.1, 0.95), (0.2, -0.2, 0.85)),
    _poses((0.2, 0.0, 1.1), (0.25, 0.0, 1.05), (0.3, 0.0, 1.0), (0.3, 0.0, 0.95)),
)
"""The same for a gripper above the table."""
PLANS: Mapping[str, Any] = {PRIMITIVES: WALKS, GRIPPER_POSES: POSES}
LENGTH = 4
"""Actions in each plan."""
ALIKE = 2
"""Actions that the first two plans share."""
SHORT = 2
"""A second plan length, for models that take any."""
NOISE = 8
"""Grey levels, of 255, up to which a difference may be due to rounding."""
MARGIN = 0.06
"""How much better, in correlation, another order of the frames must fit."""
MANY_JUMPS = 0.005
"""Share of neighbouring pixels that jump from black to white, which ordinary images never reach."""
SETTLE = 0.3
"""Seconds to wait for changes to an answer that is still being written to."""
PICTURES: Mapping[str, str] = {"channels": "pictures", "scale": "pictures"}
"""Kinds of `ContractError` that belong to a different check than the one that raised them."""
RUNS: Mapping[str, tuple[str, int]] = {
    PRIMITIVES: ("100 episodes of ImageNav", 100 * 20 * 3),
    GRIPPER_POSES: ("200 episodes of manipulation", 200 * 3 * 5),
}
"""The paper's runs, in words, and roughly how many rows they request: episodes times decisions times plans."""
UNSEEN: Mapping[str, str] = {
    "training": "its networks are on the server",
    "inputs": "it gets copies over the network",
    "memory": "its answers come as copies over the network",
}
"""The checks that a served model would always pass, and why."""
LONG_RUN = 24.0
"""Hours above which such a run is called slow."""


Result = Literal["passed", "wrong", "note", "skipped"]
CHECKS: Mapping[str, str] = {
    "construction": "It can be built, and an agent can give it what it needs",
    "answer": "It answers in time, with uint8 [rows, actions + 1, height, width, 3], no NaN",
    "frame 0": "Frame 0 is the observation",
    "pictures": "Frames are upright images of the place, in RGB from 0 to 255",
    "plan": "Frame k shows what follows action k, and different plans give different frames",
    "training": "Its networks are in evaluation mode",
    "random": "The same seeds give the same frames",
    "batch": "A row does not depend on the other rows in its batch",
    "causal": "Frames do not depend on later actions, as declared (causal)",
    "history": "Past observations make a difference, if it declares to need them",
    "inputs": "It does not modify its inputs",
    "memory": "It does not modify earlier outputs",
    "length": "It accepts plans of other lengths",
    "size": "It also works at the smallest size that it declares",
    "identity": "It describes itself as JSON, and has a version if its rollouts are to be cached",
    "speed": "How long a rollout takes",
}
"""The checks, in this order."""


@dataclass(frozen=True)
class Finding:
    """One finding about a world model."""

    kind: str
    """"needs", "raised", "deadline", the kind of a `ContractError`, "frame 0", "pictures", "training", "random",
    "batch", "causal", "history", "plan", "inputs", "memory", "describe", "version", or "slow"."""
    text: str
    """The fault, the evidence, and the remedy."""
    serious: bool = True
    """Whether the contract is broken; otherwise it is only a note."""

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class Check:
    """One check and its findings."""

    name: str
    """A key of `CHECKS`."""
    findings: tuple[Finding, ...] = ()
    skipped: str = ""
    """Reason why the check was skipped; empty if it was not."""
    detail: str = ""
    """A remark, such as a time."""

    @property
    def result(self) -> Result:
        """The result in one word."""
        if any(finding.serious for finding in self.findings):
            return "wrong"
        return "note" if self.findings else "skipped" if self.skipped else "passed"


def check_model(
    model: Any, scenes: str | Path = "apartments:val:1", *, deadline: float = DEADLINE, **options: Any
) -> list[Finding]:
    """Request a few rollouts from a world model as the loop would, and report what is wrong with them.

        for finding in wiw.check_model(MyModel()):
            print(finding)

    Checks cover type, dtype, shape, number of frames and NaN; frame 0; channel order, scale, orientation and temporal
    order of the frames, compared with what an agent would truly see; networks left in training mode; changes to inputs
    and to earlier outputs; whether the same seeds give the same frames, whether a row depends on the others in its
    batch, whether `causal` holds, whether the plan and (for a model that needs it) the history make a difference; and
    how long a rollout takes, if it returns at all.

    Args:
        model: as `wiw.world_model` takes it: name, `path.py:Class`, class, instance, "remote:ws://...".
        scenes: where the observations come from; for a model that takes poses, the tables of manipulation.
        deadline: time limit in seconds for a call or the constructor, after which checking stops.
        options: the model's options.

    Returns:
        Findings, empty if nothing is wrong; the contract is broken if one is `serious`.

    Raises:
        RegistryError: no such model; other errors of wiw if it cannot be built.
        ArgumentError: a deadline that is not above 0.
    """
    checks = examine_model(model, scenes, deadline=deadline, **options)
    return [finding for check in checks for finding in check.findings]


def examine_model(
    model: Any, scenes: str | Path = "apartments:val:1", *, deadline: float = DEADLINE, **options: Any
) -> list[Check]:
    """Return all checks of `check_model`, with their findings."""
    if not deadline > 0:
        raise ArgumentError(f"deadline: expected seconds above 0 (inf waits for ever), got {deadline}")
    try:
        made = make_model(model, deadline, **options)
    except ConstructionError as error:
        cause = error.__cause__
        text = f"{error}." if cause is None or error.kind == "deadline" else f"It cannot be built: {_describe(cause)}."
        return _build_failed_checks(Finding(error.kind, text))
    if made is None:
        raise ArgumentError("check-model: 'none' stands for no world model; see `wiw list` for the available ones")
    try:
        if made.accepts.space not in PLANS:
            raise ArgumentError(f"check-model knows plans in {', '.join(PLANS)}, but the model takes others")
        plan_space(made.accepts.space).check_model(made, LENGTH)
    except ArgumentError as error:
        return _build_failed_checks(Finding("needs", f"{error}."))
    return _ModelExaminer(made, str(scenes), deadline).checks()


def _build_failed_checks(finding: Finding) -> list[Check]:
    """Return all checks, the first failed and the others skipped."""
    first, *others = CHECKS
    return [Check(first, (finding,)), *(Check(name, skipped="there is no model to check") for name in others)]


class _ModelExaminer:
    """One model under examination."""

    def __init__(self, model: WorldModel, scenes: str, deadline: float) -> None:
        self.model, self.accepts, self.deadline = model, model.accepts, deadline
        self.plans = PLANS[self.accepts.space]
        self.queries = ModelQueries(model, scenes, deadline)
        self.steps = min(LENGTH, self.accepts.frames - 1 if self.accepts.frames else LENGTH)
        self.rows: list[Row] = []
        self.frames: Frames = np.empty(0, np.uint8)
        self.row_seconds = 0.0
        self._done: dict[str, Check] = {"construction": Check("construction")}

    def checks(self) -> list[Check]:
        """Return all checks, in order; the first invalid answer ends the requests."""
        asked: Mapping[str, Callable[[], Iterable[Finding]]] = {
            "answer": self._check_answer,
            "frame 0": self._check_first_frames,
            "pictures": self._check_pictures,
            "plan": self._check_plan,
            "training": self._check_training_mode,
            "random": self._check_determinism,
            "batch": self._check_batch_independence,
            "causal": self._check_causality,
            "history": self._check_history,
            "length": self._check_short_plans,
            "size": self._check_smallest_size,
            "inputs": self._check_inputs,
            "memory": self._check_memory,
        }
        broken = ""
        for name, look in asked.items():
            broken = self._run_check(name, look, broken) or broken
        self._done["identity"] = Check("identity", tuple(self._check_identity()))
        self._done["speed"] = self._measure_speed()
        return [self._done[name] for name in CHECKS]

    def _run_check(self, name: str, look: Callable[[], Iterable[Finding]], broken: str) -> str:
        """Run one check; return why no further requests can be made, if so."""
        if name in self._done:  # it is what broke
            return ""
        skipped = broken or self._find_skip_reason(name)
        if skipped:
            self._done[name] = Check(name, skipped=skipped)
            return ""
        try:
            self._done[name] = Check(name, tuple(look()))
            return ""
        except ContractError as error:
            finding = Finding(error.kind, f"{error}.")
        except (EndedError, RaisedError) as error:
            finding = Finding(error.kind, f"`rollout` failed: {error}.")
        except LateError:
            finding = Finding(
                "deadline",
                f"No answer in {self.deadline:g} s, so the check stopped. In a run, such a call is tried three times "
                "before its episode ends with an error. Is it waiting for a download, a lock, a server or a prompt? "
                "If it is just slow, give it a longer deadline, here and in the run, or a smaller best_batch.",
            )
        except ExitError as error:
            cause = error.__cause__
            said = error if cause is None else _describe(cause)
            text = f"`rollout` raised {said}. Raise an Exception to report an error."
            finding = Finding("raised", text)
        except Exception as error:
            finding = Finding("raised", f"`rollout` raised {_describe(error)}.")
        where = finding.kind if finding.kind in CHECKS else PICTURES.get(finding.kind, name)
        if where != name:
            self._done[name] = Check(name)
        self._done[where] = Check(where, (finding,))
        return "it gave no usable answer"

    def _find_skip_reason(self, name: str) -> str:
        """Return why a check can or must be skipped; empty if it is to be done."""
        if isinstance(self.model, Remote) and name in UNSEEN:
            return f"{UNSEEN[name]}; run `wiw check-model` on the server's machine"
        if name in ("batch", "causal", "history") and self._done["random"].findings:
            return "every comparison would fail: its answers are random"
        declared = {
            "causal": not self.accepts.causal and "it declares causal=False",
            "history": self.accepts.history < 2 and "it needs no history",
            "length": self.accepts.frames and f"it declares {self.accepts.frames} frames",
            "size": self._find_size_skip_reason(),
        }
        return str(declared.get(name) or "")

    def _find_size_skip_reason(self) -> str:
        if not self.accepts.is_scalable:
            return "it declares only one size"
        return "the history that it needs was observed in the largest size" if self.accepts.history else ""

    def _check_answer(self) -> Iterator[Finding]:
        self.rows = self.queries.rows([plan[: self.steps] for plan in self.plans])
        self.queries.ask(self.rows[:1])  # the first call may load and compile
        self.frames = self.queries.ask(self.rows)
        self.row_seconds = self.queries.row_seconds
        yield from ()

    def _check_short_plans(self) -> Iterator[Finding]:
        self.queries.ask(self.queries.rows([plan[:SHORT] for plan in self.plans]))
        yield from ()

    def _check_smallest_size(self) -> Iterator[Finding]:
        self.queries.ask(self.queries.rows([plan[: self.steps] for plan in self.plans], self.accepts.smallest))
        yield from ()

    def _check_first_frames(self) -> Iterator[Finding]:
        off = np.abs(self.frames[:, 0].astype(np.int16) - np.stack([row.image for row in self.rows]))
        if not off.any():
            return
        difference = f"it differs by up to {off.max()} of 255, {off.mean():.1f} on average"
        if off.mean() <= CLOSE:
            yield Finding(
                "frame 0",
                f"Frame 0 is only nearly the observation: {difference}, as after encoding and decoding an image. It "
                "makes next to no difference; frames[:, 0] = observations.image fixes it.",
                serious=False,
            )
        else:
            yield Finding(
                "frame 0",
                f"Frame 0 is not the observation: {difference}. Frame k is what follows action k; put the observation "
                "first: frames[:, 0] = observations.image.",
            )

    def _check_pictures(self) -> Iterator[Finding]:
        own = self._select_action_frames()
        jumps, usual = measure_jump_fraction(own), measure_jump_fraction(np.stack([row.image for row in self.rows]))
        if jumps > MANY_JUMPS + 4 * usual:
            yield Finding(
                "pictures",
                f"Values wrap around: at {jumps:.1%} of positions neighbouring pixels jump from nearly 0 to nearly 255 "
                f"(in the observations: {usual:.1%}). Clip before the cast: np.clip(frames, 0, 255).astype(np.uint8).",
            )
            return
        if fault := describe_alteration(self._truth, own):
            yield Finding("pictures", f"After frame 0, {fault}, compared with what an agent would truly see.")

    @cached_property
    def _truth(self) -> list[Frames]:
        """The frames that an agent would truly see after each action of each row's plan."""
        return self.queries.true_frames(self.rows, [row.plan for row in self.rows])

    def _select_action_frames(self) -> list[Frames]:
        """Return the frames of each row that correspond to its actions."""
        if self.accepts.space == PRIMITIVES:
            return [frames[1 : 1 + self.steps] for frames in self.frames]
        places = action.frames_of_actions(self.steps, self.frames.shape[1], "resample")[:, 1]
        return [frames[places] for frames in self.frames]

    def _check_plan(self) -> Iterator[Finding]:
        places = {id(row): place for place, row in enumerate(self.rows)}
        pairs = [(self.frames[places[id(one)]], self.frames[places[id(other)]]) for one, other in _pairs(self.rows)]
        if self.accepts.control == "image" or not pairs:
            return
        if all(np.array_equal(one[1 : 1 + self.steps], other[1 : 1 + self.steps]) for one, other in pairs):
            yield Finding(
                "plan",
                "Different plans gave the same frames, so they cannot tell an agent which plan is better. Does "
                f"`rollout` read the control that it declares ('{self.accepts.control}')?",
                serious=False,
            )
            return
        own = self._select_action_frames()
        alike = mean_correlation(self._truth, own)
        if mean_correlation([frames[::-1] for frames in self._truth], own) > max(OTHER, alike + MARGIN):
            yield Finding(
                "plan",
                "Time runs backwards: the frames are those of the plan from its end to its beginning. Frame k is what "
                "follows action k: frames[:, 1:] = frames[:, :0:-1] reverses them.",
            )
        elif self.accepts.space == PRIMITIVES:
            swapped = self.queries.true_frames(self.rows, [swap_turns(row.plan) for row in self.rows])
            if mean_correlation(swapped, own) > max(OTHER, alike + MARGIN):
                yield Finding(
                    "plan",
                    "Left and right are swapped: the frames are those of the plan with every turn mirrored. Azimuths "
                    "increase to the left (docs/conventions.md).",
                )

    def _check_training_mode(self) -> Iterator[Finding]:
        for path, layers in find_training_networks(self.model):
            yield Finding(
                "training",
                f"{path} is in training mode, with {', '.join(layers)}: dropout ignores the seeds, and batch "
                "statistics mix the rows. Call .eval() on it after loading.",
            )

    def _check_determinism(self) -> Iterator[Finding]:
        shared = min(1, self.steps - 1)
        off = _compute_differences(self.queries.ask(self.rows, shared), self.frames, shared, self.steps)
        if off.any():
            yield self._build_difference_finding(
                "random",
                f"In two calls with the same seeds, {_count_rows(off)} differ, by up to {off.max()} of 255. Draw noise "
                "from the row's own seed, with torch.Generator().manual_seed(int(seed)), switch dropout off (eval()), "
                "and keep no state between calls.",
                off,
            )

    def _check_batch_independence(self) -> Iterator[Finding]:
        rows = self.rows
        shared, some = min(2, self.steps - 1), [len(rows) - 1, len(rows) // 2]
        alone = np.concatenate([self.queries.ask([rows[place]], shared) for place in some])
        off = _compute_differences(alone, self.frames[some], shared, self.steps)
        if off.any():
            yield self._build_difference_finding(
                "batch",
                f"A row depends on the other rows in its batch: alone, {_count_rows(off)} differ from the same rows in "
                f"a batch of {min(len(rows), self.accepts.best_batch)}, by up to {off.max()} of 255. Draw each row's "
                "noise from its own seed, not the whole batch's from the first one, and do not mix statistics over "
                "the batch (BatchNorm in training mode).",
                off,
            )

    def _check_causality(self) -> Iterator[Finding]:
        """Check whether frames of a declared causal model stay the same when later primitives change."""
        alike = [
            (one, other)
            for one, other in _pairs(self.rows)
            if len(one.control.actions) >= LENGTH and _share_first_actions(one.control, other.control)
        ]
        if not alike:
            return
        one, other = alike[0]
        answer = self.queries.ask([replace(other, seed=one.seed)])
        off = _compute_differences(answer, self.queries.ask([one]), 0, ALIKE)
        if off.any():
            yield self._build_difference_finding(
                "causal",
                f"It declares causal=True, but frames before a changed action change too, by up to {off.max()} of 255; "
                "plans with a common beginning would share wrong frames. Declare causal=False.",
                off,
            )

    def _check_history(self) -> Iterator[Finding]:
        young = self.queries.ask([replace(row, history=_first_moment(row.history)) for row in self.rows])
        if not _compute_differences(young, self.frames, 0, self.steps).any():
            yield Finding(
                "history",
                "Past observations make no difference: at the start of an episode its frames are the same. Does "
                "`rollout` read `observations.history`? If it does not need it, remove it from `needs`.",
                serious=False,
            )

    def _check_inputs(self) -> Iterator[Finding]:
        if changed := self.queries.watch().changed:
            yield Finding("inputs", f"It modifies its inputs: {', '.join(changed)}. Work on a copy.")

    def _check_memory(self) -> Iterator[Finding]:
        time.sleep(SETTLE)  # for a thread that still writes
        watched = self.queries.watch()
        if watched.reuses:
            yield Finding(
                "memory",
                "An answer uses the memory of an earlier one, which is still in use when the next call is made. "
                "Return a new array, such as frames.copy().",
            )
        elif watched.rewrites:
            yield Finding(
                "memory",
                "An answer was written to after it was returned, while it was in use: by a later call, a thread, or "
                "an asynchronous copy from the GPU. Return an array that nothing else refers to, once it is complete.",
            )

    def _check_identity(self) -> Iterator[Finding]:
        try:
            json.dumps(self.model.describe())
        except Exception as error:
            yield Finding(
                "describe",
                f"`describe` does not return JSON for the run's record: {_describe(error)}.",
            )
        if self.accepts.cacheable and not self.model.fingerprint():
            yield Finding(
                "version",
                "It declares cacheable=True but no version, so nothing is cached. Give the class one, such as "
                "`version = '1'`, and change it whenever its answers change.",
            )

    def _measure_speed(self) -> Check:
        if not self.row_seconds:
            return Check("speed", skipped="it gave no usable answer")
        run, rows = RUNS[self.accepts.space]
        hours = self.row_seconds * rows / 3600
        batch = min(len(self.rows), self.accepts.best_batch)
        detail = f"{self.row_seconds:.3g} s a rollout of {self.steps} actions, {batch} at a time"
        found = Finding(
            "slow",
            f"A row takes {self.row_seconds:.3g} s. A run of {run} requests about {rows} of them: {hours:.0f} hours. "
            "Fewer denoising steps, a larger best_batch or `wiw serve` on a faster machine shorten it; --cache never "
            "computes the same rollout twice.",
            serious=False,
        )
        return Check("speed", (found,) if hours > LONG_RUN else (), detail=detail)

    def _build_difference_finding(self, kind: str, text: str, off: NDArray[np.int16]) -> Finding:
        """Return a finding, which is not serious if it may be due to rounding."""
        if off.max() > NOISE:
            return Finding(kind, text)
        where = find_place_of_computation(self.model)
        cause = {
            "gpu": "A difference this small may come from the order of additions on a GPU.",
            "cpu": "A difference this small may be rounding: a CPU adds in a different order if batches or threads "
            "differ.",
            "elsewhere": "A difference this small may be rounding on the machine that computes it.",
        }
        return Finding(kind, f"{text} {cause[where]}", serious=False)


def _share_first_actions(one: Control, other: Control) -> bool:
    """Return whether two plans share their first actions: primitives, or poses after that of the observation."""
    if one.ids is None or other.ids is None or len(one.ids) == len(one.actions):
        return np.array_equal(one.actions[:ALIKE], other.actions[:ALIKE])
    return np.array_equal(one.ids[: 1 + ALIKE], other.ids[: 1 + ALIKE])


def _first_moment(history: History | None) -> History:
    """Return the history of one row as if its episode began with frame 0."""
    assert history is not None  # the model needs one
    most = history.images.shape[1]
    now = Frame(history.images[0, -1], history.poses[0, -1], history.actions[0, :0, 0])
    return stack_histories([[now]], most)


def _pairs(rows: Sequence[Row]) -> list[tuple[Row, Row]]:
    """Return pairs of rows with different plans from the same place."""
    return [(one, other) for one, other in combinations(rows, 2) if np.array_equal(one.image, other.image)]


def _compute_differences(found: Frames, expected: Frames, shared: int, steps: int) -> NDArray[np.int16]:
    """Return absolute differences of the frames that are read."""
    read = slice(1 + shared, 1 + steps)
    return np.abs(found[:, read].astype(np.int16) - expected[:, read])


def _count_rows(off: NDArray[np.int16]) -> str:
    return f"{sum(bool(row.any()) for row in off)} of {len(off)} rows"


def _describe(error: BaseException) -> str:
    """Return the exception with the line that raised it, which is the model's own."""
    return describe_exception(error, show_line=True)
