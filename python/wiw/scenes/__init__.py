# SPDX-License-Identifier: Apache-2.0
"""Scenes: generated apartments, and meshes, Gazebo worlds and real scans from files.

World frame: metres, Y up, right-handed. See `Scene` for a scene's attributes.
"""

from wiw import _core
from wiw.scenes.apartments import COLORS, apartment, apartment_table, possible_edits
from wiw.scenes.opening import (
    ALLOW_VARIABLE,
    MOST_MISSING,
    allow_missing_textures,
    load,
    missing_textures_allowed,
    open_outline,
    open_scene,
)
from wiw.scenes.specs import absolute, is_generated, resolve, strip_edits

Scene = _core.scene.Scene

__all__ = [
    "ALLOW_VARIABLE",
    "COLORS",
    "MOST_MISSING",
    "Scene",
    "absolute",
    "allow_missing_textures",
    "apartment",
    "apartment_table",
    "is_generated",
    "load",
    "missing_textures_allowed",
    "open_outline",
    "open_scene",
    "possible_edits",
    "resolve",
    "strip_edits",
]
