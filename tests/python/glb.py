# SPDX-License-Identifier: Apache-2.0
"""A writer of small GLB files, independent of any reader."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass
class Glb:
    """Collects meshes and nodes and gives the bytes of a binary glTF file."""

    binary: bytes = b""
    views: list[dict[str, int]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    meshes: list[dict[str, Any]] = field(default_factory=list)
    nodes: list[dict[str, Any]] = field(default_factory=list)
    materials: list[dict[str, Any]] = field(default_factory=list)
    images: list[dict[str, Any]] = field(default_factory=list)

    def view(self, data: bytes) -> int:
        self.views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)})
        self.binary += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def accessor(self, array: NDArray[Any]) -> int:
        kinds = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
        columns = array.shape[1] if array.ndim == 2 else 1
        entry = {
            "bufferView": self.view(np.ascontiguousarray(array).tobytes()),
            "componentType": kinds[str(array.dtype)],
            "count": len(array),
            "type": ["SCALAR", "VEC2", "VEC3", "VEC4"][columns - 1],
            "normalized": array.dtype.kind == "u" and columns == 4,
        }
        if columns == 3:
            entry |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def mesh(self, triangles: NDArray[np.uint32], material: int | None = None, **attributes: NDArray[Any]) -> int:
        primitive: dict[str, Any] = {
            "attributes": {name: self.accessor(array) for name, array in attributes.items()},
            "indices": self.accessor(triangles.reshape(-1)),
        }
        if material is not None:
            primitive["material"] = material
        self.meshes.append({"primitives": [primitive]})
        return len(self.meshes) - 1

    def image(self, encoded: bytes, kind: str = "image/png") -> int:
        self.images.append({"bufferView": self.view(encoded), "mimeType": kind})
        return len(self.images) - 1

    def textured(self, image: int) -> int:
        self.materials.append({"pbrMetallicRoughness": {"baseColorTexture": {"index": image}}})
        return len(self.materials) - 1

    def node(self, mesh: int, **entries: Any) -> int:
        self.nodes.append({"mesh": mesh, **entries})
        return len(self.nodes) - 1

    def document(self) -> dict[str, Any]:
        """The JSON, without what is empty."""
        document = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(self.nodes)))}],
            "nodes": self.nodes,
            "meshes": self.meshes,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.binary)}],
            "materials": self.materials,
            "images": self.images,
            "textures": [{"source": i} for i in range(len(self.images))],
        }
        return {key: value for key, value in document.items() if value != []}

    def bytes(self) -> bytes:
        text = json.dumps(self.document()).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self.binary), 0x004E4942) + self.binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
