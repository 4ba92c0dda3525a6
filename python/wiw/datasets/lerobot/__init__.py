# SPDX-License-Identifier: Apache-2.0
"""Collected data as LeRobot datasets, format v3.0, and back.

    from wiw.datasets.lerobot import export_lerobot, import_lerobot

    export_lerobot("data", "data-lerobot")
    import_lerobot("data-lerobot", "data-again")

Nothing of the package `lerobot` is used. `docs/lerobot.md` has the features, and what that package was seen to read.
"""

from wiw.datasets.lerobot.convert import export_lerobot, import_lerobot

__all__ = ["export_lerobot", "import_lerobot"]
