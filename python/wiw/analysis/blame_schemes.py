# SPDX-License-Identifier: Apache-2.0
"""Which stages the failures of a run can be blamed on, how they are rerun, and what the reruns mean.

A verdict is the first of these that turns a failure into a success, ordered by how much it gives away.

Any task but question answering (`LOOP`):
imagination: ground-truth futures; the agent's own plans and scores are good enough.
scoring: ground-truth scores; the agent's own plans are good enough.
proposals: a ground-truth plan among the proposals; the agent recognises a good plan when it has one.
joint: ground truth in all three stages, but in no single one.
beyond: not even all three: the budget, the actions, or an answer that is wrong from the best view.

Question answering (`QUESTIONS`):
imagination: ground-truth futures; the agent's own perception and exploration are good enough.
perception: ground-truth labels and colours of real views; the agent's own exploration is good enough.
exploration: views from all over the home; the agent's own perception is good enough.
joint: ground truth in perception and exploration, but in neither alone.
answering: not even both: the map, or the answer that is read from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wiw.experiments.ground_truth import STAGES


@dataclass(frozen=True)
class Rerun:
    """A rerun with ground truth."""

    stages: tuple[str, ...]
    """Stages that use it."""
    about: str
    """The same in words: "scoring", "all three stages"."""


@dataclass(frozen=True)
class Scheme:
    """The stages that failures can be blamed on."""

    reruns: Mapping[str, Rerun]
    """By name, ordered by how much they give away; the last has ground truth in several stages."""
    verdicts: Mapping[str, str]
    """By name, each in a sentence: one per rerun that is the first to succeed, then the one where none does."""
    policy: str | None = None
    """The only policy whose failures can be blamed on these stages; None if any policy's can."""
    needs_guide: bool = True
    """Whether the task has to define the true value of plans."""

    def find_verdict(self, success: Mapping[str, bool]) -> str:
        """Return the verdict on a failure, by which reruns of it succeed; some may be missing."""
        *names, beyond = self.verdicts
        mended = (verdict for verdict, rerun in zip(names, self.reruns, strict=True) if success.get(rerun))
        return next(mended, beyond)

    def allows(self, agent: Mapping[str, Any]) -> bool:
        """Return whether an agent's failures can be blamed on these stages, by its recipe as JSON."""
        if self.policy is None:
            return True
        return agent["policy"] == self.policy and agent.get("reviser") in (None, self.policy)


LOOP = Scheme(
    reruns={**{stage: Rerun((stage,), stage) for stage in STAGES}, "all": Rerun(STAGES, "all three stages")},
    verdicts={
        "imagination": "ground-truth futures are enough",
        "scoring": "ground-truth scores of the agent's own plans are enough",
        "proposals": "a ground-truth plan among the proposals is enough",
        "joint": "only ground truth in all three stages is enough",
        "beyond": "not even ground truth in all three stages is enough",
    },
)
QUESTIONS = Scheme(
    reruns={
        "imagination": Rerun(("imagination",), "imagination"),
        "perception": Rerun(("perception",), "perception: true labels and colours of real views"),
        "exploration": Rerun(("exploration",), "exploration: a tour of the whole home"),
        "both": Rerun(("perception", "exploration"), "perception and exploration"),
    },
    verdicts={
        "imagination": "ground-truth futures are enough",
        "perception": "ground-truth labels and colours of real views are enough",
        "exploration": "a tour of the whole home is enough",
        "joint": "only ground truth in both perception and exploration is enough",
        "answering": "not even ground truth in both perception and exploration is enough: the map or the answer",
    },
    policy="explorer",
    needs_guide=False,
)


def choose_scheme(task: Mapping[str, Any]) -> Scheme:
    """Return the scheme for a task that describes itself so: tasks with a judge ask questions."""
    return LOOP if task.get("judge") is None else QUESTIONS
