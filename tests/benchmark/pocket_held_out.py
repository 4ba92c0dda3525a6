# SPDX-License-Identifier: Apache-2.0
"""How true pocket's views are on held-out scenes, beside warpnet, warp and what has learnt nothing.

python tests/benchmark/pocket_held_out.py [--weights FILE] [--scenes SPEC] [--windows N] [--steps 1 2 4 25]

Prints PSNR in dB by primitives ahead, in full size and at 64 x 128, and the control gap with its interval clustered by
scene.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

import wiw
from wiw import scenes
from wiw.analysis.intervals import clustered_interval
from wiw.reproject import pose, warp
from wiw.training.pocket.held_out import BASELINES, STEPS, Imagine, Window, draw_windows, imagine_by, measure
from wiw.world_models.warpnet.model import turn_panorama


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


def measure_scenes(names: Sequence[str], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of some scenes, whose windows walk as another of theirs does where places are shuffled."""
    import torch

    torch.set_num_threads(1)
    weights = {"weights": options.weights} if options.weights else {}
    models: dict[str, Imagine] = {**BASELINES, "warpnet": imagine_by_warpnet(), "warp": warp_with_true_depth}
    for steps in options.steps:
        models[f"pocket, {steps} steps"] = imagine_by(wiw.world_model("pocket", steps=steps, **weights))
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
    """Print how much of the PSNR is lost with the places of another window, over all steps."""
    for model in dict.fromkeys(row["model"] for row in rows):
        found: dict[tuple[str, int, int], dict[str, float]] = defaultdict(dict)
        for row in rows:
            if row["model"] == model and row["kind"] == "mixed":
                found[row["scene"], row["window"], row["step"]][row["control"]] = row[size]
        gaps = [pair["true"] - pair["shuffled"] for pair in found.values()]
        low, high = clustered_interval(gaps, [scene for scene, _, _ in found], "length")
        print(f"  {model:<18}{np.mean(gaps):6.2f} [{low:.2f}, {high:.2f}]")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights")
    parser.add_argument("--scenes", default="apartments:val:20")
    parser.add_argument("--windows", type=int, default=4)
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 2, 4, 25])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    names = scenes.resolve(options.scenes)
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
