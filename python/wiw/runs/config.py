# SPDX-License-Identifier: Apache-2.0
"""The settings of a run, declared once: Python, the command line and the manifest read them here."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from wiw.errors import ArgumentError
from wiw.ray_cluster import Engine
from wiw.runs.limits import Limits
from wiw.runs.shards import Shard
from wiw.typed_values import require_types
from wiw.types import check_seed


def name_folder(kind: str) -> Path:
    """Return a new run's folder: what is run, when, and random digits, for runs may begin in the same second."""
    return Path("runs") / f"{kind}-{datetime.now():%Y%m%d-%H%M%S}-{secrets.token_hex(2)}"


@dataclass(frozen=True, kw_only=True)
class EngineConfig(Engine):
    """The engine that runs the episodes, where it runs, and its servers."""

    servers: Annotated[int, arg(metavar="N")] = 0
    """Number of servers of --world-model that all workers share: Ray actors, or jobs of `wiw submit`. With 0 each
    worker has its own model."""
    server_gpus: Annotated[float, arg(metavar="N")] = 1
    """GPUs per server."""
    served: Annotated[str | None, arg(metavar="MODEL")] = None
    """World model of --arms that Ray actors serve. Default: --world-model."""
    vlm_servers: Annotated[int, arg(metavar="N")] = 0
    """Number of servers of --vlm transformers:PATH (or mock) that all workers share: Ray actors, or jobs of `wiw
    submit`."""
    vlm_server_gpus: Annotated[float, arg(metavar="N")] = 1
    """GPUs per server."""


@dataclass(frozen=True, kw_only=True)
class RunConfig(Limits, EngineConfig):
    """Settings of a run, independent of the agents it compares. All randomness is keyed by (seed, episode, decision,
    candidate): neither `workers` nor `live` changes a result.

    Raises:
        ArgumentError: a number out of range.
    """

    episodes: Annotated[int | None, arg(metavar="N")] = None
    """Number of episodes. Default: the task's, which is all of an episode file, or else 20; for manipulation 50 of each
    of its tasks."""
    seed: Annotated[int | None, arg(metavar="N")] = None
    """Seed of all randomness. Default: the task's, 0."""
    salt: Annotated[str | None, arg(metavar="TEXT")] = None
    """Secret from which the keys and seeds given to policies and models are derived, so that they do not reveal which
    episode it is. Default: random, and kept in the store. Give the same one to all shards, and to runs that are to
    share their random draws. Empty: keys are seed and index."""
    out: Annotated[Path | str | None, arg(metavar="DIR")] = None
    """Folder of the run. Default: runs/TASK-TIME-XXXX."""
    workers: Annotated[int, arg(metavar="N")] = 1
    """Number of processes; results do not depend on it. More than one requires a task and agent that are given by name
    or can be pickled."""
    live: Annotated[int, arg(metavar="N")] = 4
    """Episodes that run at the same time in each process, so that model calls are batched."""
    keep_images: Annotated[int | Literal["all"], arg(metavar="N|all")] = 2
    """Number of episodes that keep images for report and view, in manipulation at least one per task; all: every
    episode, at 0.2 MB per decision."""
    until: Annotated[str | None, arg(metavar="RULE")] = None
    """Stop early, once "A-B excludes 0" (a difference in SR between two arms is shown) or "width<8" (every arm's SR is
    known to within so many points; or width(A), width(A-B)), using intervals that stay valid under repeated looks;
    --episodes is the maximum."""
    look_every: Annotated[int, arg(metavar="N")] = 20
    """Episodes per arm between two looks of --until."""
    shard: Annotated[str | None, arg(metavar="I/N")] = None
    """Run part I of N of the episodes, in a separate store; `wiw merge` combines the stores of all parts into one
    run."""
    scratch: Annotated[Path | str | None, arg(metavar="DIR")] = None
    """Folder on a local disk, such as /tmp, where the store is written during the run; it is copied to --out every
    minute and at the end. Needed if --out is on a network file system. auto: the temporary folder of the system or the
    job."""
    resume: bool = False
    """Whether to resume the run in `out`, if there is one."""
    progress: bool = True
    """Whether to show progress bars."""

    def __post_init__(self) -> None:
        require_types("evaluate", self)
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
            raise ArgumentError("evaluate: until requires a maximum number of episodes: give --episodes (episodes=)")
        if self.until is not None and self.shard is not None:
            raise ArgumentError(
                "evaluate: a shard sees only part of a run and cannot stop it: give until or shard, not both"
            )

    def _require_use(self) -> None:
        """Check that every given setting has an effect."""
        if self.served is not None and not self.servers:
            raise ArgumentError(
                "evaluate: served is the model that servers run: give their number with --servers (servers=)"
            )
        if self.cache == "off" and self.cache_gb != RunConfig.cache_gb:
            raise ArgumentError("evaluate: cache_gb limits the rollout cache, but cache is off: leave one of them out")
        if self.fidelity_share != RunConfig.fidelity_share and not self.measures_fidelity:
            raise ArgumentError("evaluate: fidelity_share requires fidelity: give --fidelity (fidelity=True)")
        if self.look_every != RunConfig.look_every and self.until is None:
            raise ArgumentError("evaluate: look_every requires a stopping rule: give --until (until=)")

    @property
    def looks(self) -> dict[str, Any] | None:
        """Rule and number of episodes between looks, as stored in the run; None without a rule."""
        return None if self.until is None else {"rule": self.until, "every": self.look_every}

    @property
    def place(self) -> EngineConfig:
        """The engine that runs the episodes, and where it runs."""
        return EngineConfig(**{field.name: getattr(self, field.name) for field in fields(EngineConfig)})

    def count_pictured(self, episodes: int) -> int:
        """Return how many of a run's episodes keep images."""
        return episodes if isinstance(self.keep_images, str) else self.keep_images


@dataclass(frozen=True, kw_only=True)
class ResumeConfig:
    """Settings of `RunConfig` that may be changed when a run is resumed; None keeps the run's own.

    No score depends on them. Everything that scores or measurements depend on stays as when the run was started.

    Raises:
        ArgumentError: a number out of range.
    """

    live: Annotated[int | None, arg(metavar="N")] = None
    """Episodes that run at the same time in each process, as in `wiw run`. Default: as before."""
    deadline: Annotated[float | None, arg(metavar="SECONDS")] = None
    """Time limit in seconds for a call to the world model. Default: as before."""
    stall: Annotated[float | None, arg(metavar="SECONDS")] = None
    """Time in seconds without news after which a worker is stopped as hung, as in `wiw run`. Default: as before."""
    cache: Annotated[str | Path | None, arg(metavar="auto|off|DIR")] = None
    """Where rollouts are cached, as in `wiw run`. Default: as before."""
    cache_gb: Annotated[float | None, arg(metavar="N")] = None
    """Maximum size of that folder in gigabytes. Default: as before."""

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
        ArgumentError: one that is fixed once a run has started.
    """
    names = [field.name for field in fields(ResumeConfig)]
    if fixed := [name for name in settings if name not in names]:
        raise ArgumentError(
            f"resume: '{fixed[0]}' is fixed once a run has started; expected settings among workers, "
            f"{', '.join(names)}, on which no score depends. For another value start a new run"
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
