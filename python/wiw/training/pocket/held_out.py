# SPDX-License-Identifier: Apache-2.0
"""Windows of held-out scenes, rendered as they are asked for: what world models are measured on.

`wiw collect navigation` refuses scenes of val and test splits, so that nobody trains on them. These windows are drawn by
the same traversals, and are never written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import metrics
from wiw._core import core
from wiw.datasets.imagenav import camera_pose
from wiw.datasets.worlds import World, world
from wiw.errors import ArgumentError
from wiw.training.navigation_rules import NavigationRules
from wiw.training.pocket.batches import compute_displacements
from wiw.training.pocket.frames import reduce_image
from wiw.training.traversal import STEP_M, TURN_RAD, plan_scene
from wiw.training.walks import StraightPath, find_straight_paths
from wiw.world_models.warpnet.model import STILL

STEPS = (1, 3, 5, 8)
"""Numbers of primitives ahead at which models are measured."""
LENGTH = 1 + STEPS[-1]

Imagine = Callable[["Window", NDArray[np.float64], int], NDArray[np.uint8]]
"""A model: the panoramas uint8 [K, H, W, 3] of a window's trajectory, or of another one, given a seed."""


@dataclass(frozen=True)
class Window:
    """Consecutive frames of one scene."""

    scene: str
    kind: str
    """"mixed", from a traversal, or "straight", ahead all the time."""
    image: NDArray[np.uint8]
    """uint8 [H, W, 3]: frame 0."""
    depth: NDArray[np.float32]
    """float32 [H, W]: of frame 0, in metres along the ray."""
    trajectory: NDArray[np.float64]
    """float64 [LENGTH - 1, 3]: forward and left in metres, azimuth in radians, after each action."""
    truth: Mapping[int, NDArray[np.uint8]]
    """Of the frames in `STEPS` that are seen from elsewhere than frame 0, which others show without imagining."""


def draw_windows(scene: str, count: int, seed: int) -> list[Window]:
    """Draw up to `count` windows of each kind; a pure function of its arguments."""
    here = world(scene)
    name = core.fold_key([seed, 0x90C7])
    return [*_draw_mixed(here, count, name), *_draw_straight(here, count, name)]


def _draw_mixed(here: World, count: int, key: int) -> list[Window]:
    segments = [
        (traversal.north, segment)
        for traversal in plan_scene(here.navmesh, here.name, key % 2**63, 0, NavigationRules())
        for segment in traversal.segments
    ]
    starts = [(index, at) for index, (_, each) in enumerate(segments) for at in range(len(each) - LENGTH + 1)]
    order = np.argsort(core.uniform(core.fold_key([key, 1]), len(starts)))[:count]
    windows = []
    for index, at in (starts[place] for place in order):
        north, segment = segments[index]
        frames = slice(at, at + LENGTH)
        headings = north + segment.headings[frames] * TURN_RAD
        windows.append(_render(here, "mixed", segment.positions[frames].astype(np.float64), headings))
    return windows


def _draw_straight(here: World, count: int, key: int) -> list[Window]:
    length = STEPS[-1] * STEP_M
    paths: Sequence[StraightPath] = find_straight_paths(here, count, core.fold_key([key, 2]), length, length)
    windows = []
    for path in paths:
        ahead = np.array([-np.sin(path.heading), 0.0, -np.cos(path.heading)])
        positions = path.start + np.arange(LENGTH)[:, None] * STEP_M * ahead
        windows.append(_render(here, "straight", positions, np.full(LENGTH, path.heading)))
    return windows


def _render(here: World, kind: str, positions: NDArray[np.float64], headings: NDArray[np.float64]) -> Window:
    floor = here.ground.put_down(positions).astype(np.float64)
    moved = compute_displacements(positions[None][:, :, [0, 2]], headings[:1])[0]
    trajectory = np.column_stack([moved[:, 1], -moved[:, 0], headings - headings[0]])[1:]
    shown = [step for step in STEPS if np.abs(moved[step]).max() > STILL]
    poses = np.stack([camera_pose(floor[step], float(headings[step])) for step in (0, *shown)])
    color = here.renderer.panorama(poses, outputs=("color",))["color"]
    depth = here.renderer.panorama(poses[:1], outputs=("depth",))["depth"][0]
    return Window(here.name, kind, color[0], depth, trajectory, dict(zip(shown, color[1:], strict=True)))


def measure(
    windows: Sequence[Window], models: Mapping[str, Imagine], seed: int, small: tuple[int, int]
) -> Iterator[dict[str, Any]]:
    """Yield the PSNR in dB of each model's frames, weighted by latitude, in full size and reduced to size `small`.

    The control gap is measured with each window's places replaced by those of another window, turns kept: rows whose
    "control" is "shuffled". Turns are rolls, which show nothing of what a model has learnt.

    Raises:
        ArgumentError: there are no windows.
    """
    if not windows:
        raise ArgumentError("expected scenes in which windows can be drawn, got none; name others")
    others = shuffle_places(windows, seed)
    for index, window in enumerate(windows):
        trajectories = {"true": window.trajectory, "shuffled": others[index]}
        for name, imagine in models.items():
            for control, trajectory in trajectories.items():
                frames = imagine(window, trajectory, seed + index)
                for step, truth in window.truth.items():
                    made = frames[step - 1]
                    yield {
                        "scene": window.scene,
                        "window": index,
                        "kind": window.kind,
                        "model": name,
                        "control": control,
                        "step": step,
                        "psnr": float(metrics.psnr(made, truth, weights="latitude")),
                        "psnr_small": float(
                            metrics.psnr(reduce_image(made, small), reduce_image(truth, small), weights="latitude")
                        ),
                    }


def shuffle_places(windows: Sequence[Window], seed: int) -> list[NDArray[np.float64]]:
    """Return trajectories with each window's own turns and the places of another window of the same kind."""
    found = [window.trajectory.copy() for window in windows]
    for kind in sorted({window.kind for window in windows}):
        own = [index for index, window in enumerate(windows) if window.kind == kind]
        order = np.random.default_rng((seed, len(own))).permutation(own)
        for index, other in zip(order, np.roll(order, 1), strict=True):
            found[index][:, :2] = windows[other].trajectory[:, :2]
    return found
