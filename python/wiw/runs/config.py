# SPDX-License-Identifier: Apache-2.0
"""The settings of a run, declared once: Python, the command line and the manifest read them here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from wiw.errors import ArgumentError
from wiw.ray_cluster import Engine
from wiw.runs.limits import Limits
from wiw.runs.shards import Shard
from wiw.types import check_seed


@dataclass(frozen=True, kw_only=True)
class EngineConfig(Engine):
    """The engine that runs the episodes, its place, and the servers of its own."""

    servers: Annotated[int, arg(metavar="N")] = 0
    """Servers of --world-model that all workers ask: actors of Ray, or jobs of `wiw submit`; none, and each worker has
    its own model, if not given."""
    server_gpus: Annotated[float, arg(metavar="N")] = 1
    """GPUs of such a server."""
    served: Annotated[str | None, arg(metavar="MODEL")] = None
    """World model of --arms that actors of Ray serve; --world-model if not given."""
    vlm_servers: Annotated[int, arg(metavar="N")] = 0
    """Servers of --vlm transformers:PATH (or mock), as actors of Ray; worker by worker they are taken in turn."""
    vlm_server_gpus: Annotated[float, arg(metavar="N")] = 1
    """GPUs of such a server."""


@dataclass(frozen=True, kw_only=True)
class RunConfig(Limits, EngineConfig):
    """How a run goes, whatever agents it compares. All randomness is keyed by (seed, episode, decision, candidate):
    neither `workers` nor `live` changes a result.

    Raises:
        ArgumentError: a number out of range.
    """

    episodes: Annotated[int | None, arg(metavar="N")] = None
    """Number of episodes; the task's own if not given: all of an episode file, else 20; for manipulation 50 of each of
    its tasks."""
    seed: Annotated[int | None, arg(metavar="N")] = None
    """Seed of all randomness; the task's own, 0, if not given."""
    salt: Annotated[str | None, arg(metavar="TEXT")] = None
    """Secret under which policies and models get keys and seeds, so that these do not tell which episode it is. Drawn
    and kept in the store if not given; give the same one to all shards, and to runs whose random draws are to be equal.
    Empty: keys are seed and index."""
    out: Annotated[Path | str | None, arg(metavar="DIR")] = None
    """Folder of the run; runs/TASK-TIME if not given."""
    workers: Annotated[int, arg(metavar="N")] = 1
    """Processes; results do not depend on it. More than one needs names, or a task and agent that can be pickled."""
    live: Annotated[int, arg(metavar="N")] = 4
    """Episodes kept live at a time in a process, so that model calls are batched."""
    keep_images: Annotated[int | Literal["all"], arg(metavar="N|all")] = 2
    """Episodes that keep pictures for report and view, of manipulation one of each task at least; all: every one, at
    0.2 MB per decision."""
    until: Annotated[str | None, arg(metavar="RULE")] = None
    """Stop early, once "A-B excludes 0" (a difference of SR between two arms is shown) or "width<8" (every arm's SR is
    known to so many points; or width(A), width(A-B)), by intervals that allow for looking; --episodes is the most."""
    look_every: Annotated[int, arg(metavar="N")] = 20
    """Episodes per arm between two looks of --until."""
    shard: Annotated[str | None, arg(metavar="I/N")] = None
    """Part I of N of the episodes, in a store of its own; `wiw merge` makes one run of the stores of all parts."""
    scratch: Annotated[Path | str | None, arg(metavar="DIR")] = None
    """Folder on a local disk, such as /tmp, where the store is written while the run goes on; it is copied to --out
    every minute and at the end. Needed where --out is on a network file system. auto: the system's own for temporary
    files, or the job's."""
    resume: bool = False
    """Whether to resume the run in `out`, if one is there."""
    progress: bool = True
    """Whether to show progress bars."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, least in (("episodes", 1), ("workers", 1), ("live", 1), ("keep_images", 0), ("look_every", 1)):
            value = getattr(self, name)
            if isinstance(value, int) and value < least:
                raise ArgumentError(f"evaluate: expected {name} of at least {least}, got {value}")
        if self.seed is not None:
            check_seed(self.seed)
        self.require_valid("evaluate")
        for name in ("servers", "server_gpus", "vlm_servers", "vlm_server_gpus"):
            if getattr(self, name) < 0:
                raise ArgumentError(f"evaluate: expected {name} of at least 0, got {getattr(self, name)}")
        self._require_use()
        if self.shard is not None:
            Shard.parse(self.shard)
        if self.until is not None and self.episodes is None:
            raise ArgumentError(
                "evaluate: until needs the most episodes that the run may have: give --episodes (episodes=)"
            )
        if self.until is not None and self.shard is not None:
            raise ArgumentError("evaluate: a shard sees too little of a run to stop it: until cannot be had with shard")

    def _require_use(self) -> None:
        """Check that no setting is given that the others leave without use."""
        if self.engine != "ray" and self.vlm_servers:
            raise ArgumentError("evaluate: vlm_servers are for engine ray: give --engine ray (engine=)")
        if self.served is not None and not self.servers:
            raise ArgumentError("evaluate: served is the model that servers have: say how many by --servers (servers=)")
        if self.cache == "off" and self.cache_gb != RunConfig.cache_gb:
            raise ArgumentError("evaluate: cache_gb bounds the cache of rollouts, which is off: leave one of them out")
        if self.fidelity_share != RunConfig.fidelity_share and not self.measures_fidelity:
            raise ArgumentError("evaluate: fidelity_share needs something to measure: give --fidelity (fidelity=True)")
        if self.look_every != RunConfig.look_every and self.until is None:
            raise ArgumentError("evaluate: look_every is between looks of a rule: give --until (until=)")

    @property
    def looks(self) -> dict[str, Any] | None:
        """Rule and number of episodes between looks, as the run store keeps them; None where nobody looks."""
        return None if self.until is None else {"rule": self.until, "every": self.look_every}

    @property
    def place(self) -> EngineConfig:
        """The engine that runs the episodes, and its place."""
        return EngineConfig(**{field.name: getattr(self, field.name) for field in fields(EngineConfig)})

    def count_pictured(self, episodes: int) -> int:
        """Return how many of a run's episodes keep pictures."""
        return episodes if isinstance(self.keep_images, str) else self.keep_images


@dataclass(frozen=True, kw_only=True)
class ResumeConfig:
    """Settings of `RunConfig` that a run may be resumed with in place of its own, from then on; None keeps its own.

    No score depends on them. What scores or measurements depend on stays as the run was begun.

    Raises:
        ArgumentError: a number out of range.
    """

    live: Annotated[int | None, arg(metavar="N")] = None
    """Episodes kept live at a time in a process, as in `wiw run`; the run's own number if not given."""
    deadline: Annotated[float | None, arg(metavar="SECONDS")] = None
    """Most seconds for a call of the world model; the run's own if not given."""
    cache: Annotated[str | Path | None, arg(metavar="auto|off|DIR")] = None
    """Where rollouts are cached, as in `wiw run`; where the run caches them if not given."""
    cache_gb: Annotated[float | None, arg(metavar="N")] = None
    """Most gigabytes of that folder; the run's own if not given."""

    def __post_init__(self) -> None:
        self.to_json()  # RunConfig checks the numbers

    def to_json(self) -> dict[str, Any]:
        """Return the settings that are given, as the run store keeps them."""
        changes = {name: value for name, value in vars(self).items() if value is not None}
        config = RunConfig(**changes)
        recorded = {**config.to_json(), "live": config.live}
        return {name: recorded[name] for name in changes}


def read_resume_settings(settings: Mapping[str, Any]) -> ResumeConfig:
    """Return settings by name as a `ResumeConfig`.

    Raises:
        ArgumentError: one that is fixed once a run is begun.
    """
    names = [field.name for field in fields(ResumeConfig)]
    if fixed := [name for name in settings if name not in names]:
        raise ArgumentError(
            f"resume: '{fixed[0]}' stays as the run was begun; expected settings among workers, {', '.join(names)}, on "
            "which no score depends. For another value start a new run"
        )
    return ResumeConfig(**settings)


def take_settings(
    config: RunConfig | None, settings: Mapping[str, Any], episodes: int | None = None
) -> tuple[RunConfig, dict[str, Any]]:
    """Split settings into those of `RunConfig`, which replace the config's values, and the others."""
    names = {field.name for field in fields(RunConfig)}
    own = {name: value for name, value in settings.items() if name in names}
    own |= {} if episodes is None else {"episodes": episodes}
    others = {name: value for name, value in settings.items() if name not in names}
    return replace(config or RunConfig(), **own), others
