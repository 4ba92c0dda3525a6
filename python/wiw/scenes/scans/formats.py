# SPDX-License-Identifier: Apache-2.0
"""Real scans: scenes whose labels lie in files of their own, in the layout of a dataset.

A scan is opened by its mesh file, as any scene is; `find_reader` recognises its layout by the files beside it.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from wiw import _core
from wiw.errors import ArgumentError, FileError
from wiw.scenes.basis import import_mesh
from wiw.scenes.scans import hm3d, matterport, replica, scene_dataset
from wiw.scenes.scans.scan import Imported, require_folder, require_scans

__all__ = ["KINDS", "compare_tables", "find_all", "find_reader", "find_scans", "parse_spec", "read_scene"]

VERSION = 2
"""Raised when the same files give another scene."""

_READERS = {
    "mp3d": matterport.read,
    "hm3d": hm3d.read,
    "replica": replica.read,
    "dataset": scene_dataset.read,
}
KINDS = ("mp3d", "hm3d", "replica", "hssd", "replicacad", "procthor")
"""Datasets that scene specs name, as in "hm3d:DIR:val"."""


def find_reader(file: Path) -> list[Any] | None:
    """Return the reader of a scan that is opened by `file`, with its version; None for any other scene."""
    if file.name.endswith(scene_dataset.ENDING):
        return ["dataset", VERSION]
    for name, reader in (("replica", replica), ("hm3d", hm3d), ("mp3d", matterport)):
        if reader.is_scan(file):
            return [name, VERSION]
    return None


def read_scene(file: Path, options: dict[str, Any]) -> Imported:
    """Read a scene from a file.

    Args:
        file: a mesh, a Gazebo world, or what a scan is opened by.
        options: those of `wiw.scenes.load`, as "scan" what `find_reader` returned, and "basis_decoder", which only
            names the scene in the cache.

    Raises:
        FileError: a file is missing, damaged or does not fit the others; names it.
        ArgumentError: an option is out of its range.
        DependencyError: textures need a decoder that is not installed.
    """
    reader = options.get("scan")
    options = {name: value for name, value in options.items() if name not in ("scan", "basis_decoder")}
    if reader is not None:
        return _READERS[reader[0]](file, options)
    return Imported(*import_mesh(file, **options))


def parse_spec(spec: str) -> tuple[str, Path, str] | None:
    """Return kind, folder and split of a spec such as "hm3d:DIR:val" or "replica:DIR"; None for any other spec."""
    kind, colon, rest = spec.partition(":")
    if kind not in KINDS or not colon or Path(spec).exists():
        return None
    folder, colon, split = rest.rpartition(":")
    if not colon or Path(rest).expanduser().exists():
        folder, split = rest, ""
    return kind, Path(folder or "."), split


def find_scans(kind: str, folder: Path, split: str = "") -> list[Path]:
    """Return the files by which the scans of a dataset are opened, in order.

    Args:
        kind: one of `KINDS`.
        folder: the dataset's folder, or that of a single scan.
        split: a folder of that name, such as HM3D's "val"; "" for all there are.

    Raises:
        FileError: the folder does not exist, or has no scan of that kind.
    """
    if kind not in KINDS:
        raise ArgumentError(f"'{kind}' is not a kind of scan; expected one of {', '.join(KINDS)}")
    find = {"mp3d": matterport.find, "hm3d": hm3d.find, "replica": replica.find}.get(kind, scene_dataset.find)
    return find(folder, split)


def find_all(folder: Path) -> list[Path]:
    """Return the scans of every kind in a folder, in order.

    Raises:
        FileError: the folder does not exist, or has none.
    """
    found: set[Path] = set()
    for kind in ("mp3d", "hm3d", "replica", "hssd"):
        with suppress(FileError):
            found |= set(find_scans(kind, folder))
    kinds = ", ".join(KINDS)
    return require_scans(sorted(found), require_folder(folder, ""), f"scans in the layout of one of {kinds}")


def compare_tables(file: Path, scene: _core.scene.Scene) -> list[str]:
    """Return where a scan is not what its dataset's own tables say, one sentence each.

    Raises:
        FileError: a table is missing or damaged.
    """
    reader = find_reader(file)
    return matterport.compare_boxes(file, scene) if reader and reader[0] == "mp3d" else []
