# SPDX-License-Identifier: Apache-2.0
"""Rules by which scenes are traversed for the navigation dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from wiw.errors import ArgumentError
from wiw.typed_values import read_values

NextWaypoint = Literal["nearest", "2m"]


@dataclass(frozen=True)
class NavigationRules:
    """Numbers of Algorithm 1 of the World-in-World paper, and of the agent that follows its paths. Lengths in metres.

    Raises:
        ArgumentError: a number is out of range.
    """

    density: float = 4.0
    """rho: samples per square metre of the island."""
    min_samples: int = 1400
    mean_weight: float = 1.7
    """alpha: leaf score = eccentricity + alpha x mean distance."""
    spacing: float = 3.0
    """r_f: least geodesic distance between waypoints."""
    leaf_ratio: float = 0.08
    """eta: at most this share of the samples are candidates for the next waypoint. The paper gives no number."""
    visited_radius: float = 0.5
    """A waypoint counts as visited once the agent has come closer than this. The paper: `spacing`."""
    next_waypoint: NextWaypoint = "nearest"
    """The waypoint to go to: the nearest as in the paper, or the one whose distance is closest to 2 m."""
    lookahead: float = 0.5
    """Distance along the shortest path of the point that the agent heads for."""
    turn_threshold_deg: float = 11.25
    """The agent turns where its heading is further than this from the point ahead. Half a turn is the least there is;
    with more, it turns less often back and forth along paths between two headings."""
    goal_radius: float = 0.25
    """A waypoint is reached within this distance."""
    min_island_area: float = 10.0
    """Square metres; the largest island of a scene is traversed whatever its area, others only above this."""
    max_segment_frames: int = 750
    max_scene_frames: int = 7500
    """Maximum number of frames of one pass over a scene, all islands together."""

    def __post_init__(self) -> None:
        positive = ("density", "min_samples", "spacing", "leaf_ratio", "lookahead", "goal_radius")
        for name in positive:
            if not 0 < getattr(self, name) < float("inf"):
                raise ArgumentError(f"collect: expected {name} above 0, got {getattr(self, name)}")
        for name in ("mean_weight", "min_island_area"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ArgumentError(f"collect: expected a finite {name} of 0 or more, got {getattr(self, name)}")
        if not 11.25 <= self.turn_threshold_deg <= 45:
            raise ArgumentError(
                f"collect: expected a turn_threshold_deg from 11.25 to 45, got {self.turn_threshold_deg}"
            )
        if not self.goal_radius < self.visited_radius < float("inf"):
            raise ArgumentError(
                f"collect: expected a finite visited_radius above goal_radius ({self.goal_radius} m), or a reached "
                f"waypoint would never count as visited; got {self.visited_radius} m"
            )
        if self.max_segment_frames < 2 or self.max_scene_frames < 2:
            raise ArgumentError(
                "collect: expected max_segment_frames and max_scene_frames of 2 or more, got "
                f"{self.max_segment_frames} and {self.max_scene_frames}"
            )
        if self.next_waypoint not in get_args(NextWaypoint):
            raise ArgumentError(
                f"collect: expected next_waypoint among {', '.join(get_args(NextWaypoint))}, got {self.next_waypoint}"
            )


PRESETS: Mapping[str, NavigationRules] = {"default": NavigationRules(), "paper": NavigationRules(visited_radius=3.0)}
"""`paper` marks waypoints within 3 m as visited, which leaves rooms unseen that the default visits."""


def make_rules(preset: str = "default", options: Mapping[str, object] | None = None) -> NavigationRules:
    """Return the rules of a preset with some of them replaced.

    Raises:
        ArgumentError: no preset, or no rule, has such a name; or a value is of another type or out of range.
    """
    if preset not in PRESETS:
        raise ArgumentError(f"collect: expected a preset among {', '.join(PRESETS)}, got {preset}")
    given = read_values(NavigationRules, options or {}, "collect", "rule")
    return NavigationRules(**{**vars(PRESETS[preset]), **given})
