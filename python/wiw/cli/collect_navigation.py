# SPDX-License-Identifier: Apache-2.0
"""`wiw collect navigation`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from wiw.cli.bars import Bars
from wiw.cli.options import Options
from wiw.cli.stop import announce_resume
from wiw.ray_cluster import HERE, Engine


def collect_navigation(
    *,
    scenes: Annotated[tuple[str, ...], arg(metavar="SPEC...")] = ("apartments:train:80",),
    out: Annotated[Path, arg(metavar="DIR")] = Path("data"),
    preset: Literal["default", "paper"] = "default",
    passes: Annotated[int, arg(metavar="N")] = 1,
    seed: Annotated[int, arg(metavar="N")] = 0,
    size: Annotated[tuple[int, int] | None, arg(metavar="H W")] = None,
    perspective: bool = False,
    height: Annotated[float, arg(metavar="M")] = 1.0,
    depth: bool = True,
    lossless: bool = False,
    rule: Options = (),
    backend: Literal["auto", "cpu", "gpu"] = "auto",
    workers: Annotated[int, arg(metavar="N")] = 1,
    place: Annotated[Engine, arg(name="")] = HERE,
    skip_errors: bool = False,
    dry_run: bool = False,
) -> int:
    """Collect panoramas with depth, poses and actions along paths through scenes, for training world models.

    $ wiw collect navigation --scenes apartments:train:80 --out data --workers 4
    $ wiw collect navigation --scenes apartments:train:800 --preset paper --out data --dry-run
    $ wiw collect navigation --scenes hm3d/train/*/*.basis.glb --out hm3d --workers 16 --skip-errors
    $ wiw data stats data
    $ wiw data show data --out data.png

    An agent goes from one waypoint of a scene to the next, following Algorithm 1 of the World-in-World paper, with
    steps of 0.2 m and turns of 22.5 degrees. Every frame is stored with its pose and the action that led to it, in
    Parquet files that Hugging Face datasets can open: a row is a frame, a row group is the segment between two
    waypoints. `docs/collecting-navigation.md` describes the columns, and `wiw.datasets.navigation.NavigationData` reads
    them. Scenes of val and test splits are refused. To resume an interrupted collection, repeat the command: a killed
    one loses one segment at most.

    Args:
        scenes: Scenes of train splits, separated by spaces: apartments:train[[:FIRST]:END], meshes (GLB, glTF, OBJ,
            PLY, DAE), Gazebo worlds.
        out: New folder, or one that the same command started.
        preset: paper counts waypoints within 3 m as visited; default counts those within 0.5 m, so that fewer rooms are
            missed.
        passes: Passes over each scene, each with its own start and waypoints; more passes give more frames.
        seed: Seed; together with scenes and options, it determines the dataset.
        size: Height and width in pixels. Default: 576 1024 for panoramas, 480 480 for perspective views.
        perspective: Record perspective front views (HFOV 90 degrees) instead of panoramas.
        height: Height of the camera above the floor in metres.
        depth: Whether to record depth.
        lossless: Store colour as lossless WebP; otherwise as JPEG (quality 95).
        rule: A rule for the path, such as spacing=2 or next_waypoint=2m; may be repeated. See
            `wiw.training.navigation_rules.NavigationRules`.
        backend: Renderer; images differ slightly between renderers.
        workers: Number of processes; the files do not depend on it.
        place: Where the processes run; with engine ray, --out must be visible to all machines of the cluster.
        skip_errors: Skip scenes that cannot be opened; otherwise they are reported as an error at the end.
        dry_run: Only plan, and print how many frames, hours and gigabytes it would take.
    """
    from wiw.runs.part_options import parse_options
    from wiw.training.collect_navigation import collect_navigation
    from wiw.training.navigation_rules import NavigationRules

    options: dict[str, Any] = {"preset": preset, "passes": passes, "seed": seed, "size": size, "height": height}
    options |= {"perspective": perspective, "depth": depth, "lossless": lossless, "backend": backend}
    options["rules"] = parse_options(rule, NavigationRules, "--rule")
    if dry_run:
        return _estimate(scenes, {**options, "skip_errors": skip_errors})
    began = time.monotonic()
    with announce_resume(), Bars() as bars:
        data = collect_navigation(
            out, scenes, workers=workers, place=place, skip_errors=skip_errors, progress=partial(_show, bars), **options
        )
    totals = data.meta["totals"]
    print(
        f"{totals['frames']:,} frames in {totals['segments']:,} segments of {totals['scenes']} scenes, "
        f"{totals['bytes'] / 1e9:.2f} GB, in {time.monotonic() - began:.0f} s; "
        f"{totals['dropped']} waypoint{'' if totals['dropped'] == 1 else 's'} could not be reached"
    )
    _print_skipped(data.meta["left_out"])
    print(f"written   {out}")
    return 0


def _show(bars: Bars, scene: str, done: int, total: int, frames: int) -> None:
    bars.show("scenes", done, total, f"{done}/{total}, {frames:,} frames")


def _estimate(scenes: tuple[str, ...], options: Mapping[str, Any]) -> int:
    from wiw.training.navigation_estimate import estimate_collection

    with Bars() as bars:
        found = estimate_collection(
            scenes, progress=lambda scene, done, total: bars.show("planned", done, total, scene), **options
        )
    print(found)
    _print_skipped(found.left_out)
    return 0


def _print_skipped(errors: Mapping[str, str]) -> None:
    for scene, error in errors.items():
        print(f"skipped   {scene}: {error}")
