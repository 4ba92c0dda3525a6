# SPDX-License-Identifier: Apache-2.0
"""The tracker of imagined frames where none is chosen."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from wiw.networks import in_hub_cache
from wiw.perception.flow import Flow
from wiw.perception.frame_tracking import FrameTracker
from wiw.perception.sam2 import WEIGHTS, Sam2


def make_frame_tracker(**options: Any) -> FrameTracker:
    """Tracks the target in the frames: with SAM 2 if its weights are on this machine, otherwise by optical flow.

    Args:
        options: of `Sam2`, which is meant then; its weights are downloaded if need be.

    Raises:
        DependencyError, WeightsError: see `Sam2`.
    """
    if options or (in_hub_cache(WEIGHTS) and find_spec("torch") and find_spec("transformers")):
        return Sam2(**options)
    return Flow()
