# SPDX-License-Identifier: Apache-2.0
"""Keep what the frozen networks say of clips on disk, so that each clip is decoded and encoded once."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from wiw.files import atomic_file
from wiw.training.post_training.trainable import Encoded

ACTIONS = "actions"
"""Name under which a clip's actions lie beside its latents."""
FILES = 1000
"""Clips in a folder."""


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

        Raises:
            FileError: they cannot be written.
        """
        path = self.folder / f"{index // FILES:05d}" / f"{index}{'-mirrored' if mirrored else ''}.safetensors"
        found = _read(path)
        if found is None:
            encoded, actions = make()
            found = {name: value.contiguous().cpu() for name, value in {**encoded, ACTIONS: actions}.items()}
            with atomic_file(path) as draft:
                draft.write_bytes(save(found))
        moved = {name: value.to(device) for name, value in found.items()}
        actions = moved.pop(ACTIONS)
        return moved, actions


def _read(path: Path) -> dict[str, Tensor] | None:
    """Return a file's tensors; None if it is missing or damaged, and has to be made anew."""
    try:
        return load(path.read_bytes())
    except (FileNotFoundError, SafetensorError):
        return None
