# SPDX-License-Identifier: Apache-2.0
"""Image-Goal Navigation: reach the place where the goal image was taken (paper, appendix "Image-Goal Navigation")."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from wiw.datasets import episodes as episode_file
from wiw.datasets.imagenav import camera_pose, generate, ideal_primitives
from wiw.datasets.worlds import World, navmesh_file, world
from wiw.envs.navigation import NavigationEnv
from wiw.envs.trip import Trip
from wiw.envs.vector import VectorEnv
from wiw.errors import ArgumentError
from wiw.render import resolve_backend
from wiw.scenes import absolute, resolve
from wiw.tasks import presets
from wiw.types import Episode, Goal


@dataclass(frozen=True)
class ImageNavRules:
    """Budget, stop rule and metric variants; their values are in the presets (`wiw/configs`)."""

    decisions: int
    """K."""
    candidates: int
    """M, plans imagined per decision."""
    horizon: int
    """L, primitives per plan."""
    execute: int
    """Primitives carried out per decision; negative: all but that many of the chosen plan, at least one."""
    radius: float
    """Metres; the episode succeeds on entering this sphere around the goal's position. Where an episode file gives a
    goal's radius, that one holds, unless the radius is given as an option of the task."""
    checked: Literal["primitive", "decision"]
    """Whether success is looked at after every primitive or only where a decision is due."""
    distance: Literal["euclidean", "geodesic"]
    spl: Literal["metres", "actions"]
    """SPL by path length (the paper's formula) or by number of primitives."""
    motion: Literal["refuse", "slide"]

    def __post_init__(self) -> None:
        if min(self.decisions, self.candidates, self.horizon) < 1 or self.radius <= 0:
            raise ArgumentError(f"imagenav: decisions, candidates, horizon and radius must be positive, got {self}")


class ImageNav:
    """The task: where episodes come from, when one ends, and what is measured.

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

    name = "imagenav"
    metrics = ("success", "spl", "mean_trajectory")

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
        self.rules = presets.rules(ImageNavRules, self.name, preset, rules)
        self.scenes, self.seed, self.backend, self.per_scene = absolute(scenes), seed, backend, per_scene
        self.episode_file = None if episode_file is None else str(Path(episode_file).expanduser().absolute())
        self.scene_folder = str(Path(scene_folder).expanduser().absolute()) if scene_folder else ""
        self._one_radius = "radius" in rules
        self._episodes: list[Episode] = []

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
        return self.rules.motion

    @property
    def budget(self) -> int:
        """Primitives an episode may take."""
        rules = self.rules
        return rules.decisions * (rules.execute if rules.execute > 0 else max(1, rules.horizon + rules.execute))

    @property
    def size(self) -> int | None:
        """How many episodes there are; None where a single scene gives as many as are asked for."""
        if self.episode_file:
            self._episodes = self._episodes or self._of_file()
            return len(self._episodes)
        scenes = resolve(self.scenes)
        return None if len(scenes) == 1 else len(scenes) * self.per_scene

    @property
    def defaults(self) -> dict[str, int]:
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
            self._episodes = self._of_file()
        scenes = [] if self.episode_file else resolve(self.scenes)
        whole_scene = len(scenes) == 1
        while len(self._episodes) < count and not self.episode_file:
            done = len(self._episodes) // self.per_scene
            if not whole_scene and done >= len(scenes):
                break
            self._episodes += self._of_scene(scenes[0] if whole_scene else scenes[done], done if whole_scene else 0)
        if len(self._episodes) < count:
            more = "ask for fewer" if self.episode_file else "name more scenes (apartments:val:N) or raise per_scene"
            raise ArgumentError(f"imagenav: asked for {count} episodes, but there are {len(self._episodes)}; {more}")
        return self._episodes[:count]

    def require(self, episodes: Iterable[Episode]) -> dict[str, dict[str, str]]:
        """Finds out whether the scenes of episodes are there, without loading any.

        Returns:
            For each scene, what it is used with: its "navmesh", a file or "built".

        Raises:
            FileError: one is not; names it.
        """
        used = {}
        for scene in dict.fromkeys(episode.scene for episode in episodes):
            resolve(scene)
            used[scene] = {"navmesh": str(navmesh_file(scene) or "built")}
        return used

    def episode(self, index: int) -> Episode:
        """Episode `index` of the task."""
        return self.episodes(index + 1)[index]

    def goal(self, place: World, episode: Episode) -> Goal:
        """The goal image: front view at the goal's pose."""
        pose = camera_pose(np.asarray(place.ground.put_down(episode.goal_position), float), episode.goal_yaw)
        image = place.renderer.perspective(pose[None], (480, 480), 90.0, outputs=("color",))["color"][0]
        return Goal(self.name, image=image)

    def succeeded(self, trip: Trip) -> bool:
        """Whether the agent has entered the goal's sphere, looked at as the rules say."""
        if trip.success:
            return True
        if self.rules.checked == "decision" and not trip.at_decision:
            return False
        radius = trip.episode.info.get("radius", self.rules.radius)
        if trip.distance_to_goal() > radius:  # no walk is shorter than the straight line
            return False
        return self.rules.distance == "euclidean" or trip.geodesic_to_goal() <= radius

    def result(self, trip: Trip) -> dict[str, float]:
        """Metrics of one finished episode; `spl` is its contribution, 0 to 1."""
        by_actions = self.rules.spl == "actions"
        geodesic, ideal = _shortest(trip)
        shortest = float(ideal) if by_actions else geodesic
        walked = float(trip.actions) if by_actions else trip.travelled
        return {
            "success": float(trip.success),
            "actions": float(trip.actions),
            "travelled": trip.travelled,
            "shortest": geodesic,
            "spl": float(trip.success) * shortest / max(walked, shortest, 1e-9),
            "distance_to_goal": trip.distance_to_goal(),
        }

    def _of_file(self) -> list[Episode]:
        """The file's episodes, under the task's radius where that was given as an option."""
        assert self.episode_file is not None
        loaded = episode_file.load(self.episode_file, self.scene_folder)
        if not self._one_radius:
            return loaded
        return [replace(e, info={name: value for name, value in e.info.items() if name != "radius"}) for e in loaded]

    def _of_scene(self, scene: str, block: int) -> list[Episode]:
        """One block of episodes in one scene, numbered on from those before it."""
        made = generate(world(scene, self.backend), self.per_scene, self.seed, first=self.per_scene * block)
        return [replace(e, episode_id=f"{len(self._episodes) + i:04d}") for i, e in enumerate(made)]


def _shortest(trip: Trip) -> tuple[float, int]:
    """Metres and primitives of an ideal run, as the episode gives them; the one that it does not give is measured."""
    episode = trip.episode
    geodesic, ideal = episode.geodesic, episode.info.get("ideal_primitives")
    if np.isfinite(geodesic) and ideal is not None:
        return geodesic, int(ideal)
    path, length = trip.world.navmesh.shortest_path(episode.start_position, episode.goal_position, return_length=True)
    primitives = ideal_primitives(np.asarray(path, float), episode.start_yaw) if ideal is None else int(ideal)
    return geodesic if np.isfinite(geodesic) else length, primitives
