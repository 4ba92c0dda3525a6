# SPDX-License-Identifier: Apache-2.0
"""Run shards while processes are killed and hung and the disk is filled at random, merge them, and compare with a run
that nothing disturbed: chaos.py FOLDER [--episodes 500] [--shards 2] [--period 4] [--seed 0].

The shards' stores are on a file system of their own, which this script makes and fills: it needs root.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "python")]

from locations import ROOM_FOLDERS  # noqa: E402

sys.path.extend(ROOM_FOLDERS)

from test_crash import whole  # noqa: E402
from test_shards import read_rows  # noqa: E402

import wiw  # noqa: E402
from boxes import COLORS, TWO_ROOMS, write_boxes  # noqa: E402

WIW = [sys.executable, "-m", "wiw.cli"]
STOPPED = (0, 1, 2, 75, -signal.SIGKILL)
"""Exit codes that a disturbed shard may have: ended, ended with errors, disk full, stopped, killed."""
LONGEST_HANG = 3.0
"""Seconds for which a process is stopped."""
MOST_STARTS = 500


class Shard:
    """A part of the run: its process, which is started again until all episodes have ended."""

    def __init__(self, text: str, out: Path, command: list[str]) -> None:
        self.out, self.starts, self.codes = out, 0, collections.Counter[int]()
        self._command = [*command, "--shard", text, "--out", str(out), "--resume"]
        self._log = out.parent.parent / f"shard-{text.replace('/', '-of-')}.log"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self.starts += 1
        assert self.starts < MOST_STARTS, self._log.read_text()[-2000:]
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(self._command, stdout=log, stderr=log, start_new_session=True)

    def keep_going(self) -> bool:
        """Start the process again where it has ended too early; return whether the shard has ended."""
        code = None if self.process is None else self.process.poll()
        if self.process is not None and code is None:
            return False
        if code is not None:
            self.codes[code] += 1
            assert code in STOPPED, (code, self._log.read_text()[-2000:])
        if code in (0, 1):
            return True
        self.start()
        return False

    def processes(self) -> list[int]:
        """The run's process and that of its model."""
        assert self.process is not None
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        with contextlib.suppress(OSError):
            return [self.process.pid, *map(int, children.read_text().split())]
        return []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--shards", type=int, default=2)
    parser.add_argument("--period", type=float, default=4.0, help="mean seconds between two disturbances")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    for name, value in run_chaos(given.folder, given.episodes, given.shards, given.period, given.seed).items():
        print(f"{name:32} {value}")


def run_chaos(folder: Path, episodes: int, shards: int, period: float, seed: int) -> dict[str, Any]:
    """Run quietly, run disturbed, merge, compare; return what was done."""
    folder.mkdir(parents=True)
    write_boxes(folder / "two_rooms.obj", TWO_ROOMS, COLORS)
    scene, model = str(folder / "two_rooms.obj"), f"mock={HERE / 'mock_model.py'}:Mock"
    command = [*WIW, "run", "imagenav", "--scenes", scene, "--policy", "heuristic", "--revision", "matcher"]
    command += [
        "--arms",
        f"none,{model}",
        "--episodes",
        str(episodes),
        "--task-option",
        "decisions=2",
        "--salt",
        "chaos",
    ]
    command += ["--no-report", "--no-progress"]
    begin = time.monotonic()
    with (folder / "quiet.log").open("wb") as log:
        subprocess.run([*command, "--out", str(folder / "quiet")], check=True, stdout=log, stderr=log)
    quiet_seconds, begin = time.monotonic() - begin, time.monotonic()
    with small_disk(folder / "disk") as disk:
        parts = [Shard(f"{i}/{shards}", disk / str(i), command) for i in range(1, shards + 1)]
        done = disturb(parts, disk, period, random.Random(seed))
        for part in parts:  # episodes that broke on a full disk or a lost process, as a user runs them again
            again = [*WIW, "resume", str(part.out), "--retry-errors", "--no-report"]
            subprocess.run(again, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            whole(part.out)
        merged = wiw.merge([part.out for part in parts], folder / "merged")
    (rows, config), (expected, begun) = read_rows(folder / "merged"), read_rows(folder / "quiet")
    lost = {row["name"]: row["value"] for row in rows.pop("lost")}
    expected.pop("lost")
    assert merged.complete and (rows, config) == (expected, begun)
    return {
        "episodes, arms": f"{episodes}, 2",
        "disturbances": dict(done),
        "starts": [part.starts for part in parts],
        "exit codes": [dict(part.codes) for part in parts],
        "seconds quiet, disturbed": f"{quiet_seconds:.0f}, {time.monotonic() - begin:.0f}",
        "rows equal to those of the quiet run": sum(map(len, rows.values())),
        "seconds of lost decisions": round(lost.get("seconds", 0.0), 1),
    }


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """A file system of 200 MB."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200m", "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def disturb(parts: list[Shard], disk: Path, period: float, draw: random.Random) -> collections.Counter[str]:
    """Disturb shards at random until all have ended; return how often each disturbance was."""
    done: collections.Counter[str] = collections.Counter()
    left = list(parts)
    while left := [part for part in left if not part.keep_going()]:
        time.sleep(draw.expovariate(1 / period))
        victims = draw.choice(left).processes()
        if not victims:
            continue
        way = draw.choice(("kill the run", "kill its model", "hang", "fill"))
        if way == "fill":
            fill(disk, draw.uniform(0, LONGEST_HANG))
        elif way == "hang":
            hang(draw.choice(victims), draw.uniform(0, LONGEST_HANG))
        else:
            signal_process(victims[0 if way == "kill the run" else -1], signal.SIGKILL)
        done[way] += 1
    return done


def hang(process: int, seconds: float) -> None:
    signal_process(process, signal.SIGSTOP)
    time.sleep(seconds)
    signal_process(process, signal.SIGCONT)


def fill(disk: Path, seconds: float) -> None:
    """Leave no room on a file system for some time."""
    ballast = disk / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
        while True:
            file.write(b"\0" * 4096)
    time.sleep(seconds)
    ballast.unlink()


def signal_process(process: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, number)


if __name__ == "__main__":
    main()
