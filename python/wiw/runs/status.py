# SPDX-License-Identifier: Apache-2.0
"""Report the progress of runs. Read-only, so safe while other processes write."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any, Literal

from wiw.runs.processes import is_here, is_running
from wiw.runs.run import Run, find_folder, find_shards, find_stores
from wiw.runs.shards import Shard
from wiw.runs.store import RunStore

State = Literal["done", "running", "elsewhere", "stopped"]


@dataclass(frozen=True)
class StoreStatus:
    """The progress of one store."""

    store: Path
    shard: Shard | None
    of_run: int
    """Episodes of all arms of the whole run."""
    total: int
    """Episodes of all arms that belong to this store."""
    ended: int
    errors: int
    """Episodes that ended with an infrastructure error."""
    state: State
    """Whether all have finished, a process on this machine is running them, or one on another machine did at the last
    write."""
    host: str
    """Machine that last ran episodes; empty if none has."""
    written: datetime
    """Last write of the file, or of its copy if the store is written on another disk."""
    seconds_left: float | None
    """Estimate from the episodes finished since the current process started; None if there are none."""


@dataclass(frozen=True)
class RunStatus:
    """The progress of a run over all its stores; prints as a table."""

    run: Path
    stores: tuple[StoreStatus, ...]

    @property
    def ended(self) -> int:
        """Number of finished episodes over all arms."""
        return sum(store.ended for store in self.stores)

    @property
    def errors(self) -> int:
        """Episodes that ended with an infrastructure error."""
        return sum(store.errors for store in self.stores)

    @property
    def total(self) -> int:
        """Number of episodes over all arms of the whole run, including shards without a store yet; for several runs in
        one folder, of all of them.
        """
        if self._are_shards:
            return max(store.of_run for store in self.stores)
        return sum(store.total for store in self.stores)

    @property
    def missing(self) -> tuple[Shard, ...]:
        """Shards that have no store yet."""
        if not self._are_shards:
            return ()
        shards = {store.shard for store in self.stores}
        (count,) = {shard.count for shard in shards if shard is not None}
        return tuple(shard for number in range(1, count + 1) if (shard := Shard(number, count)) not in shards)

    @property
    def _are_shards(self) -> bool:
        """Whether the stores are different shards of one run, rather than runs that share a folder."""
        shards = {store.shard for store in self.stores}
        runs = {(store.of_run, store.shard and store.shard.count) for store in self.stores}
        return None not in shards and len(shards) == len(self.stores) and len(runs) == 1

    @property
    def seconds_left(self) -> float | None:
        """Estimated seconds until the last shard finishes; None if an unfinished shard has no estimate."""
        left = [store.seconds_left for store in self.stores if store.state != "done"]
        known = [seconds for seconds in left if seconds is not None]
        return None if self.missing or len(known) < len(left) else max(known, default=0.0)

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [("shard", "episodes", "errors", "state", "last write", "left", "store")]
        rows += [_format_row(store) for store in self.stores]
        left = _format_seconds(self.seconds_left)
        share = 100 * self.ended / max(1, self.total)
        rows.append(("all", f"{self.ended}/{self.total}", str(self.errors), f"{share:.0f} %", "", left, str(self.run)))
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        lines = ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows]
        if self.missing:
            lines.append(f"no store yet: shards {', '.join(map(str, self.missing))}")
        return "\n".join(line.rstrip() for line in lines)


def status(run: str | Path | Run) -> RunStatus:
    """Return the progress of a run.

    Args:
        run: a run, its folder, or one that contains the folders of its shards. These are shown even
            where the run was merged from them, for they may have gone on.

    Raises:
        StoreError: no store, or one that cannot be read.
    """
    folder = find_folder(run)
    return RunStatus(folder, tuple(map(_read_status, find_shards(folder) or find_stores([folder]))))


def _read_status(folder: Path) -> StoreStatus:
    with RunStore.read(folder) as store:
        arms = len(store.config["arms"])
        total, (ended, errors) = arms * len(store.own_episodes()), store.count_ended()
        session = store.info.get("session")
        written = _read_time(store.path)
        state = _find_state(session, ended >= total)
        left = _estimate_left(session, state, written, ended, total)
        return StoreStatus(
            folder,
            store.shard,
            arms * store.config["episodes"],
            total,
            ended,
            errors,
            state,
            "" if session is None else session["host"],
            written,
            left,
        )


def _read_time(path: Path) -> datetime:
    """Return when a store was last written; the latest transactions may be in the log next to it."""
    latest = path.stat().st_mtime
    with suppress(FileNotFoundError):  # no log, or the writer has just removed it
        latest = max(latest, path.with_name(f"{path.name}-wal").stat().st_mtime)
    return datetime.fromtimestamp(latest, timezone.utc)


def _find_state(session: Mapping[str, Any] | None, done: bool) -> State:
    if done:
        return "done"
    if session is None:
        return "stopped"
    if not is_here(session):
        return "elsewhere"
    return "running" if is_running(session) else "stopped"


def _estimate_left(
    session: Mapping[str, Any] | None, state: State, written: datetime, ended: int, total: int
) -> float | None:
    """Return the seconds until all have finished, at the pace since the session began."""
    if state == "done":
        return 0.0
    if session is None or state == "stopped" or ended <= session["ended"]:
        return None
    seconds = (written - datetime.fromisoformat(session["begun"])).total_seconds()
    return max(0.0, seconds) * (total - ended) / (ended - session["ended"])


def _format_row(store: StoreStatus) -> tuple[str, ...]:
    state = {"running": "running", "elsewhere": f"on {store.host}"}.get(store.state, store.state)
    ago = (datetime.now(timezone.utc) - store.written).total_seconds()
    return (
        "-" if store.shard is None else str(store.shard),
        f"{store.ended}/{store.total}",
        str(store.errors),
        state,
        f"{_format_seconds(max(0.0, ago))} ago",
        _format_seconds(store.seconds_left),
        str(store.store),
    )


def _format_seconds(seconds: float | None) -> str:
    return "?" if seconds is None else str(timedelta(seconds=round(seconds)))
