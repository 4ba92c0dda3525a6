# SPDX-License-Identifier: Apache-2.0
"""Runs the episodes of a run store that have not ended, in this process or in workers, and records them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from wiw.errors import Error, InfrastructureError, StoreError, read_last_line
from wiw.runs.config import EngineConfig
from wiw.runs.films import film_episodes
from wiw.runs.pictures import drop_spare_pictures
from wiw.runs.progress import ArmProgress, Board, Tracker, make_board
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.rows import AgentRow, DecisionRow, LostRow, RestartRow, to_json
from wiw.runs.scene_map import draw_scene_maps
from wiw.runs.sources import file_exists, require_sources
from wiw.runs.store import RunStore
from wiw.runs.workers import Job, Row, WorkerSpec, run_here, run_in_workers
from wiw.types import Episode, EpisodeResult


class Look(Protocol):
    """Findings of a look at a run that continues; its string form is a sentence."""

    @property
    def is_enough(self) -> bool:
        """Whether the run has shown enough, and stops."""


class Looks(Protocol):
    """A rule for stopping a run early; see `wiw.analysis.stopping`."""

    def list_bounds(self, episodes: int) -> Iterable[int]:
        """Return the numbers of episodes at which to look, the last being all."""

    def look(self, bound: int, episodes: Sequence[Episode], outcomes: Sequence[Mapping[str, Any]]) -> Look:
        """Return what the first `bound` episodes show."""


PROCESSES = EngineConfig()
"""Processes of this machine."""


def read_recipes(store: RunStore) -> tuple[TaskRecipe, dict[str, AgentRecipe]]:
    """Return the recipes of a run's task and agents.

    Raises:
        StoreError: the run was started with objects that existed only in memory.
    """
    info = store.info
    if info["task"] is None or None in info["agents"].values():
        raise StoreError(
            f"{store.path} was started with objects in memory, which cannot be rebuilt here. To continue it, call the "
            "same wiw.evaluate(..., out=..., resume=True) again. To resume it from elsewhere, to verify it or to blame "
            "its failures, start it by names: wiw.evaluate('imagenav', AgentRecipe('matcher', 'warp')) of "
            "wiw.runs.recipes, or `wiw run`"
        )
    return TaskRecipe(**info["task"]), {arm: AgentRecipe.from_json(recipe) for arm, recipe in info["agents"].items()}


def sources_of(task: Any, agents: Mapping[str, Any]) -> dict[str, str]:
    """Return digests, by path, of the user's own source files that a run of these recipes depends on."""
    found = dict(task.sources())
    for recipe in agents.values():
        found |= recipe.sources()
    return found


def require_own_sources(store: RunStore, task: Any, agents: Mapping[str, Any]) -> None:
    """Check that the user's own source files are those the run began with; close the store where they have changed.

    Raises:
        StoreError: a file has changed since.
    """
    _require_sources(store, store.info.get("sources"), sources_of(task, agents))


def update_own_sources(store: RunStore, task: Any, agents: Mapping[str, Any]) -> None:
    """Store the user's own source files as they are now, before a run continues; close the store where it must not.

    Files that no ended episode was run with may have changed: a model that could not be made is mended, and the run
    resumes.

    Raises:
        StoreError: a file that ended episodes were run with has changed since.
    """
    begun_with, now = store.info.get("sources"), sources_of(task, agents)
    if begun_with is None or begun_with == now:
        return
    ended = {row["arm"] for row in store.recorded_outcomes() if row["status"] == "done"}
    fixed = sources_of(task, {arm: recipe for arm, recipe in agents.items() if arm in ended})
    kept = {path: digest for path, digest in begun_with.items() if path in fixed or not file_exists(path)}
    _require_sources(store, kept if ended else None, fixed)
    store.change_sources(now)


def _require_sources(store: RunStore, begun_with: Mapping[str, str] | None, now: Mapping[str, str]) -> None:
    try:
        require_sources(store.path.parent, begun_with, now)
    except StoreError:
        store.close()
        raise


def require_left(task: Any, store: RunStore, arms: Iterable[str], retry_errors: bool = False) -> None:
    """Check that a run's remaining episodes will use the same scenes and source files as the others."""
    episodes = store.episodes()
    try:
        require_scenes(task, store, [episodes[i] for arm in arms for i in store.pending(arm, retry_errors)])
    except Error:
        store.close()
        raise


def require_scenes(task: Any, store: RunStore, episodes: Iterable[Episode]) -> None:
    """Check that the scenes of these episodes are the ones that the run began with.

    Raises:
        FileError: a scene does not exist.
        StoreError: what belongs to a scene has come or gone.
    """
    kept = store.info.get("scenes", {})
    used = task.require(episodes)
    store.require_same({scene: kept[scene] for scene in used if scene in kept}, used if kept else {})


def run_pending(
    store: RunStore,
    task: Any,
    agents: Mapping[str, Any],
    pending: Mapping[str, list[int]],
    workers: int,
    progress: bool,
    place: EngineConfig = PROCESSES,
    looks: Looks | None = None,
) -> None:
    """Run the pending episodes of each arm and close the store; with looks, until what they find is enough."""
    info = store.info
    episodes = store.episodes()
    pictures = frozenset(info["pictures"])
    seed, sources = store.config["seed"], info.get("sources", {})
    spec = WorkerSpec(task, agents, seed, store.salt, info["live"], pictures, info["limits"], episodes, sources)
    board = make_board(progress and any(pending.values()))
    try:
        for arm, indices in pending.items():
            store.discard(arm, indices)
        if any(pending.values()):  # now: errors that are tried again have not ended
            store.begin_session()
        built = task.build()
        writer = _StoreWriter(store, Tracker(_count_ended(store, pending), built.decisions, board))
        for batch in _split_by_looks(store, episodes, pending, looks, board):
            _run_jobs(spec, episodes, batch, writer, workers, place)
        if store.shard is None:
            drop_spare_pictures(store)
            draw_pictures(store, built)
    finally:
        board.close()
        store.close()


def _split_by_looks(
    store: RunStore, episodes: list[Episode], pending: Mapping[str, list[int]], looks: Looks | None, board: Board
) -> Iterator[Mapping[str, list[int]]]:
    """Yield the pending episodes that are to be run before the next look, until a look finds enough."""
    if looks is None:
        yield pending
        return
    begin = 0
    for bound in looks.list_bounds(len(episodes)):
        yield {arm: [index for index in left if begin <= index < bound] for arm, left in pending.items()}
        look = looks.look(bound, episodes, store.outcomes())
        board.note(f"{look}{', so the run stops' if look.is_enough else ''}")
        if look.is_enough:
            store.stop_after(bound, str(look))
            return
        begin = bound


def draw_pictures(store: RunStore, task: Any) -> None:
    """Draw scenes and films of the episodes that have pictures.

    For a shard that is done once it is merged: these episodes are chosen among those of all shards.
    """
    draw_scene_maps(store, task)
    film_episodes(store, task)


def _count_ended(store: RunStore, pending: Mapping[str, list[int]]) -> dict[str, ArmProgress]:
    """Return how far each arm is, so that a run that goes on counts from where it was stopped."""
    found = {arm: ArmProgress(len(indices)) for arm, indices in pending.items()}
    for row in store.outcomes():
        if row["arm"] in found:
            found[row["arm"]].count(row["status"], row["metrics"])
    for progress in found.values():
        progress.total += progress.ended
    return found


def _run_jobs(
    spec: WorkerSpec,
    episodes: list[Episode],
    pending: Mapping[str, list[int]],
    writer: _StoreWriter,
    workers: int,
    place: EngineConfig,
) -> None:
    """Run the pending episodes of each arm by the engine that `place` names."""
    if not any(pending.values()):
        return
    if place.engine == "ray":
        from wiw.runs.ray_engine import run_on_ray

        groups = {arm: _group_by_scene(left, episodes, spec.live) for arm, left in pending.items()}
        run_on_ray(spec, _make_jobs(spec, episodes, groups, workers), writer, workers, place)
        return
    jobs = _make_jobs(spec, episodes, {arm: [left] for arm, left in pending.items()}, workers)
    if workers == 1:
        run_here(spec, jobs, writer)
    else:
        run_in_workers(spec, jobs, writer, workers)


def _make_jobs(
    spec: WorkerSpec, episodes: Sequence[Episode], groups: Mapping[str, Sequence[Sequence[int]]], workers: int
) -> list[Job]:
    """Make jobs of the episodes of each arm, none of which has episodes of two groups."""
    jobs = []
    for arm, own in groups.items():
        count = sum(map(len, own))
        size = max(1, count) if workers == 1 else max(spec.live, math.ceil(count / (3 * workers)))
        for group in own:
            parts = (group[first : first + size] for first in range(0, len(group), size))
            jobs += [Job(arm, tuple((index, episodes[index]) for index in part)) for part in parts]
    return jobs


def _group_by_scene(indices: Iterable[int], episodes: Sequence[Episode], least: int) -> list[list[int]]:
    """Return the episodes scene by scene; scenes with fewer than `least` share a group, so that calls stay batched."""
    scenes: dict[str, list[int]] = {}
    for index in indices:
        scenes.setdefault(episodes[index].scene, []).append(index)
    groups: list[list[int]] = []
    for own in scenes.values():
        if groups and len(groups[-1]) < least:
            groups[-1].extend(own)
        else:
            groups.append(own)
    return groups


SAME_ERRORS = 5
"""Number of equal errors at the beginning of an arm that stop a run."""


class _StoreWriter:
    """Writes rows to the store and updates the progress bars."""

    def __init__(self, store: RunStore, tracker: Tracker) -> None:
        self._store, self._tracker = store, tracker
        self._known: dict[str, str] = {}
        """By arm: what its agent says of itself, as JSON."""
        self._first_errors: dict[str, list[str] | None] = {}
        """By arm: last lines of its errors; None once an episode has ended without one."""

    def write(self, row: Row) -> None:
        if isinstance(row, AgentRow):
            self._write_agent(row)
            return
        if isinstance(row, RestartRow):
            self.discard(row.arm, row.episodes)
            return
        if isinstance(row, LostRow):
            self._store.write_lost(row)
            return
        self._store.write(row)
        if isinstance(row, DecisionRow):
            self._tracker.decision(row.arm, row.episode)
        else:
            self._tracker.episode(row.arm, row.result)
            self._check_repeated_errors(row.arm, row.result)

    def _write_agent(self, row: AgentRow) -> None:
        """Store what an agent says of itself, and hold to it the agents that other workers build for the same arm.

        Raises:
            StoreError: it says otherwise, such as one of other weights.
        """
        said = to_json(row.agent)
        if self._known.get(row.arm) == said:
            return
        try:
            self._store.write_agent(row)
        except StoreError as error:
            if row.arm not in self._known:
                raise
            raise StoreError(
                f"arm '{row.arm}': expected the same agent from every worker, got different ones: {error}. Files, "
                "weights and packages must be the same on all machines, and stay so during a run"
            ) from error
        self._known[row.arm] = said

    def discard(self, arm: str, episodes: Iterable[int]) -> None:
        episodes = list(episodes)
        self._store.discard(arm, episodes)
        for episode in episodes:
            self._tracker.forget(arm, episode)

    def note(self, text: str) -> None:
        self._tracker.note(text)

    def _check_repeated_errors(self, arm: str, result: EpisodeResult) -> None:
        """Stop a run whose arm begins with the same error several times: a mistake in the set-up, not bad luck."""
        if result.status == "done":
            self._first_errors[arm] = None
        errors = self._first_errors.setdefault(arm, [])
        if errors is None:
            return
        errors.append(read_last_line(result.error))
        if len(errors) == SAME_ERRORS and len({error.partition(":")[0] for error in errors}) == 1:
            raise InfrastructureError(
                f"the first {SAME_ERRORS} episodes of arm '{arm}' all ended with the same error, so the run was "
                f"stopped: {errors[0]}. Fix the cause, then `wiw resume --retry-errors`; the tracebacks are in the run "
                "store"
            )
