# SPDX-License-Identifier: Apache-2.0
"""Prices of tokens, as far as the user states them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wiw.errors import FileError
from wiw.mapping_files import parse_yaml


@dataclass(frozen=True)
class Prices:
    """US dollars per million tokens by model: (read, written)."""

    table: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def compute_cost(self, model: str, read: int, written: int) -> float | None:
        """Return the cost in US dollars; None if the price is unknown."""
        price = self.table.get(model)
        return None if price is None else (price[0] * read + price[1] * written) / 1e6

    @classmethod
    def load(cls, path: str | Path) -> Prices:
        """Read a YAML file of lines `model: [read, written]`.

        Raises:
            FileError: it cannot be read, or holds something else.
        """
        import yaml

        try:
            content = parse_yaml(Path(path).expanduser().read_text(encoding="utf-8"))
            return cls({str(model): (_price(read), _price(written)) for model, (read, written) in content.items()})
        except (OSError, yaml.YAMLError, AttributeError, TypeError, ValueError, OverflowError) as error:
            raise FileError(
                f"{path}: expected prices as `model: [read, written]`, dollars per million tokens: {error}"
            ) from error


def _price(value: Any) -> float:
    if not 0 <= float(value) < math.inf:
        raise ValueError(f"a price of {value}")
    return float(value)
