# SPDX-License-Identifier: Apache-2.0
"""Write LeRobot datasets, format v3.0."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wiw.datasets.lerobot.layout import (
    CHUNK_FILES,
    DATA,
    EPISODES,
    FILE_MEGABYTES,
    INDICES,
    INFO,
    SOURCE,
    STATS,
    TASKS,
    VERSION,
    VIDEO_MEGABYTES,
    Episode,
    Feature,
)
from wiw.datasets.lerobot.statistics import DatasetTally, FeatureTally, tally_episode
from wiw.datasets.parquet_files import build_schema, image_values, write_row_groups
from wiw.errors import ArgumentError
from wiw.files import atomic_folder


def write_dataset(
    out: Path,
    episodes: Iterable[Episode],
    features: Mapping[str, Feature],
    *,
    fps: int,
    robot: str,
    source: Mapping[str, Any],
    card: str,
) -> None:
    """Write a dataset, which is there whole or not at all.

    Args:
        out: a new or empty folder.
        episodes: taken one by one.
        features: of their columns.
        fps: frames per second, which timestamps are counted in.
        robot: name of the kind of robot.
        source: JSON-able: what importing needs beyond the episodes.
        card: text of README.md.

    Raises:
        ArgumentError: a rate below 1, or no episodes.
        FileError: the folder holds something already or cannot be written, or a picture of an episode is damaged.
    """
    if fps < 1:
        raise ArgumentError(f"expected at least 1 frame per second, got {fps}")
    with atomic_folder(out) as folder:
        writer = _Writer(folder, features, fps)
        for episode in episodes:
            writer.add(episode)
        writer.finish(robot)
        (folder / SOURCE).write_text(json.dumps(source) + "\n")
        (folder / "README.md").write_text(card)


class _Writer:
    """Collects episodes until they fill a file."""

    def __init__(self, folder: Path, features: Mapping[str, Feature], fps: int) -> None:
        self._folder, self._fps = folder, fps
        self._features = {**features, **INDICES}
        self._schema = build_schema({name: each.arrow_type() for name, each in self._features.items()}, {})
        self._waiting: list[Any] = []
        """Tables of the file under way."""
        self._files = self._frames = 0
        self._tasks: dict[str, int] = {}
        self._rows: list[dict[str, Any]] = []
        self._tally = DatasetTally()

    def add(self, episode: Episode) -> None:
        import pyarrow as pa

        columns = self._number_frames(episode)
        table = pa.table(
            [_build_array(self._features[name], columns[name]) for name in self._schema.names], self._schema
        )
        if self._waiting and sum(each.nbytes for each in (*self._waiting, table)) > FILE_MEGABYTES * 2**20:
            self._write_file()
        self._waiting.append(table)
        tally = tally_episode(self._features, columns)
        self._tally.add(tally)
        self._rows.append(self._describe_episode(episode, len(table), tally))
        self._frames += len(table)

    def finish(self, robot: str) -> None:
        """Write what is left and all that is about the whole dataset."""
        if not self._rows:
            raise ArgumentError("expected a dataset with episodes, got none")
        self._write_file()
        _write_tasks(self._folder / TASKS, list(self._tasks))
        _write_episodes(self._folder / EPISODES, self._rows)
        _write_json(self._folder / STATS, self._tally.describe())
        _write_json(self._folder / INFO, self._describe_dataset(robot))

    def _number_frames(self, episode: Episode) -> dict[str, Any]:
        """Return the columns of an episode with `INDICES`."""
        count = len(next(iter(episode.columns.values())))
        task = self._tasks.setdefault(episode.instruction, len(self._tasks))
        frames = np.arange(count)
        return {
            **episode.columns,
            "timestamp": (frames / self._fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(count, len(self._rows)),
            "index": frames + self._frames,
            "task_index": np.full(count, task),
        }

    def _write_file(self) -> None:
        path = self._folder / DATA.format(**self._place)
        write_row_groups(
            path, self._schema, self._waiting, use_dictionary=False, compression=self._choose_compression()
        )
        self._waiting = []
        self._files += 1

    def _choose_compression(self) -> dict[str, str]:
        """Return the compression of each column; pictures are packed already."""
        packing: dict[str, str] = {}
        for name, each in self._features.items():
            if each.is_image:
                packing |= {f"{name}.{part}": "none" for part in ("bytes", "path")}
            else:
                packing[name if each.shape == (1,) else f"{name}.list.element"] = "zstd"
        return packing

    @property
    def _place(self) -> dict[str, int]:
        """Numbers of the file under way."""
        return {"chunk_index": self._files // CHUNK_FILES, "file_index": self._files % CHUNK_FILES}

    def _describe_episode(self, episode: Episode, count: int, tally: Mapping[str, FeatureTally]) -> dict[str, Any]:
        """Return the row of `meta/episodes`."""
        statistics = {name: each.describe() for name, each in tally.items()}
        return {
            "episode_index": len(self._rows),
            "tasks": [episode.instruction],
            "length": count,
            **{f"data/{name}": number for name, number in self._place.items()},
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + count,
            **{f"stats/{name}/{key}": value for name, each in statistics.items() for key, value in each.items()},
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            **episode.facts,
        }

    def _describe_dataset(self, robot: str) -> dict[str, Any]:
        """Return the content of `meta/info.json`."""
        return {
            "codebase_version": VERSION,
            "robot_type": robot,
            "total_episodes": len(self._rows),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": FILE_MEGABYTES,
            "video_files_size_in_mb": VIDEO_MEGABYTES,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._rows)}"},
            "data_path": DATA,
            "video_path": None,
            "features": {name: each.describe() for name, each in self._features.items()},
        }


def _build_array(feature: Feature, values: Any) -> Any:
    """Return a column as an Arrow array."""
    import pyarrow as pa

    if feature.is_image:
        return pa.array(image_values(values), feature.arrow_type())
    numbers = np.ascontiguousarray(values, feature.dtype)
    if feature.shape == (1,):
        return pa.array(numbers)
    return pa.FixedSizeListArray.from_arrays(pa.array(numbers.ravel()), feature.shape[0])


def _write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the tasks as pandas would, so that it makes them the index when it reads them."""
    import pyarrow as pa

    columns = [("task_index", "int64", "int64"), ("task", "unicode", "object")]
    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}
        for name, kind, stored in columns
    ]
    metadata = {"index_columns": ["task"], "column_indexes": [], "columns": described, "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    schema = table.schema.with_metadata({b"pandas": json.dumps(metadata).encode()})
    write_row_groups(path, schema, [table.cast(schema)])


def _write_episodes(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    import pyarrow as pa

    table = pa.Table.from_pylist(list(rows))
    write_row_groups(path, table.schema, [table], compression="zstd")


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4) + "\n")
