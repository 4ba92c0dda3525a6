# SPDX-License-Identifier: Apache-2.0
"""Splits of scenes: which of them evaluation uses, so that nothing is trained on them."""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike, fspath
from pathlib import Path

from wiw.scenes import is_generated, strip_edits
from wiw.scenes.scans import replica

FOLDERS = ("val", "test", "minival", "validation")
"""Names of folders that hold scenes of evaluation, as in HM3D's "hm3d/val/00800-TEEsavR23oF"."""
MATTERPORT = {
    "val": (
        "2azQ1b91cZZ", "8194nk5LbLH", "EU6Fwq7SyZv", "oLBMNvg9in8", "QUCTc6BB5sX", "TbHJrupSAjP", "X7HyMhZNoso",
        "pLe4wQe7qrG", "x8F5xyUWy9e", "Z6MFQCViBuw", "zsNo4HB9uLZ",
    ),
    "test": (
        "2t7WUuJeko7", "5ZKStnWn8Zo", "ARNzJeq3xxb", "fzynW3qQPVF", "jtcxE69GiFV", "pa4otMbVnkk", "q9vSo1VnCiC",
        "rqfALeAoiTq", "UwV83HsGsw3", "wc2JMjhGNzB", "WYY7iVyf5p8", "YFuZgdQ5vWj", "yqstnuAEVhm", "YVUC4YcDtcY",
        "gxdoqLR6rwA", "gYvKGZ5eRqb", "RPmz2sHmrrY", "Vt2qJdWjCF2",
    ),
}  # fmt: skip
"""Matterport3D's own splits (its benchmark, `scenes_val.txt` and `scenes_test.txt`): its scenes are in one folder."""


def name_scene(spec: str | PathLike[str]) -> str:
    """Return the name of a single scene in a dataset: a generated one's spec, else the file's name up to a dot.

    Rooms of Replica, whose files all have one name, are called as their folders are.
    """
    spec = fspath(spec)
    if is_generated(spec):
        return spec
    return replica.room_name(Path(spec)) if replica.is_scan(Path(spec)) else Path(spec).name.partition(".")[0]


def find_evaluation_split(spec: str | PathLike[str]) -> str | None:
    """Return the split of a single scene that is for evaluation: "val", "test" or alike; None for any other scene.

    Generated apartments and Matterport3D's scenes are known by name, files of other datasets by the folders above them.
    """
    spec = fspath(spec)
    if is_generated(spec):
        return find_named_split(spec)
    path = Path(spec).expanduser().absolute()
    named = (find_named_split(part.partition(".")[0]) for part in path.parts)
    folders = (part.lower() for part in path.parent.parts if part.lower() in FOLDERS)
    return next((split for split in (*named, *folders) if split is not None), None)


def list_evaluation_scenes(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the scenes of a dataset that are for evaluation, each once with its split, sorted by name."""
    found = ((name, find_named_split(name)) for name in sorted(set(names)))
    return [(name, split) for name, split in found if split is not None]


def find_named_split(name: str) -> str | None:
    """Return the split of a scene that is for evaluation, by its name in a dataset alone; None if none is known."""
    if is_generated(name):
        split = strip_edits(name).partition(":")[2].partition("/")[0].partition(":")[0]
        return None if split == "train" else split
    return next((split for split, names in MATTERPORT.items() if name in names), None)
