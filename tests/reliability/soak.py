# SPDX-License-Identifier: Apache-2.0
"""Run many episodes and scene switches in one process, and measure what grows: soak.py [--episodes 10000]
[--switches 200] [--minutes 60].

Every episode goes through the real loop: ImageNav, a language model that answers at random (`mock`) proposing and
scoring, and a world model in a process of its own. Memory is read after each batch, once a run is closed.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "python")]

import wiw  # noqa: E402
from boxes import COLORS, TWO_ROOMS, write_boxes  # noqa: E402
from wiw.runs.recipes import AgentRecipe, TaskRecipe  # noqa: E402

BATCH = 50
"""Episodes between two measurements."""


@dataclass(frozen=True)
class Held:
    """Resources that the process holds."""

    seconds: float
    episodes: int
    megabytes: float
    """Resident memory, once the allocator has given back what is free: how much it keeps varies by tens of MB."""
    in_use: float
    """What malloc has handed out and not got back, in MB: a leak shows here, free pages that malloc keeps do not."""
    descriptors: int
    threads: int
    shared: int
    """Files in /dev/shm."""
    temporary: int
    """Files and folders where temporary files belong."""


class MallInfo(ctypes.Structure):
    """Counts of glibc's `mallinfo2`, in the order of its manual page."""

    NAMES = ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")
    _fields_ = tuple((name, ctypes.c_size_t) for name in NAMES)


def count_bytes_in_use() -> int:
    """Return the bytes that malloc has handed out, in its arenas and by mmap."""
    libc = ctypes.CDLL(None)
    libc.mallinfo2.restype = MallInfo
    info = libc.mallinfo2()
    return int(info.uordblks + info.hblkhd)


def measure(begin: float, episodes: int) -> Held:
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Held(
        time.monotonic() - begin,
        episodes,
        pages * 4096 / 1e6,
        count_bytes_in_use() / 1e6,
        len(list(Path("/proc/self/fd").iterdir())),
        threading.active_count(),
        len(list(Path("/dev/shm").iterdir())),
        len(list(Path(tempfile.gettempdir()).iterdir())),
    )


def write_scenes(folder: Path, count: int) -> list[str]:
    """Write scenes of two rooms, each with another table."""
    paths = []
    for number in range(count):
        boxes = {**TWO_ROOMS, "table": ("red", (-3, 0, -1.5), (-2.2, 0.3 + 0.002 * number, -0.9))}
        paths.append(folder / f"rooms{number:03d}.obj")
        write_boxes(paths[-1], boxes, COLORS)
    return list(map(str, paths))


def soak(scenes: list[str], folder: Path, episodes: int, minutes: float) -> list[Held]:
    """Run episodes, a batch in each scene in turn, and measure after each batch."""
    agent = AgentRecipe("vlm", f"{HERE / 'mock_model.py'}:Mock", policy_options={"vlm": {"vlm": "mock"}}, candidates=2)
    begin, held = time.monotonic(), []
    for number in range(0, episodes, BATCH):
        task = TaskRecipe("imagenav", {"scenes": scenes[number // BATCH % len(scenes)], "decisions": 1, "seed": number})
        out = folder / "run"
        log = wiw.evaluate(task, agent, BATCH, out=out, progress=False, keep_images=0, cache="off")
        assert all(row["status"] == "done" for row in log.episodes)
        log.close()
        for file in out.iterdir():
            file.unlink()
        out.rmdir()
        held.append(measure(begin, number + BATCH))
        print(held[-1], flush=True)
        if held[-1].seconds > 60 * minutes:
            break
    return held


def switch_scenes(scenes: list[str], switches: int) -> list[Held]:
    """Open one scene after another, draw a view of each, and measure."""
    begin, held = time.monotonic(), []
    for number in range(switches):
        env = wiw.make("ImageNav-v0", scenes=scenes[number % len(scenes)], seed=number)
        env.reset(options={"episode": 0})
        env.close()
        held.append(measure(begin, number + 1))
    return held


def fit_slope(held: list[Held], over: str, memory: str = "megabytes") -> float:
    """Return the growth of memory in MB per second or episode, without the first quarter, in which caches fill."""
    rest = held[len(held) // 4 :]
    return float(np.polyfit([getattr(each, over) for each in rest], [getattr(each, memory) for each in rest], 1)[0])


def list_left(held: list[Held]) -> dict[str, int]:
    """Return what the second half of the measurements holds more of at its end than at its beginning."""
    first, last = held[len(held) // 2], held[-1]
    return {name: getattr(last, name) - getattr(first, name) for name in ("descriptors", "threads", "shared")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--switches", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=1e9)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scenes = write_scenes(folder, 8)
        tempfile.tempdir = str(folder)
        held = soak(scenes, folder, given.episodes, given.minutes)
        report("episodes", held)
        report("switches", switch_scenes(scenes, given.switches))


def report(name: str, held: list[Held]) -> dict[str, Any]:
    """Print and return what grew."""
    found = {
        name: held[-1].episodes,
        "minutes": round(held[-1].seconds / 60, 1),
        "MB at first, at the end": (round(held[0].megabytes), round(held[-1].megabytes)),
        "MB per hour": round(3600 * fit_slope(held, "seconds"), 2),
        "MB in use per hour": round(3600 * fit_slope(held, "seconds", "in_use"), 2),
        f"MB per 1000 {name}": round(1000 * fit_slope(held, "episodes"), 3),
        "left": list_left(held),
        "temporary files": held[-1].temporary - held[0].temporary,
    }
    print(found)
    return found


if __name__ == "__main__":
    main()
