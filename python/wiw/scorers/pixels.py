# SPDX-License-Identifier: Apache-2.0
"""The scorer that is always there: sharpness and colourfulness, by formula."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from wiw.metrics.image_quality import colourfulness, sharpness
from wiw.scorers.scorer import ScorerCard, read_png

CARD = ScorerCard("pixels", "1", "Apache-2.0", {"sharpness": None, "colourfulness": None})


class PixelScorer:
    """Sharpness (variance of the Laplacian) and colourfulness (Hasler and Suesstrunk 2003)."""

    card = CARD

    def score(self, paths: Sequence[Path]) -> Iterator[tuple[Path, dict[str, float]]]:
        """Yield the scores of each PNG file, in their order."""
        for path in paths:
            image = read_png(path)
            yield path, {"sharpness": sharpness(image), "colourfulness": colourfulness(image)}

    def __enter__(self) -> PixelScorer:
        return self

    def __exit__(self, *exception: object) -> None:
        """Close nothing."""
