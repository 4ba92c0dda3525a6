# SPDX-License-Identifier: Apache-2.0
"""A variant of a task that is there: Image-Goal Navigation that counts only where the agent says that it is there."""

from __future__ import annotations

from wiw.envs.episode_state import EpisodeState
from wiw.tasks.imagenav import ImageNav


class PatientImageNav(ImageNav):
    """The goal is reached where the agent stops within its radius."""

    name = "patient-imagenav"

    def is_success(self, state: EpisodeState) -> bool:
        return state.stopped and state.distance_to_goal() <= self.rules.radius
