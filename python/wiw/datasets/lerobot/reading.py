# SPDX-License-Identifier: Apache-2.0
"""Read LeRobot datasets, format v3.0."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate, groupby
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Any

import numpy as np

from wiw.datasets.lerobot.layout import DATA, INDICES, INFO, SOURCE, VERSION, Episode, Feature
from wiw.errors import FileError
from wiw.mapping_files import read_json_object

EPISODE_NUMBERS = ("length", "data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index")
EPISODE_COLUMNS = ("tasks", *EPISODE_NUMBERS)
TIME_TOLERANCE = 1e-4
"""Seconds: LeRobot's own."""
MOST_FPS = 10**9
"""Most frames per second; a number of JSON may be too large to divide by."""
PLACE = ("chunk_index", "file_index")
"""Fields of `data_path` in `meta/info.json`."""
NUMBER_FORMAT = re.compile("(?:0?[1-9])?d?")
"""How such a field may be written: as whole numbers of up to nine digits. A larger width would fill the memory."""


class LeRobotFolder:
    """A LeRobot dataset that was exported by wiw.

    Args:
        folder: with `meta/info.json`.

    Raises:
        FileError: there is no such dataset, it is of another version, was not exported by wiw, or a file of `meta` is
            missing or damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.info = read_json_object(folder / INFO, "a LeRobot dataset, which has it")
        if str(self.info.get("codebase_version")).partition(".")[0] != VERSION.partition(".")[0]:
            raise FileError(
                f"{folder / INFO}: expected a LeRobot dataset of format {VERSION}, got "
                f"{self.info.get('codebase_version')}; LeRobot converts older ones"
            )
        self.source = read_json_object(
            folder / SOURCE,
            "a dataset that `wiw data export` has written: others lack poses, cameras and scenes or tables",
        )
        """Description of the collection that the dataset was exported from."""
        self._episodes = self._read_episode_rows()
        self._starts: dict[str, int] = {}
        """First frame of each file, among all frames."""
        for row in self._episodes:
            self._starts.setdefault(self._locate(row), row["dataset_from_index"])

    def __len__(self) -> int:
        return len(self._episodes)

    def get_source(self, part: str, names: Sequence[str]) -> dict[str, Any]:
        """Return a part of `meta/wiw.json`, which must have some keys.

        Raises:
            FileError: it has not.
        """
        found = self.source.get(part)
        if not isinstance(found, dict) or (missing := [name for name in names if name not in found]):
            lack = f"no {', '.join(missing)}" if isinstance(found, dict) else "none"
            raise FileError(f"{self.folder / SOURCE}: expected {part} with {', '.join(names)}, got {lack}")
        return found

    def check_features(self, expected: Mapping[str, Feature]) -> None:
        """Check that the dataset has some features, with their types and shapes.

        Raises:
            FileError: it lacks some, or has others of their names.
        """
        found = self.info.get("features")
        found = found if isinstance(found, Mapping) else {}
        if missing := [name for name in expected if name not in found]:
            raise FileError(
                f"{self.folder / INFO}: expected features {', '.join(expected)}, got no {', '.join(missing)}"
            )
        for name, feature in expected.items():
            entry = found[name] if isinstance(found[name], Mapping) else {}
            got = entry.get("dtype"), entry.get("shape")
            if got != (feature.dtype, list(feature.shape)):
                hint = "; images decoded from videos are no longer exact" if got[0] == "video" else ""
                raise FileError(
                    f"{self.folder / INFO}: expected {name} as {feature.dtype} {list(feature.shape)}, got {got[0]} "
                    f"{got[1]}{hint}"
                )

    def read_episodes(self, features: Mapping[str, Feature], facts: Sequence[str]) -> Iterator[Episode]:
        """Yield all episodes.

        Args:
            features: to read.
            facts: names of the columns of `meta/episodes` that are wanted beyond LeRobot's own.

        Raises:
            FileError: a file or a column of it is missing or damaged, or timestamps do not fit the rate.
        """
        self.check_features({**features, **INDICES})
        if missing := [name for name in facts if name not in self._episodes[0]]:
            raise FileError(
                f"{self.folder / 'meta/episodes'}: expected columns {', '.join(facts)}, got no {', '.join(missing)}"
            )
        for name, rows in groupby(self._episodes, self._locate):
            file = _DataFile(self.folder / name)
            for row in rows:
                start = row["dataset_from_index"] - self._starts[name]
                table = file.read(start, row["length"], [*features, *INDICES])
                self._check_frames(row, table, file.path)
                columns = {key: _read_column(table.column(key), feature) for key, feature in features.items()}
                if empty := [key for key, each in features.items() if each.is_image and None in columns[key]]:
                    raise FileError(
                        f"{file.path}: expected the images of {', '.join(empty)} in it, but some are missing"
                    )
                yield Episode(row["tasks"][0], columns, {key: row[key] for key in facts})

    def _locate(self, row: Mapping[str, Any]) -> str:
        """Return the name of the file that has an episode."""
        numbers = {name: row[f"data/{name}"] for name in PLACE}
        template = self.info.get("data_path")
        try:
            name = _fill(template, numbers) if isinstance(template, str) else ""
        except ValueError:  # braces that do not match
            name = ""
        if not _is_inside(name):
            raise FileError(
                f"{self.folder / INFO}: expected a data_path of chunk_index and file_index within the dataset, such as "
                f"{DATA}, got {str(template)[:200]}"
            )
        return name

    def _read_episode_rows(self) -> list[dict[str, Any]]:
        """Return the rows of `meta/episodes` without statistics."""
        from pyarrow import ArrowException, parquet

        rows: list[dict[str, Any]] = []
        folder = self.folder / "meta" / "episodes"
        for path in sorted(folder.glob("*/*.parquet")):
            try:
                names = [name for name in parquet.read_schema(path).names if not name.startswith("stats/")]
                rows += parquet.read_table(path, columns=names).to_pylist()
            except (OSError, ArrowException) as error:
                raise FileError(f"{path}: expected a list of episodes, got a damaged file ({error})") from error
        if len(rows) != self.info.get("total_episodes") or not rows:
            raise FileError(
                f"{folder}: expected {self.info.get('total_episodes')} episodes as {INFO} says, got {len(rows)}: a "
                "file is missing, or the dataset is empty"
            )
        if missing := [name for name in EPISODE_COLUMNS if name not in rows[0]]:
            raise FileError(f"{folder}: expected columns {', '.join(EPISODE_COLUMNS)}, got no {', '.join(missing)}")
        for name in EPISODE_NUMBERS:
            if odd := [row[name] for row in rows if type(row[name]) is not int or row[name] < 0]:
                raise FileError(f"{folder}: expected whole numbers from 0 as {name}, got {str(odd[0])[:200]}")
        return rows

    def _check_frames(self, row: Mapping[str, Any], table: Any, path: Path) -> None:
        """Compare the numbers of frames with what `meta` says."""
        frames = table.column("frame_index").to_numpy()
        index = table.column("index").to_numpy()
        expected = np.arange(len(frames))
        right = len(frames) == row["length"] and np.array_equal(frames, expected)
        if not (right and np.array_equal(index, expected + row["dataset_from_index"])):
            raise FileError(
                f"{path}: expected frames {row['dataset_from_index']} to {row['dataset_to_index'] - 1} of episode "
                f"{row['episode_index']}, got others"
            )
        times = table.column("timestamp").to_numpy()
        fps = self.info.get("fps")
        if not (
            isinstance(fps, int | float)
            and 0 < fps <= MOST_FPS
            and (np.abs(times - expected / fps) <= TIME_TOLERANCE).all()
        ):
            rate = f"{(len(times) - 1) / times[-1]:g}" if len(times) and times[-1] > 0 else "no"
            raise FileError(
                f"{path}, episode {row['episode_index']}: expected {fps} frames per second as {INFO} says, got "
                f"timestamps of {rate}"
            )


class _DataFile:
    """A file of frames, read a few row groups at a time."""

    def __init__(self, path: Path) -> None:
        from pyarrow import ArrowException, parquet

        self.path = path
        try:
            self._metadata = parquet.read_metadata(path)
        except FileNotFoundError as error:
            raise FileError(f"{path} is missing, although meta/episodes lists it: copy the dataset again") from error
        except (OSError, ArrowException) as error:
            raise self._build_damage_error(error) from error
        groups = range(self._metadata.num_row_groups)
        self._ends = list(accumulate(self._metadata.row_group(index).num_rows for index in groups))

    def read(self, start: int, count: int, names: Sequence[str]) -> Any:
        """Return rows as an Arrow table; only their row groups are read."""
        from pyarrow import ArrowException, parquet

        begins = [0, *self._ends[:-1]]
        groups = [
            g
            for g, (begin, end) in enumerate(zip(begins, self._ends, strict=True))
            if begin < start + count and end > start
        ]
        try:
            with parquet.ParquetFile(self.path, metadata=self._metadata, page_checksum_verification=True) as file:
                if missing := [name for name in names if name not in file.schema_arrow.names]:
                    raise FileError(f"{self.path}: expected columns {', '.join(names)}, got no {', '.join(missing)}")
                table = file.read_row_groups(groups, columns=list(names))
        except (OSError, ArrowException) as error:
            raise self._build_damage_error(error) from error
        return table.slice(start - begins[groups[0]] if groups else 0, count)

    def _build_damage_error(self, error: Exception) -> FileError:
        return FileError(f"{self.path}: expected a file of frames, got a damaged one ({error}); copy the dataset again")


def _read_column(column: Any, feature: Feature) -> Any:
    """Return an array [T] or [T, n], or T encoded pictures."""
    if feature.is_image:
        return [each and each["bytes"] for each in column.to_pylist()]
    if feature.shape == (1,):
        return column.to_numpy()
    return column.combine_chunks().flatten().to_numpy(zero_copy_only=False).reshape(-1, *feature.shape)


def _fill(template: str, numbers: Mapping[str, int]) -> str:
    """Return a template with its fields filled in; "" where it has others, or writes them other than as numbers."""
    filled = ""
    for text, name, how, conversion in Formatter().parse(template):
        filled += text
        if name is None:
            continue
        if name not in numbers or conversion or not NUMBER_FORMAT.fullmatch(how or ""):
            return ""
        filled += format(numbers[name], how or "")
    return filled


def check_file_name(name: str) -> str:
    """Return the name of a file within the folder that is written, which a dataset gives.

    Raises:
        FileError: it leads elsewhere.
    """
    if not _is_inside(name):
        raise FileError(f"meta/episodes: expected file as the name of a Parquet file in the new folder, got {name}")
    return name


def _is_inside(name: object) -> bool:
    """Return whether a name is that of a Parquet file below the folder that it is relative to."""
    if not isinstance(name, str) or not name.endswith(".parquet") or not name.isprintable():
        return False
    path = PurePosixPath(name)
    return ".." not in path.parts and not path.is_absolute()
