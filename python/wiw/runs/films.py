# SPDX-License-Identifier: Apache-2.0
"""Films of manipulation episodes for the report: recorded actions are executed again and filmed.

Physics are a function of the state, so a film shows what truly happened. The store keeps it, as a report has no
simulator.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wiw.runs.pictures import choose_pictured_episodes
from wiw.runs.store import RunStore
from wiw.tabletop.workbench import Workbench
from wiw.tasks.base import Task

SIDE = (256, 256)
"""Pixels."""
SPEED = 2.0
"""Speed of a film against what happened."""
RATE = 15.0
"""Frames per second, as shown."""
MOST = 200
"""Frames of a film; a longer episode goes by faster."""
LAST = 1500
"""Milliseconds that the end is shown before it begins again."""
QUALITY = 85
"""WebP quality; below it, where the arm was shines through."""


def film_episodes(store: RunStore, task: Task) -> None:
    """Film the first episode of each kind that has pictures, in every arm, where the task has tables to film."""
    if "attributes" in store.config:  # failures that are run again have no page
        return
    episodes, known = store.episodes(), dict[tuple[int, str], bytes]()
    for arm, index in _list_films(store):
        if store.film(arm, index) is None:
            executed = [pose for row in store.decisions(arm, index) for pose in row["executed"]]
            name = index, str(executed)
            if name not in known:  # arms that did the same look the same
                table = task.set_table(episodes[index])
                if table is None:
                    continue
                known[name] = film(table.bench, executed)
            store.write_film(arm, index, known[name])


def film(bench: Workbench, poses: Sequence[Sequence[float]]) -> bytes:
    """Return the animated WebP of what the front camera sees while the gripper goes to these poses."""
    frames = list(_frames(bench, poses))
    every = -(-len(frames) // MOST)
    return encode_film([*frames[:-1:every], frames[-1]])


def encode_film(frames: Sequence[NDArray[np.uint8]]) -> bytes:
    """Return the animated WebP of pictures uint8 [H, W, 3] at `RATE`, over and over."""
    first, *others = (Image.fromarray(frame) for frame in frames)
    lasting = [round(1000 / RATE)] * len(others) + [LAST]
    file = io.BytesIO()
    first.save(file, "WEBP", save_all=True, append_images=others, duration=lasting, loop=0, quality=QUALITY, method=3)
    return file.getvalue()


def _list_films(store: RunStore) -> Iterator[tuple[str, int]]:
    episodes = store.episodes()
    first = {episodes[index].kind: index for index in reversed(choose_pictured_episodes(store))}
    ended = {(row["arm"], row["episode"]) for row in store.outcomes() if row["status"] == "done"}
    yield from ((arm, index) for arm, index in sorted(ended) if index in first.values())


def _frames(bench: Workbench, poses: Sequence[Sequence[float]]) -> Iterator[NDArray[np.uint8]]:
    """Return pictures at even times, and of the end."""
    due, period = bench.seconds, SPEED / RATE
    for pose in poses:
        begin = bench.seconds
        _, way = bench.film(pose)
        step = (bench.seconds - begin) / max(1, len(way) - 1)
        for k in range(len(way)):
            if begin + k * step >= due:
                yield way[k].render_view("front", SIDE)["color"]
                due += period
    yield bench.render_view("front", SIDE)["color"]
