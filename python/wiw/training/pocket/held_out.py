# SPDX-License-Identifier: Apache-2.0
"""Windows of held-out scenes, rendered as they are requested: what world models are measured on.

`wiw collect navigation` refuses scenes of val and test splits, so that nobody trains on them. These windows are drawn
by the same traversals, and are never written.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from wiw import metrics, scenes
from wiw._core import core
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import World, world
from wiw.errors import ArgumentError
from wiw.training.held_out_clips import APART
from wiw.training.navigation_rules import NavigationRules
from wiw.training.pocket.batches import compute_displacements
from wiw.training.reduced_frames import Bar
from wiw.training.traversal import STEP_M, TURN_RAD, plan_scene
from wiw.training.walks import StraightPath, find_straight_paths
from wiw.world_models.pocket.model import Pocket
from wiw.world_models.warpnet.model import STILL, shrink_panorama, to_network, turn_panorama
from wiw.world_models.warpnet.network import plain_room, warp

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
    """True panoramas of the frames in `STEPS` that are seen from elsewhere than frame 0; others need no imagining."""


def draw_windows(scene: str, count: int, seed: int) -> list[Window]:
    """Draw up to `count` windows of each kind; a pure function of its arguments."""
    here = world(scene)
    name = core.fold_key([seed, 0x90C7])
    return [*_draw_mixed(here, count, name), *_draw_straight(here, count, name)]


def _draw_mixed(here: World, count: int, key: int) -> list[Window]:
    segments = [
        (traversal.north, segment)
        for traversal in plan_scene(here.navmesh, here.name, key % 2**63, 0, NavigationRules(), here.roofs)
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
    windows: Sequence[Window], models: Mapping[str, Imagine], seed: int, small: tuple[int, int] = (64, 128)
) -> Iterator[dict[str, Any]]:
    """Yield the PSNR in dB of each model's frames, weighted by latitude, in full size and reduced to size `small`.

    The control gap is measured on mixed windows, with the places of each replaced by those of another one of its scene,
    turns kept: rows whose "control" is "shuffled". Turns are rolls, which say nothing about what a model has learnt;
    places that happen to be the same say nothing about whether it obeys, and have no such rows (`APART`).

    Each scene is measured by itself, so that a row does not depend on what other scenes there are.

    Raises:
        ArgumentError: there are no windows.
    """
    if not windows:
        raise ArgumentError("expected scenes from which windows can be sampled, got none; choose others")
    for scene in dict.fromkeys(window.scene for window in windows):
        yield from _measure_scene([window for window in windows if window.scene == scene], models, seed, small)


def _measure_scene(
    windows: Sequence[Window], models: Mapping[str, Imagine], seed: int, small: tuple[int, int]
) -> Iterator[dict[str, Any]]:
    others = shuffle_places(windows, seed)
    for index, window in enumerate(windows):
        apart = np.linalg.norm(window.trajectory[:, :2] - others[index][:, :2], axis=1) > APART
        trajectories = {"true": window.trajectory}
        trajectories |= {"shuffled": others[index]} if apart.any() else {}
        for name, imagine in models.items():
            for control, trajectory in trajectories.items():
                frames = imagine(window, trajectory, seed + index)
                for step, truth in window.truth.items():
                    if control == "shuffled" and not apart[step - 1]:
                        continue
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
                            metrics.psnr(
                                shrink_panorama(made, small), shrink_panorama(truth, small), weights="latitude"
                            )
                        ),
                    }


def evaluate(
    model: Pocket, specs: str, seed: int, count: int = 4, bar: Bar = lambda items, text, total: items
) -> dict[str, Any]:
    """Measure `copy`, the observation rolled, one plain room and this model, on `count` windows of each kind and scene.

    Returns:
        {kind: {"windows": N, "psnr": {model: {step: dB}}, "gap": {step: dB}}}, in full size; the gap on mixed ones.

    Raises:
        ArgumentError: there are no windows in the scenes.
    """
    names = scenes.resolve(specs)
    windows = [
        window
        for name in bar(names, f"evaluating on {specs}", len(names))
        for window in draw_windows(name, count, seed)
    ]
    rows = list(measure(windows, {**BASELINES, "pocket": imagine_by(model)}, seed))
    return {
        kind: _summarise([row for row in rows if row["kind"] == kind]) for kind in sorted({w.kind for w in windows})
    }


def _summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    def average(model: str, control: str) -> dict[str, float]:
        found = {
            step: [r["psnr"] for r in rows if (r["model"], r["control"], r["step"]) == (model, control, step)]
            for step in STEPS
        }
        return {str(step): round(float(np.mean(values)), 3) for step, values in found.items() if values}

    psnr = {model: average(model, "true") for model in dict.fromkeys(row["model"] for row in rows)}
    lost = defaultdict[int, list[float]](list)
    for (_, _, step), pair in pair_controls(rows, "pocket", "psnr").items():
        lost[step].append(pair["true"] - pair["shuffled"])
    gap = {str(step): round(float(np.mean(lost[step])), 3) for step in STEPS if lost[step]}
    return {"windows": len({(row["scene"], row["window"]) for row in rows}), "psnr": psnr, "gap": gap}


def pair_controls(
    rows: Sequence[Mapping[str, Any]], model: str, size: str
) -> dict[tuple[str, int, int], dict[str, float]]:
    """Return a model's PSNR of frames that were imagined under both controls, by scene, window and step.

    Args:
        rows: of `measure`.
        model: its name.
        size: "psnr" or "psnr_small".
    """
    found = defaultdict[tuple[str, int, int], dict[str, float]](dict)
    for row in rows:
        if row["model"] == model:
            found[row["scene"], row["window"], row["step"]][row["control"]] = row[size]
    return {place: pair for place, pair in found.items() if len(pair) == 2}


def imagine_by(model: Pocket) -> Imagine:
    """Return a model of `measure` that a world model answers."""
    return lambda window, trajectory, seed: model.imagine_trajectory(window.image, trajectory, seed)


def _copy(window: Window, trajectory: NDArray[np.float64], seed: int) -> NDArray[np.uint8]:
    return np.repeat(window.image[None], len(trajectory), axis=0)


def _roll(window: Window, trajectory: NDArray[np.float64], seed: int) -> NDArray[np.uint8]:
    return np.stack([turn_panorama(window.image, azimuth) for azimuth in trajectory[:, 2]])


def _show_room(window: Window, trajectory: NDArray[np.float64], seed: int) -> NDArray[np.uint8]:
    """Return what is seen if all there is were one round room of the usual size."""
    source = to_network(window.image[None])
    room = plain_room(*window.image.shape[:2])[None]
    moved = torch.from_numpy(trajectory[:, :2].astype(np.float32))
    frames = []
    for (forward, left), azimuth in zip(moved, trajectory[:, 2], strict=True):
        seen = warp(source, room, forward[None], -left[None])[0].permute(1, 2, 0)
        frames.append(turn_panorama((seen * 127.5 + 127.5).round().clamp(0, 255).byte().numpy(), azimuth))
    return np.stack(frames)


BASELINES: Mapping[str, Imagine] = {"copy": _copy, "rolled": _roll, "one room": _show_room}
"""Models that have learnt nothing: the observation, the observation turned as the agent turns, and one round room."""


def shuffle_places(windows: Sequence[Window], seed: int) -> list[NDArray[np.float64]]:
    """Return each window's trajectory with its own turns and, for mixed ones, the places of another mixed window."""
    found = [window.trajectory.copy() for window in windows]
    order = np.random.default_rng(seed).permutation([i for i, each in enumerate(windows) if each.kind == "mixed"])
    for index, other in zip(order, np.roll(order, 1), strict=True):
        found[index][:, :2] = windows[other].trajectory[:, :2]
    return found
