# SPDX-License-Identifier: Apache-2.0
"""Stored decisions: plans from one place, what each would truly lead to, and a goal that one of them serves best.

A Parquet file with one row per plan and one row group per decision, whose first row has observation and goal. World
models are compared on it without a simulator: which plan do their imagined ends choose, and what does that cost?
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.datasets.navigation_segment import encode_color
from wiw.datasets.parquet_files import (
    RowGroupFile,
    build_schema,
    hash_file,
    image_type,
    image_values,
    require_pyarrow,
    write_row_groups,
)
from wiw.errors import FileError

FORMAT = 1


@dataclass(frozen=True)
class Decisions:
    """D decisions between M plans each. Pictures are panoramas that face where the observation does."""

    scenes: tuple[str, ...]
    """[D]."""
    images: NDArray[np.uint8]
    """uint8 [D, H, W, 3]: the observations."""
    goals: NDArray[np.uint8]
    """uint8 [D, H, W, 3]: what is seen from the goal."""
    plans: NDArray[np.int8]
    """int8 [D, M, K]: primitives, null after the end of a plan."""
    futures: NDArray[np.uint8]
    """uint8 [D, M, H, W, 3]: what is truly seen from where each plan ends."""
    distances: NDArray[np.float64]
    """float64 [D, M]: metres from there to the goal."""

    def __len__(self) -> int:
        return len(self.scenes)

    @property
    def lengths(self) -> NDArray[np.int64]:
        """int64 [D, M]: actions of each plan."""
        return np.count_nonzero(self.plans, axis=-1).astype(np.int64)


def join_decisions(parts: Sequence[Decisions]) -> Decisions:
    """Return the decisions of several sets as one."""
    names = ("images", "goals", "plans", "futures", "distances")
    scenes = tuple(scene for part in parts for scene in part.scenes)
    return Decisions(scenes, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def save_decisions(path: str | Path, decisions: Decisions) -> None:
    """Write decisions to a Parquet file, pictures as lossless WebP.

    Raises:
        DependencyError: pyarrow is not installed.
        FileError: it cannot be written.
    """
    require_pyarrow("stored decisions")
    import pyarrow as pa

    types = {
        "scene": pa.string(),
        "decision": pa.int32(),
        "observation": image_type(),
        "goal": image_type(),
        "plan": pa.list_(pa.int8(), decisions.plans.shape[-1]),
        "future": image_type(),
        "distance": pa.float64(),
    }
    schema = build_schema(types, {"format": FORMAT, "size": list(decisions.images.shape[1:3])})
    write_row_groups(Path(path), schema, _build_tables(decisions, schema))


def load_decisions(path: str | Path) -> Decisions:
    """Read decisions.

    Raises:
        DependencyError: pyarrow is not installed.
        FileError: there is no such file, it is damaged, or it holds no decision.
    """
    file = _open(path)
    if not len(file):
        raise FileError(f"{path}: expected stored decisions, got a file without any")
    return join_decisions([_read_decision(file, index) for index in range(len(file))])


def read_scenes(path: str | Path) -> list[str]:
    """Read the scene of each decision, and none of their pictures.

    Raises:
        DependencyError: pyarrow is not installed.
        FileError: there is no such file, or it is damaged.
    """
    file = _open(path)
    with file.blame_damage():
        return [file.read(index, ["scene"])["scene"][0].as_py() for index in range(len(file))]


def digest_decisions(path: str | Path) -> str:
    """Return the SHA-256 of a file of decisions.

    Raises:
        FileError: it cannot be read.
    """
    try:
        return hash_file(Path(path))
    except OSError as error:
        raise FileError(f"{path}: expected a file of `wiw collect decisions`, got {error}") from error


def _open(path: str | Path) -> RowGroupFile:
    require_pyarrow("stored decisions")
    return RowGroupFile(Path(path), FORMAT, "stored decisions", "`wiw collect decisions`")


def _build_tables(decisions: Decisions, schema: Any) -> Iterator[Any]:
    import pyarrow as pa

    for index, scene in enumerate(decisions.scenes):
        others = [None] * (decisions.plans.shape[1] - 1)
        columns = {
            "scene": [scene] * decisions.plans.shape[1],
            "decision": [index] * decisions.plans.shape[1],
            "observation": image_values([encode_color(decisions.images[index], True), *others]),
            "goal": image_values([encode_color(decisions.goals[index], True), *others]),
            "plan": decisions.plans[index].tolist(),
            "future": image_values([encode_color(future, True) for future in decisions.futures[index]]),
            "distance": decisions.distances[index].tolist(),
        }
        yield pa.table(columns, schema)


def _read_decision(file: RowGroupFile, index: int) -> Decisions:
    rows = file.read(index).to_pydict()
    with file.blame_damage(cv2.error):
        return Decisions(
            (rows["scene"][0],),
            _decode(rows["observation"][0])[None],
            _decode(rows["goal"][0])[None],
            np.array(rows["plan"], np.int8)[None],
            np.stack([_decode(each) for each in rows["future"]])[None],
            np.array(rows["distance"], np.float64)[None],
        )


def _decode(value: Any) -> NDArray[np.uint8]:
    image = cv2.imdecode(np.frombuffer(value["bytes"], np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError("no picture")
    return np.asarray(image[..., ::-1], np.uint8)
