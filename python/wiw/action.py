# SPDX-License-Identifier: Apache-2.0
"""The unified action API: one plan as text, camera trajectory, viewpoints or a model's own numbers.

Follows the section "Unified Action API" of the World-in-World paper. A discrete plan is a sequence of primitive ids,
action k leading from observation k to observation k + 1; a continuous plan is float [K, 7], end-effector poses
(x, y, z, roll, pitch, yaw, gripper) in metres and radians with R = Rz(yaw) Ry(pitch) Rx(roll) and gripper 1 open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw._core import action as _core
from wiw._core.action import Action, ActionSpace, GripperTextTemplate, TextTemplate
from wiw.errors import ArgumentError

NULL = Action.NULL
FORWARD = Action.FORWARD
TURN_LEFT = Action.TURN_LEFT
TURN_RIGHT = Action.TURN_RIGHT
STOP = Action.STOP

__all__ = [
    "FORWARD",
    "NULL",
    "STOP",
    "TURN_LEFT",
    "TURN_RIGHT",
    "Action",
    "ActionSpace",
    "GripperTextTemplate",
    "GripperVocabulary",
    "PoseGrid",
    "TextTemplate",
    "chunk",
    "count_leading_turns",
    "frames_of_actions",
    "pad",
    "parse_action",
    "relative_poses",
    "resample",
    "to_controls",
    "to_text",
    "to_trajectory",
    "to_viewpoints",
    "with_null",
]

Padding = Literal["forward", "repeat", "null"]
RotationCode = Literal["euler", "sin_cos", "matrix_6d", "quaternion_wxyz", "quaternion_xyzw"]
Vocabulary = Mapping[int, Any] | Mapping[str, Any]


@dataclass(frozen=True)
class GripperVocabulary:
    """A model's numbers for 7-DoF poses: [position, rotation, gripper].

    `bounds` (low, high), each 3 metres, maps the position to [-1, 1]; None leaves it in metres.
    """

    rotation: RotationCode = "euler"
    bounds: tuple[Sequence[float], Sequence[float]] | None = None

    def __post_init__(self) -> None:
        if self.bounds is not None:
            low, high = (tuple(float(value) for value in each) for each in self.bounds)
            object.__setattr__(self, "bounds", (low, high))


@dataclass(frozen=True)
class PoseGrid:
    """Gripper poses as whole numbers [X, Y, Z, roll, pitch, yaw, gripper], as written by language models.

    With bins of size r = (high - low) / bins, X stands for the middle of bin X, low + r (X + 1/2); R for the angle R 2
    pi / turns - pi, extrinsic x, y, z; the gripper is 0 closed or 1 open. Prompts give 0 to `bins` and 0 to `turns` as
    the range, so 100 and 120 do occur: 100 is taken as the last bin, and 120 as 0.

    Source: the paper, appendix "Robotic Manipulation", after EmbodiedBench; its workspace, 1 m on each side, is the
    default.
    """

    low: tuple[float, float, float] = (-0.3, -0.5, 0.6)
    high: tuple[float, float, float] = (0.7, 0.5, 1.6)
    bins: int = 100
    turns: int = 120

    def __post_init__(self) -> None:
        ordered = len(self.low) == len(self.high) == 3 and all(np.less(self.low, self.high))
        if not ordered or min(self.bins, self.turns) < 1:
            raise ArgumentError(
                f"PoseGrid: expected low < high, 3 metres each, and at least one bin and turn, got {self.low}, "
                f"{self.high}, {self.bins} and {self.turns}"
            )

    def encode(self, poses: ArrayLike) -> NDArray[np.int64]:
        """Encode float [..., 7] as int64 [..., 7]: positions out of bounds go to the outermost bins, angles to the
        nearest.

        Raises:
            ArgumentError: not finite, or of another shape.
        """
        given = np.asarray(poses, np.float64)
        if given.ndim < 1 or given.shape[-1] != 7 or not np.isfinite(given).all():
            raise ArgumentError(f"PoseGrid.encode: expected finite poses [..., 7], got {given.tolist()}")
        low, high = np.array(self.low), np.array(self.high)
        position = np.floor((given[..., :3] - low) / (high - low) * self.bins).clip(0, self.bins - 1)
        rotation = np.rint((given[..., 3:6] / (2 * np.pi) + 0.5) * self.turns) % self.turns
        return np.concatenate([position, rotation, given[..., 6:] >= 0.5], axis=-1).astype(np.int64)

    def decode(self, numbers: ArrayLike) -> NDArray[np.float64]:
        """Decode whole numbers to float64 [..., 7]: positions are clamped to the bins, angles wrapped, the gripper is 0
        or 1.

        Raises:
            ArgumentError: fractions, or another shape.
        """
        given = np.asarray(numbers)
        if given.ndim < 1 or given.shape[-1] != 7 or not np.issubdtype(given.dtype, np.integer):
            raise ArgumentError(f"PoseGrid.decode: expected whole numbers [..., 7], got {given.dtype} {given.tolist()}")
        low, high = np.array(self.low), np.array(self.high)
        position = low + (given[..., :3].clip(0, self.bins - 1) + 0.5) * (high - low) / self.bins
        rotation = (given[..., 3:6] % self.turns) * (2 * np.pi / self.turns) - np.pi
        return np.concatenate([position, rotation, given[..., 6:].clip(0, 1)], axis=-1)


def count_leading_turns(actions: Sequence[int] | NDArray[np.int8]) -> int:
    """Return how many turns, to whichever side, a plan of primitives begins with."""
    return next((i for i, action in enumerate(actions) if action not in (TURN_LEFT, TURN_RIGHT)), len(actions))


def to_text(
    actions: ArrayLike,
    template: TextTemplate | GripperTextTemplate | None = None,
    space: ActionSpace | None = None,
) -> str:
    """Return the plan as a prompt for image-and-text-to-video models.

    Args:
        actions: ids [K], or poses float [K, 7].
        template: words to use; the default suits the kind of plan. `TextTemplate(prompt=..., phrases={FORWARD: ...},
            separator=..., merge_runs=...)` replaces any part of it.
        space: step sizes that the phrases name; default 0.2 m and 22.5 degrees.

    Raises:
        ArgumentError: an unknown id, a template of the other kind, or a prompt without `{actions}`.
    """
    plan = np.asarray(actions)
    if plan.ndim == 2:
        words = template or GripperTextTemplate()
        if not isinstance(words, GripperTextTemplate):
            raise ArgumentError("to_text: poses [K, 7] need a GripperTextTemplate, got a TextTemplate")
        return str(_core.gripper_to_text(_poses(plan), words))
    words = template or TextTemplate()
    if not isinstance(words, TextTemplate):
        raise ArgumentError("to_text: discrete ids need a TextTemplate, got a GripperTextTemplate")
    return str(_core.to_text(plan, words, space or ActionSpace()))


def to_trajectory(
    actions: ArrayLike, space: ActionSpace | None = None, *, include_start: bool = False
) -> NDArray[np.float64]:
    """Return the plan as a camera trajectory: the pose after each action in the frame of the start.

    Args:
        actions: ids [K] or a batch [..., K].
        space: step sizes.
        include_start: put the start (0, 0, 0) in front, so that row k belongs to frame k.

    Returns:
        float64 [..., K, 3]: x metres forward, y metres left, azimuth in radians (left positive, full circles counted).

    Raises:
        ArgumentError: an unknown id.
    """
    return np.asarray(_core.to_trajectory(np.asarray(actions), space or ActionSpace(), include_start))


def relative_poses(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return planar poses [..., N, 3] in the frame of the last of them; azimuths in [-pi, pi)."""
    last = poses[..., -1:, :]
    change = poses - last
    cos, sin = np.cos(last[..., 2]), np.sin(last[..., 2])
    forward = cos * change[..., 0] + sin * change[..., 1]
    left = cos * change[..., 1] - sin * change[..., 0]
    azimuth = np.remainder(change[..., 2] + np.pi, 2 * np.pi) - np.pi
    return np.stack([forward, left, azimuth], axis=-1)


def to_viewpoints(
    actions: ArrayLike, space: ActionSpace | None = None, *, include_start: bool = False
) -> NDArray[np.float64]:
    """Return the trajectory as camera poses T_start_camera, float64 [..., K, 4, 4] (right +X, up +Y, looking down
    -Z).
    """
    return np.asarray(_core.to_viewpoints(np.asarray(actions), space or ActionSpace(), include_start))


def to_controls(
    actions: ArrayLike, vocabulary: Vocabulary | GripperVocabulary, *, null_first: bool = False
) -> NDArray[np.int64] | NDArray[np.float64]:
    """Return the plan in a model's own vocabulary.

    Args:
        actions: ids [K] or [..., K]; poses float [K, 7] with a `GripperVocabulary`.
        vocabulary: for ids, a map from primitive (id, `Action` or name, e.g. "turn_left") to the model's id or vector.
        null_first: put the null token first, for models that expect one token per frame.

    Returns:
        int64 [..., K] if all entries are whole numbers, else float64 [..., K] or [..., K, D]; for poses float64 [K, D].

    Raises:
        ArgumentError: an action the vocabulary does not know, or entries of different widths.
    """
    plan = np.asarray(actions)
    if isinstance(vocabulary, GripperVocabulary):
        if null_first:
            raise ArgumentError("to_controls: poses are absolute, one per frame; prepend the current pose instead")
        rotation = _rotation(vocabulary.rotation)
        return np.asarray(_core.encode_gripper(_poses(plan), rotation, vocabulary.bounds))
    entries = {parse_action(key): value for key, value in vocabulary.items()}
    scalar = all(np.ndim(value) == 0 for value in entries.values())
    whole = scalar and all(isinstance(value, int | np.integer) for value in entries.values())
    vectors = {key: np.atleast_1d(np.asarray(value, np.float64)).tolist() for key, value in entries.items()}
    encoded = np.asarray(_core.encode(with_null(plan) if null_first else plan, vectors))
    if scalar:
        encoded = encoded[..., 0]
    return encoded.astype(np.int64) if whole else encoded


def with_null(actions: ArrayLike) -> NDArray[np.int8]:
    """Return ids [..., K] with the null token first, [..., K + 1]: entry k then belongs to frame k."""
    plan = np.asarray(actions)
    front = np.full((*plan.shape[:-1], 1), int(NULL), plan.dtype if plan.size else np.int8)
    return np.concatenate([front, plan.astype(front.dtype)], axis=-1)


def resample(
    poses: ArrayLike,
    length: int,
    *,
    start: ArrayLike | None = None,
    gripper: Literal["step", "nearest"] = "step",
) -> NDArray[np.float64]:
    """Bring a plan of poses to the length a model is conditioned on.

    Longer: linear interpolation, rotations by slerp along the shorter arc. Shorter: uniform sampling of the given
    poses. The last pose is always kept.

    Args:
        poses: float [K, 3] trajectory, [K, 7] end-effector poses or [K, 4, 4] viewpoints.
        length: number of poses wanted.
        start: the pose before the plan. With it the new poses are evenly spaced from there, as the frames after the
            observation are; without it the first pose is kept as first.
        gripper: "step" changes the gripper on reaching a waypoint, "nearest" half-way.

    Returns:
        float64 of the same kind with `length` poses.

    Raises:
        ArgumentError: discrete ids (use `pad` or `chunk`), another shape, no poses, or length < 1.
    """
    given = np.asarray(poses)
    if given.size and not np.issubdtype(given.dtype, np.floating):
        raise ArgumentError(
            f"resample: expected floating-point poses, got {given.dtype} {given.shape}: discrete actions cannot be "
            "interpolated; use pad() or chunk()"
        )
    if length < 1:
        raise ArgumentError(f"resample: expected a length of at least 1, got {length}")
    if given.ndim == 3:
        return np.asarray(_core.resample_viewpoints(given, length, start))
    first = None if start is None else np.atleast_2d(np.asarray(start, np.float64))
    if given.ndim == 2 and given.shape[1] == 3:
        return np.asarray(_core.resample_planar(given, length, first))
    if given.ndim == 2 and given.shape[1] == 7:
        return np.asarray(_core.resample_gripper(given, length, first, gripper))
    raise ArgumentError(f"resample: expected poses [K, 3], [K, 7] or [K, 4, 4], got {given.dtype} {given.shape}")


def pad(actions: ArrayLike, length: int, padding: Padding = "forward") -> NDArray[np.int8]:
    """Pad ids [K] to int8 [length] with forward steps, repetitions of the last action, or null tokens.

    Raises:
        ArgumentError: the plan is longer than `length` (use `chunk`), or empty with padding "repeat".
    """
    return np.asarray(_core.pad(np.asarray(actions), length, padding))


def chunk(actions: ArrayLike, length: int, padding: Padding = "forward") -> NDArray[np.int8]:
    """Cut ids [K] into int8 [chunks, length], the last one padded; each is rolled out from the last frame of the one
    before.
    """
    return np.asarray(_core.chunk(np.asarray(actions), length, padding))


def frames_of_actions(count: int, frames: int, fit: Literal["pad", "resample", "chunk"] = "pad") -> NDArray[np.int64]:
    """Return which frame of a model shows the outcome of each action; frame 0 is what a rollout began with.

    Args:
        count: number of actions in the agent's plan.
        frames: length of the model's rollout, frame 0 included.
        fit: how the plan was fitted: "pad" (frame k follows action k), "resample" (the clip covers the plan evenly, and
            the nearest frame is taken) or "chunk" (each chunk covers `frames` - 1 actions).

    Returns:
        int64 [count, 2]: chunk (0 unless chunked) and frame in it.

    Raises:
        ArgumentError: fewer than 2 frames, or a padded plan that does not fit.
    """
    return np.asarray(_core.frames_of_actions(count, frames, fit))


def parse_action(key: int | str) -> Action:
    """Return the primitive of an id or name, such as "turn_left".

    Raises:
        ArgumentError: there is none.
    """
    if isinstance(key, str):
        names = {action.name.lower(): action for action in Action}
        if key.lower() not in names:
            raise ArgumentError(f"vocabulary: unknown action '{key}', expected one of {', '.join(names)}")
        return names[key.lower()]
    try:
        return Action(key)
    except ValueError:
        raise ArgumentError(f"vocabulary: unknown action {key}, expected 0 to {len(Action) - 1}") from None


def _poses(plan: NDArray[Any]) -> NDArray[np.float64]:
    if plan.ndim != 2 or plan.shape[1] != 7:
        raise ArgumentError(
            f"expected poses float [K, 7] (x, y, z, roll, pitch, yaw, gripper), got {plan.dtype} {plan.shape}"
        )
    return plan.astype(np.float64)


def _rotation(name: str) -> _core.RotationCode:
    codes = {code.name.lower(): code for code in _core.RotationCode}
    if name not in codes:
        raise ArgumentError(f"rotation: unknown code '{name}', expected one of {', '.join(codes)}")
    return codes[name]
