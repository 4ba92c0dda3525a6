# SPDX-License-Identifier: Apache-2.0
"""Find a pipeline's weights, identify them, and say what to do where they cannot be had."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

from wiw.errors import ArgumentError, WeightsError
from wiw.json_text import parse_json
from wiw.networks import explain_hub_error, is_path

SAMPLES, SAMPLE_BYTES = 16, 1 << 16
"""Samples of each file of weights that identify it: training changes all of a network."""


@dataclass(frozen=True)
class Weights:
    """A pipeline's folder on this machine."""

    folder: Path
    identity: Mapping[str, str]
    """An identifier of the weights: "commit" on the hub, or "digest" of a folder of the user's own."""


def fetch_weights(
    name: str, pipeline: str, revision: str | None, variant: str | None, components: Mapping[str, Any]
) -> Weights:
    """Find the folder of a pipeline, from the hub where it is not on this machine yet.

    `components` are parts that the folder need not have.

    Raises:
        WeightsError: the folder, repository or revision does not exist, or may not be read.
        ArgumentError: a revision of a folder.
    """
    folder = Path(name).expanduser()
    if folder.is_dir():
        if revision is not None:
            raise ArgumentError(f"revision: '{revision}' is a revision of a hub repository, but {folder} is a folder")
        return Weights(folder, {"digest": digest_folder(folder)})
    if is_path(name):
        raise WeightsError(f"no folder {folder.resolve()}; give the folder of a pipeline, or its name on the hub")
    snapshot = _download(name, pipeline, revision, variant, components)
    return Weights(snapshot, {"commit": snapshot.name})


def _download(
    name: str, pipeline: str, revision: str | None, variant: str | None, components: Mapping[str, Any]
) -> Path:
    import diffusers

    try:
        return Path(getattr(diffusers, pipeline).download(name, revision=revision, variant=variant, **components))
    except Exception as error:
        raise explain_hub_error(error, name, revision) from error


def require_kind(folder: Path, pipelines: Sequence[str], flags: Mapping[str, bool]) -> None:
    """Raise WeightsError unless the folder holds one of these pipelines, with these settings set or not set."""
    index = folder / "model_index.json"
    if not index.is_file():
        raise WeightsError(
            f"{folder} has no model_index.json: expected a folder in the layout of diffusers, as written by "
            "save_pretrained"
        )
    try:
        content = parse_json(index.read_bytes())
        if not isinstance(content, dict):
            raise ValueError(f"expected a JSON object, got {type(content).__name__}")
    except ValueError as error:
        raise WeightsError(f"{index} is damaged ({error}); fetch the weights again", "unfit") from error
    found = {name: content.get(name) for name in ("_class_name", *flags)}
    if found["_class_name"] not in pipelines or any(bool(found[name]) != flag for name, flag in flags.items()):
        wanted = {"_class_name": " or ".join(pipelines), **{name: flag or None for name, flag in flags.items()}}
        raise WeightsError(f"{folder} contains a different model: expected {wanted}, found {found}", "unfit")


def digest_folder(folder: Path) -> str:
    """Return a hex digest of a pipeline's files.

    Small ones count by content, weights by name, size and `SAMPLES` pieces of them.
    """
    total = blake2b(digest_size=20)
    parts = [folder, *(part for part in folder.iterdir() if part.is_symlink())]  # `rglob` enters no link to a folder
    for path in sorted(p for part in parts for p in part.rglob("*") if p.is_file() and p.suffix in SUFFIXES):
        size = path.stat().st_size
        total.update(f"{path.relative_to(folder)} {size}\n".encode())
        with path.open("rb") as file:
            if size <= SAMPLES * SAMPLE_BYTES:
                total.update(file.read())
                continue
            for sample in range(SAMPLES):
                file.seek((size - SAMPLE_BYTES) * sample // (SAMPLES - 1))
                total.update(file.read(SAMPLE_BYTES))
    return total.hexdigest()


SUFFIXES = {".json", ".safetensors", ".bin", ".model", ".txt"}
"""Suffixes of files that a pipeline is read from; cards and pictures beside it do not count."""
