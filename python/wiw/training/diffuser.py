# SPDX-License-Identifier: Apache-2.0
"""Trains the 3D diffusion policy on demonstrations: what an expert saw, and the path that it went then."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.policies.diffuser.diffusion import KEPT, STEPS, noised
from wiw.policies.diffuser.network import Network, Shape
from wiw.policies.diffuser.paths import MIDDLE, to_vectors
from wiw.policies.diffuser.sight import Lens, Sight
from wiw.training.checkpoint import Checkpoint, Kept
from wiw.training.course import taught, up_and_down

if TYPE_CHECKING:
    from wiw.datasets.demonstrations import Demonstration

PARTS: Mapping[str, int] = {"push_buttons": 3, "slide_block": 4, "insert_peg": 6, "stack_cups": 6}
"""Actions of an expert that together come to something: one button pushed, one thing slid or put elsewhere."""


@dataclass(frozen=True)
class Moments:
    """What was seen at N moments, and the path that was gone then."""

    sight: Sight
    """Of N pictures."""
    pose: NDArray[np.float64]
    """float64 [N, 7]: where the gripper was."""
    path: NDArray[np.float64]
    """float64 [N, L, 7]: the poses that it went to; one that comes to its end sooner stays there."""

    def __len__(self) -> int:
        return len(self.pose)


@dataclass(frozen=True)
class Recipe:
    """How the network is trained."""

    epochs: int = 400
    batch: int = 8
    """Moments a step."""
    levels: int = 8
    """Noised paths of each moment."""
    width: int = 96
    layers: int = 4
    rate: float = 1e-3
    decay: float = 0.01
    turn: float = 0.5
    """Weight of errors of rotations beside those of places."""
    grip: float = 0.1
    """Weight of errors of the gripper's opening."""
    tilt: float = 0.1
    """Radians that scenes are turned about the middle of the workspace, at most."""
    average: float = 0.995
    """What the averaged weights keep of themselves in a step, late in training."""
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch, self.levels, self.width, self.layers) < 1:
            raise ArgumentError(f"Recipe: epochs, batch, levels, width and layers must be positive, got {self}")


def moments(demonstrations: Iterable[Demonstration], lens: Lens) -> Moments:
    """The beginnings of all parts of demonstrations, seen through a lens.

    Raises:
        ArgumentError: there are none, some are of an unknown task, or without depth.
    """
    found = [each for demonstration in demonstrations for each in _parts(demonstration, lens)]
    if not found:
        raise ArgumentError("diffuser: expected demonstrations to learn from, got none")
    sights, poses, paths = zip(*found, strict=True)
    sight = Sight(*(np.stack([getattr(each, name) for each in sights]) for name in ("image", "height", "places")))
    return Moments(sight, np.stack(poses), np.stack(paths))


def _parts(
    demonstration: Demonstration, lens: Lens
) -> Iterator[tuple[Sight, NDArray[np.float64], NDArray[np.float64]]]:
    """What is seen where parts begin, the gripper's pose there, and the poses that it goes to.

    A demonstration ends with its success; where that is before the hand is away, it goes straight up to where it came
    from.
    """
    if demonstration.task not in PARTS:
        raise ArgumentError(f"diffuser: expected tasks among {', '.join(PARTS)}, got {demonstration.task}")
    if demonstration.encoded_depths is None:
        raise ArgumentError("diffuser: expected demonstrations with depth, of `wiw collect manipulation --depth`")
    parts, keys, longest = PARTS[demonstration.task], demonstration.keys, max(PARTS.values())
    for first in range(0, int(keys.max()), parts):
        frame = int(np.flatnonzero(keys <= first)[-1])
        numbers = range(first + 1, min(first + parts, int(keys.max())) + 1)
        poses = [demonstration.actions[keys == number][0] for number in numbers]
        if len(poses) < parts:
            up = max(pose[2] for pose in poses)
            poses.append(np.concatenate([poses[-1][:2], [up], poses[-1][3:]]))
        path = np.stack(poses + [poses[-1]] * (longest - len(poses)))
        yield lens.sight(*_picture(demonstration, frame)), demonstration.poses[frame], path


def _picture(demonstration: Demonstration, frame: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Image and depth of one frame, without decoding the others."""
    assert demonstration.encoded_depths is not None
    images, depths = demonstration.encoded_images[frame : frame + 1], demonstration.encoded_depths[frame : frame + 1]
    alone = replace(demonstration, encoded_images=images, encoded_depths=depths)
    assert alone.depths is not None
    return alone.images[0], alone.depths[0]


def train(
    moments: Moments,
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    show: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    checkpoint: Checkpoint | None = None,
) -> tuple[Network, Recipe]:
    """A trained network, and the recipe that would give the same one again.

    Args:
        moments: to learn from.
        recipe: see there.
        minutes: if given, epochs are left out so that training takes about as long, by the speed of some trial steps.
        show: called after each step with its number, how many there are, and a running mean of the loss.
        checkpoint: where the state of training is kept, and gone on from.
    """
    an_epoch = max(1, len(moments) // recipe.batch)
    begin = partial(_Lesson, moments, recipe)
    lesson, recipe = taught(begin, recipe, an_epoch, minutes, up_and_down(0.03), show, checkpoint)
    return lesson.average.eval(), recipe


class _Lesson(Kept):
    """A network in training, with all that its next step depends on."""

    parts = ("network", "average", "optimiser")

    def __init__(self, moments: Moments, recipe: Recipe) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0xD1F1]) % 2**63)
        self.moments, self.recipe = moments, recipe
        shape = Shape(recipe.width, layers=recipe.layers, poses=moments.path.shape[1])
        self.network = Network(shape)
        self.average = deepcopy(self.network)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)

    def step(self, rate: float) -> float:
        """Learns from one batch of moments; its loss."""
        for group in self.optimiser.param_groups:
            group["lr"] = float(rate)
        key = core.fold_key([self.recipe.seed, 0xD1F2, self.count])
        batch = drawn(self.moments, self.recipe.batch, self.recipe.tilt, np.random.default_rng(key))
        loss = self._loss(batch, torch.Generator().manual_seed(key % 2**63))
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.count += 1
        self._follow(min(self.recipe.average, self.count / (self.count + 9)))
        return float(loss.detach())

    def _loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        recipe, network = self.recipe, self.network.train()
        count = len(batch.now), recipe.levels
        level = torch.randint(STEPS, count, generator=generator)
        clean = batch.path[:, None].expand(-1, recipe.levels, -1, -1)
        noise = torch.randn(*count, *clean.shape[2:-1], 9, generator=generator)
        scene = network.look(batch.image, batch.height, batch.places, batch.now)
        found, gripper = network.denoise(scene, noised(clean[..., :9], noise, level), level)
        off = _errors(found - clean[..., :9], level)
        grip = functional.binary_cross_entropy_with_logits(gripper, clean[..., 9])
        return off[..., :3].mean() + recipe.turn * off[..., 3:].mean() + recipe.grip * grip

    @torch.no_grad()
    def _follow(self, kept: float) -> None:
        for mean, value in zip(self.average.parameters(), self.network.parameters(), strict=True):
            mean.lerp_(value, 1 - kept)


def _errors(off: Tensor, level: Tensor) -> Tensor:
    """Huber's, of the size of `off` [B, R, L, 9], with a threshold at the ratio of noise to signal.

    Where noise leaves open which of several paths is meant, squares ask for the mean of all, so that sampling prefers
    none; absolute errors would ask for the middle one. Where it does not, absolute errors make for precision.
    """
    ratio = ((1 - KEPT[level]) / KEPT[level]).sqrt().clamp(0.02, 2.0)[..., None, :]
    size = off.abs()
    return torch.where(size < ratio, size * size / (2 * ratio), size - ratio / 2)


@dataclass(frozen=True)
class Batch:
    """Moments as the network takes them."""

    image: Tensor
    """uint8 [B, h, w, 3]."""
    height: Tensor
    """[B, h, w]."""
    places: Tensor
    """[B, h / CELL, w / CELL, 3]."""
    now: Tensor
    """[B, 10]."""
    path: Tensor
    """[B, L, 10]."""


def drawn(moments: Moments, count: int, tilt: float, rng: np.random.Generator) -> Batch:
    """Any moments, turned about the middle of the workspace by up to `tilt` radians, in other light."""
    chosen = rng.integers(0, len(moments), count)
    light = rng.uniform(0.8, 1.2, (count, 1, 1, 1)) * rng.uniform(0.92, 1.08, (count, 1, 1, 3))
    images = (moments.sight.image[chosen] * light.astype(np.float32)).clip(0, 255).astype(np.uint8)
    angles = rng.uniform(-tilt, tilt, count)
    turns = Rotation.from_euler("z", angles[:, None]).as_matrix()
    places = np.einsum("bij,bhwj->bhwi", turns, moments.sight.places[chosen] - MIDDLE) + MIDDLE
    poses = np.concatenate([moments.pose[chosen, None], moments.path[chosen]], axis=1)
    poses[..., :3] = np.einsum("bij,blj->bli", turns, poses[..., :3] - MIDDLE) + MIDDLE
    poses[..., 5] += angles[:, None]
    vectors = torch.from_numpy(to_vectors(poses))
    return Batch(
        torch.from_numpy(images),
        torch.from_numpy(moments.sight.height[chosen]),
        torch.from_numpy(places.astype(np.float32)),
        vectors[:, 0],
        vectors[:, 1:],
    )
