# SPDX-License-Identifier: Apache-2.0
"""Merge the stores of a run's shards into one run, identical to what a single process would have recorded.

All rows of episodes, outcomes, decisions, images, films and maps are equal. Exceptions are times (`seconds`), `spent`
and `calls` as far as they depend on which episodes ran together, and what `info` says about machines and commands.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from inspect import isfunction
from pathlib import Path
from typing import Any

from wiw.errors import Error, FileError, StoreError
from wiw.file_systems import find_network
from wiw.registry import POLICIES, TASKS, WORLD_MODELS
from wiw.runs.execute import draw_pictures, read_recipes
from wiw.runs.pictures import drop_spare_pictures
from wiw.runs.rows import drop_folders, to_json
from wiw.runs.run import find_stores, list_marks
from wiw.runs.scratch import make_local_folder
from wiw.runs.store import RunStore
from wiw.runs.store_file import lock_store, store_path
from wiw.runs.store_log import replace_store_file
from wiw.runs.verify import list_differences, read_facts
from wiw.world_models.base import Requirements

Key = tuple[str, int]
"""Arm and index of an episode."""
Repeat = tuple[Mapping[str, Any], Mapping[str, Any]]
"""Outcomes of an episode in two stores."""
_ABSENT = "absent"


@dataclass(frozen=True)
class Merged:
    """The result of `wiw.merge`; prints as a few lines."""

    run: Path
    stores: int
    ended: int
    """Number of finished episodes over all arms."""
    pending: Mapping[str, int]
    """By arm: number of episodes that no store has finished; arms without any are left out."""
    repeated: int
    """Number of episodes that several stores had, all with the same record."""
    unlike: tuple[str, ...]
    """Episodes that several stores had with different records, where equality is not guaranteed; the first was taken.
    E.g. "vlm episode 3: decision 0: note: recorded ..., now ...": the first difference."""
    undrawn: str = ""
    """Why scene maps and films could not be rendered here; empty if they were."""

    @property
    def complete(self) -> bool:
        """Whether every arm has finished every episode."""
        return not self.pending

    def __str__(self) -> str:
        lines = [f"{self.run}: {self.ended} episodes from {self.stores} store{'' if self.stores == 1 else 's'}"]
        if self.repeated:
            lines.append(f"{self.repeated} of them were in several stores, with equal records")
        if self.unlike:
            lines.append(f"{len(self.unlike)} were in several stores with different records; the first was taken:")
            lines += [f"  {text}" for text in self.unlike]
        if self.pending:
            left = ", ".join(f"{arm} {count}" for arm, count in self.pending.items())
            lines.append(f"episodes that no store has: {left}; run them with `wiw resume {self.run}`")
        if self.undrawn:
            lines.append(f"scene maps and films could not be rendered here: {self.undrawn}")
        return "\n".join(lines)


@dataclass(frozen=True)
class _Part:
    """A store to be merged, open only while it is read: a run may have more shards than a process may open files."""

    path: Path
    created: str
    benchmark: int
    info: Mapping[str, Any]

    @classmethod
    def of(cls, store: RunStore) -> _Part:
        return cls(store.path, store.created, store.benchmark, store.info)

    @property
    def folder(self) -> Path:
        return self.path.parent

    def open(self) -> RunStore:
        return RunStore.read(self.path)


def merge(stores: str | Path | Sequence[str | Path], out: str | Path, scratch: str | Path | None = None) -> Merged:
    """Merge the stores of shards, or of the same run in other places, into one run.

        wiw.merge(["/scratch/a/1", "/scratch/a/2"], out="runs/a")
        wiw.merge("runs/a", out="runs/whole")        # all stores in subfolders of runs/a

    An episode found in several stores is taken from the first that has finished it without an error. Their records must
    be equal if that is guaranteed (built-in parts without weights, on machines of the same kind); otherwise differing
    ones are counted. Stores may still be in use, and episodes may be missing: `wiw resume` runs these.

    A run at `out` that was merged from shards which are all among `stores` is replaced, unless it was resumed or judged
    since.

    Args:
        stores: folders with a store, or with subfolders that have one; a single one may be given by itself.
        out: folder of the merged run, on any disk; the store there is either complete or absent, or as it was.
        scratch: folder on a local disk in which it is written first; by default the system's temporary folder.

    Raises:
        ArgumentError: no folder is given.
        StoreError: no store; manifests that differ, naming the difference; different records of an episode for which
            equality is guaranteed; `out` already holds another run.
        FileError: `out` or `scratch` cannot be written.
    """
    parts = _read_parts(find_stores([stores] if isinstance(stores, str | Path) else stores))
    takes, repeated, unlike = _choose_sources(parts)
    with make_local_folder(scratch) as local, _choose_place(out, parts, local) as place:
        target = _begin_merged(place, parts, local)
        try:
            for part, episodes in zip(parts, takes, strict=True):
                with part.open() as source:
                    target.take_episodes(source, episodes)
            drop_spare_pictures(target)
            undrawn = _draw_pictures(target)
            left = {arm["name"]: len(target.pending(arm["name"])) for arm in target.config["arms"]}
        except BaseException:
            target.abandon()
            raise
        _close_merged(target, out)
    pending = {arm: count for arm, count in left.items() if count}
    return Merged(Path(out), len(parts), sum(map(len, takes)), pending, repeated, tuple(unlike), undrawn)


def _begin_merged(place: str | Path, parts: Sequence[_Part], local: Path) -> RunStore:
    """Create a merged run without any ended episode, open for writing."""
    created = min(part.created for part in parts)
    with parts[0].open() as first:
        return RunStore.create(
            place, first.config, _merge_info(parts), first.episodes(), local, created, first.wiw_version
        )


def _close_merged(target: RunStore, out: str | Path) -> None:
    """Write a merged run where it belongs.

    Raises:
        FileError: it cannot be written.
    """
    try:
        target.close()
    except (FileError, StoreError) as error:
        raise FileError(
            f"{out}: the merged run cannot be written ({error.__cause__ or error}); expected a writable folder with "
            "free space. The stores that were merged are as they were: make room, then merge them again"
        ) from error


@contextmanager
def _choose_place(out: str | Path, parts: Sequence[_Part], local: Path) -> Iterator[str | Path]:
    """Yield where to write a merged run: `out`, or a folder whose store then replaces an earlier merge at `out`.

    Raises:
        StoreError: the run at `out` has what the new one would lack, or is in use.
        FileError: it cannot be replaced.
    """
    if not RunStore.exists(out):
        yield out
        return
    path, new = store_path(out), local / "merged"
    with ExitStack() as locks:
        if find_network(path) is None:
            locks.callback(lock_store(path).close)
        _require_replaceable(out, parts)
        yield new
        replace_store_file(path, store_path(new))


def _require_replaceable(out: str | Path, parts: Sequence[_Part]) -> None:
    """Check that nothing of a merged run would be lost if its shards were merged again."""
    with RunStore.read(out) as old, parts[0].open() as first:
        info, marks = old.info, list_marks(old)
        is_of_shards = "merged" in info and _read_manifest(old) == _read_manifest(first)
    before = {(each["shard"], each["created"]) for each in info.get("merged", [])}
    now = {(part.info["shard"], part.created) for part in parts if part.info.get("shard") is not None}
    if not is_of_shards or not before <= now:
        why = "was not merged from these shards"
    elif "session" in info or not marks <= set().union(*map(_list_part_marks, parts)):
        why = "was resumed or judged since it was merged, of which its shards know nothing"
    else:
        return
    raise StoreError(
        f"{store_path(out)} already holds a run, which {why}; expected a folder without a run, or with one that was "
        "merged from the same shards: give another output folder"
    )


def _list_part_marks(part: _Part) -> set[tuple[str, str, int]]:
    with part.open() as store:
        return list_marks(store)


def _read_parts(folders: Sequence[Path]) -> list[_Part]:
    """Read what stores say of themselves, and check that they are of the same run.

    That is: versions, task, seed, arms, episodes, scenes, source files, measurements; agents and where it was stopped.

    Raises:
        StoreError: two differ; says which ones, and how.
    """
    parts, manifest = list[_Part](), dict[str, Any]()
    for folder in folders:
        with RunStore.read(folder) as store:
            own = _read_manifest(store)
            parts.append(_Part.of(store))
        manifest = manifest or own
        for place, here, there in _compare(manifest, own, ""):
            raise StoreError(
                f"{parts[0].folder} and {parts[-1].folder} are not from the same run: {place}: {_show(here)} and "
                f"{_show(there)}; expected stores of one command that differ only in --shard"
            )
    _require_one_stop(parts)
    _require_equal_agents(parts)
    return parts


def _require_equal_agents(parts: Sequence[_Part]) -> None:
    """Check that all stores that have begun an arm have built the same agent for it."""
    known: dict[str, tuple[Path, Any]] = {}
    for part in parts:
        for arm, agent in part.info.get("built", {}).items():
            folder, own = known.setdefault(arm, (part.folder, agent))
            for place, here, there in _compare(own, agent, f"agent {arm}"):
                raise StoreError(
                    f"{folder} and {part.folder} had different agents: {place}: {_show(here)} and "
                    f"{_show(there)}; expected the same weights and options everywhere"
                )


def _require_one_stop(parts: Sequence[_Part]) -> None:
    """Check that all stores that a rule has stopped were stopped at the same look; others may not have got there."""
    stopped = [part for part in parts if "stopped" in part.info]
    for other in stopped[1:]:
        here, there = stopped[0].info["stopped"], other.info["stopped"]
        if here != there:
            raise StoreError(
                f"{stopped[0].folder} and {other.folder} are of one run (--until) but stopped at different "
                f"looks: {here['why']}; and {there['why']}. Expected the same stop; find out which is right with "
                "`wiw verify`, and merge without the other"
            )


def _read_manifest(store: RunStore) -> dict[str, Any]:
    info = store.info
    episodes = [{**asdict(episode), "geodesic": None} for episode in store.episodes()]  # may be measured in one alone
    own = drop_folders({"task": store.config["task"], "episode": episodes})  # data may lie elsewhere on another machine
    limits = {name: info["limits"].get(name) for name in ("fidelity", "fidelity_share", "lpips")}
    files = {name: _by_file_name(info.get(name) or {}) for name in ("sources", "scenes")}
    versions = {"wiw": store.wiw_version, "benchmark": store.benchmark}
    return {**versions, **store.config, "salt": store.salt, **limits, **files, "until": info.get("until"), **own}


def _by_file_name(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is known of files by their names alone, in the order of their paths where several share one."""
    found: dict[str, list[Any]] = {}
    for path, known in facts.items():
        found.setdefault(drop_folders(path), []).append(drop_folders(known))
    return {name: known[0] if len(known) == 1 else known for name, known in found.items()}


def _compare(first: Any, second: Any, place: str) -> Iterator[tuple[str, Any, Any]]:
    """Return the places at which two manifests differ, with both values."""
    if isinstance(first, dict) and isinstance(second, dict):
        for name in dict.fromkeys([*first, *second]):
            inner = f"{place}.{name}" if place else str(name)
            yield from _compare(first.get(name, _ABSENT), second.get(name, _ABSENT), inner)
    elif isinstance(first, list | tuple) and isinstance(second, list | tuple) and len(first) == len(second):
        for index, (one, other) in enumerate(zip(first, second, strict=True)):
            yield from _compare(one, other, f"{place}[{index}]")
    elif first != second:
        yield place, first, second


def _show(value: Any, most: int = 120) -> str:
    text = to_json(value)
    return text if len(text) <= most else f"{text[: most - 1]}…"


def _choose_sources(parts: Sequence[_Part]) -> tuple[list[set[Key]], int, list[str]]:
    """Return the episodes to take from each store, the number of repeated ones, and those with unlike records."""
    found: dict[Key, list[tuple[int, Mapping[str, Any]]]] = {}
    for index, part in enumerate(parts):
        with part.open() as store:
            for outcome in store.recorded_outcomes():
                found.setdefault((outcome["arm"], outcome["episode"]), []).append((index, outcome))
    takes, repeats = [set[Key]() for _ in parts], dict[tuple[int, int], list[Repeat]]()
    for key, records in found.items():
        (first, row), *others = [record for record in records if record[1]["status"] == "done"] or records[:1]
        takes[first].add(key)
        for other, row_there in others:
            repeats.setdefault((first, other), []).append((row, row_there))
    repeated = {(row["arm"], row["episode"]) for rows in repeats.values() for row, _ in rows}
    differences = _list_differences(parts, repeats)
    return takes, len(repeated - differences.keys()), [differences[key] for key in found if key in differences]


def _list_differences(parts: Sequence[_Part], repeats: Mapping[tuple[int, int], Sequence[Repeat]]) -> dict[Key, str]:
    """Return the first difference between the records of each repeated episode that has several.

    Args:
        parts: the stores.
        repeats: by the places of two stores among these, the outcomes of the episodes to compare.

    Raises:
        StoreError: records differ although equality is guaranteed.
    """
    found: dict[Key, str] = {}
    for first, other in sorted(repeats):
        with parts[first].open() as store, parts[other].open() as store_there:
            for row, row_there in repeats[first, other]:
                if text := _find_difference(store, row, store_there, row_there):
                    found.setdefault((row["arm"], row["episode"]), text)
    return found


def _find_difference(
    store: RunStore, row: Mapping[str, Any], store_there: RunStore, row_there: Mapping[str, Any]
) -> str:
    """Return the first difference between two records of an episode; empty if they are equal.

    Raises:
        StoreError: they differ although equality is guaranteed.
    """
    facts, facts_there = read_facts(store, row), read_facts(store_there, row_there)
    text = next(list_differences(facts, facts_there), "")
    if text and _is_promised(store, row["arm"], facts) and store.info["platform"] == store_there.info["platform"]:
        raise StoreError(
            f"{row['arm']} episode {row['episode']} has different records in {store.path.parent} and "
            f"{store_there.path.parent}, although its parts guarantee equal ones on equal machines: {text}. Find out "
            "which is right with `wiw verify`, and merge without the other"
        )
    return f"{row['arm']} episode {row['episode']}: {text}" if text else ""


def _is_promised(store: RunStore, arm: str, facts: Sequence[tuple[str, Mapping[str, Any]]]) -> bool:
    """Return whether results are guaranteed to be equal on equal machines: built-in parts, no weights, no server."""
    task, agent = store.info["task"], store.info["agents"][arm]
    if task is None or agent is None or task["name"] not in TASKS.built_in:
        return False
    policies = [agent["policy"], *([agent["reviser"]] if agent["reviser"] else [])]
    asked = any(values.get("exchanges") for _, values in facts)
    return all(policy in POLICIES.built_in for policy in policies) and _needs_nothing(agent["model"]) and not asked


def _needs_nothing(model: str | None) -> bool:
    """Return whether a world model is built in and needs no packages, weights or servers."""
    if model is None:
        return True
    found = WORLD_MODELS.find(model) if model in WORLD_MODELS.built_in else None
    return isfunction(found) or (found is not None and found.requires == Requirements())


def _merge_info(parts: Sequence[_Part]) -> dict[str, Any]:
    """Return the first store's info for the whole run, with the origin of each part."""
    infos = [part.info for part in parts]
    named = ("shard", "platform", "command", "preparation_seconds", "session")
    info = {name: value for name, value in infos[0].items() if name not in ("shard", "session")}
    info["built"] = {arm: agent for own in reversed(infos) for arm, agent in own.get("built", {}).items()}
    info |= next(({"stopped": own["stopped"]} for own in infos if "stopped" in own), {})
    info["benchmark"] = parts[0].benchmark
    info["preparation_seconds"] = sum(own.get("preparation_seconds", 0.0) for own in infos)
    info["merged"] = [
        {"store": str(part.folder), "created": part.created, **{name: own.get(name) for name in named}}
        for part, own in zip(parts, infos, strict=True)
    ]
    return info


def _draw_pictures(store: RunStore) -> str:
    """Render maps and films as at the end of a run; return why that is impossible here, if so."""
    try:
        task, _ = read_recipes(store)
        draw_pictures(store, task.build())
    except Error as error:
        return str(error)
    return ""
