# SPDX-License-Identifier: Apache-2.0
"""The run store: one SQLite file that survives being killed at any moment, written by one process.

Every decision and every episode's end is a transaction of its own in WAL mode: a killed run loses at most what it was
about to write. Episodes without an outcome are partial; resuming discards and redoes them.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import wiw
from wiw import benchmark
from wiw.errors import ArgumentError, StoreError
from wiw.file_systems import find_network
from wiw.json_text import escape_surrogates
from wiw.runs import configurations
from wiw.runs.faults import explain_faults, find_remedy, write_resume_command
from wiw.runs.hidden_secrets import hide_secrets
from wiw.runs.judges import JudgedRow, JudgeRecord, apply_judge, find_judge
from wiw.runs.migrations import OLDEST_READABLE, is_newer, migrate, show_as_current
from wiw.runs.processes import describe_process
from wiw.runs.rows import AgentRow, DecisionRow, LostRow, OutcomeRow, build_episode, to_episode_values, to_json
from wiw.runs.scratch import RECORDED, ScratchCopy, SupersededError
from wiw.runs.shapes import EDITED, check_decision, check_types, parse_column
from wiw.runs.shards import Shard
from wiw.runs.store_file import (
    FILE_NAME,
    SCHEMA,
    connect,
    is_blank,
    list_columns,
    lock_both,
    lock_store,
    make_folder,
    remove_store,
    store_path,
)
from wiw.runs.store_log import has_log, take_in_log
from wiw.types import Episode

SCHEMA_VERSION = 11
DECISION_JSON = (
    "actions",
    "executed",
    "scores",
    "answer",
    "fidelity",
    "exchanges",
    "proposals",
    "real_frames",
    "path",
    "refused",
    "seconds",
    "calls",
    "spent",
)
"""Columns of table `decision` that hold JSON."""
OUTCOME_JSON = ("metrics", "details")
"""Columns of table `outcome` that hold JSON."""
_ENDED = {
    **dict.fromkeys(("outcome", "decision", "image", "film"), "arm = ? AND episode = ?"),
    "judged": "judge IN (SELECT digest FROM judge) AND arm = ? AND episode = ?",
}
"""Tables with the rows of an ended episode, and the condition by which SQLite finds them with their primary key."""
APPLICATION_ID = 0x77697721
"""Marks the file as a run store (SQLite's application_id)."""


class RunStore:
    """An open run store. Use `create`, `resume` or `read`; works as a context manager."""

    def __init__(
        self, path: Path, connection: sqlite3.Connection, lock: Any = None, copy: ScratchCopy | None = None
    ) -> None:
        self.path = path
        self._connection = connection
        self._lock = lock
        self._copy = copy
        self._judge: str | None = None

    @classmethod
    def create(
        cls,
        run: str | Path,
        config: dict[str, Any],
        info: dict[str, Any],
        episodes: Iterable[Episode],
        scratch: str | Path | None = None,
        created: str | None = None,
        version: str | None = None,
    ) -> RunStore:
        """Create a store for writing.

        Args:
            run: its folder.
            config: task, arms and seed.
            info: whatever else belongs to the run.
            episodes: that every arm runs.
            scratch: folder on a local disk; given, the store is written there, and copied to `run` when a session
                begins, then at most once a minute, and when it is closed.
            created: when the run began; now if not given.
            version: of wiw that ran it; this one if not given.

        Raises:
            StoreError: a run is already there, the folder cannot be written or is on a network file system, or rows
                of an earlier run are in `scratch` that were not copied.
        """
        copy = None if scratch is None else ScratchCopy(store_path(run), Path(scratch))
        path = store_path(run) if copy is None else copy.path
        if cls.exists(run):
            raise StoreError(
                f"{store_path(run)} already holds a run; continue it with `{find_resume_command(run)}` (or "
                "evaluate(..., resume=True)), or give another output folder"
            )
        make_folder(store_path(run))
        lock = lock_store(path) if copy is None else cls._clear_scratch(copy)
        store = cls(path, connect(path, lock), lock, copy)
        with store._close_on_error():
            store._fill(created or _format_now(), version or wiw.__version__, config, info, episodes)
        return store

    def _fill(
        self, created: str, version: str, config: dict[str, Any], info: dict[str, Any], episodes: Iterable[Episode]
    ) -> None:
        with self._writing() as connection:
            for statement in SCHEMA.read_text().split(";\n"):
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
            recorded = {"benchmark": benchmark.VERSION, **info}
            if "command" in recorded:
                recorded["command"] = hide_secrets(recorded["command"])
            connection.execute(
                "INSERT INTO run VALUES (1, ?, ?, ?, ?)", (created, version, to_json(config), to_json(recorded))
            )
            connection.executemany(
                "INSERT INTO episode VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                [to_episode_values(index, episode) for index, episode in enumerate(episodes)],
            )

    @staticmethod
    def exists(run: str | Path) -> bool:
        """Return whether a run is there, rather than nothing or a creation that was cut off."""
        path = store_path(run)
        return path.exists() and (find_network(path) is not None or not is_blank(path))

    @staticmethod
    def can_be_read(run: str | Path) -> bool:
        """Return whether a run is there, rather than nothing or a creation that goes on or was cut off; only reads.

        Raises:
            StoreError: the file is damaged.
        """
        path = store_path(run)
        return path.is_file() and not is_blank(path, writing=False)

    @classmethod
    def resume(
        cls,
        run: str | Path,
        config: dict[str, Any] | None = None,
        scratch: str | Path | None = None,
        more_arms: bool = False,
    ) -> RunStore:
        """Open an existing store for writing and discard partial episodes.

        Rows that an earlier process has left on a local disk are taken in first.

        Args:
            run: its folder.
            config: that the run must be of.
            scratch: as in `create`.
            more_arms: whether `config` may have arms that the run lacks; `add_arms` adds them.

        Raises:
            StoreError: missing, damaged, of another version, of another configuration than `config`, in use, or on a
                network file system.
        """
        path = store_path(run)
        copy = None if scratch is None else ScratchCopy(path, Path(scratch))
        cls._bring_home(path, copy)
        if copy is not None and (path.exists() or copy.holds_run()):
            store = cls._open_scratch_copy(copy)
        else:
            store = cls._open(path, lock_store(path) if path.exists() else None, continues=True)
        with store._close_on_error():
            if config is not None:
                wanted = json.loads(to_json(config))
                configurations.require_same(
                    path, store.config, configurations.drop_new_arms(store.config, wanted) if more_arms else wanted
                )
            store._discard_partial()
        return store

    def require_version(self) -> None:
        """Check that this is the version of wiw, and of the benchmark, that started the run.

        Raises:
            StoreError: this is another.
        """
        if self.wiw_version != wiw.__version__:
            raise StoreError(
                f"{self.path} was started by wiw {self.wiw_version}, this is {wiw.__version__}: results of two "
                "versions must not be mixed; install that version or start a new run"
            )
        self.require_benchmark()

    def require_benchmark(self) -> None:
        """Check that episodes of the run would be decided alike today.

        Raises:
            StoreError: the run is of another version of the benchmark.
        """
        if self.benchmark != benchmark.VERSION:
            raise StoreError(
                f"{self.path} uses version {self.benchmark} of the benchmark, but this wiw runs version "
                f"{benchmark.VERSION}, in which decisions differ (docs/results.md); use the wiw that started the run, "
                "or start a new one. Its records can still be read, reported and exported"
            )

    def require_task(self, task: dict[str, Any]) -> None:
        """Check that the task is the one the run was started with; its preset may be a file that has changed.

        Raises:
            StoreError: the task differs; says in what.
        """
        configurations.require_same(self.path, self.config["task"], json.loads(to_json(task)))

    def require_same(self, begun_with: dict[str, Any], now: dict[str, Any]) -> None:
        """Check settings or scenes, by name, against those that the run was started with.

        Raises:
            StoreError: they differ; says in what. The "content" of a scene differs only where both have one.
        """
        configurations.require_same_inputs(self.path, begun_with, now)

    @classmethod
    def read(cls, run: str | Path) -> RunStore:
        """Open an existing store for reading, also while it is being written.

        Raises:
            StoreError: missing, damaged or of another version.
        """
        return cls._open(store_path(run), None)

    @classmethod
    def annotate(cls, run: str | Path) -> RunStore:
        """Open an existing store to add marks of ended episodes; partial episodes stay.

        Raises:
            StoreError: missing, damaged, of another schema, or in use.
        """
        path = store_path(run)
        cls._bring_home(path, None)
        return cls._open(path, lock_store(path) if path.exists() else None)

    @staticmethod
    def _clear_scratch(copy: ScratchCopy) -> ExitStack:
        """Lock a store that begins on a local disk, and remove what an earlier process has left there."""
        with lock_both(copy) as lock:
            copy.require_no_rows()
            copy.discard()
            return lock.pop_all()

    @classmethod
    def _bring_home(cls, path: Path, copy: ScratchCopy | None) -> None:
        """Copy home what an earlier process has left on a local disk, unless that is where `copy` is."""
        left = cls._find_left(path)
        if left is None or (copy is not None and copy.path == left.path):
            return
        with lock_both(left):
            take_in_log(path)
            left.bring_home()

    @classmethod
    def _find_left(cls, path: Path) -> ScratchCopy | None:
        """Return what the last process to run episodes has left on a local disk of this machine; None if nothing."""
        with suppress(StoreError), cls.read(path) as store:
            folder = store._session.get("scratch_folder")
            copy = None if folder is None else ScratchCopy(path, Path(str(folder)))
            return copy if copy is not None and os.path.isfile(copy.path) else None  # noqa: PTH113 - never raises
        return None

    @classmethod
    def _open_scratch_copy(cls, copy: ScratchCopy) -> RunStore:
        """Open a store for writing on a local disk."""
        lock = lock_both(copy)
        try:
            take_in_log(copy.home)
            copy.fetch_store()
        except BaseException:
            lock.close()
            raise
        return cls._open(copy.path, lock, copy, continues=True)

    @classmethod
    def _open(cls, path: Path, lock: Any, copy: ScratchCopy | None = None, continues: bool = False) -> RunStore:
        """Open a file that exists; `continues` requires that this version may add episodes to it."""
        if not path.is_file():
            raise StoreError(f"no run at {path.parent}: expected a folder with {FILE_NAME} in it")
        store = cls(path, connect(path, lock), lock, copy)
        with store._close_on_error():
            store._require_whole()
            store._require_readable()
            if continues:  # before the file is touched: the version that may continue it reads its own schema alone
                store.require_version()
            store._update_schema()
        return store

    def _require_whole(self) -> None:
        """Check the file's length: SQLite reads a last page that is cut short as zeros."""
        pages, size = (self._rows(f"PRAGMA {name}")[0][name] for name in ("page_count", "page_size"))
        if not has_log(self.path) and self.path.stat().st_size < pages * size:  # in this order: a log may just go
            raise StoreError(f"{self.path}: the file is truncated; {find_remedy(self.path, 'malformed')}")

    def _require_readable(self) -> None:
        application, version = (self._rows(f"PRAGMA {name}")[0][name] for name in ("application_id", "user_version"))
        if application != APPLICATION_ID:
            raise StoreError(
                f"{self.path} is not a run store of wiw: expected application id {APPLICATION_ID:#x}, got "
                f"{application:#x}. If its creation was interrupted, start the run again; otherwise give another folder"
            )
        if not OLDEST_READABLE <= version <= SCHEMA_VERSION:
            raise StoreError(
                f"{self.path} was written by wiw {self.wiw_version} with schema version {version}; this is wiw "
                f"{wiw.__version__}, which reads versions {OLDEST_READABLE} to {SCHEMA_VERSION}: use the one that "
                "wrote it, or start a new run"
            )
        self._require_columns(version)

    def _require_columns(self, version: int) -> None:
        """Check that the tables have the columns of schema `version`: a damaged schema may still be SQL."""
        for table, columns in list_columns().items():
            found = {row["name"]: row["type"] for row in self._rows(f"PRAGMA main.table_info({table})")}
            for name, column in columns.items():
                if found.get(name) != column.kind and not is_newer(table, name, version):
                    raise StoreError(
                        f"{self.path}: table {table}: expected a column {name} {column.kind}, got "
                        f"{found.get(name, 'none')}; {find_remedy(self.path, 'malformed')}"
                    )

    def _update_schema(self) -> None:
        """Bring an older store to the current schema: in the file if it may be written, else for this reader alone."""
        version = self._rows("PRAGMA user_version")[0]["user_version"]
        if version == SCHEMA_VERSION:
            return
        if self._lock is None:
            with explain_faults(self.path):
                show_as_current(self._connection, version)
            return
        with self._writing() as connection:
            migrate(connection, version)
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")

    @property
    def home(self) -> Path:
        """The file in the run's own folder; `path` is another where the store is written on a local disk."""
        return self.path if self._copy is None else self._copy.home

    @property
    def local_file(self) -> Path | None:
        """The file on a local disk, of a store that is written there; None once it is copied home and removed."""
        return None if self._copy is None or not self._copy.path.is_file() else self._copy.path

    @property
    def resume_command(self) -> str:
        """Command that resumes the run, on the local disk that it is, or was last, written on."""
        if self._copy is not None:
            return self._copy.resume_command
        return write_resume_command(self.path.parent, self._session.get("scratch"))

    @property
    def _session(self) -> dict[str, Any]:
        """Values that `begin_session` has stored; empty if no episode was run yet."""
        session = self.info.get("session")
        return session if isinstance(session, dict) else {}

    # -- what the run is -------------------------------------------------------------------------------------------

    @property
    def wiw_version(self) -> str:
        """Version of wiw that began the run."""
        return str(self._read_column("wiw_version"))

    @property
    def benchmark(self) -> int:
        """Version of the benchmark that the run is of."""
        return int(self.info.get("benchmark", benchmark.FIRST))

    @property
    def created(self) -> str:
        """When the run began, ISO 8601 in UTC."""
        return str(self._read_column("created"))

    @property
    def config(self) -> dict[str, Any]:
        """Task, arms and seed."""
        return dict(parse_column("config", self._read_column("config"), str(self.path)))

    @property
    def info(self) -> dict[str, Any]:
        """Platform, how to rebuild task and agents, which episodes keep pictures."""
        return dict(parse_column("info", self._read_column("info"), str(self.path)))

    @property
    def salt(self) -> str:
        """The salt of keys and seeds (`wiw.loop.keys`); empty for a run that was started without one."""
        return str(self.info.get("salt", ""))

    @property
    def shard(self) -> Shard | None:
        """The part of the episodes that this store is for; None for all of them."""
        named = self.info.get("shard")
        return None if named is None else Shard.parse(str(named))

    def episodes(self) -> list[Episode]:
        """Return the episodes that every arm runs; their place in the list is their index."""
        rows = self._convert_types("episode", self._rows("SELECT * FROM episode ORDER BY episode"))
        infos = [parse_column("episode.info", row["info"], self._place("episode", row)) for row in rows]
        return [build_episode(row, info) for row, info in zip(rows, infos, strict=True)]

    @property
    def judges(self) -> list[JudgeRecord]:
        """All judges of the run's answers, its own first; none where its task has no answers in words."""
        own = self.config["task"].get("judge")
        found = [JudgeRecord(own, own=True)] if isinstance(own, dict) else []
        for row in self._rows("SELECT digest, description FROM judge ORDER BY created, digest"):
            description = parse_column("description", row["description"], f"{self.path}: judge {row['digest']}")
            found.append(JudgeRecord(description))
        return list({judge.digest: judge for judge in reversed(found)}.values())[::-1]  # its own counts as that

    @property
    def judge(self) -> JudgeRecord | None:
        """The judge whose marks outcomes have: the run's own unless `use_judge` has chosen another."""
        return find_judge(self.judges, self._judge, str(self.path.parent))

    def use_judge(self, name: str | None) -> None:
        """Choose the judge whose marks `outcomes` have, by name or digest; None for the run's own.

        Raises:
            ArgumentError: no judge or several of that name.
        """
        found = find_judge(self.judges, name, str(self.path.parent))
        self._judge = None if found is None else found.digest

    def outcomes(self) -> list[dict[str, Any]]:
        """Return the ended episodes of all arms, with their kind ("task") where a task has several.

        What depends on marks is by the judge that `use_judge` has chosen.
        """
        judge, found = self.judge, self.recorded_outcomes()
        return found if judge is None else apply_judge(found, self.judged_outcomes(judge.digest), judge)

    def judged_outcomes(self, digest: str) -> dict[tuple[str, int], dict[str, Any]]:
        """Return what depends on the marks of a judge, by arm and episode."""
        rows = self._rows("SELECT * FROM judged WHERE judge = ? ORDER BY arm, episode", (digest,))
        return {
            (row["arm"], row["episode"]): {
                **{name: row[name] for name in ("status", "error", "kind")},
                **{name: parse_column(name, row[name], self._place("judged", row)) for name in OUTCOME_JSON},
            }
            for row in self._convert_types("judged", rows)
        }

    def recorded_outcomes(self) -> list[dict[str, Any]]:
        """Return the ended episodes as the run recorded them, with the marks of its own judge."""
        rows = self._rows(
            "SELECT o.*, e.episode_id, e.scene, e.geodesic, json_extract(e.info, '$.task') AS task, "
            "json_extract(e.info, '$.tier') AS tier "
            "FROM outcome o JOIN episode e USING (episode) "
            "ORDER BY arm, episode"
        )
        rows = self._convert_types("outcome", rows)
        arms = [arm["name"] for arm in self.config["arms"]]
        for row in rows:
            if row["arm"] not in arms:
                place = self._place("outcome", row)
                raise StoreError(f"{place}: expected an arm of the run: {', '.join(arms)}; {EDITED}")
        named = [{name: value for name, value in row.items() if value or name not in ("task", "tier")} for row in rows]
        return [
            {**row, **{name: parse_column(name, row[name], self._place("outcome", row)) for name in OUTCOME_JSON}}
            for row in named
        ]

    def count_ended(self) -> tuple[int, int]:
        """Return how many episodes of all arms have ended, and how many of these with an error."""
        (counted,) = self._rows("SELECT count(*) AS n, coalesce(sum(status = 'error'), 0) AS errors FROM outcome")
        return counted["n"], counted["errors"]

    def has_rows(self) -> bool:
        """Return whether anything of the run is recorded: an ended episode, a decision, or what one had spent."""
        return any(self._rows(f"SELECT 1 FROM {table} LIMIT 1") for table in RECORDED)

    def decisions(self, arm: str | None = None, episode: int | None = None) -> list[dict[str, Any]]:
        """Return the decisions of ended episodes in order, of all or of one arm or episode."""
        chosen = {name: value for name, value in (("arm", arm), ("episode", episode)) if value is not None}
        condition = " AND ".join(f"{name} = ?" for name in chosen) or "true"  # nothing else lets SQLite use the key
        rows = self._rows(
            f"SELECT d.* FROM decision d JOIN outcome USING (arm, episode) WHERE {condition} "
            "ORDER BY arm, episode, decision",
            tuple(chosen.values()),
        )
        for row in self._convert_types("decision", rows):
            for column in DECISION_JSON:
                if row[column] is not None:
                    row[column] = parse_column(column, row[column], self._place("decision", row))
            check_decision(row, self._place("decision", row))
        return rows

    def totals(self, column: str) -> dict[str, dict[str, float]]:
        """Return sums over the decisions of ended episodes by arm, with the number of decisions as "decisions".

        Args:
            column: of named numbers: "seconds", "calls" or "spent".
        """
        if column not in ("seconds", "calls", "spent"):
            raise ArgumentError(f"totals: expected seconds, calls or spent, got '{column}'")
        found: dict[str, dict[str, float]] = {}
        ended = "decision d JOIN outcome USING (arm, episode)"
        for row in self._rows(f"SELECT arm, count(*) AS n FROM {ended} GROUP BY arm"):
            found[row["arm"]] = {"decisions": float(row["n"])}
        sums = f"SELECT arm, key, sum(value) AS total FROM {ended}, json_each(d.{column}) GROUP BY arm, key"
        for row in self._rows(sums):
            found[row["arm"]][row["key"]] = float(row["total"] or 0)
        return found

    def count_answers(self) -> dict[str, dict[str, int]]:
        """Return by arm how many answers of a language model ended episodes have, by their problem's kind.

        The kind is empty if an answer could be used. An arm that asked nothing is left out.
        """
        found: dict[str, dict[str, int]] = {}
        problem = "json_extract(e.value, '$.problem')"
        for row in self._rows(
            f"SELECT arm, substr({problem}, 1, instr({problem} || ':', ':') - 1) AS trouble, count(*) AS n "
            "FROM decision d JOIN outcome USING (arm, episode), json_each(d.exchanges) e "
            "WHERE json_array_length(e.value, '$.said') > 0 GROUP BY arm, trouble ORDER BY arm, trouble"
        ):
            found.setdefault(row["arm"], {})[row["trouble"] or ""] = row["n"]
        return found

    def count_choices(self) -> dict[str, tuple[int, int]]:
        """Return by arm how many choices of a language model in ended episodes are doubtful, and how many there are.

        An arm without any is left out.
        """
        rows = self._rows(
            "SELECT arm, sum(json_extract(e.value, '$.result.doubtful')) AS doubtful, count(*) AS n "
            "FROM decision d JOIN outcome USING (arm, episode), json_each(d.exchanges) e "
            "WHERE json_extract(e.value, '$.result.mass') IS NOT NULL GROUP BY arm"
        )
        return {row["arm"]: (row["doubtful"] or 0, row["n"]) for row in rows}

    def sum_lost_costs(self) -> dict[str, dict[str, float]]:
        """Return by arm and name what was spent on decisions that an error interrupted."""
        found: dict[str, dict[str, float]] = {}
        for row in self._rows("SELECT arm, name, value FROM lost"):
            found.setdefault(row["arm"], {})[row["name"]] = row["value"]
        return found

    def images(self, arm: str, episode: int, decision: int) -> dict[str, bytes]:
        """Return JPEG by name, empty if no pictures were kept."""
        rows = self._rows(
            "SELECT name, jpeg FROM image WHERE arm = ? AND episode = ? AND decision = ? ORDER BY name",
            (arm, episode, decision),
        )
        return {row["name"]: row["jpeg"] for row in rows}

    def film(self, arm: str, episode: int) -> bytes | None:
        """Return the animated WebP of an episode, if one was kept."""
        found = self._rows("SELECT webp FROM film WHERE arm = ? AND episode = ?", (arm, episode))
        return found[0]["webp"] if found else None

    def scene_map(self, scene: str) -> tuple[bytes, list[list[float]]] | None:
        """Return WebP of the scene from above and its 2x3 matrix from world (x, z) to pixels, if one was kept."""
        for row in self._rows("SELECT * FROM scene_map WHERE scene = ?", (scene,)):
            where = f"{self.path}: map of {scene}"
            return row["webp"], parse_column("world_to_pixel", row["world_to_pixel"], where)
        return None

    def pending(self, arm: str, retry_errors: bool = False) -> list[int]:
        """Return indices of the episodes still to be run in an arm.

        With `retry_errors` also those that ended with an error, unless the run's own judge has marked them since.
        """
        done = "AND status = 'done'" if retry_errors else ""
        ended = {row["episode"] for row in self._rows(f"SELECT episode FROM outcome WHERE arm = ? {done}", (arm,))}
        if retry_errors and (own := next((judge for judge in self.judges if judge.own), None)):
            ended |= {
                row["episode"]
                for row in self._rows(
                    "SELECT episode FROM judged WHERE arm = ? AND judge = ? AND status = 'done'", (arm, own.digest)
                )
            }
        return [episode for episode in self.own_episodes() if episode not in ended]

    def own_episodes(self) -> Sequence[int]:
        """Return the indices of the episodes that this store is for: all, its shard's, or up to where it stopped."""
        (counted,) = self._rows("SELECT count(*) AS n FROM episode")
        shard, stopped = self.shard, self.info.get("stopped")
        if stopped is not None:
            return range(stopped["episodes"])
        return range(counted["n"]) if shard is None else shard.select(counted["n"])

    # -- writing ---------------------------------------------------------------------------------------------------

    def write(self, row: DecisionRow | OutcomeRow) -> None:
        """Write one decision with its pictures, or one episode's end, as one transaction.

        An episode whose file gave no length takes it from the first arm that has measured it ("shortest").
        """
        with self._writing() as connection:
            if isinstance(row, DecisionRow):
                key = {"arm": row.arm, "episode": row.episode, "decision": row.decision}
                _insert(connection, "decision", {**key, **row.values})
                for name, jpeg in row.images.items():
                    _insert(connection, "image", {**key, "name": name, "jpeg": jpeg})
            else:
                result = row.result
                _insert(
                    connection,
                    "outcome",
                    {
                        "arm": row.arm,
                        "episode": result.episode,
                        "status": result.status,
                        "metrics": to_json(dict(result.metrics)),
                        "seconds": result.seconds,
                        "error": result.error,
                        "kind": result.kind,
                        "details": to_json(dict(result.details)),
                    },
                )
                shortest = result.metrics.get("shortest", math.nan)
                if math.isfinite(shortest):
                    connection.execute(
                        "UPDATE episode SET geodesic = ? WHERE episode = ? AND geodesic IS NULL",
                        (shortest, result.episode),
                    )
        if self._copy is not None and isinstance(row, OutcomeRow):
            self._copy.copy_if_due(self._connection)

    def add_judge(self, judge: JudgeRecord) -> None:
        """Store a judge's description, so that its marks can be written."""
        with self._writing() as connection:
            connection.execute(
                "INSERT OR IGNORE INTO judge VALUES (?, ?, ?)",
                (judge.digest, to_json(dict(judge.description)), _format_now()),
            )

    def write_judged(self, row: JudgedRow) -> None:
        """Write what a judge's marks make of an outcome; marks that exist already stay, an error is replaced."""
        values = {name: getattr(row, name) for name in ("judge", "arm", "episode", "status", "error", "kind")}
        values |= {name: to_json(dict(getattr(row, name))) for name in OUTCOME_JSON}
        names = ", ".join(values)
        changes = ", ".join(f"{name} = excluded.{name}" for name in ("status", "error", "kind", *OUTCOME_JSON))
        with self._writing() as connection:
            connection.execute(
                f"INSERT INTO judged ({names}) VALUES ({', '.join('?' for _ in values)}) "
                f"ON CONFLICT (judge, arm, episode) DO UPDATE SET {changes} WHERE judged.status = 'error'",
                _bind(values),
            )

    def write_agent(self, row: AgentRow) -> None:
        """Store the description of an arm's agent as `info["built"][arm]`.

        Raises:
            StoreError: the arm was started with an agent that said otherwise, such as one of other weights.
        """
        info = self.info
        agent = json.loads(to_json(row.agent))
        built = info.setdefault("built", {})
        if row.arm in built:
            configurations.require_same(self.path, built[row.arm], agent)
            return
        built[row.arm] = agent
        with self._writing() as connection:
            connection.execute("UPDATE run SET info = ?", (to_json(info),))

    def add_arms(self, config: dict[str, Any], info: Mapping[str, Any]) -> None:
        """Store arms that the run lacks, so that they can be run; `info["arms_added"]` lists them, and when.

        Args:
            config: of the run, with these arms.
            info: what it says of all arms: "agents", "sources" and "departures".
        """
        known = {arm["name"] for arm in self.config["arms"]}
        added = {"time": _format_now(), "arms": [arm["name"] for arm in config["arms"] if arm["name"] not in known]}
        log = [*self.info.get("arms_added", []), added]
        with self._writing() as connection:
            connection.execute(
                "UPDATE run SET config = ?, info = ?",
                (to_json(config), to_json({**self.info, **info, "arms_added": log})),
            )

    def change_sources(self, sources: Mapping[str, str]) -> None:
        """Store digests of the user's source files; `info["sources_changed"]` lists which changed, and when."""
        info = self.info
        old = info.get("sources", {})
        changed = sorted(path for path in old.keys() | sources.keys() if old.get(path) != sources.get(path))
        log = [*info.get("sources_changed", []), {"time": _format_now(), "files": changed}]
        with self._writing() as connection:
            connection.execute(
                "UPDATE run SET info = ?", (to_json({**info, "sources": dict(sources), "sources_changed": log}),)
            )

    def change_settings(self, changes: Mapping[str, Any]) -> None:
        """Store settings that the run continues with; `info["resumed_with"]` lists what was changed, and when."""
        info = self.info
        own = {**info["limits"], "live": info["live"]}
        changed = {name: value for name, value in changes.items() if name not in own or own[name] != value}
        if not changed:
            return
        info["live"] = changed.get("live", info["live"])
        info["limits"] |= {name: value for name, value in changed.items() if name != "live"}
        info["resumed_with"] = [*info.get("resumed_with", []), {"time": _format_now(), **changed}]
        with self._writing() as connection:
            connection.execute("UPDATE run SET info = ?", (to_json(info),))

    def stop_after(self, episodes: int, why: str) -> None:
        """Store that the run ends with its first `episodes` episodes, and why: the others will not be run."""
        stopped = {"episodes": episodes, "why": why}
        with self._writing() as connection:
            connection.execute("UPDATE run SET info = ?", (to_json({**self.info, "stopped": stopped}),))

    def begin_session(self) -> None:
        """Store when and where episodes begin to be run, and how many have ended before, for `wiw status`."""
        session = {"begun": _format_now(), "ended": self.count_ended()[0], **describe_process()}
        if self._copy is not None:
            session |= {"scratch": self._copy.given, "scratch_folder": str(self._copy.folder)}
        with self._writing() as connection:
            connection.execute("UPDATE run SET info = ?", (to_json({**self.info, "session": session}),))
        if self._copy is not None:
            self._copy.copy(self._connection)

    def take_episodes(self, source: RunStore, episodes: Collection[tuple[str, int]]) -> None:
        """Copy ended episodes, by arm and index, from another store of the same run, with all that belongs to them.

        Whatever else the other store has spent is recorded as lost.
        """
        with self._writing() as connection:
            for row in source._rows("SELECT * FROM judge"):
                connection.execute("INSERT OR IGNORE INTO judge VALUES (?, ?, ?)", tuple(row.values()))
            for table, key in _ENDED.items():
                for own in episodes:
                    for row in source._rows(f"SELECT * FROM {table} WHERE {key}", own):
                        _insert(connection, table, row)
            for row in source._rows("SELECT episode, geodesic FROM episode WHERE geodesic IS NOT NULL"):
                connection.execute(
                    "UPDATE episode SET geodesic = ? WHERE episode = ? AND geodesic IS NULL",
                    (row["geodesic"], row["episode"]),
                )
        for arm, spent in source._sum_other_costs(episodes).items():
            self.write_lost(LostRow(arm, spent))

    def _sum_other_costs(self, episodes: Collection[tuple[str, int]]) -> dict[str, dict[str, float]]:
        """Return by arm and name what was spent on anything but these episodes."""
        found = self.sum_lost_costs()
        for column, name in _COSTS:
            for row in self._rows(
                f"SELECT arm, episode, {name} AS name, total(value) AS value FROM decision d, json_each(d.{column}) "
                "WHERE key != 'replay' GROUP BY arm, episode, name"
            ):
                if (row["arm"], row["episode"]) not in episodes:
                    own = found.setdefault(row["arm"], {})
                    own[row["name"]] = own.get(row["name"], 0.0) + row["value"]
        return found

    def write_lost(self, row: LostRow) -> None:
        """Record what an interrupted decision had spent."""
        with self._writing() as connection:
            connection.executemany(
                f"INSERT INTO lost VALUES (?, ?, ?) {_ADD}", [(row.arm, *item) for item in row.spent.items()]
            )

    def discard(self, arm: str, episodes: Iterable[int]) -> None:
        """Delete episodes that are to be run again; their costs are recorded as lost."""
        with self._writing() as connection:
            for episode in episodes:
                _forget(connection, "d.arm = ? AND d.episode = ?", (arm, episode))
                for table in ("outcome", "judged"):
                    connection.execute(f"DELETE FROM {table} WHERE {_ENDED[table]}", (arm, episode))

    def keep_pictures(self, episodes: Sequence[int]) -> None:
        """Drop the pictures of all other episodes; `info["pictures"]` has these, the one to show first in front."""
        info = {name: value for name, value in self.info.items() if name != "keep_images"} | {"pictures": episodes}
        numbers = ", ".join(str(int(episode)) for episode in episodes)
        with self._writing() as connection:
            dropped = connection.execute(f"DELETE FROM image WHERE episode NOT IN ({numbers})").rowcount
            connection.execute("UPDATE run SET info = ?", (to_json(info),))
        if dropped:
            with suppress(sqlite3.OperationalError):  # a reader or a full disk: the file stays larger than it must be
                self._connection.execute("VACUUM")

    def write_scene_map(self, scene: str, webp: bytes, world_to_pixel: Any) -> None:
        """Store a picture of a scene from above."""
        with self._writing() as connection:
            connection.execute(
                "INSERT OR REPLACE INTO scene_map VALUES (?, ?, ?)", (scene, webp, to_json(world_to_pixel))
            )

    def write_film(self, arm: str, episode: int, webp: bytes) -> None:
        """Store the film of an episode."""
        with self._writing() as connection:
            _insert(connection, "film", {"arm": arm, "episode": episode, "webp": webp})

    def abandon(self) -> None:
        """Close a new store that is written on a local disk, and remove it without copying it to its own folder."""
        home = self.home
        self._end(keep=False)
        if not home.exists():
            remove_store(home)

    def close(self) -> None:
        """Close the file and let others write; a store on a local disk is copied to its own folder, and removed."""
        self._end(keep=True)

    def __enter__(self) -> RunStore:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # -- inside ----------------------------------------------------------------------------------------------------

    def _end(self, keep: bool) -> None:
        copy = None if self._lock is None else self._copy  # closed before
        with nullcontext() if copy is None else copy.ending():
            try:
                if copy is not None and keep:
                    copy.copy(self._connection)
                self._connection.close()
                if copy is not None:
                    copy.remove()
            finally:
                self._connection.close()
                if self._lock is not None:
                    self._lock.close()
                    self._lock = None

    def _discard_partial(self) -> None:
        with self._writing() as connection:
            _forget(
                connection, "NOT EXISTS (SELECT 1 FROM outcome o WHERE o.arm = d.arm AND o.episode = d.episode)", ()
            )

    @contextmanager
    def _close_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.close()
            raise

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        with explain_faults(self.path, self.home), self._connection as connection:
            connection.execute("BEGIN IMMEDIATE")
            yield connection

    def _rows(self, query: str, values: tuple[Any, ...] = ()) -> list[dict[str, Any]]:
        with explain_faults(self.path):
            return [dict(row) for row in self._connection.execute(query, values)]

    def _convert_types(self, table: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return the rows of a table, held to the types of its columns.

        Raises:
            StoreError: a value is of another type.
        """
        declared = {name: column.types for name, column in list_columns()[table].items()}
        for row in rows:
            check_types(row, declared, self._place(table, row))
        return rows

    def _place(self, table: str, row: dict[str, Any]) -> str:
        names = ", ".join(f"{name} {row[name]}" for name in ("arm", "episode", "decision") if name in row)
        return f"{self.path}: {table} ({names})"

    def _read_column(self, column: str) -> Any:
        rows = self._rows("SELECT * FROM run")
        if not rows or column not in rows[0]:
            raise StoreError(f"{self.path} does not say which run it holds; {find_remedy(self.path, 'malformed')}")
        return rows[0][column]


@contextmanager
def leave_resumable(begun: RunStore) -> Iterator[None]:
    """Where an error ends the work on a new run, note on it how the run continues, or remove one without any record.

    So a wrong token or missing weights leave no run behind that can neither be begun again nor resumed. An
    interruption leaves it.
    """
    command = begun.resume_command
    try:
        yield
    except SupersededError:  # another process continues the run
        raise
    except Exception as error:
        with suppress(StoreError), RunStore.read(begun.local_file or begun.home) as store:
            if begun.local_file is None and not store.has_rows():  # home may lack rows that are left on the local disk
                remove_store(begun.home)
            elif store.info["task"] is not None:  # else it was begun with objects, and no command can resume it
                place = "" if begun.local_file is None else f" in {begun.local_file}"
                note = f"Everything recorded is kept{place}. Once the cause is fixed:  {command}"
                vars(error).setdefault("__notes__", []).append(note)  # as `add_note` of Python 3.11 does
        raise


def find_resume_command(run: str | Path) -> str:
    """Return the command that resumes the run in a folder, as its store says."""
    with suppress(StoreError), RunStore.read(run) as store:
        return store.resume_command
    return write_resume_command(store_path(run).parent)


def _format_now() -> str:
    """Return the time, ISO 8601 in UTC."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def _insert(connection: sqlite3.Connection, table: str, values: dict[str, Any]) -> None:
    marks = ", ".join("?" for _ in values)
    connection.execute(f"INSERT INTO {table} ({', '.join(values)}) VALUES ({marks})", _bind(values))


def _bind(values: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the values of a row as SQLite takes them."""
    return tuple(escape_surrogates(value) if isinstance(value, str) else value for value in values.values())


_ADD = "ON CONFLICT (arm, name) DO UPDATE SET value = value + excluded.value"


_COSTS = (("spent", "key"), ("seconds", "'seconds'"))
"""Columns of a decision with costs, and the names of these in SQL."""


def _forget(connection: sqlite3.Connection, condition: str, values: tuple[Any, ...]) -> None:
    """Delete decisions, pictures and films `d` that meet a condition; record their costs as lost."""
    for column, name in _COSTS:
        connection.execute(
            f"INSERT INTO lost SELECT arm, {name}, total(value) FROM decision d, json_each(d.{column}) "
            f"WHERE ({condition}) AND key != 'replay' GROUP BY arm, {name} {_ADD}",
            values,
        )
    for table in ("decision", "image", "film"):
        connection.execute(f"DELETE FROM {table} AS d WHERE {condition}", values)
