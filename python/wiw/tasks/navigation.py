# SPDX-License-Identifier: Apache-2.0
"""What navigation tasks have in common: where episodes come from, and the environments they are run in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.worlds import World, navmesh_file, world
from wiw.envs.navigation import NavigationEnv
from wiw.envs.pointing import Pointing
from wiw.envs.trip import Trip
from wiw.envs.vector import VectorEnv
from wiw.errors import ArgumentError, FileError
from wiw.render import resolve_backend
from wiw.scenes import absolute, resolve
from wiw.tasks import presets
from wiw.types import Episode, Goal, Wording, checked_seed


class NavigationTask(ABC):
    """Base of the tasks in which an agent walks; a subclass says what its goal is and when it is reached.

    Args:
        scenes: scene spec, e.g. "apartments:val", "apartments:test:40", or the path of a mesh or SDF world; where
            Habitat's navigation mesh lies beside it ("house.navmesh" for "house.glb"), that one is used.
        seed: seed of the generated episodes and of the run.
        preset: "paper", "official", or the path of a YAML file; `rules` overrides it field by field.
        episode_file: a JSON episode file to use instead of generating; habitat-lab's and World-in-World's are read too.
        scene_folder: folder that scene paths in an episode file are relative to; if not given, the folder of a file of
            wiw, else the present one.
        per_scene: generated episodes a scene.
        backend: renderer, "auto", "cpu" or "gpu".
    """

    name: str
    metrics: tuple[str, ...]
    rules_class: type
    default_policy: str
    """Runs it where none is named."""
    wording = Wording()
    """How reports speak of its episodes."""
    choices: tuple[str, ...] = ()
    """What answers are chosen from, where the task asks for any."""

    def __init__(
        self,
        scenes: str | Path = "apartments:val",
        seed: int = 0,
        preset: str | Path = presets.DEFAULT,
        episode_file: str | Path | None = None,
        scene_folder: str | Path = "",
        per_scene: int = 5,
        backend: Literal["auto", "cpu", "gpu"] = "auto",
        **rules: Any,
    ) -> None:
        self.given = frozenset(rules)
        """Names of the rules that were given as options."""
        self.rules: Any = presets.rules(self.rules_class, self.name, preset, rules)
        self.scenes, self.seed = absolute(scenes), checked_seed(seed)
        self.backend, self.per_scene = backend, per_scene
        self.episode_file = None if episode_file is None else str(Path(episode_file).expanduser().absolute())
        self.scene_folder = str(Path(scene_folder).expanduser().absolute()) if scene_folder else ""
        self._episodes: list[Episode] = []

    # -- what a task says of itself ------------------------------------------------------------------------------------

    @abstractmethod
    def goal(self, place: World, episode: Episode) -> Goal:
        """What the agent is asked to do."""

    @abstractmethod
    def goal_position(self, place: World, episode: Episode) -> NDArray[np.float64]:
        """Where distances to the goal end."""

    @abstractmethod
    def succeeded(self, trip: Trip) -> bool:
        """Whether an episode has been successful so far."""

    @abstractmethod
    def result(self, trip: Trip) -> dict[str, float]:
        """Metrics of one finished episode."""

    @abstractmethod
    def of_file(self) -> list[Episode]:
        """The episodes of `episode_file`."""

    @abstractmethod
    def of_scene(self, place: World, first: int, before: list[Episode]) -> list[Episode]:
        """`per_scene` generated episodes of a scene, from its number `first` on, after those `before`."""

    @property
    def pointing(self) -> Pointing | None:
        """How the task points its target out, where it has one."""
        return None

    def sure(self, trip: Trip) -> bool:
        """Whether the answers given so far end the episode."""
        return False

    def destination(self, trip: Trip) -> NDArray[np.float64]:
        """Where an agent that knew the scene would go."""
        return trip.goal_position

    def progress(self, trip: Trip, fork: Any, left: float) -> float:
        """How good it would be to stand where a fork of the simulator stands, the higher the better.

        `left` counts the primitives of the shortest way from there to the destination; here the fewer, the better.
        """
        return -left

    # ------------------------------------------------------------------------------------------------------------------

    @staticmethod
    def portable(options: Mapping[str, Any]) -> dict[str, Any]:
        """The same options, with paths that mean the same in any folder and the renderer that "auto" stands for."""
        ways: dict[str, Callable[[Any], str]] = {
            "scenes": absolute,
            "preset": presets.absolute,
            "backend": resolve_backend,
            "episode_file": lambda path: str(Path(path).expanduser().absolute()),
            "scene_folder": lambda path: str(Path(path).expanduser().absolute()),
        }
        return {
            name: ways[name](value) if name in ways and value not in (None, "") else value
            for name, value in {"backend": "auto", **options}.items()
        }

    @property
    def motion(self) -> str:
        """What happens to a blocked move: "refuse" or "slide"."""
        return str(self.rules.motion)

    @property
    def budget(self) -> int:
        """Primitives an episode may take."""
        execute = self.defaults["execute"]
        return int(self.rules.decisions * (execute if execute > 0 else max(1, self.rules.horizon + execute)))

    @property
    def size(self) -> int | None:
        """How many episodes there are; None where a single scene gives as many as are asked for."""
        if self.episode_file:
            self._episodes = self._episodes or self.of_file()
            return len(self._episodes)
        scenes = resolve(self.scenes)
        return None if len(scenes) == 1 else len(scenes) * self.per_scene

    @property
    def defaults(self) -> dict[str, Any]:
        """Options for `wiw.Agent` that the task prescribes."""
        return {"candidates": self.rules.candidates, "horizon": self.rules.horizon, "execute": self.rules.execute}

    def describe(self) -> dict[str, Any]:
        """JSON-able identity: what must be equal for two runs to be comparable."""
        source = (
            {"episode_file": self.episode_file}
            if self.episode_file
            else {"scenes": self.scenes, "per_scene": self.per_scene}
        )
        backend = resolve_backend(self.backend)
        return {"task": self.name, "seed": self.seed, **source, "backend": backend, **asdict(self.rules)}

    def environment(self, depth: bool = False) -> NavigationEnv:
        """A gymnasium environment of this task; `depth` adds it to the observations."""
        return NavigationEnv(self, depth)

    def vector_environment(self, num_envs: int, depth: bool = False) -> VectorEnv:
        """A gymnasium vector environment of this task, with `num_envs` episodes at a time."""
        return VectorEnv(self, num_envs, depth)

    def episodes(self, count: int) -> list[Episode]:
        """The first `count` episodes; generated scene by scene, `per_scene` each.

        Raises:
            ArgumentError: the episode file or the scenes hold fewer.
        """
        if not self._episodes and self.episode_file:
            self._episodes = self.of_file()
        scenes = [] if self.episode_file else resolve(self.scenes)
        whole_scene = len(scenes) == 1
        while len(self._episodes) < count and not self.episode_file:
            done = len(self._episodes) // self.per_scene
            if not whole_scene and done >= len(scenes):
                break
            self._add(scenes[0] if whole_scene else scenes[done], done if whole_scene else 0)
        if len(self._episodes) < count:
            more = "ask for fewer" if self.episode_file else "name more scenes (apartments:val:N) or raise per_scene"
            raise ArgumentError(f"{self.name}: asked for {count} episodes, but there are {len(self._episodes)}; {more}")
        return self._episodes[:count]

    def require(self, episodes: Iterable[Episode]) -> dict[str, dict[str, str]]:
        """Finds out whether the scenes of episodes are there, without loading any.

        Returns:
            For each scene, what it is used with: its "navmesh", a file or "built".

        Raises:
            FileError: one is not; names it, and the episode file.
        """
        used: dict[str, dict[str, str]] = {}
        for episode in episodes:
            scene = episode.scene
            if scene in used:
                continue
            try:
                resolve(scene)
            except (FileError, ArgumentError) as error:
                where = f"{self.episode_file}: episode {episode.episode_id}: scene: " if self.episode_file else ""
                raise FileError(f"{where}{error}") from error
            used[scene] = {"navmesh": str(navmesh_file(scene) or "built")}
        return used

    def episode(self, index: int) -> Episode:
        """Episode `index` of the task."""
        return self.episodes(index + 1)[index]

    def _add(self, scene: str, block: int) -> None:
        """One block of episodes in one scene, numbered on from those before it."""
        made = self.of_scene(world(scene, self.backend), self.per_scene * block, self._episodes)
        first = len(self._episodes)
        self._episodes += [replace(episode, episode_id=f"{first + i:04d}") for i, episode in enumerate(made)]
