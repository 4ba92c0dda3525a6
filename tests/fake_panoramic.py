# SPDX-License-Identifier: Apache-2.0
"""The official packages of PathDreamer and SE3DS as `shim.py` meets them: their calls, with arithmetic for networks."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wiw.world_models.panoramic.served import SHIM

CHECKPOINTS = {"pathdreamer": ("structure_gen_ckpt", "image_gen_ckpt"), "se3ds": ("se3ds_ckpt",)}
TENSORFLOW = """
import numpy as np

__version__ = "0"
constant = np.asarray


class random:
    set_seed = np.random.seed
"""
CONFIG = """
class Config:
    batch_size, ckpt_path, spade_ckpt_path = 1, "data/ckpt", "data/spade"
    image_height, pathdreamer_height_multiplier, depth_scale = 32, 0.5, {scale}


def get_config():
    return Config()
"""
PATHDREAMER = '''
import numpy as np


class Structure:
    """Names holes walls (1) half the scale away; at random, or not."""

    def __call__(self, inputs, groundtruth_inputs=None, sample_noise=True, z=None, training=None):
        one_hot, depth = inputs
        assert one_hot.shape == (1, 1, 16, 32, 42) and depth.shape == (1, 1, 16, 32, 1) and training is False
        assert one_hot.dtype == depth.dtype == np.float32 and (one_hot.sum(-1) == 1).all()
        logits = one_hot.copy()
        logits[..., 1] += 2 * one_hot[..., 0]
        filled = np.where(depth < 1, depth, np.random.uniform(0.3, 0.7) if sample_noise else 0.5)
        return logits, filled.astype(np.float32), None, None, None


class Painter:
    """Paints holes by category, depth and the previous image."""

    def __call__(self, inputs, training=None):
        given, z = inputs
        assert set(given) == {"one_hot_mask", "prev_image", "proj_image", "proj_mask", "depth", "first_frame"}
        shapes = {name: value.shape for name, value in given.items()}
        assert shapes["one_hot_mask"] == (1, 32, 64, 42) and shapes["depth"] == shapes["proj_mask"] == (1, 32, 64, 1)
        assert shapes["prev_image"] == shapes["proj_image"] == (1, 32, 64, 3) and z is None
        assert given["proj_image"].max() <= 1 and set(np.unique(given["proj_mask"])) <= {0, 1}
        category = given["one_hot_mask"].argmax(-1)[..., None] / 41
        previous = np.broadcast_to(given["prev_image"].mean(), category.shape)
        fancy = np.concatenate([category, given["depth"], previous], -1)
        return None, None, np.where(given["proj_mask"] > 0, given["proj_image"], fancy).astype(np.float32)


class PathdreamerModel:
    def __init__(self, config):
        for path in (config.ckpt_path, config.spade_ckpt_path):
            assert open(path + ".index").read()
        self.model, self.spade_model = Structure(), Painter()
'''
SE3DS = '''
import numpy as np


class Generator:
    """Paints holes grey, half the scale away."""

    def __call__(self, inputs, sample_noise=False, training=None):
        given, z = inputs
        names = {"prev_image", "proj_image", "proj_depth", "proj_mask", "blurred_mask", "dataset_type"}
        assert set(given) == names and z is None and training is False and not sample_noise
        assert given["proj_depth"].shape == given["blurred_mask"].shape == (1, 32, 64, 1)
        assert given["dataset_type"].dtype == np.int32
        mask = given["proj_mask"] > 0
        depth = np.where(mask, given["proj_depth"], 0.5).astype(np.float32)
        image = np.where(mask, given["proj_image"], 0.5).astype(np.float32)
        if mask.any() and given["proj_image"][mask[..., 0]].min() == 1:
            raise RuntimeError("out of memory")  # at a white room, so that a test can have it raise
        return None, None, None, depth, None, None, image


class SE3DSModel:
    def __init__(self, config):
        assert open(config.ckpt_path + ".index").read()
        self.model = Generator()
'''
FILES = {
    "tensorflow.py": TENSORFLOW,
    "pathdreamer/models/pathdreamer_config.py": CONFIG.format(scale=10.0),
    "pathdreamer/models/pathdreamer_models.py": PATHDREAMER,
    "se3ds/models/model_config.py": CONFIG.format(scale=20.0),
    "se3ds/models/models.py": SE3DS,
}


def install(folder: Path) -> None:
    """Writes the packages and their checkpoints."""
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for name, checkpoints in CHECKPOINTS.items():
        (folder / name / "data/ckpt").mkdir(parents=True, exist_ok=True)
        for checkpoint in checkpoints:
            (folder / name / f"data/ckpt/{checkpoint}.index").write_text(f"weights of {checkpoint}")


def command(folder: Path, name: str, *options: str) -> list[str]:
    """Of the shim, for packages in a folder."""
    code = folder / name
    return [sys.executable, str(SHIM), name, "--code", str(code), "--weights", str(code / "data"), *options]


@contextmanager
def serving(folder: Path, name: str, *options: str, port: int = 0, token: str = "") -> Iterator[str]:
    """The shim in a process of its own; gives its address."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "WIW_TOKEN": token}
    arguments = command(folder, name, "--port", str(port), *options)
    with subprocess.Popen(arguments, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        try:
            yield line.split()[-1]
        finally:
            process.terminate()
