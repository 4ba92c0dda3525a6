# SPDX-License-Identifier: Apache-2.0
"""Episode files that somebody has damaged: whatever is wrong with one is an error of wiw's own that names the file."""

from __future__ import annotations

import gzip
import json
import random
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from wiw.datasets import ar, episodes
from wiw.errors import Error, FileError
from wiw.types import Episode

MUTATIONS = 250
"""Of each format."""
ODD = (
    None, True, -1, 0, 1, 3.5, 10**400, 1e308, float("nan"), float("inf"), "", "x", "~nobody/x", "apartments:val",
    "apartments:val/x", "a\0b", "\ud800", [], {}, [1], [[0, 0], [1]], {"a": 1}, [None] * 3, ["0"] * 3, [0, 0, 0, 0],
)  # fmt: skip
"""What stands where something else is expected."""


def own_file(path: Path) -> bytes:
    info = {"ideal_primitives": 7, "radius": 0.5, "target": 1, "category": "sofa", "best_position": [0.0, 0.0, 1.0]}
    made = [Episode(str(i), f"apartments:val/{i}", (0, 0, 0), 0, (1, 0, 0), 0, 1, info) for i in range(3)]
    episodes.save(path, made, "ar", categories=["sofa", "bed"])
    return path.read_bytes()


def habitat_file(path: Path) -> bytes:
    item = {
        "episode_id": "7", "scene_id": "a.glb", "start_position": [-2.0, 0.0, 0.5], "start_rotation": [0, 0.0, 0, 1.0],
        "goals": [{"position": [3.0, 0.0, 1.0], "rotation": [0, 0, 0, 1]}], "info": {"geodesic_distance": 5.5},
    }  # fmt: skip
    return json.dumps({"episodes": [item] * 3}).encode()


def object_goal_file(path: Path) -> bytes:
    item = {
        "episode_id": "7", "scene_id": "a.glb", "start_position": [-2.0, 0.0, 0.5], "start_rotation": [0, 0.0, 0, 1.0],
        "goals": [], "object_category": "bed",
    }  # fmt: skip
    view = {"agent_state": {"position": [3.0, 0.0, 1.0], "rotation": [0, 0, 0, 1]}, "iou": 0.4}
    goals = {"a.glb_bed": [{"object_id": 3, "view_points": [view] * 2}]}
    return json.dumps({"episodes": [item] * 3, "goals_by_category": goals}).encode()


def world_in_world_file(path: Path) -> bytes:
    item = {
        "episode_id": 3, "scene_relpath": "a/b.glb", "goal_image_relpath": "i.png", "start_position": [-2.0, 0, 0.5],
        "start_rotation": [1, 0, 0, 0], "goal_position": [3.0, 0, 1.0], "goal_rotation": [0.0, 0, 1.0, 0],
        "goal_radius": 0.5, "step_to_goal": 33,
    }  # fmt: skip
    return json.dumps({"version": 1, "data": [item] * 3}).encode()


def recognition_file(path: Path) -> bytes:
    item = {
        "episode_id": 3, "scene_id": "/home/a/b/c.glb", "start_position": [-2.0, 0, 0.5], "target_id": 5,
        "start_rotation": [1, 0, 0, 0], "target_categrory": "sofa", "difficulty": 1,
    }  # fmt: skip
    return json.dumps({"episodes": [item] * 3}).encode()


FORMATS: dict[str, Callable[[Path], bytes]] = {
    "own": own_file,
    "habitat": habitat_file,
    "objects of habitat": object_goal_file,
    "world-in-world": world_in_world_file,
    "active recognition": recognition_file,
}


def change_value(value: Any, draw: random.Random) -> Any:
    """The value with one of its parts, or all of it, replaced, removed or doubled."""
    if isinstance(value, dict | list) and value and draw.random() < 0.85:
        copy = value.copy()
        name = draw.choice(list(copy)) if isinstance(copy, dict) else draw.randrange(len(copy))
        if draw.random() < 0.15:
            del copy[name]
        else:
            copy[name] = change_value(copy[name], draw)
        return copy
    return nest(draw.choice((40, 900, 100_000))) if draw.random() < 0.1 else draw.choice(ODD)


@cache
def nest(levels: int) -> Any:
    """So many lists in one another, made once: it takes milliseconds."""
    deep: Any = 1
    for _ in range(levels):
        deep = [deep]
    return deep


def as_json(value: Any) -> bytes:
    """JSON also of what is nested beyond what the standard encoder follows."""
    if isinstance(value, dict):
        return (
            b"{" + b",".join(json.dumps(name).encode() + b":" + as_json(inner) for name, inner in value.items()) + b"}"
        )
    levels = 0
    while isinstance(value, list) and len(value) == 1:
        value, levels = value[0], levels + 1
    inner = b"[" + b",".join(map(as_json, value)) + b"]" if isinstance(value, list) else b""
    return (
        b"[" * levels
        + (inner or (as_json(value) if isinstance(value, dict) else json.dumps(value).encode()))
        + b"]" * levels
    )


def damage_bytes(data: bytes, draw: random.Random) -> bytes:
    """Bytes flipped, cut out, doubled or appended."""
    damaged = bytearray(data)
    for _ in range(draw.randrange(1, 6)):
        at = draw.randrange(len(damaged))
        kind = draw.randrange(4)
        if kind == 0:
            damaged[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del damaged[at : at + draw.randrange(1, 20)]
        elif kind == 2:
            damaged[at:at] = damaged[at : at + 20]
        else:
            damaged += bytes(draw.randrange(256) for _ in range(4))
        if not damaged:
            return b""
    return bytes(damaged)


@pytest.mark.parametrize("form", FORMATS)
def test_mutations_end_in_errors_of_wiw_that_name_the_file(form: str, tmp_path: Path) -> None:
    whole = FORMATS[form](tmp_path / "whole.json")
    draw, refused = random.Random(form), 0
    for number in range(MUTATIONS):
        kind = draw.randrange(3)
        data = as_json(change_value(json.loads(whole), draw)) if kind == 0 else whole
        path = tmp_path / ("m.json.gz" if kind == 2 or draw.random() < 0.3 else "m.json")
        data = gzip.compress(data, mtime=0) if path.suffix == ".gz" else data
        path.write_bytes(damage_bytes(data, draw) if kind else data)
        try:
            read = episodes.load(path)
            episodes.save(tmp_path / "again.json", [e for e in read if e.goal_position[0] == e.goal_position[0]], "t")
            ar.load(path)
        except Error as error:
            assert isinstance(error, FileError) and str(path) in str(error), (number, error)
            refused += 1
    assert refused > MUTATIONS / 4


@pytest.mark.parametrize("name", ["bomb.json.gz", "bomb.json"])
def test_a_file_is_not_unpacked_beyond_its_limit(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / name
    data = b'{"episodes": "' + b" " * (64 << 20) + b'"}'
    path.write_bytes(gzip.compress(data, 9, mtime=0) if path.suffix == ".gz" else data)
    monkeypatch.setattr(episodes, "MOST_BYTES", 1 << 20)
    with pytest.raises(FileError, match=rf"{name}: .*at most 1048576 bytes when unpacked"):
        episodes.load(path)


def test_unpacking_stops_at_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is read of a bomb is counted where it comes out of the decompressor."""
    path, taken = tmp_path / "bomb.json.gz", 0
    path.write_bytes(gzip.compress(b" " * (64 << 20), 9, mtime=0))
    read = gzip._GzipReader.read  # type: ignore[attr-defined]

    def counted(self: Any, size: int = -1) -> bytes:
        nonlocal taken
        piece: bytes = read(self, size)
        taken += len(piece)
        return piece

    monkeypatch.setattr(gzip._GzipReader, "read", counted)  # type: ignore[attr-defined]
    monkeypatch.setattr(episodes, "MOST_BYTES", 1 << 20)
    with pytest.raises(FileError, match="1048576 bytes"):
        episodes.load(path)
    assert 0 < taken < 2 << 20


@pytest.mark.parametrize(
    "content",
    [
        b'{"episodes": [1]}',
        b'{"episodes": {"0": {"start_rotation": 1}}}',
        b'{"data": ["goal_image_relpath"]}',
        b'{"format": "wiw-episodes", "version": 1}',
        b"[" * 100_000 + b"]" * 100_000,
        b'{"episodes": ' + b"[" * 900 + b"]" * 900 + b"}",
    ],
)
def test_shapes_that_are_none_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "odd.json"
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"odd\.json"):
        episodes.load(path)
