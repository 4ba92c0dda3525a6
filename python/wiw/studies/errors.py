# SPDX-License-Identifier: Apache-2.0
"""Study which kinds of error cost success: degrade true futures by known doses, and measure success.

The paper finds that success follows controllability rather than visual quality, over a dozen models that differ in both
and in everything else. Here one thing is changed at a time in otherwise true futures, so that a loss of success is due
to that error and nothing else (`wiw.experiments.errors`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from wiw.analysis.errors import ErrorTable, summarise_errors
from wiw.errors import ArgumentError, StoreError
from wiw.experiments.errors.kinds import ERRORS
from wiw.loop import keys
from wiw.metrics import Lpips
from wiw.registry import task_class
from wiw.runs.recipes import ERROR, AgentRecipe, TaskRecipe
from wiw.runs.rows import to_json
from wiw.runs.shards import Shard
from wiw.runs.store import RunStore
from wiw.studies.evaluate import evaluate
from wiw.types import PRIMITIVES

TASKS = ("imagenav", "ar", "aeqa", "manipulation")
FLOOR, CEILING = "none", "oracle"
"""Arms in addition to those with errors: no imagination, and true futures."""
BLOCK = 8
"""Episodes in one part of a run; every arm finishes a part before the next part begins."""

Watch = Callable[[str, int, int, str], None]
"""Called with what is being done, how much is done, out of how much, and a text."""


@dataclass(frozen=True, kw_only=True)
class ErrorSettings:
    """The user's settings of the study.

    Raises:
        ArgumentError: a number out of range, or an unknown task or kind of error.
    """

    tasks: tuple[str, ...] = TASKS
    kinds: tuple[str, ...] = tuple(ERRORS)
    """Kinds of errors; those that make no sense in a task are skipped there, and listed."""
    doses: int = 3
    """Number of doses of each kind, counted from the largest of `FutureError.doses`."""
    episodes: int = 100
    """Episodes of each task."""
    seed: int = 0
    scenes: str | None = None
    """Scenes of tasks in which an agent walks; None means the task's default."""
    per_scene: int = 2
    """Episodes per scene, for tasks in which an agent walks."""
    preset: str | None = None
    """Preset of the tasks, as a name or the path of a YAML file (`wiw.tasks.presets`); None means each task's
    default."""
    tier: str | None = None
    """Tier of Image-Goal Navigation: near, far, beyond, or all; None means episodes without a tier."""
    policy: str | None = None
    """Policy; None means the preset's, or else the task's."""
    size: tuple[int, int] | None = None
    """Height and width of the oracle's frames; None means its default."""
    fidelity_share: float = 0.25
    """Share of the decisions at which frames and scores are compared with the true ones."""

    def __post_init__(self) -> None:
        for name, known in (("tasks", TASKS), ("kinds", tuple(ERRORS))):
            given = getattr(self, name)
            if not given or len(set(given)) < len(given) or not set(given) <= set(known):
                raise ArgumentError(f"errors: expected different {name} among {', '.join(known)}, got {list(given)}")
        if not 1 <= self.doses <= 3 or min(self.episodes, self.per_scene) < 1:
            raise ArgumentError(
                f"errors: expected 1 to 3 doses and 1 or more episodes, in all and in a scene, got {self.doses}, "
                f"{self.episodes} and {self.per_scene}"
            )
        if self.tier is not None and self.tasks != ("imagenav",):
            raise ArgumentError(f"errors: expected imagenav alone for a tier, got {', '.join(self.tasks)}")

    def find_policy(self, task: str) -> str:
        """Return the name of the policy that runs a task.

        Raises:
            ArgumentError: the task has no such preset.
        """
        return self.policy or TaskRecipe(task, {"preset": self.preset}).find_policy()

    def list_arms(self, task: str) -> dict[str, tuple[str, float]]:
        """Return the kind and dose of each of a task's arms that have an error."""
        space = task_class(task).space
        found = [(kind, dose) for kind in self.kinds for dose in ERRORS[kind].doses.get(space, ())[-self.doses :]]
        return {f"{ERROR}{kind}@{dose:g}": (kind, dose) for kind, dose in found}

    def list_left_out(self, task: str) -> list[str]:
        """Return the kinds of error that make no sense in a task."""
        chosen = {kind for kind, _ in self.list_arms(task).values()}
        return [kind for kind in self.kinds if kind not in chosen]


FULL = ErrorSettings()
SMALL = ErrorSettings(
    tasks=("imagenav",), kinds=("blur", "flicker", "ignored", "moved"), doses=2, episodes=8, size=(144, 256)
)
"""A small version that takes about three minutes on two cores."""


@dataclass(frozen=True)
class ErrorStudy:
    """The result of `wiw.study_errors`."""

    tables: tuple[ErrorTable, ...]
    """One table per task."""
    settings: ErrorSettings
    out: Path
    """Folder of the study, which `save` writes into."""

    def summary(self) -> None:
        """Print the tables and findings."""
        from wiw.report.error_tables import print_errors

        print_errors(self.tables)

    def to_json(self) -> str:
        """Return the numbers as JSON."""
        found = {"settings": asdict(self.settings), "tasks": [asdict(table) for table in self.tables]}
        return json.dumps(json.loads(to_json(found)), indent=2)

    def save(self) -> list[Path]:
        """Write errors.html, .svg, .png and .json into `out`, and return their paths."""
        from wiw.report.error_page import write_errors

        return write_errors(self.tables, asdict(self.settings), self.to_json(), self.out)


def study_errors(
    out: str | Path = "runs/errors",
    settings: ErrorSettings = FULL,
    *,
    workers: int = 1,
    lpips: str | Path | None = None,
    distances: str | Path | None = None,
    watch: Watch = lambda *_: None,
) -> ErrorStudy:
    """Run the oracle with errors of known doses on the same episodes, and measure what each costs.

        found = wiw.study_errors("runs/errors", workers=4)
        found.summary()
        found.save()

    The same call continues where an earlier one was stopped, episode by episode; with more kinds, doses or tasks it
    adds them. The runs are ordinary ones, each with a part of the episodes: `wiw merge runs/errors/imagenav` combines
    them, `wiw report` and `wiw view` show the result.

    Args:
        out: folder of the study, with a folder of runs for each task.
        settings: tasks, errors, doses and episodes; `wiw.studies.errors.SMALL` is the small version.
        workers: number of processes; results do not depend on it.
        lpips: folder of the weights of LPIPS, or "auto", to measure it besides PSNR and SSIM.
        distances: folder of another study, from which to take distances and regret, as in `read_errors`.
        watch: called with progress.

    Raises:
        ArgumentError: a number out of range, or a policy that does not fit a task.
        StoreError: the folder holds a study with other settings, or `distances` one of another agent.
        WeightsError: those of LPIPS are missing.
    """
    if lpips is not None:
        Lpips(lpips)  # fails before anything takes time
    if distances is not None:
        for task in settings.tasks:
            _list_others(task, distances)  # likewise
    folder = Path(out)
    tables = []
    for task in settings.tasks:
        parts = _run_task(task, settings, folder / task, workers, lpips, watch)
        table = _read_task(task, settings, parts, _list_measured(task, parts, distances))
        if table is None:
            raise StoreError(
                f"errors: nothing can be compared in {folder / task}: no episode of {FLOOR}, {CEILING} or of any arm "
                "with an error was scored; `wiw status` on the folders there says why"
            )
        tables.append(table)
    return ErrorStudy(tuple(tables), settings, folder)


def read_errors(out: str | Path, settings: ErrorSettings = FULL, *, distances: str | Path | None = None) -> ErrorStudy:
    """Return the study in a folder, as far as it has progressed, without running anything.

    Success needs many episodes, but distances, above all LPIPS, are slow to measure and are known from few. Measure
    them in a second study of the same episodes, with a `fidelity_share` of 1, and name it in `distances`.

    Args:
        out: folder of the study.
        settings: tasks, kinds and doses to show; everything else is as the study was started. Tasks in which no arm
            with an error has finished an episode are left out.
        distances: folder of another study of the same tasks by the same agent, from which distances and regret are
            taken instead.

    Raises:
        StoreError: no task has such an arm, or `distances` is a study of another agent or lacks a task.
    """
    folder = Path(out)
    tables = []
    for task in settings.tasks:
        parts = _list_parts(folder / task)
        tables.append(_read_task(task, settings, parts, _list_measured(task, parts, distances) if parts else []))
    found = tuple(table for table in tables if table is not None)
    if not found:
        raise StoreError(
            f"errors: {folder} has no episode of an arm with an error so far (tasks {', '.join(settings.tasks)}, "
            f"errors {', '.join(settings.kinds)}); run the study without --read-only, or name its folder with --out"
        )
    return ErrorStudy(found, _recall_settings([table.task for table in found], settings, folder), folder)


def _recall_settings(tasks: Sequence[str], settings: ErrorSettings, folder: Path) -> ErrorSettings:
    """Return the settings that the runs of these tasks were started with; kinds and doses are the given ones."""
    with RunStore.read(_list_parts(folder / tasks[0])[0]) as store:
        info, seed, episodes = store.info, store.config["seed"], len(store.episodes())
    options, agent = info["task"]["options"], info["agents"][CEILING]
    size = agent["model_options"].get("size")
    recalled = replace(
        settings,
        tasks=tuple(tasks),
        episodes=episodes,
        seed=seed,
        scenes=options.get("scenes"),
        per_scene=options.get("per_scene", settings.per_scene),
        preset=options.get("preset"),
        tier=options.get("tier") if len(tasks) == 1 else None,
        policy=None,
        size=None if size is None else tuple(size),
        fidelity_share=info["limits"]["fidelity_share"],
    )
    own = agent["policy"]
    return recalled if own == recalled.find_policy(tasks[0]) else replace(recalled, policy=own)


def _list_parts(folder: Path) -> list[Path]:
    """Return the existing folders of a task's runs."""
    return sorted(path.parent for path in folder.glob("shard-*-of-*/run.sqlite"))


def _list_others(task: str, study: str | Path) -> list[Path]:
    """Return the folders of a task's runs in another study; a StoreError says that there are none."""
    found = _list_parts(Path(study) / task)
    if not found:
        raise StoreError(f"errors: {study} has no run of {task}; name the folder of a study of this task")
    return found


def _list_measured(task: str, parts: Sequence[Path], distances: str | Path | None) -> list[Path]:
    """Return the folders of the runs that distances are taken from: a task's own, or those of another study."""
    if distances is None:
        return list(parts)
    measured = _list_others(task, distances)
    with RunStore.read(parts[0]) as own, RunStore.read(measured[0]) as other:
        for what, mine, theirs in (
            ("benchmark version", own.info["benchmark"], other.info["benchmark"]),
            ("task", own.info["task"], other.info["task"]),
            ("agent", own.info["agents"][CEILING], other.info["agents"][CEILING]),
        ):
            if mine != theirs:
                raise StoreError(
                    f"errors: expected distances of the same {what} as in {parts[0].parent}, {mine}, got {theirs} in "
                    f"{measured[0].parent}; run `wiw study errors` there with the same settings, but for --episodes, "
                    "--fidelity-share and --lpips"
                )
    return measured


def _run_task(
    task: str, settings: ErrorSettings, folder: Path, workers: int, lpips: str | Path | None, watch: Watch
) -> list[Path]:
    """Run all arms of a task, part by part; return the folders of the runs."""
    recipe, agent = make_recipes(task, settings)
    arms = [FLOOR, CEILING, *_order_arms(settings.list_arms(task))]
    count, salt = -(-settings.episodes // BLOCK), _find_salt(folder)
    shards = [Shard(number, count) for number in range(1, count + 1)]
    others = {path.name for path in _list_parts(folder)} - {shard.folder for shard in shards}
    if others:
        raise StoreError(
            f"errors: {folder} has {min(others)}, a part of a study of another number of episodes than "
            f"{settings.episodes}; ask for the same --episodes, or name another folder with --out"
        )
    done = []
    for number, shard in enumerate(shards, 1):
        log = evaluate(
            recipe,
            agent,
            settings.episodes,
            arms=arms,
            more_arms=True,
            out=folder / shard.folder,
            resume=True,
            shard=str(shard),
            salt=salt,
            workers=workers,
            seed=settings.seed,
            keep_images=0,
            fidelity=True,
            fidelity_share=settings.fidelity_share,
            lpips=lpips,
            progress=False,
        )
        log.close()
        done.append(folder / shard.folder)
        watch(task, number, count, f"{shard.select(settings.episodes).stop}/{settings.episodes} episodes")
    return done


def _find_salt(folder: Path) -> str:
    """Return the common salt of a run's parts: that of the first one, or a new one."""
    begun = _list_parts(folder)
    if not begun:
        return keys.draw_salt()
    with RunStore.read(begun[0]) as store:
        return store.salt


def _order_arms(arms: Mapping[str, tuple[str, float]]) -> list[str]:
    """Return the arms with the largest dose of each kind first, so that an interrupted study covers all kinds."""
    doses: dict[str, list[float]] = {}
    for kind, dose in arms.values():
        doses.setdefault(kind, []).append(dose)
    return sorted(arms, key=lambda arm: -doses[arms[arm][0]].index(arms[arm][1]))


def make_recipes(task: str, settings: ErrorSettings) -> tuple[TaskRecipe, AgentRecipe]:
    """Return the recipes for a task's runs: the task, and the agent whose world model is the oracle."""
    walks = task_class(task).space == PRIMITIVES
    options: dict[str, Any] = {"seed": settings.seed}
    if walks:
        options |= {"per_scene": settings.per_scene}
        named = {"scenes": settings.scenes, "tier": settings.tier}
        options |= {name: value for name, value in named.items() if value is not None}
    if settings.preset is not None:
        options["preset"] = settings.preset
    policy = settings.find_policy(task)
    return TaskRecipe(task, options), AgentRecipe(policy, "oracle", model_options=_size_option(settings))


def _size_option(settings: ErrorSettings) -> dict[str, Any]:
    return {} if settings.size is None else {"size": list(settings.size)}


def _read_task(
    task: str, settings: ErrorSettings, parts: Sequence[Path], measured: Sequence[Path]
) -> ErrorTable | None:
    """Return the numbers of a task from its runs, which may be unfinished.

    Success is taken from the runs in `parts`, distances and regret from those in `measured`, mostly the same. None
    until an episode has been scored without imagination, with true futures and in an arm with an error. One run is open
    at a time, for a study may have more than a process may open files.
    """
    outcomes = [row for path in parts for row in _read_outcomes(path)]
    scored = {row["arm"] for row in outcomes if row["status"] == "done"}
    shown = settings.list_arms(task)
    if not {FLOOR, CEILING} <= scored or scored.isdisjoint(shown):
        return None
    with RunStore.read(parts[0]) as first:
        policy = first.info["agents"][CEILING]["policy"]
    return summarise_errors(
        task,
        policy,
        outcomes,
        (row for path in measured for row in _read_decisions(path)),
        shown,
        settings.list_left_out(task),
        settings.seed,
        others=sorted(scored - {FLOOR, CEILING, *shown}),
    )


def _read_outcomes(run: Path) -> list[dict[str, Any]]:
    with RunStore.read(run) as store:
        return store.outcomes()


def _read_decisions(run: Path) -> list[dict[str, Any]]:
    with RunStore.read(run) as store:
        return store.decisions()
