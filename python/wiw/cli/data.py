# SPDX-License-Identifier: Apache-2.0
"""`wiw data`."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from wiw.cli.bars import Bars
    from wiw.datasets.navigation_statistics import NavigationStatistics

Folder = Positional[Annotated[Path, arg(metavar="DIR")]]


def verify_data(
    folders: Positional[Annotated[tuple[Path, ...], arg(metavar="DIR...", help_behavior_hint="(required)")]],
    /,
    *,
    quick: bool = False,
) -> int:
    """Check every file and frame of a navigation dataset; given several, also check that they share no scene.

    $ wiw data verify data
    $ wiw data verify data --quick
    $ wiw data verify train held-out

    Files are checked against their SHA-256, frames against the list of segments, and poses against the actions that led
    to them. Images are decoded and compared with all others: equal ones in two scenes or datasets are a leak. Exit code
    0 if everything is sound, 1 otherwise.

    Args:
        folders: Finished datasets of `wiw collect navigation`.
        quick: Skip the images, which take most of the time.
    """
    from wiw.cli.bars import Bars
    from wiw.datasets.navigation_check import verify_datasets
    from wiw.errors import ArgumentError

    if not folders:
        raise ArgumentError("wiw data verify: expected a dataset's folder, such as `wiw data verify data`, got none")
    with Bars() as bars:
        found = verify_datasets(
            folders, not quick, lambda name, done, total: bars.show("files", done, total, f"{done}/{total}")
        )
    print(found)
    return 0 if found.sound else 1


def stats_data(folder: Folder, /, *, clip: Annotated[int, arg(metavar="N")] = 14) -> int:
    """Print frames, actions, segment lengths, coverage and sizes of a navigation dataset.

    $ wiw data stats data
    $ wiw data stats data --clip 25

    Args:
        folder: Finished dataset of `wiw collect navigation`.
        clip: Length in frames of the windows to count.
    """
    from wiw.datasets.navigation import NavigationData
    from wiw.datasets.navigation_statistics import compute_statistics
    from wiw.errors import ArgumentError

    if clip < 1:
        raise ArgumentError(f"data stats: expected --clip of at least 1 frame, got {clip}")
    data = NavigationData(folder)
    _print_totals(compute_statistics(data), clip)
    camera = data.meta["camera"]
    height, width = camera["size"]
    print(
        f"\n{camera['projection']} {height} x {width}, {camera['height_m']:g} m above the floor; {data.meta['color']}"
    )
    return 0


LISTED_SCENES = 10
"""Scenes with the least coverage that are listed."""
LENGTHS = (2, 10, 20, 30, 40, 60, 80, 120)
"""Frames: where the ranges of the histogram of lengths begin."""
BAR = 40
"""Characters of the longest bar of a histogram."""


def _print_totals(figures: NavigationStatistics, clip: int) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    totals = figures.totals
    print(
        f"{totals['frames']:,} frames ({totals['pictures']:,} pictures, the others after turns) in "
        f"{totals['segments']:,} segments of {totals['scenes']:,} scenes, {totals['bytes'] / 1e9:.2f} GB\n"
        f"{figures.count_windows(clip):,} windows of {clip} frames, one frame apart\n"
    )
    names = ("forward", "turn_left", "turn_right")
    _print_bars("actions", [(name, totals.get(name, 0)) for name in names])
    _print_bars("frames of a segment", _count_lengths(figures))
    _print_bars("segments that", [(f"ended {name}", count) for name, count in figures.endings.items()])
    print(f"coverage  {figures.coverage:.1%} of the floor within 1 m; {totals['dropped']} waypoints dropped")
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for column in ("least covered scenes", "m2", "frames", "segments", "covered", "dropped"):
        table.add_column(column, justify="left" if column.startswith("least") else "right")
    for each in figures.scenes[:LISTED_SCENES]:
        numbers = f"{each.area:.0f}", str(each.frames), str(each.segments), f"{each.coverage:.0%}", str(each.dropped)
        table.add_row(Text(each.scene), *numbers)
    Console().print(table)


def _count_lengths(figures: NavigationStatistics) -> list[tuple[str, int]]:
    """Return the number of segments in each range of lengths."""
    counts, _ = np.histogram(figures.lengths, [*LENGTHS, np.inf])
    labels = [f"{low} to {high - 1}" for low, high in pairwise(LENGTHS)] + [f"{LENGTHS[-1]} and more"]
    return list(zip(labels, counts.tolist(), strict=True))


def _print_bars(title: str, counts: list[tuple[str, int]]) -> None:
    total, largest = sum(count for _, count in counts), max(count for _, count in counts)
    print(title)
    for name, count in counts:
        print(
            f"  {name:<14} {'#' * round(BAR * count / max(1, largest)):<{BAR}} {count:>9,} {count / max(1, total):6.1%}"
        )
    print()


def show_data(
    folder: Folder,
    /,
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("data.png"),
    scenes: Annotated[int, arg(metavar="N")] = 6,
    frames: Annotated[int, arg(metavar="N")] = 4,
) -> int:
    """Draw maps of the floor that a navigation dataset covers, and frames with their actions and depth.

    $ wiw data show data --out data.png
    $ wiw data show data --scenes 12 --frames 2

    On a map, floor within 1 m of a frame is green and other floor red; the path goes from blue to orange; red dots are
    waypoints, the circle is the start.

    Args:
        folder: Finished dataset of `wiw collect navigation`.
        out: Where to write the sheet, a PNG.
        scenes: Number of maps, spread evenly over the dataset.
        frames: Frames next to each map.
    """
    from wiw.datasets.navigation import NavigationData
    from wiw.errors import ArgumentError
    from wiw.files import atomic_file
    from wiw.viz.navigation_sheet import draw_sheet

    data = NavigationData(folder)
    if scenes < 1 or frames < 1 or not len(data):
        raise ArgumentError(
            f"wiw data show: expected 1 scene and 1 frame or more, of a dataset that has some, got {scenes}, {frames} "
            f"and {len(data)} segments"
        )
    sheet = draw_sheet(data, scenes, frames)
    with atomic_file(out) as draft:
        sheet.save(draft, format="PNG")
    print(f"sheet  {out}")
    return 0


def export_data(
    folder: Folder,
    /,
    *,
    out: Annotated[Path, arg(metavar="DIR")],
    format: Literal["lerobot"] = "lerobot",
    fps: Annotated[int | None, arg(metavar="N")] = None,
    workers: Annotated[int, arg(metavar="N")] = 1,
) -> int:
    """Convert collected data to a LeRobot dataset, format v3.0.

    $ wiw data export data --out data-lerobot --workers 4
    $ wiw data export demos --out demos-lerobot --fps 30

    A segment of `wiw collect navigation` or a demonstration of `wiw collect manipulation` becomes an episode. Colour
    and depth are kept exactly; LeRobot's own tools can turn them into videos. `docs/lerobot.md` lists the features. The
    new folder appears once all of it is written.

    Args:
        folder: Finished collection.
        out: New folder.
        format: Format of the new dataset; there is only one.
        fps: Frames per second for the timestamps. Default: 5 for navigation, and the mean rate of demonstrations.
        workers: Threads that encode navigation images.
    """
    from wiw.cli.bars import Bars
    from wiw.datasets.lerobot import export_lerobot

    with Bars() as bars:
        export_lerobot(folder, out, fps=fps, workers=workers, progress=partial(_show_episodes, bars))
    print(f"written   {out}, {format} v3.0")
    return 0


def import_data(
    folder: Folder,
    /,
    *,
    out: Annotated[Path, arg(metavar="DIR")],
    format: Literal["lerobot"] = "lerobot",
) -> int:
    """Convert an exported LeRobot dataset back to the collection it came from.

    $ wiw data import data-lerobot --out data
    $ wiw data verify data

    Only datasets written by `wiw data export` can be read: others lack poses, cameras, and scenes or tables.

    Args:
        folder: LeRobot dataset, format v3.0.
        out: New folder.
        format: Format of the dataset; there is only one.
    """
    from wiw.cli.bars import Bars
    from wiw.datasets.lerobot import import_lerobot

    with Bars() as bars:
        data = import_lerobot(folder, out, progress=partial(_show_episodes, bars))
    print(f"written   {out}, {len(data)} episodes of {format}")
    return 0


def _show_episodes(bars: Bars, done: int, total: int) -> None:
    bars.show("episodes", done, total, f"{done}/{total}")
