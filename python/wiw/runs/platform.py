# SPDX-License-Identifier: Apache-2.0
"""Describe the platform of a run: enough to tell two machines apart."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from typing import Any


def describe_platform() -> dict[str, Any]:
    """Return JSON-able facts: Python, packages, processor, cores, instruction set."""
    from wiw._core import core

    return {
        "python": platform.python_version(),
        "system": platform.platform(),
        "processor": processor_name(),
        "cores": len(os.sched_getaffinity(0)),
        "isa": core.active_isa(),
        "packages": {name: find_version(name) for name in ("numpy", "scipy", "opencv-python-headless", "torch")},
    }


def processor_name() -> str:
    """Return the name as Linux names it, e.g. "AMD EPYC 7B13"."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:  # noqa: PTH123 - not a file on disk
            names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.machine()


def find_version(package: str) -> str | None:
    """Return the version of an installed package; None where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
