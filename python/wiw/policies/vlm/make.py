# SPDX-License-Identifier: Apache-2.0
"""The policy `vlm` for plans of primitives or of gripper poses."""

from __future__ import annotations

import inspect
from typing import Any

from wiw.policies.vlm import VLM
from wiw.policies.vlm.arm import ArmVLM
from wiw.types import GRIPPER_POSES, PRIMITIVES


def make_vlm(space: str = PRIMITIVES, **options: Any) -> VLM:
    """Ask a vision-language model for plans, scores and answers (any OpenAI-compatible server, or a local model).

    `VLM` documents the options.
    """
    return (ArmVLM if space == GRIPPER_POSES else VLM)(**options)


def _signature() -> inspect.Signature:
    """The options of `VLM`, so that `--policy-option` and errors name them."""
    own = inspect.signature(make_vlm, eval_str=True).parameters["space"].replace(kind=inspect.Parameter.KEYWORD_ONLY)
    *options, rest = inspect.signature(VLM).parameters.values()
    return inspect.Signature([*options, own, rest])


make_vlm.__signature__ = _signature()  # type: ignore[attr-defined]
