# SPDX-License-Identifier: Apache-2.0
"""`wiw collect manipulation`."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from wiw.cli.bars import Bars
from wiw.cli.stop import announce_resume
from wiw.ray_cluster import HERE, Engine


def collect_manipulation(
    *,
    out: Annotated[Path, arg(metavar="DIR")] = Path("demonstrations"),
    tasks: Annotated[str, arg(metavar="NAMES")] = "all",
    episodes: Annotated[int, arg(metavar="N")] = 200,
    seed: Annotated[int, arg(metavar="N")] = 0,
    size: Annotated[int, arg(metavar="N")] = 480,
    frames: Annotated[int, arg(metavar="N")] = 150,
    format: Literal["jpeg", "png"] = "jpeg",
    depth: bool = False,
    wrist: bool = False,
    keep_failed: bool = False,
    backend: Literal["auto", "cpu", "gpu"] = "auto",
    workers: Annotated[int, arg(metavar="N")] = 1,
    place: Annotated[Engine, arg(name="")] = HERE,
) -> int:
    """Collect demonstrations of the manipulation tasks as training data, in Parquet files.

    $ wiw collect manipulation --out demos --workers 4
    $ wiw collect manipulation --tasks push_buttons,stack_cups --episodes 20 --size 128 --frames 60 --depth --out few

    Scripted experts that know all object poses perform each task; only successes are kept. Each row is a frame: the
    front view, the gripper's pose and its commanded pose. `docs/demonstrations.md` describes the columns, and
    `wiw.datasets.demonstrations.Demonstrations` reads them. The tables are never those of an evaluation. To resume an
    interrupted collection, repeat the command.

    Args:
        out: New folder, or one that the same command started.
        tasks: all, or a comma-separated list of push_buttons, slide_block, insert_peg and stack_cups.
        episodes: Demonstrations per task.
        seed: Seed, which determines the demonstrations.
        size: Height and width of the square front view in pixels.
        frames: Frames per demonstration, evenly spaced in time.
        format: Image format: jpeg (quality 95) or lossless png.
        depth: Also write the front view's depth.
        wrist: Also write the wrist camera's view, and with --depth its depth.
        keep_failed: Also keep failed demonstrations; otherwise their tables are replaced by others.
        backend: Renderer; images differ slightly between renderers.
        workers: Number of processes; the files do not depend on it.
        place: Where the processes run; with engine ray, --out must be visible to all machines of the cluster.
    """
    from wiw.training.collect import collect

    began = time.monotonic()
    what_of_it = {"episodes": episodes, "seed": seed, "keep_failed": keep_failed}
    how_seen = {"size": size, "frames": frames, "format": format, "depth": depth, "wrist": wrist, "backend": backend}
    with announce_resume(), Bars() as bars:
        made = collect(
            out, tasks, workers=workers, place=place, progress=partial(_show, bars), **what_of_it, **how_seen
        )
    megabytes = sum(path.stat().st_size for path in out.glob("*.parquet")) / 2**20
    failed = sum(made.failed.values())
    print(
        f"{len(made)} demonstrations of {frames} frames, {megabytes:.1f} MB, in {time.monotonic() - began:.0f} s; "
        f"experts failed at {failed} table{'' if failed == 1 else 's'}"
    )
    print(f"written   {out}")
    return 0


def _show(bars: Bars, task: str, done: int, episodes: int, failed: int) -> None:
    bars.show(task, done, episodes, f"{done}/{episodes} demonstrations" + (f", {failed} failed" if failed else ""))
