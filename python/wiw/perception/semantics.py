# SPDX-License-Identifier: Apache-2.0
"""What each pixel is, in Matterport3D's categories (mpcat40): for world models that read semantics, as PathDreamer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError

CATEGORIES = (
    "void", "wall", "floor", "chair", "door", "table", "picture", "cabinet", "cushion", "window", "sofa", "bed",
    "curtain", "chest of drawers", "plant", "sink", "stairs", "ceiling", "toilet", "stool", "towel", "mirror",
    "tv monitor", "shower", "column", "bathtub", "counter", "fireplace", "lighting", "beam", "railing", "shelving",
    "blinds", "gym equipment", "seating", "board panel", "furniture", "appliances", "clothes", "objects", "misc",
)  # fmt: skip
"""By id, from 0 for nothing to 40."""
WORDS = {
    "armchair": "chair",
    "blind": "blinds",
    "bookshelf": "shelving",
    "coffee table": "table",
    "couch": "sofa",
    "desk": "table",
    "dining table": "table",
    "dresser": "chest of drawers",
    "floor lamp": "lighting",
    "fridge": "appliances",
    "kitchen counter": "counter",
    "microwave": "appliances",
    "nightstand": "chest of drawers",
    "oven": "appliances",
    "painting": "picture",
    "pendant lamp": "lighting",
    "pillow": "cushion",
    "range hood": "appliances",
    "refrigerator": "appliances",
    "shelf": "shelving",
    "shoe rack": "shelving",
    "stove": "appliances",
    "table lamp": "lighting",
    "television": "tv monitor",
    "wall cabinet": "cabinet",
    "wardrobe": "cabinet",
    "washing machine": "appliances",
}
"""Other words, those of the apartments among them, in these categories."""
OTHER = CATEGORIES.index("objects")
"""What words are that neither list has."""


class Semantics(ABC):
    """Tells what each pixel of a panorama is."""

    needs: tuple[str, ...] = ()
    """"depth", or the simulator's instance "ids"."""

    @abstractmethod
    def panoramas(
        self,
        images: NDArray[np.uint8],
        depth: NDArray[np.float32] | None = None,
        ids: NDArray[np.uint32] | None = None,
    ) -> NDArray[np.uint32]:
        """Ids of `CATEGORIES`, uint32 [B, H, W], as `Conditioning.semantic` holds them.

        Args:
            images: uint8 [B, H, W, 3] panoramas.
            depth: float32 [B, H, W] distances along the ray in metres, where needed.
            ids: uint32 [B, H, W] instance ids, where needed.

        Raises:
            ArgumentError: arrays of other shapes, or without what is needed.
        """

    def describe(self) -> dict[str, Any]:
        """JSON-able identity for the run's manifest."""
        return {"name": type(self).__name__}


class TrueSemantics(Semantics):
    """The simulator's own: each instance's category; 0 where nothing is hit.

    Args:
        categories: id to category; `wiw.perception.simulator.categories_of(scene)`.
    """

    needs = ("ids",)

    def __init__(self, categories: Mapping[int, str]) -> None:
        self.categories = {number: category_id(name) for number, name in categories.items()}

    def panoramas(
        self,
        images: NDArray[np.uint8],
        depth: NDArray[np.float32] | None = None,
        ids: NDArray[np.uint32] | None = None,
    ) -> NDArray[np.uint32]:
        """Looks every id up; one that no instance has is an object."""
        if ids is None or ids.shape != images.shape[:3]:
            raise ArgumentError(
                f"TrueSemantics: expected ids {images.shape[:3]}, got {None if ids is None else ids.shape}"
            )
        numbers, places = np.unique(ids, return_inverse=True)
        table = np.array([self.categories.get(int(number), OTHER) if number else 0 for number in numbers], np.uint32)
        return np.asarray(table[places.reshape(ids.shape)])


def category_id(name: str) -> int:
    """The id of a category or of another word for it; of "objects" for words unknown."""
    word = name.strip().casefold().replace("_", " ")
    word = WORDS.get(word, word)
    return CATEGORIES.index(word) if word in CATEGORIES else OTHER
