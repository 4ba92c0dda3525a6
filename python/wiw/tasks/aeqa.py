# SPDX-License-Identifier: Apache-2.0
"""Active Embodied Question Answering: explore until a question can be answered in words (paper, appendix "A-EQA")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.episodes import read_json
from wiw.datasets.questions import Question, openeqa
from wiw.datasets.questions.balance import EpisodeSeries
from wiw.datasets.questions.blind import blind_answer
from wiw.datasets.questions.generate import EpisodeRules, generate, generate_available
from wiw.datasets.questions.mesh_table import NO_ATTRIBUTES, read_attributes
from wiw.datasets.visibility import COARSE, measure_sizes
from wiw.datasets.worlds import World, world
from wiw.envs.episode_state import EpisodeState
from wiw.errors import ArgumentError, FileError, JudgeError, StoreError, VlmError
from wiw.judging import Judge, Judgement, make_judge
from wiw.judging.judge import HIGHEST_MARK
from wiw.scenes import is_generated, resolve
from wiw.tasks.answer_record import CUTS, MARK_METRICS, AnswerRecord, Unanswered, make_reference, map_mark
from wiw.tasks.navigation import NavigationTask
from wiw.typed_values import require_positive
from wiw.types import Episode, Goal, TableSpec, TextAnswer, Wording

COUNTED_SCENES = 16
"""Apartments whose episodes are all made to be counted, which takes some seconds each."""
HALF_TURN = 8
"""Maximum number of primitives of a turn: 22.5 degrees each, the shorter way round."""
SEEN = 0.008
"""Steradians of a thing in view that count as having seen it: .3 % of a view with 105 degrees across."""


@dataclass(frozen=True)
class AEQARules:
    """Budget, end and metric variants; their values are in the presets (`wiw/configs`)."""

    actions: int
    """Primitives that an episode may take."""
    candidates: int
    """M, plans imagined per decision."""
    horizon: int
    """L, actions per plan of policy `vlm`, where the turn that a plan begins with counts as one, whatever its angle.
    Routes of `explorer` are not cut so: they have up to L - 1 + 8 primitives, and a world model of L - 1 actions a clip
    needs two calls for one with more than that after its first turn."""
    execute: int
    """Maximum number of primitives carried out before the next decision. Plans have L - 1 + 8 at most; only routes that
    policy `vlm` decides on may have more (`longest_route`)."""
    confirm: Literal["next_view", "same_view", "none"]
    """When a final answer ends the episode: given again after the next segment, given again at once on the same view
    (nothing is carried out in between), or the first time."""
    unanswered: Unanswered
    """Mark of an episode without a final answer."""
    turns: Literal["counted", "first_free"]
    """Whether the turn at the start of a segment counts as primitives."""
    motion: Literal["refuse", "slide"]

    def __post_init__(self) -> None:
        require_positive("aeqa", self, "actions", "candidates", "horizon", "execute")


class AEQA(NavigationTask):
    """Answer a question about a home, exploring it as far as needed.

    Questions, when an episode ends, and metrics. `NavigationTask` documents the rest of the arguments.

    Args:
        judge: who marks answers, see `wiw.judging.make_judge`: "rules" marks typed questions by rules and all others
            by an approximate score, "rules+llm:URL" asks a language model for those.
        attributes: JSON file that says more of the instances of a scene from a file, see
            `wiw.datasets.questions.mesh_table.read_attributes`.
    """

    name = "aeqa"
    default_policy = "explorer"
    metrics = ("answer_score", "spl", "path_length")
    rules_class = AEQARules
    generator_class = EpisodeRules
    wording = Wording(
        succeeded="answered correctly",
        won="correct",
        lost="not correct",
        goal="nearest viewpoint",
        way="to the nearest viewpoint",
        asked="The question",
    )
    tables = TableSpec(kinds=("answer_score", "spl"), judged=MARK_METRICS, cuts=CUTS, kind="category")

    def __init__(
        self, *args: Any, judge: str | Judge = "rules", attributes: str | Path | None = None, **options: Any
    ) -> None:
        super().__init__(*args, **options)
        self.judge = make_judge(judge)
        self.attributes = NO_ATTRIBUTES if attributes is None else read_attributes(attributes)
        if attributes is not None and (self.episode_file or self.is_balanced):
            raise ArgumentError(
                "aeqa: attributes=FILE describes the objects of a scene that lacks such data, such as a house of "
                "meshes (scenes=...); apartments need none, and episodes from a file are used as they are"
            )

    # -- what it says of itself ----------------------------------------------------------------------------------------

    @property
    def limit(self) -> int:
        """Maximum number of primitives of an episode."""
        return int(self.rules.actions)

    @property
    def budget(self) -> int:
        """Maximum number of primitives of an episode."""
        return self.limit

    @property
    def decisions(self) -> int:
        """Number of decisions of an episode if each executes as much as it may: what progress bars expect."""
        return -(-self.limit // int(self.rules.execute))

    @property
    def free_turns(self) -> bool:
        """Whether the turn at the start of a segment does not count."""
        return bool(self.rules.turns == "first_free")

    @property
    def defaults(self) -> dict[str, Any]:
        """Options for `wiw.Agent` that the task prescribes."""
        horizon = self.rules.horizon - 1 + HALF_TURN
        return {"candidates": self.rules.candidates, "horizon": horizon, "execute": self.rules.execute}

    @staticmethod
    def make_portable(options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the same options, with absolute paths and the renderer that "auto" stands for."""
        made = NavigationTask.make_portable(options)
        path = made.get("attributes")
        return made if path is None else {**made, "attributes": str(Path(path).expanduser().absolute())}

    @property
    def is_balanced(self) -> bool:
        """Whether generated questions are asked in two scenes at least, so that texts give no answers away."""
        return is_generated(self.scenes)

    @property
    def file_header(self) -> dict[str, Any]:
        """Header of a file of its episodes."""
        return {**super().file_header, "balanced": self.is_balanced}

    def describe(self) -> dict[str, Any]:
        """Return the JSON-able identity: what must be equal for two runs to be comparable."""
        more = {"attributes": self.attributes.to_info()} if self.attributes != NO_ATTRIBUTES else {}
        return {**super().describe(), "judge": self.judge.describe(), "policies": self.policy_options, **more}

    def explain_episodes(self, episodes: Sequence[Episode]) -> list[str]:
        """Return what unbalanced questions give away."""
        asked = [read_question(episode) for episode in episodes if episode.info.get("unbalanced")]
        if not asked:
            return []
        references = [make_reference(each) for each in asked]
        guessed = make_judge("rules").judge(references, [blind_answer(each.text) for each in asked])
        score = 100 * sum(map_mark(each.mark) for each in guessed) / len(asked)
        return [
            "unbalanced: each question is asked in one scene only, so its text may give its answer away; guessing "
            f"what is most frequent in apartments scores {score:.0f} of 100"
        ]

    # -- episodes ------------------------------------------------------------------------------------------------------

    def load_episodes(self) -> list[Episode]:
        """Return the file's episodes: wiw's own, or one of OpenEQA's lists.

        Raises:
            FileError: the file cannot be read, an episode has no question or a bad one, or two have the same id.
        """
        assert self.episode_file is not None
        if isinstance(read_json(self.episode_file), list):
            found = openeqa.load(self.episode_file, self.scene_folder)
        else:
            found = super().load_episodes()
            _check_questions(found, self.episode_file)
        return [_describe(episode) for episode in found]

    def episodes(self, count: int) -> list[Episode]:
        """Return the first `count` episodes; the scene of one without a start is opened, so that it has one.

        Raises:
            ArgumentError: the episode file or the scenes hold fewer.
        """
        found = super().episodes(count)
        self._episodes[:count] = [
            self.locate(self.open_world(each), each) if np.isnan(each.start_position).any() else each for each in found
        ]
        return self._episodes[:count]

    def locate(self, place: World, episode: Episode) -> Episode:
        """Return the episode with a start on the floor: OpenEQA's lists may give none."""
        return openeqa.locate_start(place, episode) if episode.info.get("source") == openeqa.SOURCE else episode

    def generate_first(self, count: int) -> list[Episode]:
        """Return questions, from where the answer is not in view.

        Of generated apartments each is asked in two at least, with different answers. A scene from a file is used
        alone: its questions are unbalanced, and their episodes say so (`info["unbalanced"]`).
        """
        if self.is_balanced:
            return [_describe(episode) for episode in self._series.require(count)]
        place = world(resolve(self.scenes)[0], self.backend)
        alone = generate(place, count, self.seed, self.generator, attributes=self.attributes)
        return [_describe(replace(each, info={**each.info, "unbalanced": True})) for each in alone]

    @cached_property
    def _series(self) -> EpisodeSeries:
        """The episodes of apartments."""
        scenes = resolve(self.scenes)
        return EpisodeSeries(scenes, self.seed, self.generator, per_scene=self.per_scene, backend=self.backend)

    @property
    def episode_count(self) -> int | None:
        """How many episodes there are: as many as questions are found in a few scenes, which takes seconds for each;
        None for many apartments.
        """
        if not self._makes_questions:
            return super().episode_count
        return self._count_up_to(None) if len(resolve(self.scenes)) <= COUNTED_SCENES else None

    @property
    def drawn_count(self) -> int:
        """Among how many episodes a seed draws: those of a usual run, or as many as there are.

        Raises:
            ArgumentError: the scenes give none.
        """
        if not self._makes_questions:
            return super().drawn_count
        self.episodes(1)
        return self._count_up_to(self.default_episodes)

    def wrap_index(self, index: int) -> int:
        """Return an episode's number modulo the number of episodes, of which no more are made than that one needs.

        Raises:
            ArgumentError: the scenes give none.
        """
        if not self._makes_questions:
            return super().wrap_index(index)
        if index < len(self._episodes):
            return index
        self.episodes(1)
        return index % self._count_up_to(index + 1)

    @property
    def _makes_questions(self) -> bool:
        """Whether episodes are made as here, not read, nor made in another way by a class derived from this one."""
        names = ("episodes", "generate_first")
        return not self.episode_file and all(getattr(type(self), name) is getattr(AEQA, name) for name in names)

    def _count_up_to(self, most: int | None) -> int:
        """Return the number of episodes, or `most` if there are more."""
        if self.is_balanced:
            return len(self._series.take(most))
        place = world(resolve(self.scenes)[0], self.backend)
        return len(generate_available(place, most, self.seed, self.generator, attributes=self.attributes))

    def make_goal(self, place: World, episode: Episode) -> Goal:
        """Return the question's text, nothing else of it, and the budget with what counts towards it."""
        text = read_question(episode).text
        return Goal(AEQA.name, text=text, question=True, budget=self.budget, free_turns=self.free_turns)

    def find_goal_position(self, place: World, episode: Episode) -> NDArray[np.float64]:
        """Return the viewpoint that is nearest to the start; the start itself where none is known."""
        known = episode.goal_position if np.isfinite(episode.goal_position).all() else episode.start_position
        return place.ground.put_down(known).astype(np.float64)

    # -- when it ends --------------------------------------------------------------------------------------------------

    def is_sure(self, state: EpisodeState) -> bool:
        """Return whether the last answer is final, and confirmed as the rules ask."""
        needed = 1 if self.rules.confirm == "none" else 2
        latest = state.answers[-needed:]
        return len(latest) == needed and all(isinstance(own, TextAnswer) and own.final for own in latest)

    def waits(self, state: EpisodeState) -> bool:
        """Return whether a final answer is to be confirmed on the same view."""
        latest = state.answers[-1]
        return bool(self.rules.confirm == "same_view" and isinstance(latest, TextAnswer) and latest.final)

    def is_success(self, state: EpisodeState) -> bool:
        """Return whether the episode has ended with an answer of the highest mark.

        One that could not be judged is none so far: that is an error of the episode, which `measure` reports.
        """
        answer = self.final_answer(state)
        judged = self._judge(state, answer) if answer else None
        return isinstance(judged, Judgement) and judged.mark == HIGHEST_MARK

    def final_answer(self, state: EpisodeState) -> str:
        """Return the answer that the episode has ended with; empty without one.

        A final answer that the budget leaves no time to confirm counts too.
        """
        last = state.answers[-1] if state.answers else None
        over = state.ended or state.is_out_of_budget(self)
        return last.text if over and isinstance(last, TextAnswer) and last.final else ""

    # -- metrics -------------------------------------------------------------------------------------------------------

    def measure(self, state: EpisodeState) -> dict[str, float]:
        """Return the metrics of one finished episode.

        `mark` 1 to 5; `answer_score` (mark - 1) / 4; `success` 0 or 1, 1 for the highest mark; `spl`, the episode's
        contribution; `path_length` in metres and `shortest`, L*; `primitives`; `answered` 0 or 1; `score_at_30` and so
        on, the score if the episode had been cut there; `grounded` 0 or 1, whether what the question is about was in
        sight before the answer. Without `shortest` and `spl` where L* is not known, and without `grounded` where that
        is not.

        Raises:
            JudgeError: the judge gave no mark.
            VlmError: its language model could not be asked.
        """
        record = self._make_record(state)
        judgements = self._judge_answers(state, record)
        for found in judgements.values():
            if not isinstance(found, Judgement):
                raise found
        return record.compute_metrics(_select_judgements(judgements))

    def describe_end(self, state: EpisodeState) -> dict[str, Any]:
        """Return the answer, what was expected, the answer by the text alone, and who judged them how."""
        record = self._make_record(state)
        if "measured" not in (found := record.describe(_select_judgements(self._judge_answers(state, record)))):
            return found
        return {**found, "measured": {**found["measured"], "decisions": float(state.decisions)}}

    @classmethod
    def read_answers(cls, task: Mapping[str, Any], episode: Episode, outcome: Mapping[str, Any]) -> AnswerRecord | None:
        """Return the answers of a stored outcome; None if it has none because something other than a judge broke.

        Raises:
            StoreError: the outcome lacks what its marks are computed from.
        """
        details, metrics = outcome["details"], outcome["metrics"]
        walk = details.get("measured") if outcome["status"] == "error" else metrics
        if walk is None:
            return None
        measured = {name: value for name, value in walk.items() if name not in MARK_METRICS}
        question = read_question(episode)
        try:
            blind = details.get("blind", {"answer": blind_answer(question.text)})["answer"]
            record = AnswerRecord(question, details["answer"], blind, task["unanswered"], measured)
            record.require_whole()
        except (KeyError, TypeError) as error:
            place = f"outcome of {outcome['arm']} in episode {outcome['episode']}"
            raise StoreError(f"{place}: no {error}; the run store was edited: restore it from a backup") from error
        return record

    def _make_record(self, state: EpisodeState) -> AnswerRecord:
        """Return an ended episode with all that no mark changes."""
        question, answer = read_question(state.episode), self.final_answer(state)
        measured = {
            "path_length": state.path_length,
            **({"shortest": state.episode.geodesic} if np.isfinite(state.episode.geodesic) else {}),
            "primitives": float(state.actions),
            "answered": float(bool(answer)),
            **self._measure_grounding(state),
        }
        return AnswerRecord(question, answer, blind_answer(question.text), self.rules.unanswered, measured)

    def _judge_answers(self, state: EpisodeState, record: AnswerRecord) -> dict[str, Judgement | JudgeError | VlmError]:
        return {answer: self._judge(state, answer) for answer in record.answers}

    def _judge(self, state: EpisodeState, answer: str) -> Judgement | JudgeError | VlmError:
        """Return the judgement of an answer, or why there is none; each one is asked for once per episode."""
        known: dict[str, Judgement | JudgeError | VlmError] = state.notes.setdefault("judgements", {})
        if answer not in known:
            try:
                known[answer] = self.judge.judge([make_reference(read_question(state.episode))], [answer])[0]
            except (JudgeError, VlmError) as error:
                known[answer] = error
        return known[answer]

    def _measure_grounding(self, state: EpisodeState) -> dict[str, float]:
        """Return whether all that the question is about has been in sight; measured once for each number of views."""
        targets = list(read_question(state.episode).target)
        if not targets:
            return {}
        known: dict[int, float] = state.notes.setdefault("grounded", {})
        if len(state.observed) not in known:
            places = np.unique(np.stack([state.positions[i] for i in state.observed]), axis=0)
            sizes = measure_sizes(state.world, places, COARSE)[:, targets]
            known[len(state.observed)] = float((sizes.max(axis=0) >= SEEN).all())
        return {"grounded": known[len(state.observed)]}


def read_question(episode: Episode) -> Question:
    """Return the question of an episode, including everything hidden from the agent."""
    return Question.from_info(episode.info["question"])


def _check_questions(episodes: Sequence[Episode], path: str | Path) -> None:
    """Check that each episode of a file has a question, and an id of its own, by which twins name each other."""
    first: dict[str, int] = {}
    for i, episode in enumerate(episodes):
        where = f"{path}: episode {i} ('{episode.episode_id}')"
        if "question" not in episode.info:
            raise FileError(
                f"{where} has no question: expected a file of `wiw episodes aeqa`, or a list of OpenEQA; episodes of "
                "other tasks ask none"
            )
        try:
            read_question(episode)
        except ArgumentError as error:
            raise FileError(f"{where}: {error}") from error
        if (other := first.setdefault(episode.episode_id, i)) != i:
            raise FileError(f"{where} has the id of episode {other}; expected a unique one")


def _describe(episode: Episode) -> Episode:
    """Let reports show the question, and tables be split by its category."""
    question = read_question(episode)
    return replace(episode, info={**episode.info, "task": question.category, "instruction": question.text})


def _select_judgements(found: Mapping[str, Judgement | JudgeError | VlmError]) -> dict[str, Judgement]:
    return {answer: each for answer, each in found.items() if isinstance(each, Judgement)}
