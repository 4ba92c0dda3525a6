# SPDX-License-Identifier: Apache-2.0
"""Image-Goal Navigation: reach the place where the goal image was taken (paper, appendix "Image-Goal Navigation")."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw.datasets.cameras import camera_pose
from wiw.datasets.imagenav import EpisodeRules, generate, ideal_primitives
from wiw.datasets.worlds import World
from wiw.envs.episode_state import EpisodeState
from wiw.errors import ArgumentError, FileError
from wiw.metrics import path_efficiency
from wiw.scenes import resolve
from wiw.tasks.navigation import NavigationTask
from wiw.typed_values import require_positive
from wiw.types import Episode, Goal, Wording

GOAL_SIZE, GOAL_HFOV = (480, 480), 90.0
"""Pixels and degrees of goal images."""


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
    """Metres; the episode succeeds on entering this sphere around the goal's position. A goal's radius from an episode
    file takes precedence, unless the radius is given as an option of the task.
    """
    checked: Literal["primitive", "decision"]
    """Whether success is checked after every primitive or only at decisions; a stop, which ends the episode, is one."""
    distance: Literal["euclidean", "geodesic"]
    spl: Literal["metres", "actions"]
    """SPL by path length (the paper's formula) or by number of primitives."""
    motion: Literal["refuse", "slide"]

    def __post_init__(self) -> None:
        require_positive("imagenav", self, "decisions", "candidates", "horizon")
        if self.radius <= 0:
            raise ArgumentError(f"imagenav: radius must be positive, got {self.radius}")


class ImageNav(NavigationTask):
    """Reach the place where a goal image was taken.

    Goal images, when one is reached, and what is measured; `NavigationTask` documents the arguments.
    """

    name = "imagenav"
    default_policy = "matcher"
    metrics = ("success", "spl", "mean_trajectory")
    rules_class = ImageNavRules
    generator_class = EpisodeRules
    complete_progress = 0.0
    wording = Wording(
        succeeded="reached the goal", won="reached", lost="not reached", asked="The goal: find where this was taken"
    )

    def make_goal(self, place: World, episode: Episode) -> Goal:
        """Return the goal image: front view at the goal's pose, in the picture that the episode brings, if it does.

        Raises:
            FileError: there is a picture, and it cannot be read.
        """
        if "goal_image" in episode.info:
            return Goal(ImageNav.name, image=read_goal_image(Path(episode.info["goal_image"])))
        pose = camera_pose(np.asarray(place.ground.put_down(episode.goal_position), float), episode.goal_yaw)
        image = place.renderer.perspective(pose[None], GOAL_SIZE, GOAL_HFOV, outputs=("color",))["color"][0]
        return Goal(ImageNav.name, image=image)

    def find_goal_position(self, place: World, episode: Episode) -> NDArray[np.float64]:
        """Return the goal's position, on the floor that is drawn."""
        return place.ground.put_down(episode.goal_position).astype(np.float64)

    def is_success(self, state: EpisodeState) -> bool:
        """Return whether the agent has entered the goal's sphere, looked at as the rules say."""
        if state.success:
            return True
        if self.rules.checked == "decision" and not state.at_decision:
            return False
        return self._within(state, state.positions[-1])

    def measure_progress(self, state: EpisodeState, fork: Any, primitives_left: float) -> float:
        """Return 0 within the goal's sphere, else less by the primitives to its centre."""
        return 0.0 if self._within(state, fork.position) else -primitives_left

    def _within(self, state: EpisodeState, place: NDArray[np.float64]) -> bool:
        radius = state.episode.info.get("radius", self.rules.radius)
        if np.linalg.norm(place - state.goal_position) > radius:  # no walk is shorter than the straight line
            return False
        walked = state.world.navmesh.geodesic_distance
        return self.rules.distance == "euclidean" or float(walked(place, state.goal_position)) <= radius

    def measure(self, state: EpisodeState) -> dict[str, float]:
        """Return the metrics of one finished episode; `spl` is its contribution, 0 to 1."""
        by_actions = self.rules.spl == "actions"
        geodesic, ideal = _find_shortest(state)
        shortest = float(ideal) if by_actions else geodesic
        walked = float(state.actions) if by_actions else state.path_length
        return {
            "success": float(state.success),
            "actions": float(state.actions),
            "travelled": state.path_length,
            "shortest": geodesic,
            "spl": float(path_efficiency([state.success], [shortest], [walked])[0]),
            "distance_to_goal": state.distance_to_goal(),
        }

    def load_episodes(self) -> list[Episode]:
        """Return the file's episodes, under the task's radius where that was given as an option.

        Raises:
            FileError: see `wiw.datasets.episodes.load`; an episode is of another task.
        """
        loaded = super().load_episodes()
        for i, episode in enumerate(loaded):
            if other := [name for name in ("target", "question") if name in episode.info]:
                raise FileError(
                    f"{self.episode_file}: episode {i} has a {other[0]}, so it is one of another task (ar, aeqa); "
                    "expected episodes that end at a place, see `wiw episodes imagenav`"
                )
        if "radius" not in self.overridden:
            return loaded
        return [replace(e, info={name: value for name, value in e.info.items() if name != "radius"}) for e in loaded]

    def episode(self, index: int) -> Episode:
        """Return episode `index`; of generated ones only its block is made, as none depends on those before it.

        Raises:
            ArgumentError: a negative number, or there are fewer.
        """
        if index < 0 or index < len(self._episodes) or not self._has_own_blocks:
            return super().episode(index)
        number = index // self.block
        if number not in self._blocks:
            scenes = resolve(self.scenes)
            if 1 < len(scenes) <= number:
                return super().episode(index)  # which says how many there are
            self._blocks[number] = self.generate_block(scenes, number, [])
        return self._blocks[number][index % self.block]

    @property
    def _has_own_blocks(self) -> bool:
        """Whether episodes are generated as here, not in another way by a class derived from this one."""
        names = ("episodes", "generate_first", "generate_block", "generate_episodes")
        return not self.episode_file and all(getattr(type(self), name) is getattr(ImageNav, name) for name in names)

    @property
    def drawn_count(self) -> int:
        """Among how many episodes a seed draws: any, as no episode depends on those before it."""
        return self.episode_count or 64 if self._has_own_blocks else super().drawn_count

    @property
    def block(self) -> int:
        """Episodes generated in a scene at a time: `per_scene` of each tier."""
        return self.per_scene * max(1, len(self.generator.tiers))

    def generate_episodes(self, place: World, first: int, before: list[Episode]) -> list[Episode]:
        """Return episodes with goals out of sight of the start, yet within reach."""
        return generate(place, self.per_scene, self.seed, self.generator, first=first)


def _find_shortest(state: EpisodeState) -> tuple[float, int]:
    """Return metres and primitives of an ideal run, as the episode gives them; missing values are measured."""
    episode = state.episode
    geodesic, ideal = episode.geodesic, episode.info.get("ideal_primitives")
    if np.isfinite(geodesic) and ideal is not None:
        return geodesic, int(ideal)
    path, length = state.world.navmesh.shortest_path(episode.start_position, episode.goal_position, return_length=True)
    primitives = ideal_primitives(np.asarray(path, float), episode.start_yaw) if ideal is None else int(ideal)
    return geodesic if np.isfinite(geodesic) else length, primitives


def read_goal_image(path: Path) -> NDArray[np.uint8]:
    """Return the front view, uint8 [480, 480, 3], in the middle of a panorama of a goal.

    Raises:
        FileError: no picture, or no panorama, which is about twice as wide as high, and even in width.
    """
    found = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if found is None:
        raise FileError(f"{path}: expected a goal image, got a file that cannot be read")
    height, width = found.shape[:2]
    if not 1.5 <= width / height <= 2.5:  # those of the loop have 576 x 1024 pixels
        raise FileError(f"{path}: expected a panorama, about twice as wide as high, got {height}x{width}")
    try:
        return np.asarray(panorama.to_perspective(np.ascontiguousarray(found[..., ::-1]), GOAL_HFOV, GOAL_SIZE))
    except ArgumentError as error:
        raise FileError(f"{path}: expected a panorama: {error}") from error
