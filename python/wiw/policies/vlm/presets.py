# SPDX-License-Identifier: Apache-2.0
"""Presets of policy `vlm`: models, how to serve them, and how to query them (`wiw/configs/vlm`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parents[2] / "configs" / "vlm"


def list_names() -> list[str]:
    """Return the presets' names."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def describe(name: str) -> str:
    """Return one line on a preset."""
    return str(_load_preset(name)["about"])


def get_serve_command(name: str) -> str:
    """Return the command that serves its model."""
    return str(_load_preset(name)["serve"]).strip()


def get_client_options(model: str | None) -> dict[str, Any]:
    """Return the client options of a preset; for any other model its name alone."""
    return dict(_load_preset(model)["client"]) if model in list_names() else {} if model is None else {"model": model}


def _load_preset(name: str | None) -> dict[str, Any]:
    return dict(yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8")))
