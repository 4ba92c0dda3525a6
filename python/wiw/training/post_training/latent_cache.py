# SPDX-License-Identifier: Apache-2.0
"""Keep what the frozen networks say of clips on disk, so that each clip is decoded and encoded once."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from wiw.errors import ArgumentError
from wiw.files import atomic_file
from wiw.training.post_training.trainable import Encoded

ACTIONS = "actions"
"""Name under which a clip's actions lie beside its latents."""
CHECKSUM = "crc32"
"""Entry of a file's metadata: the CRC-32 of its tensors with their names, types and shapes, which safetensors lacks."""
FILES = 1000
"""Clips in a folder."""


def require_folder(path: Path) -> None:
    """Check that a cache can be in a folder of that path, which need not be there.

    Raises:
        ArgumentError: it, or what it is to be in, is a file.
    """
    there = next((each for each in (path, *path.absolute().parents) if each.exists()), None)
    if there is not None and not there.is_dir():
        raise ArgumentError(f"cache: expected a folder, new or not, got {path}: {there} is a file; choose another path")


class LatentCache:
    """A folder of encoded clips, one file each, for one dataset, one set of frozen weights and one shape of clips.

    Trainings that agree in these share the files, whatever else they differ in. It can be deleted at any time.

    Args:
        folder: of all caches.
        identity: JSON-able: all that latents depend on beside the clip's number and whether it is mirrored.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any]) -> None:
        key = hashlib.blake2b(json.dumps(identity, sort_keys=True).encode(), digest_size=12).hexdigest()
        self.folder = folder / key

    def encode(
        self, index: int, mirrored: bool, make: Callable[[], tuple[Encoded, Tensor]], device: torch.device
    ) -> tuple[Encoded, Tensor]:
        """Return a clip's latents and actions: those on disk, or what `make` returns, which is then written.

        Files that are damaged, by their checksum, are replaced.

        Raises:
            FileError: they cannot be written.
        """
        path = self.folder / f"{index // FILES:05d}" / f"{index}{'-mirrored' if mirrored else ''}.safetensors"
        found = _read(path)
        if found is None:
            encoded, actions = make()
            found = {name: value.contiguous().cpu() for name, value in {**encoded, ACTIONS: actions}.items()}
            with atomic_file(path) as draft:
                draft.write_bytes(save(found, {CHECKSUM: compute_checksum(found)}))
        moved = {name: value.to(device) for name, value in found.items()}
        actions = moved.pop(ACTIONS)
        return moved, actions


def compute_checksum(tensors: Mapping[str, Tensor]) -> str:
    """Return the CRC-32 of tensors on the CPU with their names, types and shapes, as eight hexadecimal digits."""
    found = 0
    for name, value in sorted(tensors.items()):
        found = zlib.crc32(f"{name} {value.dtype} {list(value.shape)}".encode(), found)
        found = zlib.crc32(value.detach().reshape(-1).view(torch.uint8).numpy().data, found)
    return f"{found:08x}"


def _read(path: Path) -> dict[str, Tensor] | None:
    """Return a file's tensors; None if it is missing, damaged or without a checksum, and has to be made anew."""
    try:
        data = path.read_bytes()
        tensors = load(data)
    except (FileNotFoundError, SafetensorError, KeyError):  # a damaged header may name a type that torch has not
        return None
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    expected = (header.get("__metadata__") or {}).get(CHECKSUM)
    return tensors if expected == compute_checksum(tensors) else None
