# SPDX-License-Identifier: Apache-2.0
"""Models that policy `vlm` is set up for: how they are served, and how they are asked (`wiw/configs/vlm`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parents[2] / "configs" / "vlm"


def names() -> list[str]:
    """Their short names."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def about(name: str) -> str:
    """One line on a preset."""
    return str(_read(name)["about"])


def serve_command(name: str) -> str:
    """How its model is served."""
    return str(_read(name)["serve"]).strip()


def client_options(model: str | None) -> dict[str, Any]:
    """Options of the client: a preset's where the model is named by one, else the model alone."""
    return dict(_read(model)["client"]) if model in names() else {} if model is None else {"model": model}


def _read(name: str | None) -> dict[str, Any]:
    return dict(yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8")))
