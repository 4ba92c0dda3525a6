# SPDX-License-Identifier: Apache-2.0
"""Meshes of the links of a URDF file, placed by its joints."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wiw.errors import FileError

MOST_BYTES = 16 << 20


@dataclass(frozen=True)
class Visual:
    """A mesh of a link."""

    mesh: Path
    T_root_mesh: NDArray[np.float64]
    """float64 [4, 4] in the frame of the root link; it may scale."""


def read_visuals(path: Path, pose: Mapping[str, float] | Sequence[float] = ()) -> list[Visual]:
    """Return the meshes of all links.

    Args:
        path: the file; mesh paths are relative to its folder.
        pose: joint values in radians and metres, by name or in the order of the movable joints; 0 for the others.

    Raises:
        FileError: it is missing, no URDF, or its joints do not form a tree.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise FileError(f"{path}: is larger than {MOST_BYTES} bytes")
        robot = ET.parse(path).getroot()
        placed = _place_links(robot, pose)
        return [visual for link in robot.findall("link") for visual in _visuals(link, placed, path.parent)]
    except OSError as error:
        raise FileError(f"{path}: {error.strerror or error}") from error
    except (ET.ParseError, LookupError, ValueError, AttributeError, TypeError) as error:
        raise FileError(f"{path}: not a readable URDF ({type(error).__name__}: {error})") from error


def _numbers(text: str | None, count: int, default: float = 0.0) -> NDArray[np.float64]:
    values = np.full(count, default) if text is None else np.array([float(word) for word in text.split()])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"expected {count} finite numbers, got '{text}'")
    return values


def rotation_about(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Return the rotation [3, 3] about an axis of any length by so many radians, right-handed."""
    length = np.linalg.norm(axis)
    if not length > 0:
        raise ValueError("an axis has no length")
    x, y, z = axis / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _origin(element: ET.Element) -> NDArray[np.float64]:
    """Return the transform of an element's <origin>."""
    origin = element.find("origin")
    result = np.eye(4)
    if origin is not None:
        roll, pitch, yaw = _numbers(origin.get("rpy"), 3)
        x, y, z = np.eye(3)
        result[:3, :3] = rotation_about(z, yaw) @ rotation_about(y, pitch) @ rotation_about(x, roll)
        result[:3, 3] = _numbers(origin.get("xyz"), 3)
    return result


def _motion(joint: ET.Element, value: float) -> NDArray[np.float64]:
    """Return what a joint does at a value."""
    result, axis = np.eye(4), joint.find("axis")
    direction = np.array([1.0, 0, 0]) if axis is None else _numbers(axis.get("xyz"), 3)
    if joint.get("type") == "prismatic":
        result[:3, 3] = value * direction / np.linalg.norm(direction)
    elif joint.get("type") in ("revolute", "continuous"):
        result[:3, :3] = rotation_about(direction, value)
    return result


def _place_links(robot: ET.Element, pose: Mapping[str, float] | Sequence[float]) -> dict[str, NDArray[np.float64]]:
    """Return the transform of each link in the root's frame."""
    joints = robot.findall("joint")
    movable = [joint for joint in joints if joint.get("type") != "fixed"]
    values = dict(pose) if isinstance(pose, Mapping) else {}
    if not isinstance(pose, Mapping):
        values = {str(joint.get("name")): value for joint, value in zip(movable, pose, strict=False)}
    above = {joint.find("child").attrib["link"]: joint for joint in joints}  # type: ignore[union-attr]
    placed: dict[str, NDArray[np.float64]] = {}
    for link in robot.findall("link"):
        chain, name = [], link.attrib["name"]
        while name in above:
            chain.append(above[name])
            if len(chain) > len(joints):
                raise ValueError("its joints form a cycle")
            name = above[name].find("parent").attrib["link"]  # type: ignore[union-attr]
        transform = np.eye(4)
        for joint in reversed(chain):
            transform = transform @ _origin(joint) @ _motion(joint, float(values.get(str(joint.get("name")), 0.0)))
        placed[link.attrib["name"]] = transform
    return placed


def _visuals(link: ET.Element, placed: Mapping[str, NDArray[np.float64]], folder: Path) -> list[Visual]:
    found = []
    for visual in link.findall("visual"):
        mesh = visual.find("geometry/mesh")
        if mesh is None:  # a box or a cylinder, which scans' models do not have
            continue
        scale = np.diag([*_numbers(mesh.get("scale"), 3, 1.0), 1.0])
        file = folder / mesh.attrib["filename"].removeprefix("file://").removeprefix("package://")
        found.append(Visual(file, placed[link.attrib["name"]] @ _origin(visual) @ scale))
    return found
