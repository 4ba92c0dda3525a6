# SPDX-License-Identifier: Apache-2.0
"""Where networks run, and what to do where they do not fit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from wiw.errors import ArgumentError, DependencyError, DeviceMemoryError
from wiw.world_models.base import Requirements


def require(requirements: Requirements) -> None:
    """Raises DependencyError where a package is missing."""
    if missing := requirements.missing():
        raise DependencyError(f"{', '.join(missing)} not installed; pip install 'wiw[{requirements.extra}]'")


def device(name: str | None) -> str:
    """The device asked for; "cuda" where there is one if none is.

    Raises:
        ArgumentError: torch does not know it, or has none.
    """
    import torch

    if name is None:
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        asked = torch.device(name)
    except RuntimeError as error:
        raise ArgumentError(f"device: expected one of torch, such as cpu, cuda or cuda:1, got '{name}'") from error
    if asked.type == "cuda" and not 0 <= (asked.index or 0) < torch.cuda.device_count():
        raise ArgumentError(
            f"device: torch sees {torch.cuda.device_count()} CUDA devices, so there is no '{name}'; check the driver "
            f"(nvidia-smi) and that torch {torch.__version__} is a CUDA build, or use device='cpu'"
        )
    return name


@contextmanager
def memory_guard(what: str, cures: str) -> Iterator[None]:
    """Turns torch's error of a full GPU into one that says what needs less.

    Raises:
        DeviceMemoryError: torch has no memory left.
    """
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        torch.cuda.empty_cache()
        raise DeviceMemoryError(f"{what} does not fit on the device ({str(error).splitlines()[0]}); {cures}") from error
