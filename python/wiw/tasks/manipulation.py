# SPDX-License-Identifier: Apache-2.0
"""Robotic Manipulation: four tasks of an arm at a table (paper, appendix "Robotic Manipulation")."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.envs.manipulation import ManipulationEnv
from wiw.envs.manipulation_spec import ManipulationSpec
from wiw.envs.manipulation_vector import ManipulationVectorEnv
from wiw.errors import ArgumentError
from wiw.render import resolve_backend
from wiw.tabletop.base import derive_key
from wiw.tabletop.robot import load_panda, load_robot
from wiw.tabletop.table import Table
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import CAMERAS, TABLE, Workbench
from wiw.tasks import presets
from wiw.tasks.base import Task
from wiw.typed_values import require_positive
from wiw.types import GRIPPER_POSES, ArmObservation, Episode, Wording, check_seed

WALKING = ("scenes", "per_scene", "episode_file", "scene_folder", "motion")
"""Options of the tasks in which an agent walks, which mean nothing at a table."""
UNREACHABLE = -1000.0
"""Progress where nothing helps any more, such as after a wrong button."""


@dataclass(frozen=True)
class ManipulationRules:
    """Budget of an episode and size of a run; their values are in the presets (`wiw/configs`)."""

    actions: int
    """K, poses that an episode may take."""
    candidates: int
    """M, plans imagined per decision."""
    horizon: int
    """L, poses per plan."""
    execute: int
    """Poses carried out per decision; 0: all of the chosen plan; negative: all but that many, at least one."""
    episodes: int
    """Default number of episodes per task."""

    def __post_init__(self) -> None:
        require_positive("manipulation", self, "actions", "candidates", "horizon", "episodes")


class Manipulation(ManipulationSpec, Task):
    """Push buttons, slide a block, put a ring on a peg, stack cups; instructions in words, actions as gripper poses.

    Args:
        tasks: "all", or names of `TABLETOP_TASKS`; episodes take them in turn.
        seed: of the episodes and of the run.
        preset: "default", "paper", "paper-diffusion", or the path of a YAML file; `rules` overrides it field by field
            (`ManipulationRules`).
        backend: renderer, "auto", "cpu" or "gpu".
        robot: URDF file of an arm to work with in place of the project's own Panda (`wiw.tabletop.robot`).
        robot_tcp: the link of that file between the finger tips, where its name does not tell.
    """

    name = "manipulation"
    metrics = ("success", "mean_trajectory")
    default_policy = "scripted"
    space = GRIPPER_POSES
    has_guide = True
    sensor_options = ("size", "cameras", "ids", "cloud", "grid")
    wording = Wording("completed the task", "done", "not done", "what is left", asked="Instruction", steps="decisions")

    def __init__(
        self,
        tasks: str | Sequence[str] = "all",
        seed: int = 0,
        preset: str | Path = presets.DEFAULT,
        backend: Literal["auto", "cpu", "gpu"] = "auto",
        robot: str | Path | None = None,
        robot_tcp: str = "",
        **rules: Any,
    ) -> None:
        if robot_tcp and robot is None:
            raise ArgumentError(f"robot_tcp: names a link of `robot`, but no robot file is given; got '{robot_tcp}'")
        if walking := [name for name in rules if name in WALKING]:
            raise ArgumentError(
                f"manipulation: {', '.join(walking)}: only for tasks in which an agent walks; tables are determined by "
                "`tasks` and `seed`"
            )
        self.tasks, self.seed, self.backend = _parse_tasks(tasks), check_seed(seed), backend
        self.robot = load_panda() if robot is None else load_robot(robot, robot_tcp)
        owner = presets.find_owner(type(self))
        self.rules = presets.load_rules(ManipulationRules, owner, preset, rules)
        self.preset, self.preset_settings = presets.make_absolute(preset), presets.load_preset(owner, preset)

    @staticmethod
    def make_portable(options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the same options, with paths that mean the same in any folder and the renderer of "auto"."""
        ways: dict[str, Callable[[Any], str]] = {
            "preset": presets.make_absolute,
            "backend": resolve_backend,
            "robot": lambda file: str(Path(file).expanduser().absolute()),
        }
        given = {"backend": "auto", **options}
        return {
            name: ways[name](value) if name in ways and value not in (None, "") else value
            for name, value in given.items()
        }

    @property
    def actions(self) -> int:
        """K: poses that an episode may take."""
        return self.rules.actions

    @property
    def decisions(self) -> int:
        """Number of decisions of an episode, if each plan is executed in full."""
        execute = self.rules.execute
        return -(-self.rules.actions // (execute if execute > 0 else max(1, self.rules.horizon + execute)))

    @property
    def default_episodes(self) -> int:
        """Default number of episodes of a run."""
        return self.rules.episodes * len(self.tasks)

    @property
    def defaults(self) -> dict[str, Any]:
        """Options for `wiw.Agent` that the task prescribes."""
        rules = self.rules
        numbers = {"candidates": rules.candidates, "horizon": rules.horizon, "execute": rules.execute}
        return {**numbers, "space": self.space}

    @property
    def stage(self) -> dict[str, Any]:
        """Where reports draw plans on front views: the "camera" that takes them, and "ground", the table's height."""
        return {"camera": asdict(CAMERAS["front"]), "ground": TABLE}

    def describe(self) -> dict[str, Any]:
        """Return the JSON-able identity: what must be equal for two runs to be comparable."""
        backend = resolve_backend(self.backend)
        return {
            "task": self.name, "tasks": list(self.tasks), "seed": self.seed, "backend": backend,
            "robot": self.robot.identity, **asdict(self.rules),
        }  # fmt: skip

    def environment(self, depth: bool = False, **sensors: Any) -> ManipulationEnv:
        """Return an environment for the task's episodes; `ManipulationEnv` documents what it can be given to sense."""
        return ManipulationEnv(self, depth, **sensors)

    def vector_environment(self, num_envs: int, depth: bool = False, **sensors: Any) -> ManipulationVectorEnv:
        """Return a gymnasium vector environment of this task, with `num_envs` tables at a time."""
        return ManipulationVectorEnv(self, num_envs, depth, **sensors)

    def episodes(self, count: int) -> list[Episode]:
        """Return the first `count` episodes."""
        return [self.episode(index) for index in range(count)]

    def episode(self, index: int) -> Episode:
        """Return an episode by its number, each with a table of its own, laid by the seed; variations take turns.

        Raises:
            ArgumentError: a number below 0.
        """
        if index < 0:
            raise ArgumentError(f"episode: expected a number of 0 or more, got {index}")
        name = self.tasks[index % len(self.tasks)]
        seed = derive_key(self.seed, index, 0) % 2**31
        variation = index // len(self.tasks) % TABLETOP_TASKS[name].variations
        here = (0.0, 0.0, 0.0)
        info = {"task": name, "seed": seed, "variation": variation}
        info["instruction"] = TABLETOP_TASKS[name].create_setup(seed, variation).instruction
        return Episode(f"{index:04d}", f"{name}/{seed}", here, 0.0, here, 0.0, float("nan"), info)

    def set_table(self, episode: Episode) -> Table:
        """Return an episode's table, at rest."""
        kind = TABLETOP_TASKS[episode.info["task"]]
        return Table(
            kind, kind.create_setup(int(episode.info["seed"]), int(episode.info["variation"])), self.backend, self.robot
        )

    def measure_progress(self, table: Table, bench: Workbench) -> float:
        """Return 0 where what is asked for is done, else less by each pose that an expert would need."""
        if table.kind.is_success(bench, table.setup):
            return 0.0
        return float(-len(self.plan_expert(table, bench)) or UNREACHABLE)

    def plan_expert(self, table: Table, bench: Workbench) -> NDArray[np.float64]:
        """Return the remaining poses from a bench's present state, float64 [K, 7]; nothing where nothing helps."""
        kind, setup = table.kind, table.setup
        places = bench.get_poses(setup.objects)
        front = bench.render_view(arm=False)["color"]
        left = kind.find_remaining_target(ArmObservation(front, bench.pose, places=places), setup.target)
        return np.empty((0, 7)) if left is None else kind.plan_expert(places, left, bench.pose)


def _parse_tasks(tasks: str | Sequence[str]) -> tuple[str, ...]:
    """Return the tasks that "all", "a,b" or ["a", "b"] mean.

    Raises:
        ArgumentError: none, one twice, or one that is not known.
    """
    names = tuple(TABLETOP_TASKS) if tasks == "all" else tuple(tasks.split(",") if isinstance(tasks, str) else tasks)
    names = tuple(name.strip() for name in names)
    if not names or len(set(names)) < len(names) or not set(names) <= set(TABLETOP_TASKS):
        known = ", ".join(TABLETOP_TASKS)
        raise ArgumentError(
            f"manipulation: expected tasks as all, or different ones of {known}, got {', '.join(names)}"
        )
    return names
