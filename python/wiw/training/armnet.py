# SPDX-License-Identifier: Apache-2.0
"""Trains armnet on plays, and measures it on plays that it never saw."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.training.checkpoint import Checkpoint, Kept
from wiw.training.course import taught, up_and_down
from wiw.training.plays import POSES, Plays
from wiw.world_models.armnet.body import plate
from wiw.world_models.armnet.motion import motion as motion_of
from wiw.world_models.armnet.network import (
    FRONT,
    WINDOW,
    Arm,
    Motion,
    Network,
    clear_arm,
    compose_view,
    find_visible_arm,
    in_sight,
    sources,
    still,
)

HELD_OUT = 150
"""Plays that it is measured on."""
OTHERS = 1000
"""Added to the seed of what is learnt from: that of what is not."""
STEPS = (1, 2, 3, 5)
"""Poses after the observation that the model is measured at."""
NEAR, DEARER = 0.03, 0.02
"""Of colour: differences within which sources are about as near; what paint counts as farther off, for it is soft."""
CHANGED = 0.06
"""Difference of a channel from which on a pixel counts as changed."""


@dataclass(frozen=True)
class Recipe:
    """How the network is trained."""

    epochs: int = 4
    """How often each pose of each play is gone to, on average."""
    batch: int = 4
    """Plays at once."""
    steps: int = 3
    """Poses that are gone to one after another."""
    free: float = 0.25
    """Share of batches in which each pose is gone to from what the network itself made of the one before; in the others
    what went wrong before is put right, so that nothing is asked for that cannot be known."""
    widths: tuple[int, int, int] = (32, 64, 96)
    """Channels of the U-Net."""
    rate: float = 1.5e-3
    decay: float = 0.01
    changes: float = 15.0
    """Weight of pixels that are neither as before nor the arm, beside 1 of all others."""
    edges: float = 1.0
    """Weight of errors of the differences between neighbouring pixels."""
    paint: float = 0.3
    """Weight of errors of the paint alone, where things change: it learns what is to be seen before it is used."""
    shares: float = 0.05
    """Weight of the shares' cross-entropy, where things change, with a choice of the source that is nearest."""
    bfloat16: bool = True
    """Products in half the bits: faster on CPUs that can (AVX512-BF16), slower on others."""
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch, *self.widths) < 1 or not 1 <= self.steps <= POSES:
            raise ArgumentError(f"Recipe: expected positive epochs, batch, widths and steps up to {POSES}, got {self}")


def train(
    plays: Plays,
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    show: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    checkpoint: Checkpoint | None = None,
) -> tuple[Network, Recipe]:
    """A trained network, and the recipe that would give the same one again.

    Args:
        plays: to learn from.
        recipe: see there.
        minutes: if given, epochs are left out so that training takes about as long, by the speed of some trial steps.
        show: called after each step with its number, how many there are, and a running mean of the loss.
        checkpoint: where the state of training is kept, and gone on from.
    """
    an_epoch = max(1, len(plays) * POSES // (recipe.batch * recipe.steps))
    lesson, recipe = taught(
        lambda: _Lesson(plays, recipe), recipe, an_epoch, minutes, up_and_down(0.03), show, checkpoint
    )
    return lesson.network.eval(), recipe


class _Lesson(Kept):
    """A network in training, with all that its next step depends on."""

    parts = ("network", "optimiser")

    def __init__(self, plays: Plays, recipe: Recipe) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0xA111]) % 2**63)
        self.plays, self.recipe = plays, recipe
        self.network = Network(recipe.widths)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)

    def step(self, rate: float) -> float:
        """Learns from one batch of short ways; its loss."""
        for group in self.optimiser.param_groups:
            group["lr"] = float(rate)
        self.optimiser.zero_grad(set_to_none=True)
        recipe, total = self.recipe, 0.0
        rng = np.random.default_rng(core.fold_key([recipe.seed, 0xA112, self.count]))
        self.count += 1
        batch = drawn(self.plays, recipe.batch, recipe.steps, rng)
        follow = followed if rng.random() < recipe.free else led
        network = self.network.train()
        for part in follow(network, batch, recipe.bfloat16):
            loss = _loss(part, recipe) * len(part.made) / (recipe.batch * recipe.steps)
            loss.backward()
            total += float(loss.detach())
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        return total


@dataclass(frozen=True)
class Ways:
    """T poses gone to one after another, and what is seen before and after each."""

    seen: list[Tensor]
    """T + 1 of [B, 3, h, w]."""
    arms: list[Arm]
    """T + 1, over the bare table."""
    motions: list[Motion]
    """T."""


def drawn(plays: Plays, count: int, steps: int, rng: np.random.Generator) -> Ways:
    """Ways from anywhere in as many plays."""
    rows = rng.integers(0, len(plays), count)
    return ways(plays, rows, rng.integers(0, POSES + 1 - steps, count), steps)


def ways(plays: Plays, rows: NDArray[np.int64], first: NDArray[np.int64], steps: int) -> Ways:
    """Those of some plays from some of their views on."""
    at = [first + k for k in range(steps + 1)]
    arms = [
        Arm(_images(plays.bare[rows, t]), torch.from_numpy(plays.arm[rows, t][:, None].astype(np.float32))) for t in at
    ]
    poses = plays.poses
    motions = [motion_of(poses[rows, t], poses[rows, t + 1]) for t in at[:-1]]
    return Ways([_images(plays.seen[rows, t]) for t in at], arms, motions)


def _images(images: NDArray[np.uint8]) -> Tensor:
    """Float [B, 3, H, W] in [0, 1] of uint8 [B, H, W, 3]."""
    return torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255


def bare_table() -> Tensor:
    """[1, 3, h, w]: the window of the table without arm and things."""
    return _images(plate(FRONT).color[WINDOW][None].copy())


@dataclass(frozen=True)
class Step:
    """What the network makes of one motion, and what is truly seen."""

    made: Tensor
    target: Tensor
    still: Tensor
    """The view if nothing but the arm had moved."""
    shares: Tensor
    sources: Tensor
    """What `made` is composed of."""


def followed(network: Network, ways: Ways, bfloat16: bool = False) -> Iterator[Step]:
    """Each step from the canvas that the one before has left."""
    plate = bare_table()
    canvas = clear_view(ways.seen[0], ways.arms[0], plate)
    for k, motion in enumerate(ways.motions):
        before, arm = ways.arms[k : k + 2]
        step = _step(network, canvas, before.mask, arm, motion, ways.seen[k + 1], bfloat16)
        canvas = clear_arm(step.made.detach(), arm, find_visible_arm(step.shares.detach(), arm), plate, canvas)
        yield step


def clear_view(seen: Tensor, arm: Arm, before: Tensor) -> Tensor:
    """The canvas after a true view."""
    return clear_arm(seen, arm, in_sight(seen, arm), bare_table(), before)


def led(network: Network, ways: Ways, bfloat16: bool = False) -> Iterator[Step]:
    """All steps at once, each from the canvas that true views have left."""
    plate = bare_table()
    canvases = [plate.expand_as(ways.seen[0])]
    for seen, arm in zip(ways.seen[:-1], ways.arms[:-1], strict=True):
        canvases.append(clear_view(seen, arm, canvases[-1]))
    arm = Arm(torch.cat([each.color for each in ways.arms[1:]]), torch.cat([each.mask for each in ways.arms[1:]]))
    before = torch.cat([each.mask for each in ways.arms[:-1]])
    fields = ("before", "after", "scalars", "below")
    motion = Motion(*(torch.cat([getattr(each, name) for each in ways.motions]) for name in fields))
    yield _step(network, torch.cat(canvases[1:]), before, arm, motion, torch.cat(ways.seen[1:]), bfloat16)


def _step(
    network: Network, canvas: Tensor, before: Tensor, arm: Arm, motion: Motion, target: Tensor, bfloat16: bool
) -> Step:
    plate = bare_table()
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        mixture = network(canvas, arm, before, motion, plate)
    parts = sources(mixture, canvas, arm, motion, plate)
    return Step(compose_view(mixture.shares, parts), target, still(canvas, arm, plate), mixture.shares, parts)


def _loss(step: Step, recipe: Recipe) -> Tensor:
    differs = ((step.target - step.still).abs().amax(1, keepdim=True) > CHANGED).float()
    weight = 1 + recipe.changes * functional.max_pool2d(differs, 3, 1, 1)
    gap = step.made - step.target

    def error(a: Tensor, w: Tensor) -> Tensor:
        return (a.abs() * w).sum() / (3 * weight.sum())

    across = gap[..., 1:] - gap[..., :-1], torch.maximum(weight[..., 1:], weight[..., :-1])
    down = gap[..., 1:, :] - gap[..., :-1, :], torch.maximum(weight[..., 1:, :], weight[..., :-1, :])
    off = (step.sources - step.target[:, None]).abs().mean(2)
    aside = off.detach() + DEARER * torch.tensor([0.0, 0.0, 0.0, 1.0])[:, None, None]
    choice = -((-aside / NEAR).softmax(1) * (step.shares + 1e-6).log()).sum(1, keepdim=True)
    count = differs.sum() + 1
    return (
        error(gap, weight)
        + recipe.edges * (error(*across) + error(*down))
        + recipe.paint * (off[:, 3:] * differs).sum() / count
        + recipe.shares * (choice * differs).sum() / count
    )


# -- measuring ---------------------------------------------------------------------------------------------------------


def measured(network: Network, plays: Plays) -> dict[str, Any]:
    """How far `copy`, the arm alone and the network are from the truth, by the number of poses gone to.

    {"plays": N, "changed": {"copy": {"1": error, ...}, "arm": ..., "armnet": ...}, "psnr": likewise}. "changed" is the
    mean absolute error, in parts of 255, of pixels that truly differ from the view with only the arm moved and from
    things left where they were seen at first; "psnr" is in dB over the whole window.
    """
    most = max(STEPS)
    rows = np.arange(len(plays))
    errors: dict[str, dict[str, list[float]]] = {name: {} for name in ("copy", "arm", "armnet")}
    noise: dict[str, dict[str, list[float]]] = {name: {} for name in errors}
    for part in np.array_split(rows, max(1, len(rows) // 16)):
        batch = ways(plays, part, np.zeros(len(part), np.int64), most)
        plate = bare_table()
        first = clear_view(batch.seen[0], batch.arms[0], plate)
        with torch.inference_mode():
            for number, step in enumerate(followed(network, batch), 1):
                if number not in STEPS:
                    continue
                arm = batch.arms[number]
                alone = still(first, arm, plate)
                changed = (step.target - alone).abs().amax(1, keepdim=True) > CHANGED
                for name, made in (("copy", batch.seen[0]), ("arm", alone), ("armnet", step.made)):
                    gap = made - step.target
                    wrong = (gap.abs().mean(1, keepdim=True) * changed).sum((1, 2, 3)), changed.sum((1, 2, 3))
                    errors[name].setdefault(str(number), []).extend(
                        (255 * w / n).item() for w, n in zip(*wrong, strict=True) if n
                    )
                    square = (gap**2).mean((1, 2, 3)).clamp_min(1e-6)
                    noise[name].setdefault(str(number), []).extend((-10 * square.log10()).tolist())

    def means(values: dict[str, dict[str, list[float]]]) -> dict[str, dict[str, float]]:
        return {name: {k: round(float(np.mean(v)), 3) for k, v in by.items()} for name, by in values.items()}

    return {"plays": len(plays), "changed": means(errors), "psnr": means(noise)}
