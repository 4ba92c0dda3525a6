# SPDX-License-Identifier: Apache-2.0
"""The pictures of question answering: the four real views, with marks and without, and imagined ones at plans' ends."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wiw import annotate
from wiw.mapping.views import VIEW_NAMES, cut_images
from wiw.policies.vlm.questions.home_map import Sight
from wiw.types import Rollout

Image = NDArray[np.uint8]


def render_marked_views(sight: Sight) -> Image:
    """Return the four views side by side, with the landmarks' outlines and numbers."""
    return _join(sight.marked.images, "real")


def render_plain_views(sight: Sight) -> Image:
    """Return the four views side by side, without marks."""
    return _join(sight.views.images, "real")


def render_view(sight: Sight, view: int) -> Image:
    """Return one view with its marks, as the agent sees it once it has turned there."""
    return annotate.strip(sight.marked.images[view][None], [f"real: {VIEW_NAMES[view]} view"])


def describe_end(rollout: Rollout) -> str:
    """Return what `render_end` shows; a plan that only turns ends with real views, turned."""
    kind = "The real views, turned," if rollout.real[-1] else "Imagined views"
    return f"{kind} at its end"


def render_end(rollout: Rollout) -> Image:
    """Return what is to be seen at the end of a plan: four views, or the front view where no more was imagined."""
    end = rollout.frames[-1]
    kind = "real" if rollout.real[-1] else "imagined"
    if rollout.view == "panorama":
        return _join(cut_images(end), kind)
    return _join(end[None] if end.ndim == 3 else end, kind)


def _join(views: Image | Sequence[Image], kind: str) -> Image:
    return annotate.strip(views, [f"{kind}: {name} view" for name in VIEW_NAMES[: len(views)]])
