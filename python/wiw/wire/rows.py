# SPDX-License-Identifier: Apache-2.0
"""One row of a rollout over the wire: what the model sees, the plan in every form, the seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from wiw.errors import RemoteError
from wiw.types import Conditioning, Control, History
from wiw.wire.arrays import pack_array, unpack_array
from wiw.wire.messages import Reader, read_count, read_fields, text, unpack_map

SEEN = ("image", "depth", "semantic")
PAST = ("images", "poses", "actions", "lengths")
PLAN = ("actions", "trajectory", "viewpoints", "ids")


@dataclass(frozen=True)
class Row:
    """One future that is requested."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32] | None
    semantic: NDArray[np.uint32] | None
    history: History | None
    """History of one row."""
    control: Control
    seed: int

    @property
    def shape(self) -> tuple[Any, ...]:
        """Return what the rows of a batch have in common.

        The size of the image, the number of actions, the shapes of ids and of the history's poses, and the ids' kind.
        """
        ids, past = self.control.ids, self.history
        kinds = () if ids is None else (ids.shape, ids.dtype.str)
        return self.image.shape, len(self.control.actions), *kinds, *(() if past is None else past.poses.shape[1:])


def pack_row(observations: Conditioning, row: int, control: Control, seed: int) -> bytes:
    """Return one row of what `WorldModel.rollout` is given."""
    seen = {name: getattr(observations, name) for name in SEEN}
    arrays = {name: None if values is None else values[row] for name, values in seen.items()}
    arrays |= {name: getattr(control, name) for name in PLAN}
    packed = {name: None if array is None else pack_array(np.asarray(array)) for name, array in arrays.items()}
    packed["history"] = None if observations.history is None else _pack_history(observations.history.rows([row]))
    plain = {"text": control.text, "length": control.length, "shared": control.shared, "seed": int(seed)}
    return bytes(msgpack.packb({**packed, **plain}))


def _pack_history(history: History) -> dict[str, Any]:
    """Return a map of the arrays of one row, without the padding of actions that others in the batch brought about."""
    return {**{name: pack_array(getattr(history, name)[0]) for name in PAST}, "count": int(history.count[0])}


def row_id(row: bytes) -> bytes:
    """Return the digest of a packed row: 16 bytes that equal questions share."""
    return blake2b(row, digest_size=16).digest()


def unpack_row(data: bytes) -> Row:
    """Return the row behind some bytes.

    Raises:
        RemoteError: no such row; names what is wrong with it.
    """
    values = read_fields("row", unpack_map("row", data), _READERS)
    plan: dict[str, Any] = {name: None if values[name] is None else values[name].copy() for name in PLAN}
    control = Control(**plan, text=values["text"], length=values["length"], shared=values["shared"])
    count = len(control.actions)
    for name, shape in (("trajectory", (count, 3)), ("viewpoints", (count, 4, 4))):
        if getattr(control, name).shape != shape or not np.isfinite(getattr(control, name)).all():
            raise RemoteError(f"row.{name}: expected finite numbers of shape {shape}", "message")
    if control.ids is not None and len(control.ids) not in (count, count + 1):
        raise RemoteError(f"row.ids: expected one for each of {count} actions", "message")
    if not control.shared <= control.length <= count:
        raise RemoteError(f"row: expected shared <= length <= {count} actions", "message")
    seen = {name: values[name] for name in SEEN}
    return Row(control=control, seed=values["seed"], history=values["history"], **seen)


def stack(rows: Sequence[Row]) -> tuple[Conditioning, list[Control], NDArray[np.uint64]]:
    """Return rows of one shape as `WorldModel.rollout` takes them."""
    first = rows[0]
    observations = Conditioning(
        np.stack([row.image for row in rows]),
        depth=None if first.depth is None else np.stack([row.depth for row in rows if row.depth is not None]),
        semantic=None
        if first.semantic is None
        else np.stack([row.semantic for row in rows if row.semantic is not None]),
        history=None
        if first.history is None
        else History.concatenate([row.history for row in rows if row.history is not None]),
    )
    return observations, [row.control for row in rows], np.array([row.seed for row in rows], np.uint64)


def _array(dtype: str, dimensions: int) -> Reader:
    def read(name: str, value: Any) -> NDArray[Any]:
        array = unpack_array(name, value)
        if array.dtype.str != dtype or array.ndim != dimensions:
            expected = f"{np.dtype(dtype).name} in {dimensions} dimensions"
            raise RemoteError(f"{name}: expected {expected}, got {array.dtype} {array.shape}", "message")
        return array

    return read


def _ids(name: str, value: Any) -> NDArray[Any]:
    array = unpack_array(name, value)
    if array.ndim not in (1, 2):
        raise RemoteError(f"{name}: expected ids or vectors, got shape {array.shape}", "message")
    return array


def _history(name: str, value: Any) -> History:
    if not isinstance(value, dict):
        raise RemoteError(f"{name}: expected a map, got {type(value).__name__}", "message")
    values = read_fields(name, value, _HISTORY_READERS)
    images, poses, actions, lengths, count = (values[part] for part in (*PAST, "count"))
    most, gripper = len(images), actions.ndim == 3
    expected = {
        "poses": (poses.shape, (most, 7 if gripper else 3)),
        "actions": (actions.shape, (most - 1, *actions.shape[1:2], *((7,) if gripper else ()))),
        "lengths": (lengths.shape, (most - 1,)),
    }
    for part, (shape, wanted) in expected.items():
        if shape != wanted:
            raise RemoteError(f"{name}.{part}: expected {wanted} for {most} images, got {shape}", "message")
    room = actions.shape[1]
    if room < 1 or not ((lengths >= 0) & (lengths <= room)).all():
        raise RemoteError(f"{name}.lengths: expected 0 to {room} actions, and room for at least one", "message")
    if not np.isfinite(poses).all() or (gripper and not np.isfinite(actions).all()):
        raise RemoteError(f"{name}: expected finite poses", "message")
    if not 1 <= count <= most:
        raise RemoteError(f"{name}.count: expected 1 to {most} frames, got {count}", "message")
    one = np.array([count], np.int64)
    return History(images[None], poses[None], actions[None], lengths[None], one)  # views; `stack` copies them


def _past_actions(name: str, value: Any) -> NDArray[Any]:
    array = unpack_array(name, value)
    if (array.dtype.str, array.ndim) not in (("|i1", 2), ("<f8", 3)):
        raise RemoteError(f"{name}: expected int8 ids or float64 poses, got {array.dtype} {array.shape}", "message")
    return array


def _make_optional(reader: Reader) -> Reader:
    return lambda name, value: None if value is None else reader(name, value)


_HISTORY_READERS: Mapping[str, Reader] = {
    "images": _array("|u1", 4),
    "poses": _array("<f8", 2),
    "actions": _past_actions,
    "lengths": _array("<i8", 1),
    "count": read_count,
}
_READERS: Mapping[str, Reader] = {
    "image": _array("|u1", 3),
    "depth": _make_optional(_array("<f4", 2)),
    "semantic": _make_optional(_array("<u4", 2)),
    "history": _make_optional(_history),
    "actions": _array("|i1", 1),
    "trajectory": _array("<f8", 2),
    "viewpoints": _array("<f8", 3),
    "ids": _make_optional(_ids),
    "text": text,
    "length": read_count,
    "shared": read_count,
    "seed": read_count,
}
