# SPDX-License-Identifier: Apache-2.0
"""Seeds of the fuzz targets of the compiled readers: whole files, from which damage reaches deep."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from locations import TESTS
from test_damaged_files import plain

from wiw import _core
from wiw.physics import Articulation, read_surface

CUBE = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + "f 1 2 4 3\nf 5 7 8 6\n"
MODEL = """<sdf version="1.7"><model name="part"><link name="l"><visual name="v"><geometry><sphere><radius>1</radius>
</sphere></geometry></visual></link></model></sdf>"""


@pytest.fixture
def seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, list[bytes]]:
    monkeypatch.syspath_prepend(str(TESTS / "reliability"))
    monkeypatch.setattr(sys, "path", list(sys.path))  # the script adds to it
    from fuzz_seeds import make_seeds

    return make_seeds(tmp_path)


def link_extension(seed: bytes) -> str:
    """Return the extension by which cpp/fuzz/link.cpp hands bytes to the reader."""
    if seed.startswith(b"ply"):
        return "ply"
    return "dae" if seed.startswith(b"<") else "stl"


def read_seed(target: str, seed: bytes, folder: Path) -> Any:
    readers: dict[str, tuple[str, Callable[[Path], Any]]] = {
        "surface": ("ply", lambda path: _core.scene.read_ply_surface(path, "object_id")),
        "cache": ("wiwscene", _core.scene.map_cache),
        "navmesh": ("navmesh", _core.nav.NavMesh.load),
        "urdf": ("urdf", Articulation),
        "link": (link_extension(seed), lambda path: read_surface(path, link="hand")),
    }
    extension, read = readers.get(target, (target, lambda path: plain(path).describe()))
    path = folder / f"m.{extension}"
    path.write_bytes(seed)
    return read(path)


def test_every_target_has_seeds_that_its_reader_takes(seeds: dict[str, list[bytes]], tmp_path: Path) -> None:
    targets = (TESTS.parent / "cpp/fuzz/CMakeLists.txt").read_text()
    lists = re.findall(r"foreach\(\w+ ([a-z ]+)\)", targets)
    assert {*re.findall(r"^wiw_fuzz\(([a-z]+)", targets, re.M), *" ".join(lists).split()} == set(seeds)
    (tmp_path / "part.obj").write_text(CUBE)
    (tmp_path / "part").mkdir()
    (tmp_path / "part/model.sdf").write_text(MODEL)
    for target, contents in seeds.items():
        assert contents, target
        for content in contents:
            assert target == "image" or read_seed(target, content, tmp_path), target
