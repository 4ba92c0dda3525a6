# SPDX-License-Identifier: Apache-2.0
"""Demonstrations of manipulation tasks as LeRobot datasets: an episode is a demonstration.

LeRobot pairs a frame with the pose that is commanded from it on, wiw with the one that was commanded before it: actions
move by a frame, and the last is repeated.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.datasets import shards
from wiw.datasets.demonstration import Demonstration, decode_depths
from wiw.datasets.demonstrations import Demonstrations, encode_depth
from wiw.datasets.lerobot.layout import Episode, Feature, color_feature, depth_feature
from wiw.datasets.lerobot.reading import LeRobotFolder, check_file_name
from wiw.datasets.parquet_files import MANIFEST
from wiw.errors import FileError

FRONT, DEPTH = "observation.images.front", "observation.images.front_depth"
WRIST, WRIST_DEPTH = "observation.images.wrist", "observation.images.wrist_depth"
WRIST_POSE = "wrist_camera_pose"
TIFF_DEFLATE = 8
POSE = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad", "gripper_open")
FACTS = ("kind", "variation", "seed", "episode", "success", "places", "file")
"""Facts of an episode, beside its frames; kind is the task that wiw knows it by."""


def describe_features(manifest: Mapping[str, Any]) -> dict[str, Feature]:
    """Return the features of demonstrations that were collected with the settings of a manifest."""
    size, depth, wrist = manifest["size"], manifest["depth"], manifest.get("wrist", False)
    features = {
        "observation.state": Feature("where the gripper is, z up, R = Rz Ry Rx", "float64", (7,), POSE),
        "action": Feature("pose that is commanded after this frame, likewise", "float64", (7,), POSE),
        "seconds": Feature("time of the physics since frame 0", "float64"),
        "key": Feature("number of the action that led here, from 1; 0 in frame 0", "int32"),
        "ended": Feature("whether that action ends in this frame, which makes it a key frame", "bool"),
        FRONT: color_feature("the front view", (size, size)),
    }
    if depth:
        about = "the front view's planar depth, in metres, 0 where nothing is hit"
        features[DEPTH] = depth_feature(about, (size, size), depth_unit="m", measure="planar")
    if wrist:
        features[WRIST] = color_feature("the wrist camera's view", (size, size))
        about = "T_world_camera of the wrist camera, 4 x 4 row by row; it looks along -z with +y up"
        features[WRIST_POSE] = Feature(about, "float64", (16,))
    if wrist and depth:
        about = "planar depth of the wrist camera's view, in metres, 0 where nothing is hit"
        features[WRIST_DEPTH] = depth_feature(about, (size, size), depth_unit="m", measure="planar")
    return features


def estimate_rate(data: Demonstrations) -> int:
    """Return the mean number of frames per second, rounded."""
    times = [shard.read(index, ["seconds"]).column(0) for shard in data.files for index in range(len(shard))]
    seconds = sum(each[-1].as_py() for each in times)
    return max(1, round(sum(len(each) - 1 for each in times) / seconds)) if seconds else 1


def build_episodes(data: Demonstrations) -> Iterator[Episode]:
    """Yield the demonstrations as episodes.

    Raises:
        FileError: a file is damaged.
    """
    for shard in data.files:
        for index in range(len(shard)):
            yield _build_episode(shard[index], shard.path.name)


def _build_episode(each: Demonstration, file: str) -> Episode:
    columns = {
        "observation.state": each.poses,
        "action": np.concatenate([each.actions[1:], each.actions[-1:]]),
        "seconds": each.seconds,
        "key": each.keys,
        "ended": each.ended,
        FRONT: each.encoded_images,
    }
    for name, depths in ((DEPTH, each.encoded_depths), (WRIST_DEPTH, each.encoded_wrist_depths)):
        if depths is not None:
            columns[name] = [_encode_metres(depth) for depth in decode_depths(depths)]
    if each.encoded_wrist_images is not None and each.wrist_poses is not None:
        columns |= {WRIST: each.encoded_wrist_images, WRIST_POSE: each.wrist_poses.reshape(-1, 16)}
    places = json.dumps({name: pose.tolist() for name, pose in each.places.items()})
    values = each.task, each.variation, each.seed, each.episode, each.success, places, file
    return Episode(each.instruction, columns, dict(zip(FACTS, values, strict=True)))


def describe_source(data: Demonstrations) -> dict[str, Any]:
    """Return what importing needs beyond the episodes."""
    files = {shard.path.name: _strip_facts(shard.facts) for shard in data.files}
    return {"what": "manipulation", "manifest": data.config, "files": files}


def _strip_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out what writing a file adds."""
    return {name: value for name, value in facts.items() if name not in ("format", "columns")}


def write_demonstrations(found: LeRobotFolder, out: Path, progress: Any) -> None:
    """Write the demonstrations that were exported into an empty folder.

    Raises:
        FileError: a file or a column is missing or damaged, or the folder cannot be written.
    """
    manifest = found.get_source("manifest", ("tasks", "episodes", "size", "depth"))
    episodes = found.read_episodes(describe_features(manifest), FACTS)
    done = 0
    for name, of_file in groupby(episodes, lambda episode: check_file_name(episode.facts["file"])):
        demonstrations = [build_demonstration(episode) for episode in of_file]
        shards.write(out / name, demonstrations, found.get_source("files", [name])[name])
        done += len(demonstrations)
        progress(done, len(found))
    (out / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n")


def build_demonstration(episode: Episode) -> Demonstration:
    """Return the demonstration that an episode was built of."""
    columns, facts = episode.columns, episode.facts
    action: NDArray[np.float64] = columns["action"]
    return Demonstration(
        task=facts["kind"],
        variation=facts["variation"],
        seed=facts["seed"],
        episode=facts["episode"],
        instruction=episode.instruction,
        success=facts["success"],
        places={name: np.array(pose) for name, pose in json.loads(facts["places"]).items()},
        seconds=columns["seconds"],
        poses=columns["observation.state"],
        actions=np.concatenate([action[:1], action[:-1]]),
        keys=columns["key"],
        ended=columns["ended"],
        encoded_images=tuple(columns[FRONT]),
        encoded_depths=_convert_depths(columns.get(DEPTH)),
        encoded_wrist_images=tuple(columns[WRIST]) if WRIST in columns else None,
        encoded_wrist_depths=_convert_depths(columns.get(WRIST_DEPTH)),
        wrist_poses=columns[WRIST_POSE].reshape(-1, 4, 4) if WRIST_POSE in columns else None,
    )


def _convert_depths(depths: Sequence[bytes] | None) -> tuple[bytes, ...] | None:
    """Return depths of LeRobot as wiw stores them."""
    return None if depths is None else tuple(encode_depth(_decode_metres(each)) for each in depths)


def _encode_metres(depth: NDArray[np.float32]) -> bytes:
    """Encode metres float32 [H, W] as TIFF: LeRobot's other unit is the millimetre, which is not fine enough."""
    options = [cv2.IMWRITE_TIFF_COMPRESSION, TIFF_DEFLATE]
    return bytes(cv2.imencode(".tiff", depth, options)[1])


def _decode_metres(encoded: bytes) -> NDArray[np.float32]:
    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or image.dtype != np.float32:
        raise FileError("expected depth as TIFF with one float32 per pixel, got something else; copy the dataset again")
    return np.asarray(image, np.float32)
