# SPDX-License-Identifier: Apache-2.0
"""Active Recognition: say what the boxed thing is, moving where that helps (paper, appendix "Active Recognition")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.datasets import ar
from wiw.datasets.visibility import visible_fraction
from wiw.datasets.worlds import World, world
from wiw.envs.episode_state import EpisodeState
from wiw.envs.pointing import Pointing
from wiw.errors import ArgumentError
from wiw.tasks.navigation import NavigationTask
from wiw.typed_values import require_positive
from wiw.types import Answer, Episode, Goal, Wording


@dataclass(frozen=True)
class ARRules:
    """Budget, stop rule and variants; their values are in the presets (`wiw/configs`)."""

    decisions: int
    """K; nothing is carried out after the last one."""
    candidates: int
    """M, plans imagined per decision."""
    horizon: int
    """L, primitives per plan."""
    execute: Literal["primitive", "sequence"]
    """Part of the chosen plan carried out before the next decision: its first primitive, or its first L, which are
    all of it unless a search of several levels has extended it."""
    confidence: float
    """An answer more probable than this, before it is normalised (`Answer.confidence`), ends the episode at once."""
    prediction: Literal["last", "surest"]
    """Rule for the final answer; of equally confident ones the earliest."""
    lost: Literal["continue", "stop"]
    """Whether the episode goes on when neither panorama nor front view shows the target."""
    box_scale: float
    """The target's box about its centre."""
    box_part: Literal["all", "largest"]
    """Whether the box holds all visible pixels of the target or their largest piece."""
    motion: Literal["refuse", "slide"]

    def __post_init__(self) -> None:
        require_positive("ar", self, "decisions", "candidates", "horizon")
        if self.box_scale <= 0:
            raise ArgumentError(f"ar: box_scale must be positive, got {self.box_scale}")
        if not 0 <= self.confidence <= 1:
            raise ArgumentError(f"ar: confidence: expected a probability from 0 to 1, got {self.confidence}")


class AR(NavigationTask):
    """Recognise the boxed object, moving if that helps; the policy must give an answer.

    Targets, when an episode ends, and metrics. `NavigationTask` documents the rest of the arguments.

    Args:
        categories: what targets are and answers are chosen from; None means the built-in list
            (`wiw.datasets.ar.CATEGORIES`), or, with an episode file, the file's own.
    """

    name = "ar"
    default_policy = "recogniser"
    metrics = ("success", "mean_trajectory")
    rules_class = ARRules
    generator_class = ar.EpisodeRules
    wording = Wording(
        succeeded="recognised the target",
        won="recognised",
        lost="not recognised",
        goal="target",
        way="to the best view",
        asked="The boxed thing",
    )

    def __init__(self, *args: Any, categories: Sequence[str] | None = None, **options: Any) -> None:
        super().__init__(*args, **options)
        if categories is not None and not _different_names(categories):
            raise ArgumentError(f"ar: categories: expected different names, got {categories!r}")
        self.choices = tuple(categories or ar.CATEGORIES)
        self._categories = categories
        if self.episode_file:
            self._read_file()  # the file may name the choices

    @property
    def defaults(self) -> dict[str, Any]:
        """Options for `wiw.Agent` that the task prescribes; a policy that only proposes needs one that answers."""
        execute = 1 if self.rules.execute == "primitive" else 0
        return {**super().defaults, "execute": execute, "revision": "recogniser"}

    @property
    def file_header(self) -> dict[str, Any]:
        """Header of a file of its episodes."""
        return {**super().file_header, "categories": list(self.choices)}

    @property
    def pointing(self) -> Pointing:
        """How the target is boxed."""
        return Pointing(self.rules.box_scale, self.rules.box_part, self.rules.lost)

    def describe(self) -> dict[str, Any]:
        """Return the JSON-able identity: what must be equal for two runs to be comparable."""
        return {**super().describe(), "categories": list(self.choices)}

    def make_goal(self, place: World, episode: Episode) -> Goal:
        """Return the choices; what is to be recognised is pointed out in the observations."""
        return Goal(AR.name, choices=self.choices)

    def find_goal_position(self, place: World, episode: Episode) -> NDArray[np.float64]:
        """Return the place nearest to the target's centre where an agent can stand; below the centre without one."""
        centre = ar.centre_of(place, int(episode.info["target"]), f"episode {episode.episode_id}")
        below = np.array([centre[0], episode.start_position[1], centre[2]])
        nearest = place.navmesh.snap(below)
        known = below if nearest is None or not np.isfinite(nearest).all() else nearest
        return place.ground.put_down(known).astype(np.float64)

    def is_sure(self, state: EpisodeState) -> bool:
        """Return whether the last answer is above the confidence that ends the episode."""
        return state.answers[-1].confidence > self.rules.confidence

    def is_success(self, state: EpisodeState) -> bool:
        """Return whether the episode has ended with the right answer."""
        final = self.final_answer(state)
        return state.ended and final is not None and final.label == state.episode.info["category"]

    def find_destination(self, state: EpisodeState) -> NDArray[np.float64]:
        """Return where the target is seen best."""
        return ar.find_best_place(state.world, state.episode)

    def measure_progress(self, state: EpisodeState, fork: Any, primitives_left: float) -> float:
        """Return how well the target is truly seen, 0 to 1; where that is equal, the way to the best view decides."""
        return (
            ar.measure_clarity(state.world, fork.position, int(state.episode.info["target"])) - 0.001 * primitives_left
        )

    def final_answer(self, state: EpisodeState, decisions: int | None = None) -> Answer | None:
        """Return the answer that counts, of those given so far, or at the first `decisions`."""
        given = [answer for answer in state.answers[:decisions] if isinstance(answer, Answer)]
        if not given:
            return None
        return max(given, key=lambda answer: answer.confidence) if self.rules.prediction == "surest" else given[-1]

    def describe_end(self, state: EpisodeState) -> dict[str, Any]:
        """Return `right_after`: after each decision, whether the answer that would have counted then is right."""
        finals = [self.final_answer(state, count + 1) for count in range(len(state.answers))]
        right = state.episode.info["category"]
        return {"right_after": [answer is not None and answer.label == right for answer in finals]}

    def measure(self, state: EpisodeState) -> dict[str, float]:
        """Return the metrics of one finished episode.

        `success` 0 or 1; `actions` carried out before the final answer; its `confidence` (0 without an answer);
        `visible_start` and `visible_end`, the shares of the target in sight there; `category` and `predicted`, numbers
        of the choices (`predicted` is -1 without an answer).
        """
        final, target = self.final_answer(state), int(state.episode.info["target"])
        category = state.episode.info["category"]
        return {
            "success": float(final is not None and final.label == category),
            "actions": float(state.actions),
            "confidence": 0.0 if final is None else final.confidence,
            "visible_start": visible_fraction(state.world, state.positions[0], target),
            "visible_end": visible_fraction(state.world, state.positions[-1], target),
            "category": float(self.choices.index(category)),
            "predicted": -1.0 if final is None else float(self.choices.index(final.label)),
        }

    def load_episodes(self) -> list[Episode]:
        """Return the file's episodes; where it gives no place of the target, the scene does."""
        assert self.episode_file is not None
        loaded, self.choices = ar.load(self.episode_file, self.scene_folder, self._categories)
        return [self._place_goal(episode, f"{self.episode_file}: episode {i}") for i, episode in enumerate(loaded)]

    def generate_episodes(self, place: World, first: int, before: list[Episode]) -> list[Episode]:
        """Return episodes with targets hardly seen at the start, of the categories that are rarest so far."""
        taken = [episode.info["category"] for episode in before]
        return ar.generate(place, self.per_scene, self.seed, self.choices, self.generator, first=first, before=taken)

    def _place_goal(self, episode: Episode, where: str) -> Episode:
        if np.isfinite(episode.goal_position).all():
            return episode
        centre = ar.centre_of(world(episode.scene, self.backend), int(episode.info["target"]), where)
        return replace(episode, goal_position=(float(centre[0]), float(centre[1]), float(centre[2])))


def _different_names(given: Any) -> bool:
    names = given if isinstance(given, Sequence) and not isinstance(given, str) else ()
    return len(names) > 0 and all(isinstance(name, str) for name in names) and len(set(names)) == len(names)
