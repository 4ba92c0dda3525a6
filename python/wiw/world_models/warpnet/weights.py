# SPDX-License-Identifier: Apache-2.0
"""The network's file: half-precision safetensors with its size and how it was made and measured."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as packed

from wiw.errors import FileError, WeightsError
from wiw.world_models.warpnet.network import Network

FORMAT = "wiw-warpnet-1"
TRAIN = "`wiw train warpnet` makes some"


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
        network = Network(int(header["height"]), tuple(header["widths"]))
        network.load_state_dict(values)
        return network.eval(), dict(header["card"])
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise WeightsError(f"{path}: expected weights of warpnet, whole: {error}; {TRAIN}", "unfit") from error


def save(path: Path, network: Network, card: Mapping[str, Any]) -> None:
    """Writes them whole or not at all.

    Raises:
        FileError: the file cannot be written.
    """
    header = {"height": network.height, "widths": network.widths, "card": dict(card)}
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
            "revision" if str(found).startswith("wiw-warpnet") else "unfit",
        )
    return dict(json.loads(metadata["header"]))
