# SPDX-License-Identifier: Apache-2.0
"""The child process that imports a scene for `wiw.scenes.isolated.import_to`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from wiw import _core
from wiw.scenes.child import answer_job
from wiw.scenes.scans.formats import read_scene


def import_scene(job: dict[str, Any]) -> dict[str, Any]:
    """Import a scene, write its cache file, name the files read and looked for."""
    imported = read_scene(Path(job["path"]), job["options"])
    _core.scene.write_cache(imported.scene, job["out"])
    return {"read": [str(path) for path in imported.read], "absent": [str(path) for path in imported.absent]}


if __name__ == "__main__":
    answer_job(import_scene)
