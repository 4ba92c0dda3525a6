# SPDX-License-Identifier: Apache-2.0
"""Colour words of things under the light of a scene, calibrated on apartments whose colours are known.

A floor that looks orange is brown wood under a warm lamp, a sofa may well be orange: what a thing is helps to name its
colour.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, FileError, WeightsError
from wiw.files import atomic_file
from wiw.scenes import COLORS

PARAMETERS = Path(__file__).parent / "colors.json"
QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
HUES = 8
"""Sectors of hue among which pixels are counted."""
FEATURES = 3 * len(QUANTILES) + HUES + 3
GREY_CHROMA = 0.02
"""Oklab chroma that weighs half in the histogram of hues: hues of nearly grey pixels are noise."""
_TO_CONES = np.array(
    [[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566],
     [0.0883024619, 0.2817188376, 0.6299787005]]
)  # fmt: skip
_TO_LAB = np.array(
    [[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099],
     [0.0259040371, 0.7827717662, -0.8086757660]]
)  # fmt: skip
"""Linear sRGB to cone responses, their cube roots to Oklab (B. Ottosson, 2020)."""


@dataclass(frozen=True)
class ColorNamer:
    """A small network that names the colour of a set of pixels of one thing.

    Made by `wiw train perception`; arrays are float64.
    """

    categories: tuple[str, ...]
    """Names of the things' categories; index 0 is "", where a category is not known."""

    shift: NDArray[np.float64]
    """[FEATURES]; features are normalised by (x - shift) * scale."""
    scale: NDArray[np.float64]
    hidden: NDArray[np.float64]
    """[hidden, FEATURES]."""
    hidden_bias: NDArray[np.float64]
    output: NDArray[np.float64]
    """[len(COLORS), hidden]."""
    output_bias: NDArray[np.float64]
    category_hidden: NDArray[np.float64]
    """[len(categories), hidden]: added to the hidden units."""
    category_output: NDArray[np.float64]
    """[len(categories), len(COLORS)]: added to the output."""

    def __post_init__(self) -> None:
        units, count = len(self.hidden_bias), len(self.categories)
        expected = [(FEATURES,), (FEATURES,), (units, FEATURES), (units,), (len(COLORS), units), (len(COLORS),)]
        expected += [(count, units), (count, len(COLORS))]
        arrays = [getattr(self, name) for name in self.__dataclass_fields__ if name != "categories"]
        if [array.shape for array in arrays] != expected or not all(np.isfinite(array).all() for array in arrays):
            raise ArgumentError(
                f"ColorNamer: expected finite arrays of {expected}, got {[array.shape for array in arrays]}"
            )

    @classmethod
    def load(cls, path: str | Path) -> ColorNamer:
        """Read the JSON file that `save` wrote.

        Raises:
            WeightsError: it does not exist, is damaged, or holds something else.
        """
        try:
            values = json.loads(Path(path).expanduser().read_text())
            if values.pop("colors") != list(COLORS):
                raise ValueError(f"its colours are not {', '.join(COLORS)}")
            categories = tuple(values.pop("categories"))
            return cls(categories, **{name: np.array(value, np.float64) for name, value in values.items()})
        except (OSError, ValueError, KeyError, TypeError, AttributeError, ArgumentError) as error:
            raise WeightsError(
                f"{path}: expected parameters for colour naming: {error}; `wiw train perception` creates them",
                "missing" if isinstance(error, OSError) else "unfit",
            ) from error

    def save(self, path: Path) -> None:
        """Write the parameters as JSON, whole or not at all.

        Raises:
            FileError: the file cannot be written.
        """
        arrays = asdict(self)
        values: dict[str, Any] = {"colors": list(COLORS), "categories": arrays.pop("categories")}
        values |= {name: np.asarray(value).round(4).tolist() for name, value in arrays.items()}
        with atomic_file(path) as draft:
            try:
                draft.write_text(json.dumps(values) + "\n")
            except OSError as error:
                raise FileError(f"{path}: cannot be written: {error}") from error

    def compute_probabilities(
        self, features: NDArray[np.float64], category: NDArray[np.integer[Any]]
    ) -> NDArray[np.float64]:
        """Return the probability of each colour for rows of features: float64 [N, len(COLORS)].

        Args:
            features: float64 [N, FEATURES].
            category: [N]: index into `categories`.
        """
        inner = (features - self.shift) * self.scale @ self.hidden.T + self.hidden_bias + self.category_hidden[category]
        logits = np.maximum(inner, 0.0) @ self.output.T + self.output_bias + self.category_output[category]
        weights = np.exp(logits - logits.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def __call__(self, pixels: NDArray[np.uint8], category: str = "") -> tuple[str, float]:
        """Name the colour of pixels; see `name_color`."""
        if not isinstance(pixels, np.ndarray) or pixels.dtype != np.uint8 or pixels.ndim != 2 or pixels.shape[1] != 3:
            came = f"{pixels.dtype} {pixels.shape}" if isinstance(pixels, np.ndarray) else type(pixels).__name__
            raise ArgumentError(f"name_color: expected pixels uint8 [n, 3], got {came}")
        if not len(pixels):
            return "", 0.0
        row = self._rows.get(category, 0)
        found = self.compute_probabilities(compute_features(pixels[None]), np.array([row]))[0]
        best = int(found.argmax())
        return COLORS[best], float(found[best])

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {name: row for row, name in enumerate(self.categories)}


def name_color(pixels: NDArray[np.uint8], category: str = "") -> tuple[str, float]:
    """Return the colour word for the pixels of a thing, and its probability; ("", 0.0) for no pixels.

    Args:
        pixels: uint8 [n, 3].
        category: of the thing, if known: one of `wiw.perception.scene_labels.CATEGORIES`; others count as unknown.

    Raises:
        ArgumentError: an array of another shape or type.
    """
    return _load_built_in()(pixels, category)


@cache
def _load_built_in() -> ColorNamer:
    return ColorNamer.load(PARAMETERS)


def compute_features(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Describe sets of pixels uint8 [N, n, 3]: float64 [N, FEATURES].

    Quantiles of Oklab's three axes, the share of each sector of hue among the pixels that have one, and mean,
    standard deviation and largest value of the chroma.
    """
    lab = to_oklab(pixels)
    chroma = np.hypot(lab[..., 1], lab[..., 2])
    quantiles = _compute_quantiles(lab).reshape(len(lab), -1)
    mean = _average(chroma)[:, None]
    deviation = np.sqrt(_average((chroma - mean) ** 2))
    spread = [mean, deviation[:, None], chroma.max(axis=1, keepdims=True)]
    return np.concatenate([quantiles, _compute_shares(lab, chroma), *spread], axis=1)


def _average(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean along the last axis; for few values `np.mean` itself takes longer than the sum."""
    return np.asarray(values.sum(axis=-1) / values.shape[-1])


def _compute_quantiles(lab: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return QUANTILES of sets of colours [N, n, 3]: [N, len(QUANTILES), 3].

    The same as `np.quantile` gives, to the bit, which for as few pixels as these is slow.
    """
    low, high, share = _plan_quantiles(lab.shape[1])
    ordered = np.sort(lab, axis=1)
    below, above = ordered[:, low], ordered[:, high]
    step = above - below
    return np.where(share < 0.5, below + step * share, above - step * (1 - share))


@lru_cache(maxsize=512)
def _plan_quantiles(count: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Return between which two of n sorted values each quantile is, and how far from the lower one, [5, 1]."""
    place = (count - 1) * np.array(QUANTILES)
    low = np.floor(place).astype(np.intp)
    return low, np.minimum(low + 1, count - 1), (place - low)[:, None]


def _compute_shares(lab: NDArray[np.float64], chroma: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share of each sector of hue in sets of colours [N, n, 3]: [N, HUES]; a hue counts to two sectors."""
    sector = (np.arctan2(lab[..., 2], lab[..., 1]) / (2 * np.pi) % 1.0) * HUES
    weight = chroma / (chroma + GREY_CHROMA)
    lower = np.floor(sector)
    part, hue = sector - lower, lower.astype(np.intp) % HUES
    placed = np.zeros((len(lab), HUES, lab.shape[1]))
    sets, pixels = np.arange(len(lab))[:, None], np.arange(lab.shape[1])
    placed[sets, hue, pixels] = weight * (1 - part)
    placed[sets, (hue + 1) % HUES, pixels] = weight * part
    return _average(placed)


@cache
def _decode_levels() -> NDArray[np.float64]:
    """Return the linear value of each byte, by the power law that the apartments are lit and drawn with."""
    return np.asarray((np.arange(256) / 255.0) ** 2.2)


def to_oklab(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return Oklab lightness, a and b of display-encoded colours [..., 3]."""
    return np.asarray(np.cbrt(_decode_levels()[pixels] @ _TO_CONES.T) @ _TO_LAB.T)
