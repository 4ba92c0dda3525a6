# SPDX-License-Identifier: Apache-2.0
"""Real observations in the view and size that a world model takes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw._core import planner
from wiw.action import FORWARD
from wiw.types import ArmObservation, Observation
from wiw.world_models.base import Accepts


@cache
def view_maker(view: str, size: tuple[int, int]) -> Any:
    """Return the maker of views of a kind and size; it keeps its tables."""
    return planner.ViewMaker(view, size)


def maker_of(accepts: Accepts) -> Any:
    """Return the maker of the views that a world model takes."""
    return view_maker("front" if accepts.view == "perspective" else "panorama", accepts.size)


def resize(image: NDArray[Any], size: tuple[int, int], how: int = cv2.INTER_AREA) -> NDArray[Any]:
    """Return the image in a size, itself where it has that already."""
    return image if image.shape[:2] == size else np.asarray(cv2.resize(image, size[::-1], interpolation=how))


def take_views(accepts: Accepts, observations: Sequence[Observation | ArmObservation]) -> NDArray[np.uint8]:
    """Return each observation as the world model is shown it, uint8 [n, H, W, 3]."""
    if isinstance(observations[0], ArmObservation):
        return np.stack([resize(observation.front, accepts.size) for observation in observations])
    ahead = [[np.array([FORWARD], np.int8)]] * len(observations)  # a row per observation, without leading turns
    panoramas = [observation.panorama for observation in observations if isinstance(observation, Observation)]
    return np.asarray(planner.Batch.build(ahead).observations(panoramas, maker_of(accepts)))
