# SPDX-License-Identifier: Apache-2.0
"""Export collected data as LeRobot datasets, and import them again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sized
from pathlib import Path

from wiw.datasets.demonstrations import Demonstrations
from wiw.datasets.lerobot import manipulation, navigation
from wiw.datasets.lerobot.card import build_card
from wiw.datasets.lerobot.layout import SOURCE, Episode
from wiw.datasets.lerobot.reading import LeRobotFolder
from wiw.datasets.lerobot.writing import write_dataset
from wiw.datasets.navigation import META, NavigationData, read_navigation_manifest
from wiw.datasets.parquet_files import require_pyarrow
from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_folder

Progress = Callable[[int, int], None]
"""Called with the number of episodes that are done, and of how many."""


def export_lerobot(
    folder: str | Path, out: str | Path, *, fps: int | None = None, workers: int = 1, progress: Progress | None = None
) -> None:
    """Write what `wiw collect navigation` or `wiw collect manipulation` has collected as a LeRobot dataset, v3.0.

    Pictures stay exactly what they are: those of frames after turns of panoramas are encoded without loss, as is depth.

    Args:
        folder: a finished collection.
        out: a new or empty folder, which has the dataset whole or not at all.
        fps: frames per second, which timestamps are counted in; 5 for navigation and the mean rate of demonstrations if
            None.
        workers: threads that encode pictures of navigation.
        progress: called after each episode.

    Raises:
        DependencyError: pyarrow is not installed.
        ArgumentError: fps or workers below 1.
        FileError: there is no finished collection, a file of it is damaged, or `out` holds something or cannot be
            written.
    """
    require_pyarrow("LeRobot datasets")
    if workers < 1:
        raise ArgumentError(f"export: expected 1 worker or more, got {workers}")
    data = open_collection(Path(folder))
    if isinstance(data, NavigationData):
        features = navigation.describe_features(data.meta)
        episodes, source = navigation.build_episodes(data, workers), navigation.describe_source(data)
        rate, robot = fps if fps is not None else navigation.FPS, "agent"
    else:
        features = manipulation.describe_features(data.config)
        episodes, source = manipulation.build_episodes(data), manipulation.describe_source(data)
        rate, robot = fps if fps is not None else manipulation.estimate_rate(data), "panda"
    card = build_card(source["what"], len(data), features, rate)
    counted = _count(episodes, data, progress)
    write_dataset(Path(out), counted, features, fps=rate, robot=robot, source=source, card=card)


def _count(episodes: Iterable[Episode], data: Sized, progress: Progress | None) -> Iterator[Episode]:
    """Pass episodes on and report how many are done."""
    for done, episode in enumerate(episodes, 1):
        yield episode
        if progress is not None:
            progress(done, len(data))


def open_collection(folder: Path) -> NavigationData | Demonstrations:
    """Return what was collected in a folder.

    Raises:
        FileError: nothing was, or it is not finished.
    """
    return NavigationData(folder) if _is_navigation(folder) else Demonstrations(folder)


def _is_navigation(folder: Path) -> bool:
    if (folder / META).exists():
        return True
    try:
        read_navigation_manifest(folder)  # of a collection that is under way, which `NavigationData` says then
    except FileError:
        return False
    return True


def import_lerobot(
    folder: str | Path, out: str | Path, *, progress: Progress | None = None
) -> NavigationData | Demonstrations:
    """Write the collection that a LeRobot dataset was exported from.

    Args:
        folder: what `export_lerobot` has written.
        out: a new or empty folder, which has the collection whole or not at all.
        progress: called after each episode.

    Returns:
        The collection.

    Raises:
        DependencyError: pyarrow is not installed.
        FileError: the dataset is of another version or from elsewhere; a file or a column is missing or damaged; its
            timestamps are of another rate; its pictures are videos; or `out` holds something or cannot be written.
    """
    require_pyarrow("LeRobot datasets")
    found = LeRobotFolder(Path(folder))
    what = found.source.get("what")
    if what not in _WRITERS:
        raise FileError(f"{found.folder / SOURCE}: expected what to be {' or '.join(_WRITERS)}, got {what}")
    with atomic_folder(Path(out)) as draft:
        _WRITERS[what](found, draft, progress or (lambda done, total: None))
    return open_collection(Path(out))


_WRITERS = {"navigation": navigation.write_navigation, "manipulation": manipulation.write_demonstrations}
