# SPDX-License-Identifier: Apache-2.0
"""Parquet files of the navigation dataset: one row per frame, one row group per segment.

`docs/collecting-navigation.md` describes the columns.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wiw.datasets.navigation_segment import NavigationSegment
from wiw.datasets.parquet_files import (
    RowGroupFile,
    build_schema,
    hash_file,
    image_type,
    image_values,
    write_row_groups,
)

FORMAT = 1
COLUMNS: Mapping[str, str] = {
    "scene": "name of the scene",
    "pass": "number of the pass over the scene, from 0",
    "island": "part of the scene's navigation mesh",
    "segment": "number of the segment within the pass; a segment is a row group",
    "index": "number of the frame within its segment, from 0",
    "rgb": "what the camera sees; null after a turn, see source and roll",
    "depth": "distance in millimetres, 16-bit PNG, 0 where nothing is hit; null after a turn",
    "source": "index of the frame of this segment that has the picture of this position",
    "roll": "columns to roll that picture by: numpy.roll(rgb[source], roll, axis=1)",
    "T_world_camera": "pose: metres, +Y up, the camera looks along -Z",
    "action": "that led to this frame: 0 none, 1 forward 0.2 m, 2 turn left, 3 turn right by 22.5 degrees",
    "height": "metres of the camera above the floor",
    "seed": "of the dataset",
}
SEGMENT_COLUMNS: Mapping[str, str] = {
    "scene": "string",
    "pass": "int32",
    "island": "int32",
    "segment": "int32",
    "file": "string",
    "row_group": "int32",
    "frames": "int32",
    "pictures": "int32",
    "forward": "int32",
    "turn_left": "int32",
    "turn_right": "int32",
    "ending": "string",
}
"""Columns of `segments.parquet`, with their types."""
SEGMENTS = "segments.parquet"


def navigation_schema(depth: bool, facts: Mapping[str, Any]) -> Any:
    """Return the Arrow schema of frames.

    Args:
        depth: whether there is a depth column.
        facts: JSON-able: what holds for all frames.
    """
    import pyarrow as pa

    types = {
        "scene": pa.string(),
        "pass": pa.int32(),
        "island": pa.int32(),
        "segment": pa.int32(),
        "index": pa.int32(),
        "rgb": image_type(),
        "depth": image_type(),
        "source": pa.int32(),
        "roll": pa.int32(),
        "T_world_camera": pa.list_(pa.list_(pa.float64(), 4), 4),
        "action": pa.int8(),
        "height": pa.float32(),
        "seed": pa.int64(),
    }
    if not depth:
        del types["depth"]
    columns = {name: COLUMNS[name] for name in types}
    return build_schema(types, {"format": FORMAT, **facts, "columns": columns})


def build_table(segment: NavigationSegment, schema: Any) -> Any:
    """Return the rows of a segment as an Arrow table."""
    import pyarrow as pa

    each, count = segment, len(segment)
    columns: dict[str, Any] = {
        "scene": [each.scene] * count,
        "pass": [each.pass_index] * count,
        "island": [each.island] * count,
        "segment": [each.segment] * count,
        "index": range(count),
        "rgb": image_values(each.encoded_images),
        "source": each.sources,
        "roll": each.rolls,
        "T_world_camera": each.poses.tolist(),
        "action": each.actions,
        "height": np.full(count, each.height, np.float32),
        "seed": [each.seed] * count,
    }
    if each.encoded_depths is not None:
        columns["depth"] = image_values(each.encoded_depths)
    return pa.table([pa.array(columns[name], schema.field(name).type) for name in schema.names], schema=schema)


def write_frames(path: Path, schema: Any, tables: Iterable[Any]) -> None:
    """Write a file of segments, each a table of `build_table`; it is there whole or not at all.

    Pictures are packed already, so that their columns are neither compressed nor looked up in dictionaries; a page
    index lets readers skip them.

    Raises:
        FileError: it cannot be written, for instance because the disk is full.
    """
    pictures = [name for name in ("rgb", "depth") if name in schema.names]
    plain = [name for name in schema.names if name not in (*pictures, "T_world_camera")]
    packing = dict.fromkeys((*plain, "T_world_camera.list.element.list.element"), "zstd")
    packing |= {f"{name}.{part}": "none" for name in pictures for part in ("bytes", "path")}
    write_row_groups(path, schema, tables, use_dictionary=["scene"], compression=packing, write_page_index=True)


class FrameFile(RowGroupFile):
    """A file of frames that is read segment by segment.

    Raises:
        FileError: it does not exist, is damaged, or was not written by wiw.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, FORMAT, "navigation frames")

    def read_segment(self, row_group: int, pictures: bool = True) -> NavigationSegment:
        """Return a segment; nothing else of the file is read.

        Args:
            row_group: its number in the file.
            pictures: whether to read colour and depth, too; without, `encoded_images` are None.

        Raises:
            FileError: the file is damaged.
        """
        with self.blame_damage():
            names = [name for name in self.facts["columns"] if pictures or name not in ("rgb", "depth")]
            return _build_segment(self.read(row_group, names))


def _build_segment(table: Any) -> NavigationSegment:
    def first(name: str) -> Any:
        return table.column(name)[0].as_py()

    def numbers(name: str, kind: Any) -> Any:
        return np.asarray(table.column(name).to_numpy(), kind)

    def pictures(name: str) -> tuple[bytes | None, ...] | None:
        if name not in table.column_names:
            return None
        return tuple(None if each is None else each["bytes"] for each in table.column(name).to_pylist())

    count = len(table)
    poses = table.column("T_world_camera").combine_chunks().flatten().flatten().to_numpy()
    return NavigationSegment(
        scene=first("scene"),
        pass_index=first("pass"),
        island=first("island"),
        segment=first("segment"),
        seed=first("seed"),
        height=float(first("height")),
        actions=numbers("action", np.int8),
        poses=np.array(poses, np.float64).reshape(count, 4, 4),
        sources=numbers("source", np.int32),
        rolls=numbers("roll", np.int32),
        encoded_images=pictures("rgb") or (None,) * count,
        encoded_depths=pictures("depth"),
    )


def describe_file(path: Path, frames: int) -> dict[str, Any]:
    """Return what `meta.json` says about a file with so many frames."""
    return {"frames": frames, "bytes": path.stat().st_size, "sha256": hash_file(path)}


def write_segment_list(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write `segments.parquet`: one row per segment, with where it is and what is in it.

    Raises:
        FileError: it cannot be written.
    """
    import pyarrow as pa

    types = {name: pa.type_for_alias(kind) for name, kind in SEGMENT_COLUMNS.items()}
    schema = build_schema(types, {"format": FORMAT})
    table = pa.table([pa.array([row[name] for row in rows], types[name]) for name in types], schema=schema)
    write_row_groups(path, schema, [table], compression="zstd")


def read_segment_list(path: Path) -> list[dict[str, Any]]:
    """Return the rows of `segments.parquet`.

    Raises:
        FileError: it is missing or damaged.
    """
    rows: list[dict[str, Any]] = RowGroupFile(path, FORMAT, "segments").read(0).to_pylist()
    return rows
