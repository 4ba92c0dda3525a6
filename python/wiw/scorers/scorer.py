# SPDX-License-Identifier: Apache-2.0
"""The interface of image scorers: a card that identifies the scorer, and numbers for PNG files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

Range = tuple[float, float] | None
"""Smallest and largest score, or None if a score has no bounds."""


@dataclass(frozen=True)
class ScorerCard:
    """Identity of a scorer: all that is stored of it beside its scores."""

    scorer: str
    """Its id, such as "musiq-koniq"."""
    version: str
    """Whatever identifies its version: a release, a digest of weights."""
    licence: str
    """SPDX id or name of the licence that it is used under."""
    scores: Mapping[str, Range]
    """The numbers that it gives each image, with their ranges."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self) | {"scores": {name: span and list(span) for name, span in self.scores.items()}}

    @property
    def digest(self) -> str:
        """Digest of the card: scores stored under it are by one scorer in one version."""
        return hashlib.sha256(json.dumps(self.as_dict(), sort_keys=True).encode()).hexdigest()[:16]

    @property
    def label(self) -> str:
        """E.g. "musiq-koniq 1.0, licence CC-BY-4.0"."""
        return f"{self.scorer} {self.version}, licence {self.licence}"


class Scorer(Protocol):
    """Gives each image one number or several. Used in a `with` block, which closes it."""

    @property
    def card(self) -> ScorerCard:
        """Its identity; known before it scores anything."""
        ...

    def score(self, paths: Sequence[Path]) -> Iterator[tuple[Path, dict[str, float]]]:
        """Yield the scores of each PNG file, in any order, each as soon as it is known.

        Raises:
            ScorerError: it gives no valid scores of all of them.
        """
        ...

    def __enter__(self) -> Any: ...

    def __exit__(self, *exception: object) -> None: ...


def read_png(path: Path) -> Any:
    """Return an image as uint8 [H, W, 3], RGB."""
    import numpy as np
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
