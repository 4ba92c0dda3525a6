# SPDX-License-Identifier: Apache-2.0
"""Read a run on disk: arms, episodes and decisions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from html import escape
from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError, StoreError
from wiw.metrics.metric import name_column
from wiw.registry import TASKS, task_class
from wiw.runs.store import RunStore
from wiw.runs.store_file import FILE_NAME, store_path
from wiw.types import TableSpec

SHOWN = 20
"""Records that a notebook shows, and beyond which they are not printed in full."""
LONGEST, LONGEST_CELL = 5000, 60
"""Characters of records that are printed in full, and of a cell in a notebook."""


class Records(list[dict[str, Any]]):
    """A list of plain dicts that turns into a pandas DataFrame on request; prints in full only if it is short."""

    def to_pandas(self) -> Any:
        """Return the records as a DataFrame, nested metrics as columns (`name_column` names them).

        Raises:
            ArgumentError: pandas is not installed.
        """
        try:
            import pandas
        except ModuleNotFoundError:
            raise ArgumentError("to_pandas needs pandas, which is not installed: pip install pandas") from None
        return pandas.DataFrame([_flat(record) for record in self])

    def __repr__(self) -> str:
        text = super().__repr__() if len(self) <= SHOWN else ""
        return text if 0 < len(text) <= LONGEST else f"Records({self._count()}; .to_pandas() for a DataFrame)"

    def _repr_html_(self) -> str:
        rows = [_flat(record) for record in self[:SHOWN]]
        names = list(dict.fromkeys(name for row in rows for name in row))
        lines = [_html_row("th", names), *(_html_row("td", [row.get(name, "") for name in names]) for row in rows)]
        count = self._count() if len(self) <= SHOWN else f"The first {SHOWN} of {self._count()}"
        return f"<table>{''.join(lines)}</table><p>{count}; .to_pandas() for a DataFrame</p>"

    def _count(self) -> str:
        return "1 record" if len(self) == 1 else f"{len(self)} records"


def _flat(record: dict[str, Any]) -> dict[str, Any]:
    metrics = {name_column(name, record): value for name, value in record.get("metrics", {}).items()}
    return {**{name: value for name, value in record.items() if name != "metrics"}, **metrics}


def _html_row(tag: str, values: Sequence[Any]) -> str:
    texts = (str(value) for value in values)
    short = (text if len(text) <= LONGEST_CELL else f"{text[: LONGEST_CELL - 1]}…" for text in texts)
    return f"<tr>{''.join(f'<{tag}>{escape(text)}</{tag}>' for text in short)}</tr>"


class Run:
    """A run on disk, finished or not."""

    def __init__(self, store: RunStore) -> None:
        self.store = store

    @property
    def path(self) -> Path:
        """The run's folder."""
        return self.store.path.parent

    @property
    def arms(self) -> list[str]:
        """Names of the arms, in the order of the table."""
        return [arm["name"] for arm in self.store.config["arms"]]

    @property
    def episodes(self) -> Records:
        """Finished episodes of all arms: arm, episode, scene, status, metrics, seconds, error."""
        return Records(self.store.outcomes())

    @property
    def decisions(self) -> Records:
        """Decisions of all finished episodes: proposals, scores, choice, executed actions, truth before and after."""
        return Records(self.store.decisions())

    @property
    def tables(self) -> TableSpec:
        """Return what the task's tables and plots show; for older runs, what the task says now."""
        kept, task = self.store.info.get("tables"), self.store.config["task"].get("task")
        if kept is not None:
            known = {each.name: kept[each.name] for each in fields(TableSpec) if each.name in kept}
            values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in known.items()}
            return TableSpec(**values)
        return TableSpec() if task not in TASKS.names() else task_class(task).tables

    @property
    def complete(self) -> bool:
        """Whether every arm has finished every episode."""
        return not any(self.store.pending(arm) for arm in self.arms)

    def close(self) -> None:
        """Close the run's file."""
        self.store.close()

    def __repr__(self) -> str:
        ended = {arm: sum(record["arm"] == arm for record in self.episodes) for arm in self.arms}
        return f"{type(self).__name__}({str(self.path)!r}, ended: {ended} of {len(self.store.episodes())})"


def find_folder(run: str | Path | Run) -> Path:
    """Return the folder of a run that is given as such or as an object."""
    return run.path if isinstance(run, Run) else Path(run)


def find_stores(runs: Sequence[str | Path]) -> list[Path]:
    """Return the folders with a store, each once: the given ones, or for folders without a store their subfolders.

    A run that was merged from shards in its subfolders stands for these, unless it was resumed or judged since. Stores
    inside that are being created, or whose creation was interrupted, are left out.

    Raises:
        ArgumentError: no folder is given.
        StoreError: neither a folder nor those inside have a store.
    """
    if not runs:
        raise ArgumentError("expected at least one run: a folder with a store, or with folders of shards; got none")
    found = [store for run in runs for store in _stores_of(Path(run).expanduser())]
    return list({store.resolve(): store for store in reversed(found)}.values())[::-1]


def find_shards(run: str | Path) -> list[Path]:
    """Return the shards in the subfolders of a run that was merged from such; none of other runs, or one resumed since.

    None either where one of the shards that it was merged from is not there: the merged run then has more.

    Raises:
        StoreError: one of the stores cannot be read.
    """
    path = Path(run).expanduser()
    inside = _list_inside(path) if store_path(path).is_file() else []
    if not inside:
        return []
    with RunStore.read(path) as store:
        config, info = store.config, store.info
    if "merged" not in info or "session" in info:
        return []
    found = {folder: shard for folder in inside if (shard := _read_shard(folder, config)) is not None}
    merged = {(each["shard"], each["created"]) for each in info["merged"]}
    return list(found) if merged <= set(found.values()) else []


def list_marks(store: RunStore) -> set[tuple[str, str, int]]:
    """Return for which answers a store has marks of judges, as digest, arm and episode."""
    return {(judge.digest, *key) for judge in store.judges for key in store.judged_outcomes(judge.digest)}


def _read_shard(folder: Path, config: dict[str, Any]) -> tuple[str, str] | None:
    """Return which shard a store is and when it began; None for no shard of this run, such as `wiw blame` keeps."""
    with RunStore.read(folder) as store:
        is_shard = store.shard is not None and store.config == config
        return (store.info["shard"], store.created) if is_shard else None


def _list_inside(run: Path) -> list[Path]:
    return sorted(path.parent for path in run.glob(f"*/{FILE_NAME}") if RunStore.can_be_read(path.parent))


def _has_marks(run: Path) -> bool:
    with RunStore.read(run) as store:
        return bool(list_marks(store))


def _stores_of(run: Path) -> Iterator[Path]:
    if store_path(run).is_file():
        shards = find_shards(run)
        yield from shards if shards and not _has_marks(run) else [run]
        return
    inside = _list_inside(run)
    if not inside:
        raise StoreError(f"no run at {run}: expected a folder with {FILE_NAME} in it, or with folders of shards")
    yield from inside
