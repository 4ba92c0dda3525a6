# SPDX-License-Identifier: Apache-2.0
"""Files of the small networks that are trained here: half-precision safetensors with how each was made and measured."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any, Generic, TypeVar

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as packed
from torch import Tensor, nn

from wiw.errors import ArgumentError, WeightsError
from wiw.files import atomic_file

N = TypeVar("N", bound=nn.Module)
_UNFIT = (OSError, SafetensorError, ArgumentError, KeyError, TypeError, ValueError, OverflowError, RuntimeError)
"""Errors that a damaged file leads to."""


@dataclass(frozen=True)
class WeightFile(Generic[N]):
    """The files of one kind of network."""

    name: str
    """Name of the world model or policy, as in `wiw train NAME`."""
    sizes: Callable[[N], dict[str, Any]]
    """JSON-able: what a network of the same shape is built of."""
    build: Callable[[Mapping[str, Any]], N]
    """A network of such sizes."""

    @property
    def format(self) -> str:
        """In the header; its number is raised when networks change."""
        return f"wiw-{self.name}-1"

    @property
    def cure(self) -> str:
        """Return advice for a missing file."""
        return f"`wiw train {self.name}` creates one"

    def load(self, path: str | Path) -> tuple[N, dict[str, Any]]:
        """Load the network and its card.

        Raises:
            WeightsError: it does not exist, is damaged, has another version, or holds something else.
        """
        path = Path(path).expanduser()
        if not path.is_file():
            raise WeightsError(f"no file {path}; {self.cure}")
        try:
            with safe_open(path, framework="pt") as file:
                header = self._header(file.metadata(), path)
                values = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - it is no mapping
                self._check(values, file.metadata().get("digest"), path)
            network = self.build(header)
            network.load_state_dict({name: value.float() for name, value in values.items()})
            return network.eval(), dict(header["card"])
        except _UNFIT as error:
            raise WeightsError(
                f"{path}: expected complete weights of {self.name}: {error}; {self.cure}", "unfit"
            ) from error

    def save(self, path: Path, network: N, card: Mapping[str, Any]) -> None:
        """Write them atomically.

        Raises:
            FileError: the file cannot be written.
        """
        header = {**self.sizes(network), "card": dict(card)}
        values = {name: value.half().cpu().contiguous() for name, value in network.state_dict().items()}
        metadata = {"format": self.format, "header": json.dumps(header, sort_keys=True), "digest": digest(values)}
        with atomic_file(path) as draft:
            draft.write_bytes(packed(values, metadata))

    def _check(self, values: Mapping[str, Tensor], expected: str | None, path: Path) -> None:
        """Check that the values are finite and match the digest in the file, if it has one."""
        if expected is not None and expected != digest(values):
            wrong = "its values differ from what was written: it is damaged"
        elif not all(value.isfinite().all() for value in values.values()):
            wrong = "some of its values are not finite: it is damaged, or its training diverged"
        else:
            return
        raise WeightsError(f"{path}: expected complete weights of {self.name}; {wrong}; {self.cure}", "unfit")

    def _header(self, metadata: Mapping[str, str] | None, path: Path) -> dict[str, Any]:
        found = (metadata or {}).get("format")
        if not metadata or found != self.format:
            raise WeightsError(
                f"{path}: expected the format '{self.format}' in its header, got {found!r}: these are weights of "
                f"something else, or of another version; {self.cure}",
                "revision" if str(found).startswith(f"wiw-{self.name}") else "unfit",
            )
        return dict(json.loads(metadata["header"]))


def digest(values: Mapping[str, Tensor]) -> str:
    """Return the digest of names and values."""
    found = blake2b(digest_size=16)
    for name in sorted(values):
        found.update(name.encode() + b"\0" + values[name].cpu().numpy().tobytes())
    return found.hexdigest()
