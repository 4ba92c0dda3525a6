# SPDX-License-Identifier: Apache-2.0
"""Files of demonstrations: Parquet, a row per frame, a row group per demonstration (`docs/demonstrations.md`)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wiw.datasets import parquet_files
from wiw.datasets.demonstration import Demonstration, Outline
from wiw.datasets.parquet_files import RowGroupFile, build_schema, image_type, image_values, write_row_groups

FORMAT = 1
COLUMNS: Mapping[str, str] = {
    "task": "which kind of manipulation it is",
    "variation": "number of the combination of colours, counts and targets",
    "seed": "of the table: where things are",
    "episode": "number of the demonstration within its task",
    "frame": "from 0",
    "seconds": "of the physics, since frame 0",
    "instruction": "what is asked for, in words",
    "pose": "where the gripper is: x, y, z in metres, z up; roll, pitch, yaw in radians, R = Rz Ry Rx; 1 open, 0 shut",
    "action": "the pose that it is told to go to, likewise; in frame 0 the first",
    "key": "number of the action under way, from 1; 0 in frame 0",
    "ended": "whether the action has ended in this frame, which makes it a key frame",
    "success": "whether what is asked for is done in the end",
    "places": "JSON: T_world_object [4, 4] in frame 0 of all that agents are told the place of, by name",
    "image": "the front view, sRGB, JPEG or PNG",
    "depth": "the front view's planar depth, 16-bit PNG, 5000 a metre, 0 where nothing is hit",
    "wrist": "the wrist camera's view, sRGB, JPEG or PNG",
    "wrist_depth": "its planar depth, as that of the front view",
    "wrist_pose": "T_world_camera of the wrist camera, 4 x 4 row by row; it looks along -z with +y up",
}
PICTURES = ("image", "depth", "wrist", "wrist_depth")
REPEATED = ("task", "instruction", "places")
"""Text that is the same all through a demonstration, which Parquet then writes once."""


def require_pyarrow() -> None:
    """Check that files can be read and written.

    Raises:
        DependencyError: pyarrow is not installed.
    """
    parquet_files.require_pyarrow("demonstrations")


def write(path: Path, demonstrations: Sequence[Demonstration], facts: Mapping[str, Any]) -> None:
    """Write a file, which is there whole or not at all.

    Args:
        path: of the file; what it held is replaced.
        demonstrations: of as many frames each.
        facts: JSON-able: what holds for all of them.

    Raises:
        FileError: it cannot be written, for instance because the disk is full.
    """
    schema = _build_schema(_list_columns(demonstrations[0]), facts)
    tables = (_build_table(each, schema) for each in demonstrations)
    write_row_groups(path, schema, tables, use_dictionary=list(REPEATED), compression=_choose_compression(schema.names))


class Shard(RowGroupFile):
    """A file that is read demonstration by demonstration.

    Raises:
        FileError: it does not exist, is damaged, or was not written by wiw.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, FORMAT, "demonstrations")

    def __getitem__(self, index: int) -> Demonstration:
        """Return a demonstration, whose pictures are not yet decoded.

        Raises:
            FileError: the file is damaged.
        """
        rows = self.read(index).to_pydict()
        with self.blame_damage():
            return _build_demonstration(rows)

    def read_outline(self, index: int) -> Outline:
        """Return when the actions of a demonstration end, and at which table; its pictures are not read.

        Raises:
            FileError: the file is damaged.
        """
        rows = self.read(index, ["task", "seed", "ended"]).to_pydict()
        with self.blame_damage():
            return Outline(rows["task"][0], rows["seed"][0], np.array(rows["ended"], np.bool_))


def _list_columns(demonstration: Demonstration) -> list[str]:
    """Return the columns of a file with such demonstrations."""
    absent = {
        "depth": demonstration.encoded_depths is None,
        "wrist": demonstration.encoded_wrist_images is None,
        "wrist_depth": demonstration.encoded_wrist_depths is None,
        "wrist_pose": demonstration.wrist_poses is None,
    }
    return [name for name in COLUMNS if not absent.get(name)]


def _build_schema(columns: Sequence[str], facts: Mapping[str, Any]) -> Any:
    import pyarrow as pa

    picture = image_type()
    pose = pa.list_(pa.float64(), 7)
    types = {
        "task": pa.string(),
        "variation": pa.int32(),
        "seed": pa.int64(),
        "episode": pa.int32(),
        "frame": pa.int32(),
        "seconds": pa.float64(),
        "instruction": pa.string(),
        "pose": pose,
        "action": pose,
        "key": pa.int32(),
        "ended": pa.bool_(),
        "success": pa.bool_(),
        "places": pa.string(),
        "image": picture,
        "depth": picture,
        "wrist": picture,
        "wrist_depth": picture,
        "wrist_pose": pa.list_(pa.float64(), 16),
    }
    about = {name: COLUMNS[name] for name in columns}
    return build_schema({name: types[name] for name in columns}, {"format": FORMAT, **facts, "columns": about})


def _choose_compression(columns: Sequence[str]) -> dict[str, str]:
    """Return the compression of each column; pictures are compressed already."""
    pictures = [f"{name}.{part}" for name in columns if name in PICTURES for part in ("bytes", "path")]
    lists = ("pose", "action", "wrist_pose")
    numbers = [f"{name}.list.element" if name in lists else name for name in columns if name not in PICTURES]
    return {**dict.fromkeys(numbers, "zstd"), **dict.fromkeys(pictures, "none")}


def _build_table(demonstration: Demonstration, schema: Any) -> Any:
    import pyarrow as pa

    each, count = demonstration, len(demonstration)
    columns: dict[str, Any] = {
        "task": [each.task] * count,
        "variation": [each.variation] * count,
        "seed": [each.seed] * count,
        "episode": [each.episode] * count,
        "frame": range(count),
        "seconds": each.seconds,
        "instruction": [each.instruction] * count,
        "pose": list(each.poses),
        "action": list(each.actions),
        "key": each.keys,
        "ended": each.ended,
        "success": [each.success] * count,
        "places": [json.dumps({name: pose.tolist() for name, pose in each.places.items()})] * count,
        "image": image_values(each.encoded_images),
    }
    for name, encoded in (
        ("depth", each.encoded_depths),
        ("wrist", each.encoded_wrist_images),
        ("wrist_depth", each.encoded_wrist_depths),
    ):
        if encoded is not None:
            columns[name] = image_values(encoded)
    if each.wrist_poses is not None:
        columns["wrist_pose"] = list(each.wrist_poses.reshape(count, 16))
    return pa.table([pa.array(columns[name], schema.field(name).type) for name in schema.names], schema=schema)


def _build_demonstration(rows: Mapping[str, list[Any]]) -> Demonstration:
    def read_pictures(name: str) -> tuple[bytes, ...] | None:
        return None if name not in rows else tuple(picture["bytes"] for picture in rows[name])

    poses = rows.get("wrist_pose")
    return Demonstration(
        task=rows["task"][0],
        variation=rows["variation"][0],
        seed=rows["seed"][0],
        episode=rows["episode"][0],
        instruction=rows["instruction"][0],
        success=rows["success"][0],
        places={name: np.array(pose, np.float64) for name, pose in json.loads(rows["places"][0]).items()},
        seconds=np.array(rows["seconds"], np.float64),
        poses=np.array(rows["pose"], np.float64),
        actions=np.array(rows["action"], np.float64),
        keys=np.array(rows["key"], np.int32),
        ended=np.array(rows["ended"], np.bool_),
        encoded_images=tuple(picture["bytes"] for picture in rows["image"]),
        encoded_depths=read_pictures("depth"),
        encoded_wrist_images=read_pictures("wrist"),
        encoded_wrist_depths=read_pictures("wrist_depth"),
        wrist_poses=None if poses is None else np.array(poses, np.float64).reshape(-1, 4, 4),
    )
