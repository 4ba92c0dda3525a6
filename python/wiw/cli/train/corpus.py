# SPDX-License-Identifier: Apache-2.0
"""Helpers of trainings on a collected dataset: `wiw train pocket` and `wiw train NAME-action`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from wiw.cli.train.progress import describe_validation
from wiw.errors import ArgumentError

TrackerName = Literal["trackio", "wandb", "tensorboard"]


def require_data(name: str, data: Path | None, also: str = "") -> Path:
    """Return the folder of the dataset.

    Raises:
        ArgumentError: there is none.
    """
    if data is None:
        raise ArgumentError(f"{name} trains on a dataset; give a folder of `wiw collect navigation`{also} with --data")
    return data


def describe_steps(card: Mapping[str, Any], batch: int) -> str:
    """Describe a training: its length, how it ended, and which weights were best."""
    text = f"{card['trained_steps']:,} steps of {batch} clips, loss {card['loss']:.4f}"
    if "validation" not in card:
        return text
    return f"{text}, best after {card['steps']:,} ({describe_validation(card['validation'])})"
