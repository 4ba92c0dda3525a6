# SPDX-License-Identifier: Apache-2.0
"""How true pocket's views are on held-out scenes, beside warpnet, warp and what has learnt nothing.

python tests/benchmark/pocket_held_out.py [--weights FILE] [--scenes SPEC] [--windows N] [--steps 1 2 4 25]

Prints PSNR in dB by primitives ahead, in full size and at 64 x 128, and the control gap with its interval clustered by
scene. With `--picture FILE` it draws the first window straight ahead instead: true and imagined panoramas.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import wiw
from wiw import scenes
from wiw.analysis.intervals import clustered_interval
from wiw.reproject import pose, warp
from wiw.training.pocket.held_out import (
    BASELINES,
    STEPS,
    Imagine,
    Window,
    draw_windows,
    imagine_by,
    measure,
    pair_controls,
)
from wiw.training.traversal import STEP_M
from wiw.world_models.warpnet.model import turn_panorama

PICTURED = (1, 3, 8)
"""Numbers of primitives ahead that a picture shows."""
WIDTH = 320
"""Width of a panorama in it, in pixels."""


def warp_with_true_depth(window: Window, trajectory: NDArray[np.float64], seed: int) -> NDArray[np.uint8]:
    """Return what `warp` shows, which is told the true distances."""
    poses = np.stack([pose(forward, left, yaw_deg=np.degrees(turn)) for forward, left, turn in trajectory])
    return np.asarray(warp(window.image[None], window.depth[None], poses[None])[0])


def imagine_by_warpnet() -> Imagine:
    """Return warpnet as a model of `measure`."""
    model = wiw.world_model("warpnet")

    def imagine(window: Window, trajectory: NDArray[np.float64], seed: int) -> NDArray[np.uint8]:
        return np.stack(
            [turn_panorama(model.imagine_move(window.image, forward, left), turn) for forward, left, turn in trajectory]
        )

    return imagine


def make_models(options: argparse.Namespace) -> dict[str, Imagine]:
    """Return the networks, and warp, by the names that are printed."""
    weights = {"weights": options.weights} if options.weights else {}
    pockets = {
        f"pocket, {steps} {'step' if steps == 1 else 'steps'}": imagine_by(
            wiw.world_model("pocket", steps=steps, **weights)
        )
        for steps in options.steps
    }
    return {**pockets, "warpnet": imagine_by_warpnet(), "warp": warp_with_true_depth}


def measure_scenes(names: Sequence[str], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of some scenes."""
    import torch

    torch.set_num_threads(1)
    models: dict[str, Imagine] = {**BASELINES, **make_models(options)}
    windows = [window for name in names for window in draw_windows(name, options.windows, options.seed)]
    return list(measure(windows, models, options.seed))


def print_table(rows: Sequence[Mapping[str, Any]], kind: str, size: str) -> None:
    """Print the mean PSNR of each model by primitives ahead."""
    print(f"\n{kind}, {size}")
    for model in dict.fromkeys(row["model"] for row in rows):
        means = [
            np.mean(
                [r[size] for r in rows if (r["kind"], r["model"], r["control"], r["step"]) == (kind, model, "true", k)]
            )
            for k in STEPS
        ]
        print(f"  {model:<18}" + "".join(f"{mean:8.2f}" for mean in means))


def print_gap(rows: Sequence[Mapping[str, Any]], size: str) -> None:
    """Print how much of the PSNR is lost with the places of another window of the scene, over all steps."""
    for model in dict.fromkeys(row["model"] for row in rows):
        found = pair_controls(rows, model, size)
        gaps = [pair["true"] - pair["shuffled"] for pair in found.values()]
        low, high = clustered_interval(gaps, [scene for scene, _, _ in found], "length")
        print(f"  {model:<18}{np.mean(gaps):6.2f} [{low:.2f}, {high:.2f}]")


def draw_picture(scene: str, options: argparse.Namespace) -> None:
    """Draw what is seen, and what was and would be seen farther ahead, a row for the truth and for each model."""
    window = next(each for each in draw_windows(scene, 1, options.seed) if each.kind == "straight")
    rows = {"truth": [window.truth[step] for step in PICTURED]}
    for name, imagine in make_models(options).items():
        frames = imagine(window, window.trajectory, options.seed)
        rows[name] = [frames[step - 1] for step in PICTURED]
    canvas = Image.new("RGB", (WIDTH // 3 + (1 + len(PICTURED)) * WIDTH, 20 + len(rows) * WIDTH * 9 // 16), "white")
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(13)
    for column, step in enumerate((0, *PICTURED)):
        metres = "seen" if step == 0 else f"{step * STEP_M:.1f} m ahead"
        draw.text((WIDTH // 3 + column * WIDTH + 4, 4), metres, "black", font)
    for row, (name, frames) in enumerate(rows.items()):
        top = 20 + row * WIDTH * 9 // 16
        draw.text((2, top + WIDTH // 4), name, "black", font)
        for column, frame in enumerate([window.image, *frames]):
            small = Image.fromarray(frame).resize((WIDTH - 4, WIDTH * 9 // 16 - 4), Image.Resampling.BOX)
            canvas.paste(small, (WIDTH // 3 + column * WIDTH, top))
    canvas.save(options.picture)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights")
    parser.add_argument("--scenes", default="apartments:val:20")
    parser.add_argument("--windows", type=int, default=4)
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 2, 4, 25])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--picture", metavar="FILE")
    options = parser.parse_args()
    names = scenes.resolve(options.scenes)
    if options.picture:
        draw_picture(names[0], options)
        return
    parts = [names[at :: options.workers] for at in range(options.workers)]
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        rows = [row for found in pool.map(measure_scenes, parts, [options] * len(parts)) for row in found]
    windows = {(row["scene"], row["window"]) for row in rows}
    print(f"{len(windows)} windows of {len({scene for scene, _ in windows})} scenes; primitives ahead: {STEPS}")
    for size in ("psnr", "psnr_small"):
        for kind in ("mixed", "straight"):
            print_table(rows, kind, size)
        print(f"\ncontrol gap of displacements, {size}")
        print_gap(rows, size)


if __name__ == "__main__":
    main()
