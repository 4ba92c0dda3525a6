# SPDX-License-Identifier: Apache-2.0
"""Read a LeRobot dataset with the package `lerobot`, in an environment that has it, and save what it says.

usage: read_lerobot.py FOLDER OUT.npz
"""

import json
import sys
import tempfile
from pathlib import Path

import lerobot
import numpy as np
from lerobot.datasets import compute_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image


def read(folder, out):
    plain = LeRobotDataset("wiw/exported", root=folder)
    meta = plain.meta
    items = [plain[index] for index in range(len(plain))]
    found = {f"item/{key}": np.stack([np.asarray(item[key]) for item in items]) for key in items[0]}
    steps = [0, 1, 2]
    windows = LeRobotDataset(
        "wiw/exported", root=folder, delta_timestamps={"action": [each / meta.fps for each in steps]}
    )
    ahead = [windows[index] for index in range(len(windows))]
    found |= {
        f"ahead/{key}": np.stack([np.asarray(each[key]) for each in ahead]) for key in ("action", "action_is_pad")
    }
    second = LeRobotDataset("wiw/exported", root=folder, episodes=[1])
    found["second/index"] = np.array([int(second[index]["index"]) for index in range(len(second))])
    computed = [compute_episode(meta, folder, index) for index in range(meta.total_episodes)]
    for index, each in enumerate(computed):
        found |= {f"computed/{index}/{key}/{name}": value for key, row in each.items() for name, value in row.items()}
    total = compute_stats.aggregate_stats(computed)
    found |= {f"total/{key}/{name}": value for key, row in total.items() for name, value in row.items()}
    found |= {f"stored/{key}/{name}": value for key, row in meta.stats.items() for name, value in row.items()}
    bounds = [[row["dataset_from_index"], row["dataset_to_index"]] for row in meta.episodes]
    about = {"lerobot": lerobot.__version__, "fps": meta.fps, "frames": meta.total_frames, "bounds": bounds,
             "episodes": meta.total_episodes, "tasks": list(meta.tasks.index), "cameras": meta.camera_keys,
             "depth": list(getattr(meta, "depth_keys", []))}  # fmt: skip
    np.savez(out, about=json.dumps(about), **found)


def compute_episode(meta, folder, index):
    """Return the statistics that LeRobot computes when it records the same frames."""
    rows = LeRobotDataset("wiw/exported", root=folder, episodes=[index]).hf_dataset.with_format(None)
    with tempfile.TemporaryDirectory() as scratch:
        data = {}
        for key, feature in meta.features.items():
            if feature["dtype"] != "image":
                data[key] = np.array(rows[key], feature["dtype"])
            elif feature["shape"][2] == 3:
                data[key] = [save(image, Path(scratch) / f"{key}-{i}.png") for i, image in enumerate(rows[key])]
            elif hasattr(meta, "depth_keys"):
                data[key] = [save(image, Path(scratch) / f"{key}-{i}.tiff") for i, image in enumerate(rows[key])]
        features = {key: meta.features[key] for key in data}
        return compute_stats.compute_episode_stats(data, features)


def save(image: Image.Image, path: Path) -> str:
    image.save(path)
    return str(path)


if __name__ == "__main__":
    read(Path(sys.argv[1]), sys.argv[2])
