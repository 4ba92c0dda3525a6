# SPDX-License-Identifier: Apache-2.0
"""Devices that the `gpu` renderer can be tested on."""

from __future__ import annotations

from typing import Any

import pytest

from wiw import _core
from wiw.errors import BackendError


def usable_devices() -> list[dict[str, Any]]:
    """Return the devices that give an OpenGL context."""
    try:
        return [device for device in _core.render.egl_devices() if not device["error"]]
    except BackendError:
        return []


needs_egl = pytest.mark.skipif(not usable_devices(), reason="no EGL device gives an OpenGL context here")
