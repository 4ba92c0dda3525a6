# SPDX-License-Identifier: Apache-2.0
"""`config.json` of an action-conditioned checkpoint."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from wiw.action import Action
from wiw.errors import ArgumentError, WeightsError
from wiw.json_text import parse_json
from wiw.typed_values import require_positive

FILE = "config.json"


@dataclass(frozen=True, kw_only=True)
class ActionConfig:
    """State which actions a checkpoint takes and which model it belongs to.

    Raises:
        ArgumentError: values that make no sense.
    """

    base: str
    """World model that it steers, as registered: "svd"."""
    weights: str
    """Folder or hub repository of that model's weights."""
    revision: str | None = None
    """Commit of the repository."""
    kind: Literal["discrete", "pose7"] = "discrete"
    width: int
    """Width of the denoiser's time embedding."""
    stride: int
    """Frames that the autoencoder makes one latent of."""
    vocabulary: tuple[str, ...] = ("null", "forward", "turn_left", "turn_right", "stop")
    """Names of the actions; an action's id is its place."""
    low: tuple[float, float, float] | None = None
    high: tuple[float, float, float] | None = None
    """Corners of the workspace in metres, for poses."""

    def __post_init__(self) -> None:
        for name in ("vocabulary", "low", "high"):
            value = getattr(self, name)
            object.__setattr__(self, name, None if value is None else tuple(value))
        if self.kind not in ("discrete", "pose7"):
            raise ArgumentError(f"ActionConfig: expected kind discrete or pose7, got {self.kind!r}")
        require_positive("ActionConfig", self, "width", "stride")
        if self.kind == "discrete" and set(self.vocabulary) != {action.name.lower() for action in Action}:
            raise ArgumentError(
                f"ActionConfig: vocabulary: expected {', '.join(a.name.lower() for a in Action)} in some order, got "
                f"{', '.join(self.vocabulary)}"
            )
        if self.kind == "pose7" and not _is_box(self.low, self.high):
            raise ArgumentError(f"ActionConfig: pose7 needs low < high, 3 metres each, got {self.low}, {self.high}")

    @property
    def null(self) -> int:
        """Id of the null token."""
        return self.vocabulary.index("null")

    @property
    def ids(self) -> dict[int, Any]:
        """Id of each primitive, as `wiw.accepts` takes it."""
        return {int(Action[name.upper()]): index for index, name in enumerate(self.vocabulary)}

    def save(self, folder: Path) -> None:
        """Write `config.json`."""
        (folder / FILE).write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> ActionConfig:
        """Read `config.json`.

        Raises:
            WeightsError: it is missing, damaged, or of another format.
        """
        file = folder / FILE
        if not file.is_file():
            raise WeightsError(
                f"no {file}: expected the folder of an action-conditioned checkpoint; action-conditioned models have "
                "no weights except those that you train"
            )
        try:
            content = parse_json(file.read_bytes())
            return cls(**content)
        except (ValueError, TypeError, AttributeError, ArgumentError) as error:
            known = ", ".join(field.name for field in fields(cls))
            raise WeightsError(f"{file} cannot be used ({error}); it has {known}", "unfit") from error


def _is_box(low: tuple[float, ...] | None, high: tuple[float, ...] | None) -> bool:
    return (
        low is not None
        and high is not None
        and len(low) == len(high) == 3
        and all(a < b for a, b in zip(low, high, strict=True))
    )
