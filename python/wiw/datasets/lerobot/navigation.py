# SPDX-License-Identifier: Apache-2.0
"""Navigation datasets as LeRobot datasets: an episode is a segment.

LeRobot pairs a frame with the action that is taken in it, wiw with the one that led to it: actions move by a frame. The
last frame of an episode has none, which is a motion of zero. Frames after turns, which wiw stores as a roll of another
picture, get separate pictures, equal to the rolled ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import NULL, to_trajectory
from wiw.datasets.lerobot.layout import Episode, Feature, color_feature, depth_feature
from wiw.datasets.lerobot.reading import LeRobotFolder, check_file_name
from wiw.datasets.navigation import NavigationData, count_totals, write_meta
from wiw.datasets.navigation_files import (
    SEGMENTS,
    build_table,
    describe_file,
    navigation_schema,
    write_frames,
    write_segment_list,
)
from wiw.datasets.navigation_segment import NavigationSegment, describe_segment, encode_color, encode_units

FPS = 5
"""Steps of 0.2 m at a metre a second; nothing in a navigation dataset says how long an action takes."""
INSTRUCTION = "walk to the next waypoint"
COLOR, DEPTH = "observation.images.rgb", "observation.images.depth"
FACTS = ("scene", "pass", "island", "segment", "seed", "height", "ending", "file")
"""Facts of an episode, beside its frames."""
FRAME_FACTS = ("wiw", "split", "camera", "color", "depth", "actions")
"""Entries of `meta.json` that files of frames repeat."""


def describe_features(meta: Mapping[str, Any]) -> dict[str, Feature]:
    """Return the features of a dataset with such a `meta.json`."""
    size = meta["camera"]["size"]
    features = {
        "observation.state": Feature(
            "where the camera is, in the frame of the episode's start",
            "float32",
            (3,),
            ("forward_m", "left_m", "yaw_left_rad"),
        ),
        "action": Feature(
            "motion that follows this frame; 0 in the last one", "float32", (2,), ("forward_m", "turn_left_rad")
        ),
        "primitive": Feature(
            "the same as a number: 1 forward 0.2 m, 2 turn left, 3 turn right by 22.5 degrees, 0 none", "int8"
        ),
        "T_world_camera": Feature(
            "pose, row by row: metres, +Y up, the camera looks along -Z",
            "float64",
            (16,),
            [f"{row}{column}" for row in range(4) for column in range(4)],
        ),
        "source": Feature("frame of this episode whose picture this one is, rolled", "int32"),
        "roll": Feature("columns that it is rolled by, to the right", "int32"),
        COLOR: color_feature("what the camera sees", size),
    }
    if meta["depth"] is not None:
        measure = meta["depth"]["measure"]
        about = f"{measure}, in millimetres, 0 where nothing is hit"
        features[DEPTH] = depth_feature(about, size, depth_unit="mm", measure=measure)
    return features


def build_episodes(data: NavigationData, workers: int) -> Iterator[Episode]:
    """Yield the segments as episodes.

    Args:
        data: of which to yield all segments.
        workers: threads that encode pictures.

    Raises:
        FileError: a file or a picture is missing or damaged.
    """
    with ThreadPoolExecutor(workers) as pool:
        for row, segment in zip(data.segments, data, strict=True):
            yield _build_episode(row, segment, pool)


def _build_episode(row: Mapping[str, Any], segment: NavigationSegment, pool: ThreadPoolExecutor) -> Episode:
    pictures = list(pool.map(lambda frame: _encode_frame(segment, frame), range(len(segment))))
    primitives = np.append(segment.actions[1:], np.int8(NULL))
    columns = {
        "observation.state": _compute_odometry(segment.poses),
        "action": _compute_motions(primitives),
        "primitive": primitives,
        "T_world_camera": segment.poses.reshape(-1, 16),
        "source": segment.sources,
        "roll": segment.rolls,
        COLOR: [color for color, _ in pictures],
    }
    if segment.encoded_depths is not None:
        columns[DEPTH] = [depth for _, depth in pictures]
    facts = {"seed": segment.seed, "height": segment.height, **row}
    return Episode(INSTRUCTION, columns, {name: facts[name] for name in FACTS})


def _encode_frame(segment: NavigationSegment, frame: int) -> tuple[bytes, bytes | None]:
    """Return colour and depth of a frame: as stored, or rolled and then encoded without loss."""
    stored = segment.encoded_images[frame]
    if stored is not None:
        return stored, None if segment.encoded_depths is None else segment.encoded_depths[frame]
    color, depth = segment.decode(int(segment.sources[frame]))
    roll = int(segment.rolls[frame])
    rolled = encode_color(np.roll(color, roll, axis=1), lossless=True)
    return rolled, None if depth is None else encode_units(np.roll(depth, roll, axis=1))


def _compute_odometry(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where each camera is in the frame of the first: metres forward and left, radians to the left, [T, 3]."""
    relative = np.linalg.inv(poses[0]) @ poses
    return np.stack([-relative[:, 2, 3], -relative[:, 0, 3], np.arctan2(relative[:, 0, 2], relative[:, 0, 0])], axis=1)


def _compute_motions(primitives: NDArray[np.int8]) -> NDArray[np.float64]:
    """Return how far each primitive goes forward, in metres, and turns left, in radians, [T, 2]."""
    return to_trajectory(primitives[:, None])[:, 0, [0, 2]]


def describe_source(data: NavigationData) -> dict[str, Any]:
    """Return what importing needs beyond the episodes."""
    return {"what": "navigation", "meta": data.meta}


def write_navigation(found: LeRobotFolder, out: Path, progress: Any) -> None:
    """Write the navigation dataset that was exported into an empty folder.

    Raises:
        FileError: a file or a column is missing or damaged, or the folder cannot be written.
    """
    meta = found.get_source("meta", ("format", "passes", *FRAME_FACTS))
    schema = navigation_schema(meta["depth"] is not None, {name: meta[name] for name in FRAME_FACTS})
    episodes = found.read_episodes(describe_features(meta), FACTS)
    rows: list[dict[str, Any]] = []
    files: dict[str, Any] = {}

    def build_tables(name: str, episodes: Iterator[Episode]) -> Iterator[Any]:
        for row_group, episode in enumerate(episodes):
            segment = build_segment(episode)
            where = {"file": name, "row_group": row_group, "ending": episode.facts["ending"]}
            rows.append({**describe_segment(segment), **where})
            progress(len(rows), len(found))
            yield build_table(segment, schema)

    for name, of_file in groupby(episodes, lambda episode: check_file_name(episode.facts["file"])):
        before = len(rows)
        write_frames(out / name, schema, build_tables(name, of_file))
        files[name] = describe_file(out / name, sum(row["frames"] for row in rows[before:]))
    write_segment_list(out / SEGMENTS, rows)
    files[SEGMENTS] = describe_file(out / SEGMENTS, 0)
    write_meta(out, {**meta, "totals": count_totals(rows, files, meta["passes"]), "files": files})


def build_segment(episode: Episode) -> NavigationSegment:
    """Return the segment that an episode was built of."""
    columns, facts = episode.columns, episode.facts
    actions = np.append(np.int8(NULL), columns["primitive"][:-1])
    own = columns["source"] == np.arange(len(actions))

    def keep_own(pictures: list[bytes]) -> tuple[bytes | None, ...]:
        return tuple(each if stored else None for each, stored in zip(pictures, own, strict=True))

    return NavigationSegment(
        scene=facts["scene"],
        pass_index=facts["pass"],
        island=facts["island"],
        segment=facts["segment"],
        seed=facts["seed"],
        height=facts["height"],
        actions=actions.astype(np.int8),
        poses=columns["T_world_camera"].reshape(-1, 4, 4),
        sources=columns["source"],
        rolls=columns["roll"],
        encoded_images=keep_own(columns[COLOR]),
        encoded_depths=keep_own(columns[DEPTH]) if DEPTH in columns else None,
    )
