# SPDX-License-Identifier: Apache-2.0
"""The warp: how near it comes to true renders after steps of 0.2 m, against keeping the old view, and its speed.

Poses: random places and headings in generated apartments with at least 1.6 m free ahead. PSNR is the mean over poses,
of whole panoramas and of their front view of 90 degrees; the gain is the mean of PSNR(warp) - PSNR(copy), which is also
the difference of the means. "Known" is the warp with its holes replaced by the truth, and "mean" with each connected
hole replaced by its true mean colour: what no better guess, and no smooth one, could pass.
"""

from __future__ import annotations

import os

os.environ.setdefault("WIW_NUM_THREADS", "1")

import numpy as np
from harness import measure, report, spread
from scipy import ndimage

from wiw import panorama, reproject, scenes
from wiw.nav import Ground, NavMesh
from wiw.render import Renderer

SIZE = (576, 1024)
STEPS = (1, 3, 5, 8)
POSES, APARTMENTS = 50, 5
CAMERA_HEIGHT = 1.0


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255.0**2 / np.mean((a.astype(np.float64) - b) ** 2)))


def hole_means(truth: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """The true mean colour of the connected hole that each pixel lies in."""
    labels, which = ndimage.label(hole)
    of = np.arange(which + 1)
    return np.stack([ndimage.mean(truth[..., c], labels, of)[labels] for c in range(3)], -1)


def free_poses(mesh: NavMesh, ground: Ground, count: int, seed: int) -> list[np.ndarray]:
    """T_world_camera of places from which 1.6 m straight ahead is navigable all along."""
    rng = np.random.default_rng(seed)
    poses: list[np.ndarray] = []
    for point in mesh.sample(2000, seed=seed):
        start = np.eye(4)
        start[:3, 3] = point
        pose = start @ reproject.pose(yaw_deg=rng.uniform(-180, 180))
        path = np.stack([(pose @ reproject.pose(forward=0.2 * k))[:3, 3] for k in range(1, 9)])
        if np.all(mesh.is_navigable(path)):
            pose[1, 3] = ground.put_down(point)[1] + CAMERA_HEIGHT
            poses.append(pose)
        if len(poses) == count:
            break
    return poses


def main() -> None:
    steps = np.stack([reproject.pose(forward=0.2 * k) for k in STEPS])
    scores: dict[str, list[list[float]]] = {
        name: [] for name in ("warp", "copy", "warp front", "copy front", "mean", "known")
    }
    first = None
    for seed in range(APARTMENTS):
        scene = scenes.apartment(seed)
        renderer = Renderer(scene, "cpu")
        for pose in free_poses(NavMesh.build(scene), Ground(scene), POSES // APARTMENTS, seed):
            seen = renderer.panorama(np.concatenate([pose[None], pose @ steps]), SIZE, outputs=("color", "depth"))
            color, depth = seen["color"], seen["depth"]
            shown = reproject.warp(color[:1], depth[:1], steps[None], outputs=("color", "hole"))
            imagined, hole = shown["color"][0], shown["hole"][0]
            front = panorama.to_perspective(np.concatenate([color, imagined]), 90.0, (384, 384))
            truth, old, new = front[1 : len(STEPS) + 1], front[0], front[len(STEPS) + 1 :]
            scores["warp"].append([psnr(a, b) for a, b in zip(imagined, color[1:], strict=True)])
            scores["known"].append(
                [psnr(np.where(h[..., None], b, a), b) for a, b, h in zip(imagined, color[1:], hole, strict=True)]
            )
            scores["mean"].append(
                [
                    psnr(np.where(h[..., None], hole_means(b, h), a), b)
                    for a, b, h in zip(imagined, color[1:], hole, strict=True)
                ]
            )
            scores["copy"].append([psnr(color[0], b) for b in color[1:]])
            scores["warp front"].append([psnr(a, b) for a, b in zip(new, truth, strict=True)])
            scores["copy front"].append([psnr(old, b) for b in truth])
            first = (color[:1], depth[:1]) if first is None else first
    if first is None:
        raise SystemExit("no pose with 1.6 m free ahead: cannot measure")
    table = {name: np.array(rows) for name, rows in scores.items()}
    print(f"\nPSNR in dB over {len(table['warp'])} poses   (target: warp - copy at least 12 at 5 and 8 steps)")
    for k, step in enumerate(STEPS):
        cells = [f"{name} {table[name][:, k].mean():.2f}" for name in table]
        gain = table["warp"][:, k] - table["copy"][:, k]
        front_gain = table["warp front"][:, k] - table["copy front"][:, k]
        print(f"  {step} steps: {', '.join(cells)}; gain {gain.mean():.2f} panorama, {front_gain.mean():.2f} front")
        print(f"     gain by pose: panorama {spread(gain, 1)}, front {spread(front_gain, 1)}")

    one, five = steps[None, 2:3], np.stack([reproject.pose(forward=0.2 * k) for k in range(1, 6)])[None]
    view = {"size": (384, 384), "target_hfov_deg": 90.0}
    color, depth = first
    cases = {
        "one 576x1024 panorama": lambda: reproject.warp(color, depth, one),
        "five of one source": lambda: reproject.warp(color, depth, five),
        "one 384x384 view": lambda: reproject.warp(color, depth, one, **view),
        "copy of the panorama": color.copy,
    }
    timings = measure(cases)
    report("warp", cases, timings, "one 576x1024 panorama", "12 ms a panorama")


if __name__ == "__main__":
    main()
