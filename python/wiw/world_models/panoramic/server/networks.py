# SPDX-License-Identifier: Apache-2.0
"""The official networks of PathDreamer and SE3DS, driven along a plan with wiw's own geometry.

The official code builds the networks and loads their weights; what they are fed is made here, as that code makes it:
projections of a memory of points, which the observation begins and every prediction extends. Batches are of one row.

This file needs NumPy, the official code and its TensorFlow, and Python 3.8; nothing of wiw but `memory.py` beside it.
"""

from __future__ import annotations

import importlib
import sys
from abc import ABC, abstractmethod
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from memory import (  # type: ignore[import-not-found]
    Memory,
    locate_camera,
    resize_nearest,
    resize_smooth,
    sharp_rows,
    turn_panorama,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

LABELS = 42
"""Categories of Matterport3D, with 0 for nothing and 41 for what is masked."""


class MissingError(Exception):
    """Code or weights are not where they should be."""


class RowError(ValueError):
    """A request for something that the models cannot show."""


class Network(ABC):
    """An official model: its networks, and what it remembers while it follows a plan.

    Args:
        code: folder of the official repository, named as its package.
        weights: folder with its checkpoints, wherever in it they are.
        noise: whether what cannot be known is drawn at random (where the network can) instead of being the likeliest.

    Raises:
        MissingError: code, TensorFlow or weights cannot be found.
    """

    name: str
    package: str
    needs: tuple[str, ...]
    takes_noise = False
    scale: float
    """Metres of depth 1."""
    size: tuple[int, int]
    """[H, W] of what the networks see and give."""

    def __init__(self, code: Path, weights: Path, noise: bool) -> None:
        if noise and not self.takes_noise:
            raise MissingError(f"{self.name} has no randomness: leave --noise out")
        self.noise = noise
        self._code, self._weights = code, weights
        self._checkpoints: list[Path] = []
        self._tf = _tensorflow(code, self.package)
        config = self._load()
        self.scale, self.size = config.depth_scale, (config.image_height, 2 * config.image_height)
        self._sharp = np.zeros(self.size, bool)
        self._sharp[sharp_rows(self.size[0])] = True
        self._previous: NDArray[np.float32] = np.zeros((*self.size, 3), np.float32)

    def describe(self) -> dict[str, Any]:
        """Return what it is, for the records of runs."""
        return {"name": self.name, "depth_metres": self.scale, "noise": self.noise, "size": list(self.size)}

    def fingerprint(self) -> str:
        """Return a digest of all that frames depend on: this code, the official code, options, TensorFlow and weights.

        A checkpoint's index has a checksum of each tensor, so the tensors themselves (17 GB of SE3DS) are not read.
        """
        digest = blake2b(f"{self.describe()} {self._tf.__version__} {np.__version__}".encode(), digest_size=20)
        here = Path(__file__).parent
        sources = [here / "memory.py", here / "networks.py", *sorted(self._code.rglob("*.py"))]
        for file in [*sources, *self._checkpoints]:
            digest.update(f"{file.name} {file.stat().st_size}\0".encode())
            digest.update(file.read_bytes())
        return digest.hexdigest()

    def rollout(
        self,
        image: NDArray[np.uint8],
        depth: NDArray[np.float32],
        semantic: NDArray[np.uint32] | None,
        viewpoints: NDArray[np.float64],
        seed: int,
    ) -> NDArray[np.uint8]:
        """Return what is seen from each viewpoint [K, 4, 4]: uint8 [K, H, W, 3].

        Each place is imagined once, and turns there roll what was imagined: the networks know no heading. The place of
        the observation is not imagined at all.

        Args:
            image: uint8 [H, W, 3] panorama.
            depth: float32 [H, W] distances in metres, 0 where nothing is hit.
            semantic: uint32 [H, W] categories, where needed.
            viewpoints: T_start_camera, poses in the camera of the observation.
            seed: of all that is drawn.

        Raises:
            RowError: unknown categories, or a camera that does not stand upright.
        """
        if semantic is not None and semantic.max(initial=0) >= LABELS:
            raise RowError(f"expected categories below {LABELS}, got {semantic.max()}")
        try:
            places = [locate_camera(viewpoint) for viewpoint in viewpoints]
        except ValueError as error:
            raise RowError(str(error)) from None
        self._tf.random.set_seed(seed % 2**31)
        labels = (
            np.zeros(self.size, np.uint8) if semantic is None else resize_nearest(semantic, self.size).astype(np.uint8)
        )
        share = np.clip(resize_nearest(depth, self.size) / np.float32(self.scale), 0, 1).astype(np.float32)
        self._begin(resize_smooth(image, self.size), share, labels)
        known = {_name((0.0, 0.0, 0.0)): image}
        frames = np.empty((len(places), *image.shape), np.uint8)
        for frame, (position, yaw) in zip(frames, places):  # noqa: B905 - Python 3.8
            if _name(position) not in known:
                known[_name(position)] = resize_smooth(self._look(position), image.shape[:2])
            frame[:] = turn_panorama(known[_name(position)], yaw)
        return frames

    def _checkpoint(self, name: str) -> str:
        """Return the prefix of a checkpoint's files, somewhere in the folder of weights."""
        found = sorted(self._weights.rglob(f"{name}*.index"))
        if len(found) != 1:
            raise MissingError(
                f"{self._weights}: expected one checkpoint {name}.index with its {name}.data-... beside it, found "
                f"{[str(file) for file in found] or 'none'}"
            )
        self._checkpoints += found
        return str(found[0].with_suffix(""))

    @abstractmethod
    def _load(self) -> Any:
        """Build the networks with their weights; return the official configuration."""

    @abstractmethod
    def _begin(self, image: NDArray[np.uint8], depth: NDArray[np.float32], labels: NDArray[np.uint8]) -> None:
        """Forget everything but an observation."""

    @abstractmethod
    def _look(self, position: tuple[float, float, float]) -> NDArray[np.uint8]:
        """Return what is seen at a position, and remember it."""

    def _batch(self, array: NDArray[Any]) -> Any:
        """Return a tensor float32 of one row."""
        return self._tf.constant(np.ascontiguousarray(array[None], np.float32))


class PathDreamer(Network):
    """A structure generator (categories and depth, 256x512), then an image generator (colours, 512x1024)."""

    name = "PathDreamer"
    package = "pathdreamer"
    needs = ("depth", "semantic")
    takes_noise = True

    def _load(self) -> Any:
        config = importlib.import_module("pathdreamer.models.pathdreamer_config").get_config()
        config.ckpt_path = self._checkpoint("structure_gen_ckpt")
        config.spade_ckpt_path = self._checkpoint("image_gen_ckpt")
        model = importlib.import_module("pathdreamer.models.pathdreamer_models").PathdreamerModel(config)
        self._structure, self._painter = model.model, model.spade_model
        height = int(config.image_height * config.pathdreamer_height_multiplier)
        self._half = (height, 2 * height)  # what the structure generator sees and gives
        return config

    def _begin(self, image: NDArray[np.uint8], depth: NDArray[np.float32], labels: NDArray[np.uint8]) -> None:
        self._colours, self._labels = Memory(self.scale), Memory(self.scale)
        self._remember(image, depth, labels, (0.0, 0.0, 0.0), np.ones(self.size, bool))

    def _look(self, position: tuple[float, float, float]) -> NDArray[np.uint8]:
        view = self._colours.view_from(position, self.size)
        labels, depth = self._complete_structure(position)
        painted = self._painter(
            [
                {
                    "one_hot_mask": self._batch(one_hot(labels)),
                    "prev_image": self._batch(self._previous),
                    "proj_image": self._batch(view.features / np.float32(255)),
                    "proj_mask": self._batch(view.seen[..., None]),
                    "depth": self._batch(depth[..., None]),
                    "first_frame": self._tf.constant(np.zeros(1, np.float32)),
                },
                None,
            ]
        )[2]
        image = (np.clip(np.asarray(painted)[0], 0, 1) * 255).astype(np.uint8)
        self._remember(image, depth, labels, position, ~view.seen)
        return image

    def _complete_structure(
        self, position: tuple[float, float, float]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the completed categories and depth at a position."""
        view = self._labels.view_from(position, self._half)
        inputs = [self._batch(one_hot(view.features)[None]), self._batch(view.depth[None, ..., None])]
        logits, depth = self._structure(inputs, sample_noise=self.noise, training=False)[:2]
        labels = np.asarray(logits)[0, 0].argmax(-1).astype(np.uint8)
        return resize_nearest(labels, self.size), resize_nearest(np.asarray(depth)[0, 0, ..., 0], self.size)

    def _remember(
        self,
        image: NDArray[np.uint8],
        depth: NDArray[np.float32],
        labels: NDArray[np.uint8],
        position: tuple[float, float, float],
        fresh: NDArray[np.bool_],
    ) -> None:
        """Add the pixels that are fresh; they are also the previous image of the next look, black around them."""
        self._previous = np.where(fresh[..., None], image, 0).astype(np.float32) / np.float32(255)
        self._colours.add(image, depth, position, fresh & self._sharp)
        known = resize_nearest(fresh & (labels > 0), self._half)
        self._labels.add(resize_nearest(labels, self._half), resize_nearest(depth, self._half), position, known)


class SE3DS(Network):
    """One generator: colours and depth from their projections, 512x1024."""

    name = "SE3DS"
    package = "se3ds"
    needs = ("depth",)

    def _load(self) -> Any:
        config = importlib.import_module("se3ds.models.model_config").get_config()
        config.ckpt_path = self._checkpoint("se3ds_ckpt")
        self._generator = importlib.import_module("se3ds.models.models").SE3DSModel(config).model
        return config

    def _begin(self, image: NDArray[np.uint8], depth: NDArray[np.float32], labels: NDArray[np.uint8]) -> None:
        self._colours = Memory(self.scale)
        self._remember(image, depth, (0.0, 0.0, 0.0))

    def _look(self, position: tuple[float, float, float]) -> NDArray[np.uint8]:
        view = self._colours.view_from(position, self.size)
        mask = view.seen[..., None]
        inputs = {
            "prev_image": self._batch(self._previous),
            "proj_image": self._batch(view.features / np.float32(255)),
            "proj_depth": self._batch(view.depth[..., None]),
            "proj_mask": self._batch(mask),
            "blurred_mask": self._batch(np.zeros_like(mask)),
            "dataset_type": self._tf.constant(np.zeros(1, np.int32)),
        }
        found = self._generator(inputs=[inputs, None], sample_noise=False, training=False)
        depth, painted = np.clip(np.asarray(found[3])[0, ..., 0], 0, 1), np.clip(np.asarray(found[6])[0], 0, 1)
        image = (painted * 255).astype(np.uint8)
        self._remember(image, depth, position)
        return image

    def _remember(
        self, image: NDArray[np.uint8], depth: NDArray[np.float32], position: tuple[float, float, float]
    ) -> None:
        """Add all of a picture, also where it repeats what is known, as the official model does."""
        self._previous = image.astype(np.float32) / np.float32(255)
        self._colours.add(image, depth, position, self._sharp)


NETWORKS = {"pathdreamer": PathDreamer, "se3ds": SE3DS}


def one_hot(labels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return categories [H, W] as float32 [H, W, 42]."""
    return np.eye(LABELS, dtype=np.float32)[labels]


def _name(position: tuple[float, float, float]) -> tuple[int, ...]:
    """Return one name for positions that are the same to the millimetre."""
    return tuple(round(1000 * value) for value in position)


def _tensorflow(code: Path, package: str) -> Any:
    """Return TensorFlow, with the official code on the path."""
    if code.name != package or not (code / "models").is_dir():
        raise MissingError(
            f"{code}: expected the official code, in a folder named '{package}':  git clone "
            f"https://github.com/google-research/{package}"
        )
    sys.path.insert(0, str(code.parent))
    try:
        return importlib.import_module("tensorflow")
    except ImportError as error:
        raise MissingError(
            f"{error}: run this in the environment of the official code, with its requirements.txt"
        ) from None
