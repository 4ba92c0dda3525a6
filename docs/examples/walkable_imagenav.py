# SPDX-License-Identifier: Apache-2.0
"""A variant of an existing task: Image-Goal Navigation that succeeds only if the agent itself stops at the goal."""

from __future__ import annotations

from wiw.envs.episode_state import EpisodeState
from wiw.tasks.imagenav import ImageNav


class PatientImageNav(ImageNav):
    """Succeeds if the agent stops within the goal's radius."""

    name = "patient-imagenav"

    def is_success(self, state: EpisodeState) -> bool:
        return state.stopped and state.distance_to_goal() <= self.rules.radius
