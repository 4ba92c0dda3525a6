# SPDX-License-Identifier: Apache-2.0
"""The network's file: half-precision safetensors with its shape and how it was made."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as packed

from wiw.errors import ArgumentError, FileError, WeightsError
from wiw.policies.diffuser.network import Network, Shape

FORMAT = "wiw-diffuser-1"
TRAIN = "`wiw train diffuser` makes some"


def load(path: str | Path) -> tuple[Network, dict[str, Any]]:
    """The network and its card.

    Raises:
        WeightsError: there is no such file, or it is damaged, of another version or of something else.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise WeightsError(f"no file {path}; {TRAIN}")
    try:
        with safe_open(path, framework="pt") as file:
            header = _header(file.metadata(), path)
            values = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 - it is no mapping
        network = Network(Shape(**header["shape"]))
        network.load_state_dict(values)
        return network.eval(), dict(header["card"])
    except (OSError, SafetensorError, ArgumentError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise WeightsError(f"{path}: expected weights of diffuser, whole: {error}; {TRAIN}", "unfit") from error


def save(path: Path, network: Network, card: Mapping[str, Any]) -> None:
    """Writes them whole or not at all.

    Raises:
        FileError: the file cannot be written.
    """
    header = {"shape": asdict(network.shape), "card": dict(card)}
    values = {name: value.half().contiguous() for name, value in network.state_dict().items()}
    half = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        half.write_bytes(packed(values, {"format": FORMAT, "header": json.dumps(header, sort_keys=True)}))
        half.replace(path)
    except OSError as error:
        half.unlink(missing_ok=True)
        raise FileError(f"{path}: cannot be written ({error.strerror}); choose another place") from error


def _header(metadata: Mapping[str, str] | None, path: Path) -> dict[str, Any]:
    found = (metadata or {}).get("format")
    if not metadata or found != FORMAT:
        raise WeightsError(
            f"{path}: expected the format '{FORMAT}' in its header, got {found!r}: weights of something else, or of "
            f"another version; {TRAIN}",
            "revision" if str(found).startswith("wiw-diffuser") else "unfit",
        )
    return dict(json.loads(metadata["header"]))
