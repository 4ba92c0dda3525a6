# SPDX-License-Identifier: Apache-2.0
"""Parts of GLB files that the core's importer does not hand out: encoded images and exact colours of vertices."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import FileError
from wiw.json_text import parse_json
from wiw.scenes.scans.scan import rotation_of

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MOST_NODES = 1_000_000
UNREADABLE = (LookupError, TypeError, ValueError, AttributeError, struct.error, RecursionError)
"""Errors that a document of another shape raises."""


@dataclass
class Glb:
    """A GLB file: its document and its binary chunk."""

    path: Path
    document: dict[str, Any]
    body: bytes

    @staticmethod
    def read(path: Path) -> Glb:
        """Read a file.

        Raises:
            FileError: it is missing, truncated, or no GLB of version 2.
        """
        try:
            data = path.read_bytes()
        except OSError as error:
            raise FileError(f"{path}: {error.strerror or error}") from error
        try:
            magic, version, length = struct.unpack_from("<4sII", data)
            if magic != b"glTF" or version != 2 or length > len(data):
                raise ValueError("expected a complete GLB file of version 2")
            chunks = dict(_chunks(data, length))
            document = parse_json(chunks[_JSON])
            if not isinstance(document, dict):
                raise ValueError("its JSON is not an object")
        except UNREADABLE as error:
            raise FileError(f"{path}: cannot be read as GLB: {error} (damaged file?)") from error
        return Glb(path, document, chunks.get(_BIN, b""))

    def bytes(self) -> bytes:
        """Return the file."""
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        body = self.body + bytes(-len(self.body) % 4)
        size = 12 + 8 + len(text) + 8 + len(body)
        head = struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<II", len(text), _JSON)
        return head + text + struct.pack("<II", len(body), _BIN) + body

    def items(self, name: str) -> list[Any]:
        """Return a list of the document; empty if there is none."""
        return self.document.get(name, [])

    def view(self, index: int) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.items("bufferViews")[index]
        if view.get("buffer", 0) != 0:
            raise ValueError(f"buffer view {index} is in another file")
        start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
        if start < 0 or length < 0 or start + length > len(self.body):
            raise ValueError(f"buffer view {index} reaches beyond the file")
        return memoryview(self.body)[start : start + length]

    def values(self, index: int) -> NDArray[Any]:
        """Return an accessor's values as they are stored, [N] or [N, components]."""
        accessor = self.items("accessors")[index]
        if "sparse" in accessor:
            raise ValueError(f"accessor {index} is sparse, which is not supported")
        view = self.items("bufferViews")[accessor["bufferView"]]
        dtype, width = np.dtype(_DTYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        count, stride = int(accessor["count"]), int(view.get("byteStride", 0)) or width * dtype.itemsize
        data, start = self.view(accessor["bufferView"]), int(accessor.get("byteOffset", 0))
        if (
            count < 0
            or start < 0
            or start + max(0, count - 1) * stride + (count > 0) * width * dtype.itemsize > len(data)
        ):
            raise ValueError(f"accessor {index} reaches beyond its buffer view")
        values = np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))
        return values[:, 0] if width == 1 else values

    def fractions(self, index: int) -> NDArray[Any]:
        """Return an accessor's values as `values` does, normalised integers as fractions float32."""
        values = self.values(index)
        if values.dtype.kind == "f" or not self.items("accessors")[index].get("normalized"):
            return values
        return np.maximum(values / np.float32(np.iinfo(values.dtype).max), np.float32(-1))

    @cached_property
    def node_transforms(self) -> list[tuple[int, NDArray[np.float64]]]:
        """Mesh and transform [4, 4] to the file's axes of each node that shows a mesh."""
        return list(self._placed_meshes())

    def _placed_meshes(self) -> Iterator[tuple[int, NDArray[np.float64]]]:
        nodes = self.items("nodes")
        stack = [(index, np.eye(4)) for index in self._list_roots()]
        seen = 0
        while stack:
            index, above = stack.pop()
            seen += 1
            if seen > MOST_NODES:
                raise ValueError("its nodes form a cycle, or are too many")
            node = nodes[index]
            here = above @ _local(node)
            if "mesh" in node:
                yield node["mesh"], here
            stack.extend((child, here) for child in node.get("children", []))

    def _list_roots(self) -> list[int]:
        """Return the nodes that the file's scene begins with; without scenes, those that are nobody's children.

        glTF leaves open what a file without scenes shows; here every part counts once.
        """
        nodes, scenes = self.items("nodes"), self.items("scenes")
        if scenes:
            return list(scenes[self.document.get("scene", 0)].get("nodes", []))
        children = {child for node in nodes for child in node.get("children", [])}
        if nodes and len(children) >= len(nodes):
            raise ValueError("its nodes form a cycle")
        return [index for index in range(len(nodes)) if index not in children]


def _chunks(data: bytes, length: int) -> Iterator[tuple[int, bytes]]:
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise ValueError("a chunk reaches beyond the file")
        yield kind, data[at + 8 : at + 8 + size]
        at += 8 + size


def _local(node: dict[str, Any]) -> NDArray[np.float64]:
    """Return a node's own transform."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), float)
    result = np.eye(4)
    result[:3, :3] = rotation_of((w, x, y, z)) * np.array(node.get("scale", (1, 1, 1)), float)
    result[:3, 3] = node.get("translation", (0, 0, 0))
    return result
