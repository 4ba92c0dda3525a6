# SPDX-License-Identifier: Apache-2.0
"""An Active Recognition episode in the two rooms, as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from wiw.datasets import episodes
from wiw.datasets.worlds import world
from wiw.types import Episode

CHOICES = ("chest", "picture", "shelf", "table")


def a_file(folder: Path, scene: str, start: Any = (-1.2, 0.0, -1.2), yaw: float = 0.0, target: str = "table") -> Path:
    """One episode: a thing of the two rooms, seen from a place in the western one."""
    things = {thing["name"]: thing for thing in world(scene, "cpu").scene.instances}
    centre = tuple(float(x) for x in np.asarray(things[target]["bounds"]).mean(axis=0))
    info = {"target": int(things[target]["id"]), "category": target}
    episode = Episode("one", scene, start, yaw, centre, 0.0, 1.0, info)
    path = folder / "ar.json"
    episodes.save(path, [episode], "ar", categories=list(CHOICES))
    return path
