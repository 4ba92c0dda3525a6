# SPDX-License-Identifier: Apache-2.0
"""The policy `vlm` for plans of primitives or of gripper poses."""

from __future__ import annotations

import inspect
from typing import Any

from wiw.policies.vlm.arm.policy import ArmVLM
from wiw.policies.vlm.policy import VLM, refuse_tracking
from wiw.policies.vlm.questions.policy import QuestionVLM
from wiw.types import GRIPPER_POSES, PRIMITIVES

TRACKING = frozenset(inspect.signature(refuse_tracking).parameters)
"""Options that are of no use without a target."""


def make_vlm(space: str = PRIMITIVES, task: str = "", **options: Any) -> VLM:
    """Asks a vision-language model for plans, scores and answers (any OpenAI-compatible server, or a local model).

    `VLM` documents the options, and `QuestionVLM` those of task "aeqa".
    """
    if task == "imagenav":  # which points nothing out
        refuse_tracking(**{name: options[name] for name in TRACKING.intersection(options)})
        options["tracker"] = None
    kind = ArmVLM if space == GRIPPER_POSES else QuestionVLM if task in QuestionVLM.tasks else VLM
    return kind(**options)


def _signature() -> inspect.Signature:
    """The options of all classes, so that `--policy-option` and errors name them."""
    *options, rest = inspect.signature(VLM).parameters.values()
    own = inspect.signature(make_vlm, eval_str=True).parameters
    asking = inspect.signature(QuestionVLM).parameters.values()
    more = [each for each in asking if each.kind is inspect.Parameter.KEYWORD_ONLY]
    named = [own[name].replace(kind=inspect.Parameter.KEYWORD_ONLY) for name in ("space", "task")]
    return inspect.Signature([*options, *more, *named, rest])


make_vlm.__signature__ = _signature()  # type: ignore[attr-defined]
