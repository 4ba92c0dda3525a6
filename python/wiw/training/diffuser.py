# SPDX-License-Identifier: Apache-2.0
"""Train the 3D diffusion policy on demonstrations: the expert's view and the path that it took next."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from wiw._core import core
from wiw.datasets.demonstration import decode_colors, decode_depths, name_demonstration
from wiw.datasets.navigation import part_of
from wiw.errors import ArgumentError
from wiw.policies.diffuser.diffusion import ALPHA_BARS, NOISE_LEVELS, add_noise
from wiw.policies.diffuser.network import Network, Shape, Views, to_tensors
from wiw.policies.diffuser.paths import MIDDLE, to_vectors
from wiw.policies.diffuser.workspace import PinholeCamera, WorkspaceView, stack_views
from wiw.training.checkpoint import Checkpoint, ResumableTrainer
from wiw.training.trainer import apply_gradients, run_training, warmup_cosine_schedule
from wiw.typed_values import require_positive

if TYPE_CHECKING:
    from wiw.datasets.demonstrations import Demonstration

SUBTASK_LENGTHS: Mapping[str, int] = {"push_buttons": 3, "slide_block": 4, "insert_peg": 6, "stack_cups": 6}
"""Number of an expert's actions that achieve one subtask: one button pushed, or one object slid or placed."""


MIRRORED_POSE = np.array([1, -1, 1, -1, 1, -1, 1.0])
"""Factors of a gripper's pose whose left and right are exchanged; the middle of the workspace is at y = 0."""


@dataclass(frozen=True)
class Samples:
    """N training samples: what was seen, and the path that the expert took next."""

    views: tuple[WorkspaceView, ...]
    """Views of N frames by each camera: the front one, and that on the wrist where it was recorded."""
    pose: NDArray[np.float64]
    """float64 [N, 7]: the gripper's pose."""
    path: NDArray[np.float64]
    """float64 [N, L, 7]: the poses that the gripper went to; a shorter path repeats its last pose."""
    demonstrations: tuple[str, ...]
    """[N]: names of the demonstrations that they are from."""
    failed: int = 0
    """Number of other demonstrations, left out because they failed."""

    def __len__(self) -> int:
        return len(self.pose)

    def select(self, rows: NDArray[np.int64]) -> Samples:
        """Return some of the samples, by their numbers."""
        names = tuple(self.demonstrations[row] for row in rows)
        views = tuple(each.select(rows) for each in self.views)
        return Samples(views, self.pose[rows], self.path[rows], names, self.failed)

    def hold_out(self, share: float = 0.05) -> tuple[Samples, Samples]:
        """Return the samples to train on, and those of a share of the demonstrations, chosen by a hash of their names.

        Raises:
            ArgumentError: none is left to train on.
        """
        rows = np.array([part_of(name, share) == "held-out" for name in self.demonstrations])
        if rows.all():
            raise ArgumentError("diffuser: all demonstrations are held out, none is left to train on; collect more")
        return self.select(np.flatnonzero(~rows)), self.select(np.flatnonzero(rows))


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters of the training."""

    epochs: int = 40
    batch: int = 8
    """Samples in a batch."""
    levels: int = 8
    """Noised paths of each sample."""
    width: int = 96
    layers: int = 4
    rate: float = 1e-3
    decay: float = 0.01
    turn: float = 0.5
    """Weight of rotation errors beside position errors."""
    grip: float = 0.1
    """Weight of errors of the gripper's opening."""
    tilt: float = 0.5
    """Augmentation: greatest rotation of a scene about the middle of the workspace, in radians."""
    mirror: float = 0.5
    """Augmentation: share of scenes whose left and right are exchanged."""
    recolor: float = 1.0
    """Augmentation: share of scenes whose red, green and blue are exchanged at random.

    Which colour is meant the policy is not told. Without this it learns by heart what was meant at each table.
    """
    average: float = 0.995
    """Decay of the exponential moving average of the weights, late in training."""
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive("Recipe", self, "epochs", "batch", "levels", "width", "layers")


def extract_samples(
    demonstrations: Iterable[Demonstration], camera: PinholeCamera, wrist_intrinsics: NDArray[np.float64] | None = None
) -> Samples:
    """Return a training sample for each subtask of the demonstrations, as cameras see its beginning.

    Demonstrations that failed are left out: where they were given up, no path leads on.

    Args:
        demonstrations: with depth.
        camera: the front one.
        wrist_intrinsics: float64 [3, 3] of the wrist camera; its views are left out if not given.

    Raises:
        ArgumentError: there are none, all failed, or some are of an unknown task, or without depth or the wrist
            camera's views.
    """
    cameras, found, failed = Cameras(camera, wrist_intrinsics), [], 0
    for demonstration in demonstrations:
        if demonstration.success:
            name = name_demonstration(demonstration)
            found += [(*each, name) for each in _split_into_subtasks(demonstration, cameras)]
        failed += not demonstration.success
    if not found:
        raise ArgumentError(
            "diffuser: expected demonstrations to learn from, got "
            + (f"{failed} that failed; collect others without --keep-failed" if failed else "none")
        )
    views, poses, paths, names = zip(*found, strict=True)
    stacked = tuple(stack_views(each) for each in zip(*views, strict=True))
    return Samples(stacked, np.stack(poses), np.stack(paths), names, failed)


@dataclass(frozen=True)
class Cameras:
    """The cameras that demonstrations are looked at by."""

    front: PinholeCamera
    wrist_intrinsics: NDArray[np.float64] | None = None

    def view(self, demonstration: Demonstration, frame: int) -> list[WorkspaceView]:
        """Return what each camera sees of the workspace in a frame; no other frame is decoded.

        Raises:
            ArgumentError: the demonstration lacks depth or the wrist camera's views.
        """
        if demonstration.encoded_depths is None:
            raise ArgumentError("diffuser: expected demonstrations with depth, of `wiw collect manipulation --depth`")
        one = slice(frame, frame + 1)
        image, depth = (
            decode_colors(demonstration.encoded_images[one]),
            decode_depths(demonstration.encoded_depths[one]),
        )
        views = [self.front.view_workspace(image[0], depth[0])]
        if self.wrist_intrinsics is None:
            return views
        images, depths = demonstration.encoded_wrist_images, demonstration.encoded_wrist_depths
        if images is None or depths is None or demonstration.wrist_poses is None:
            raise ArgumentError("diffuser: expected views of the wrist camera in all demonstrations, got one without")
        wrist = PinholeCamera(self.wrist_intrinsics, demonstration.wrist_poses[frame])
        return [*views, wrist.view_from_wrist(decode_colors(images[one])[0], decode_depths(depths[one])[0])]


def _split_into_subtasks(
    demonstration: Demonstration, cameras: Cameras
) -> Iterator[tuple[list[WorkspaceView], NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the views at the beginning of each subtask, the gripper's pose there, and the poses that it goes to.

    A demonstration ends with its success. Where that comes before the hand has withdrawn, a pose straight above is
    added.
    """
    if demonstration.task not in SUBTASK_LENGTHS:
        raise ArgumentError(f"diffuser: expected tasks among {', '.join(SUBTASK_LENGTHS)}, got {demonstration.task}")
    parts, keys, longest = SUBTASK_LENGTHS[demonstration.task], demonstration.keys, max(SUBTASK_LENGTHS.values())
    for first in range(0, int(keys.max()), parts):
        frame = int(np.flatnonzero(keys <= first)[-1])
        numbers = range(first + 1, min(first + parts, int(keys.max())) + 1)
        poses = [demonstration.actions[keys == number][0] for number in numbers]
        if len(poses) < parts:
            up = max(pose[2] for pose in poses)
            poses.append(np.concatenate([poses[-1][:2], [up], poses[-1][3:]]))
        path = np.stack(poses + [poses[-1]] * (longest - len(poses)))
        yield cameras.view(demonstration, frame), demonstration.poses[frame], path


def train(
    samples: Samples,
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    checkpoint: Checkpoint | None = None,
) -> tuple[Network, Recipe]:
    """Train a network; return it with the recipe that reproduces it without a time limit.

    Args:
        samples: to learn from.
        recipe: how to train; see `Recipe`.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        checkpoint: where the state of training is saved, and from where it resumes.
    """
    steps_per_epoch = max(1, len(samples) // recipe.batch)
    begin = partial(_Trainer, samples, recipe)
    trainer, recipe = run_training(
        begin, recipe, steps_per_epoch, minutes, warmup_cosine_schedule(0.03), on_step, checkpoint
    )
    return trainer.average.eval(), recipe


class _Trainer(ResumableTrainer):
    """The network in training, with everything that its next step depends on."""

    stateful_parts = ("network", "average", "optimiser")

    def __init__(self, samples: Samples, recipe: Recipe) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0xD1F1]) % 2**63)
        self.samples, self.recipe = samples, recipe
        shape = Shape(recipe.width, layers=recipe.layers, poses=samples.path.shape[1], wrist=len(samples.views) > 1)
        self.network = Network(shape)
        self.average = deepcopy(self.network)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch of samples and return its loss."""
        key = core.fold_key([self.recipe.seed, 0xD1F2, self.step_count])
        batch = sample_batch(self.samples, self.recipe, np.random.default_rng(key))
        loss = self._compute_loss(batch, torch.Generator().manual_seed(key % 2**63))
        loss.backward()
        apply_gradients(self.optimiser, self.network, learning_rate)
        self.step_count += 1
        self._update_average(min(self.recipe.average, self.step_count / (self.step_count + 9)))
        return float(loss.detach())

    def _compute_loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        recipe, network = self.recipe, self.network.train()
        count = len(batch.now), recipe.levels
        level = torch.randint(NOISE_LEVELS, count, generator=generator)
        clean = batch.path[:, None].expand(-1, recipe.levels, -1, -1)
        noise = torch.randn(*count, *clean.shape[2:-1], 9, generator=generator)
        scene = network.encode_scene(batch.views, batch.now)
        found, gripper = network.denoise(scene, add_noise(clean[..., :9], noise, level), level)
        off = _compute_huber_errors(found - clean[..., :9], level)
        grip = functional.binary_cross_entropy_with_logits(gripper, clean[..., 9])
        return off[..., :3].mean() + recipe.turn * off[..., 3:].mean() + recipe.grip * grip

    @torch.no_grad()
    def _update_average(self, kept: float) -> None:
        for mean, value in zip(self.average.parameters(), self.network.parameters(), strict=True):
            mean.lerp_(value, 1 - kept)


def _compute_huber_errors(off: Tensor, level: Tensor) -> Tensor:
    """Return Huber errors of the same shape as `off` [B, R, L, 9], with the noise-to-signal ratio as threshold.

    Where noise leaves open which of several paths is meant, squared errors ask for their mean, so that sampling prefers
    none of them; absolute errors would ask for the median. Where noise is low, absolute errors make for precision.
    """
    ratio = ((1 - ALPHA_BARS[level]) / ALPHA_BARS[level]).sqrt().clamp(0.02, 2.0)[..., None, :]
    size = off.abs()
    return torch.where(size < ratio, size * size / (2 * ratio), size - ratio / 2)


@dataclass(frozen=True)
class Batch:
    """Samples as the network's input."""

    views: list[Views]
    """One of each camera."""
    now: Tensor
    """[B, 10]."""
    path: Tensor
    """[B, L, 10]."""


def sample_batch(samples: Samples, recipe: Recipe, rng: np.random.Generator) -> Batch:
    """Sample random rows, and augment them as the recipe says, with other brightness and tint."""
    count = recipe.batch
    chosen = rng.integers(0, len(samples), count)
    augmentation = Augmentation.draw(count, recipe, rng)
    poses = augmentation.change_poses(np.concatenate([samples.pose[chosen, None], samples.path[chosen]], axis=1))
    vectors = torch.from_numpy(to_vectors(poses))
    views = [augmentation.change_view(each, chosen) for each in samples.views]
    return Batch(views, vectors[:, 0], vectors[:, 1:])


@dataclass(frozen=True)
class Augmentation:
    """Changes of B samples: of colours, and of the scene about the middle of the workspace."""

    light: NDArray[np.float32]
    """float32 [B, 1, 1, 3]: factors of red, green and blue."""
    channels: NDArray[np.int64]
    """int64 [B, 3]: which channel becomes red, green and blue."""
    mirrored: NDArray[np.bool_]
    """bool [B]: whether left and right are exchanged."""
    angles: NDArray[np.float64]
    """float64 [B]: rotation about the vertical in radians, once mirrored."""

    @classmethod
    def draw(cls, count: int, recipe: Recipe, rng: np.random.Generator) -> Augmentation:
        """Draw changes at random."""
        light = rng.uniform(0.8, 1.2, (count, 1, 1, 1)) * rng.uniform(0.92, 1.08, (count, 1, 1, 3))
        angles = rng.uniform(-recipe.tilt, recipe.tilt, count)
        mirrored = rng.random(count) < recipe.mirror
        exchanged = rng.random(count) < recipe.recolor
        channels = np.where(exchanged[:, None], rng.permuted(np.tile(np.arange(3), (count, 1)), axis=1), np.arange(3))
        return cls(light.astype(np.float32), channels, mirrored, angles)

    def change_poses(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return poses [B, L, 7] of the changed scenes."""
        changed = poses.copy()
        changed[self.mirrored] *= MIRRORED_POSE
        changed[..., :3] = self._move(changed[..., :3])
        changed[..., 5] += self.angles[:, None]
        return changed

    def change_view(self, view: WorkspaceView, chosen: NDArray[np.int64]) -> Views:
        """Return what a camera sees of the changed scenes in the chosen rows."""
        own = view.select(chosen)
        image, height, places = own.image, own.height, own.places
        for each in (image, height, places):
            each[self.mirrored] = each[self.mirrored, :, ::-1]
        places[self.mirrored, ..., 1] *= -1
        places = self._move(places.reshape(len(places), -1, 3)).reshape(places.shape)
        image = np.take_along_axis(image, self.channels[:, None, None], axis=3)
        image = (image * self.light).clip(0, 255).astype(np.uint8)
        return to_tensors(WorkspaceView(image, height, places.astype(np.float32)))

    def _move(self, points: NDArray[Any]) -> NDArray[Any]:
        """Return points [B, N, 3] rotated about the middle of the workspace."""
        turns = Rotation.from_euler("z", self.angles[:, None]).as_matrix()
        return np.einsum("bij,bnj->bni", turns, points - MIDDLE) + MIDDLE
