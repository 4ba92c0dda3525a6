# SPDX-License-Identifier: Apache-2.0
"""A variant of an existing task: Image-Goal Navigation in which a goal behind a wall does not count as reached."""

from __future__ import annotations

from wiw.envs.episode_state import EpisodeState
from wiw.tasks.imagenav import ImageNav


class WalkableImageNav(ImageNav):
    """Succeeds if the agent comes within the goal's radius, and the way from there is at most twice as long."""

    name = "walkable-imagenav"

    def is_success(self, state: EpisodeState) -> bool:
        return super().is_success(state) and (state.success or state.geodesic_to_goal() <= 2 * self.rules.radius)
