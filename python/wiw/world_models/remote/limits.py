# SPDX-License-Identifier: Apache-2.0
"""Limits of the connection: rows as a model accepts them, and no larger."""

from __future__ import annotations

from wiw.errors import RemoteError
from wiw.types import GRIPPER_POSES, History
from wiw.wire.messages import MOST_BYTES
from wiw.wire.rows import Row
from wiw.world_models.base import Accepts

CONTROL_BYTES = 2**20
"""Maximum size of a row beside its images in bytes."""


def most_bytes(accepts: Accepts) -> int:
    """Return the greatest size of one message of a client."""
    height, width = accepts.size
    needs = {"depth": 4, "semantic": 4, "history": 3 * accepts.history}
    pixel = 3 + sum(size for need, size in needs.items() if need in accepts.needs)
    return min(MOST_BYTES, height * width * pixel + CONTROL_BYTES)


def check_row(row: Row, accepts: Accepts) -> None:
    """Hold a row to what the model accepts, and its answer to what can be sent.

    Raises:
        RemoteError: what was expected and what came.
    """
    size, count = row.image.shape[:2], len(row.control.actions)
    if not accepts.takes_size(size):
        least = f"{accepts.smallest} to " if accepts.is_scalable else ""
        raise RemoteError(f"row.image: expected {least}{accepts.size} pixels, got shape {row.image.shape}", "row")
    for name in ("image", "depth", "semantic", "history"):
        array, needed = getattr(row, name), name == "image" or name in accepts.needs
        if (array is not None) != needed:
            raise RemoteError(f"row.{name}: {'missing' if needed else 'the model does not take it'}", "row")
        if array is not None and name != "history" and array.shape[:2] != size:
            raise RemoteError(f"row.{name}: expected {size} pixels, got shape {array.shape}", "row")
    if row.image.shape[2:] != (3,):
        raise RemoteError("row: expected images of three channels", "row")
    if row.history is not None:
        _check_history(row.history, accepts, size)
    if (row.control.ids is not None) != (accepts.control == "action"):
        raise RemoteError(f"row.ids: these ids do not fit a model with control '{accepts.control}'", "row")
    if count < 1 or (accepts.frames and count != accepts.frames - 1):
        expected = accepts.frames - 1 if accepts.frames else "at least 1"
        raise RemoteError(f"row.actions: expected {expected} actions, got {count}", "row")
    if (count + 1) * row.image.size > MOST_BYTES - CONTROL_BYTES:
        raise RemoteError(f"row.actions: {count} frames of {size} pixels are too many to send", "row")


def _check_history(history: History, accepts: Accepts, size: tuple[int, ...]) -> None:
    expected, images = (accepts.history, *size, 3), history.images.shape[1:]
    if images != expected:
        raise RemoteError(f"row.history: expected images {expected}, got {images}", "row")
    follows = accepts.control not in ("image", "text")  # those know nothing of primitives or poses
    width = 7 if accepts.space == GRIPPER_POSES else 3
    if follows and history.poses.shape[2] != width:
        raise RemoteError(f"row.history: expected poses of {width} numbers, got {history.poses.shape[2]}", "row")
