# SPDX-License-Identifier: Apache-2.0
"""Image-Goal Navigation: reach the place where the goal image was taken (paper, appendix "Image-Goal Navigation")."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.datasets import episodes as episode_file
from wiw.datasets.imagenav import camera_pose, generate, ideal_primitives
from wiw.datasets.worlds import World
from wiw.envs.trip import Trip
from wiw.errors import ArgumentError
from wiw.tasks.navigation import NavigationTask
from wiw.types import Episode, Goal, Wording


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


class ImageNav(NavigationTask):
    """Reach the place where a goal image was taken.

    Goal images, when one is reached, and what is measured; `NavigationTask` documents the arguments.
    """

    name = "imagenav"
    default_policy = "matcher"
    metrics = ("success", "spl", "mean_trajectory")
    rules_class = ImageNavRules
    wording = Wording(
        succeeded="reached the goal", won="reached", lost="not reached", asked="The goal: find where this was taken"
    )

    def goal(self, place: World, episode: Episode) -> Goal:
        """The goal image: front view at the goal's pose."""
        pose = camera_pose(np.asarray(place.ground.put_down(episode.goal_position), float), episode.goal_yaw)
        image = place.renderer.perspective(pose[None], (480, 480), 90.0, outputs=("color",))["color"][0]
        return Goal(self.name, image=image)

    def goal_position(self, place: World, episode: Episode) -> NDArray[np.float64]:
        """The goal's position, on the floor that is drawn."""
        return place.ground.put_down(episode.goal_position).astype(np.float64)

    def succeeded(self, trip: Trip) -> bool:
        """Whether the agent has entered the goal's sphere, looked at as the rules say."""
        if trip.success:
            return True
        if self.rules.checked == "decision" and not trip.at_decision:
            return False
        return self._within(trip, trip.positions[-1])

    def progress(self, trip: Trip, fork: Any, left: float) -> float:
        """0 within the goal's sphere, else less by the primitives to its centre."""
        return 0.0 if self._within(trip, fork.position) else -left

    def _within(self, trip: Trip, place: NDArray[np.float64]) -> bool:
        radius = trip.episode.info.get("radius", self.rules.radius)
        if np.linalg.norm(place - trip.goal_position) > radius:  # no walk is shorter than the straight line
            return False
        walked = trip.world.navmesh.geodesic_distance
        return self.rules.distance == "euclidean" or float(walked(place, trip.goal_position)) <= radius

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

    def of_file(self) -> list[Episode]:
        """The file's episodes, under the task's radius where that was given as an option."""
        assert self.episode_file is not None
        loaded = episode_file.load(self.episode_file, self.scene_folder)
        if "radius" not in self.given:
            return loaded
        return [replace(e, info={name: value for name, value in e.info.items() if name != "radius"}) for e in loaded]

    def of_scene(self, place: World, first: int, before: list[Episode]) -> list[Episode]:
        """Goals out of sight of the start, yet within reach."""
        return generate(place, self.per_scene, self.seed, first=first)


def _shortest(trip: Trip) -> tuple[float, int]:
    """Metres and primitives of an ideal run, as the episode gives them; the one that it does not give is measured."""
    episode = trip.episode
    geodesic, ideal = episode.geodesic, episode.info.get("ideal_primitives")
    if np.isfinite(geodesic) and ideal is not None:
        return geodesic, int(ideal)
    path, length = trip.world.navmesh.shortest_path(episode.start_position, episode.goal_position, return_length=True)
    primitives = ideal_primitives(np.asarray(path, float), episode.start_yaw) if ideal is None else int(ideal)
    return geodesic if np.isfinite(geodesic) else length, primitives
