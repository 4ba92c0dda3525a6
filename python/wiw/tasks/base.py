# SPDX-License-Identifier: Apache-2.0
"""`Task`: the interface that evaluation relies on, with defaults for everything optional.

`docs/write-your-own-task.md` shows a minimal one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from wiw.envs.base import Env
from wiw.errors import ArgumentError
from wiw.tasks.presets import Preset
from wiw.types import PRIMITIVES, Episode, TableSpec, Wording

if TYPE_CHECKING:
    import gymnasium

    from wiw.datasets.worlds import World
    from wiw.tabletop.table import Table
    from wiw.tasks.answer_record import AnswerRecord


class Task(ABC):
    """Episodes, the environment they run in, and what reports say about them.

    A task is pickled to worker processes, and rebuilt from its name and options when a run is resumed.
    """

    name: str
    """Name in tables and run folders."""
    seed: int = 0
    """Default seed of a run."""
    space: str = PRIMITIVES
    """Kind of actions in plans: `wiw.types.PRIMITIVES`, `wiw.types.GRIPPER_POSES`, or the task's own space."""
    metrics: tuple[str, ...] = ("success",)
    """Names of the metrics that the paper reports for it."""
    default_policy: str | None = None
    """Name of its default policy."""
    sensor_options: tuple[str, ...] = ()
    """Options of `wiw.make` that are the environment's, not the task's."""
    choices: tuple[str, ...] = ()
    """Labels that answers are chosen from, if the task requires one."""
    wording: Wording = Wording()
    """The words that reports use for its episodes."""
    tables: TableSpec = TableSpec()
    """Contents of the tables and plots of its runs."""
    preset: str = ""
    """Name of its preset, or the path of its file; empty for a task without presets."""
    preset_settings: Preset = Preset()
    """Everything that its preset sets."""
    has_guide: bool = False
    """Whether its environments' `guide` gives the true value of plans, which `wiw blame` needs."""

    # -- what every task says ------------------------------------------------------------------------------------------

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return the JSON-able identity of the task: what must be equal for two runs to be comparable."""

    @abstractmethod
    def environment(self, depth: bool = False) -> Env:
        """Return a new environment for the task's episodes, with or without `depth` in the observations.

        If the task has `sensor_options`, it takes these, too. The loop passes one of them, `cameras=("wrist",)`, for an
        agent that needs the view of a wrist camera.
        """

    @abstractmethod
    def episodes(self, count: int) -> list[Episode]:
        """Return the first `count` episodes; a larger `count` starts with the same ones.

        Raises:
            ArgumentError: there are fewer.
        """

    # -- where a task may be silent ------------------------------------------------------------------------------------

    @property
    def defaults(self) -> dict[str, Any]:
        """Defaults for the search's parameters: the paper's candidates M, horizon L and execute."""
        return {"candidates": 3, "horizon": 5, "execute": 1}

    @property
    def policy_options(self) -> Mapping[str, Mapping[str, Any]]:
        """Default options of named policies on this task."""
        return self.preset_settings.policies

    @property
    def model_options(self) -> Mapping[str, Mapping[str, Any]]:
        """Default options of named world models on this task."""
        return self.preset_settings.models

    @property
    def departures(self) -> Mapping[str, Mapping[str, str]]:
        """Reasons for which its preset departs from the paper."""
        return self.preset_settings.departures

    @property
    def default_episodes(self) -> int:
        """Default number of episodes of a run."""
        return 20

    @property
    def block(self) -> int | None:
        """Episodes generated in a scene at a time; None for a task whose episodes do not come scene by scene."""
        return None

    @property
    def decisions(self) -> int:
        """Number of decisions in an episode as far as known beforehand, for progress bars."""
        return 20

    @property
    def stage(self) -> dict[str, Any] | None:
        """Where reports draw plans on front views: "camera" and "ground" (see `wiw.report.stage`); None for nowhere."""
        return None

    def explain_episodes(self, episodes: Sequence[Episode]) -> list[str]:
        """Return sentences that users of generated episodes must know. Default: none."""
        return []

    @property
    def file_header(self) -> dict[str, Any] | None:
        """Header of a file of its episodes (`wiw episodes`); None if episodes are not kept in files."""
        return None

    @staticmethod
    def make_portable(options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the task's options in a form that means the same in any folder and when resuming."""
        return dict(options)

    def episode(self, index: int) -> Episode:
        """Return an episode by its number.

        Raises:
            ArgumentError: a negative number, or there are fewer.
        """
        if index < 0:
            raise ArgumentError(f"expected an episode number of at least 0, got {index}")
        return self.episodes(index + 1)[index]

    def vector_environment(self, num_envs: int, depth: bool = False) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
        """Return a gymnasium vector environment with `num_envs` episodes at a time.

        Raises:
            ArgumentError: the task has none.
        """
        raise ArgumentError(f"task '{self.name}' has no vector environment; use several of `wiw.make`")

    def require(self, episodes: Iterable[Episode]) -> dict[str, dict[str, str]]:
        """Check that everything episodes need exists, without loading it.

        Returns:
            For each scene, what it is used with, which must not change during a run. A digest of what is in its files
            is its "content", which is compared only where both sides have one.

        Raises:
            FileError: something is missing.
        """
        return {}

    def open_world(self, episode: Episode) -> World | None:
        """Return the scene that reports draw from above, with its navigation mesh; None for no drawing."""
        return None

    @classmethod
    def read_answers(cls, task: Mapping[str, Any], episode: Episode, outcome: Mapping[str, Any]) -> AnswerRecord | None:
        """Return the answers of a stored outcome, so that they can be judged again; None if it has none.

        Args:
            task: the run's task as it describes itself (`describe`).
            episode: the finished episode.
            outcome: row of the run store: "status", "metrics", "details".
        """
        return None

    def set_table(self, episode: Episode) -> Table | None:
        """Return the table that reports film, as the episode begins; None for no film."""
        return None
