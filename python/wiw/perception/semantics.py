# SPDX-License-Identifier: Apache-2.0
"""Semantic labels in Matterport3D's categories (mpcat40), for world models that read them, such as PathDreamer."""

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
"""Category names by id, from 0 for nothing to 40."""
SYNONYMS = {
    "armchair": "chair",
    "bench": "seating",
    "blind": "blinds",
    "bookshelf": "shelving",
    "bunk bed": "bed",
    "ceiling lamp": "lighting",
    "coffee table": "table",
    "console table": "table",
    "couch": "sofa",
    "desk": "table",
    "dining chair": "chair",
    "dining table": "table",
    "door frame": "door",
    "doorframe": "door",
    "doorway": "door",
    "dresser": "chest of drawers",
    "floor lamp": "lighting",
    "fridge": "appliances",
    "kitchen cabinet": "cabinet",
    "kitchen counter": "counter",
    "kitchen sink": "sink",
    "microwave": "appliances",
    "nightstand": "chest of drawers",
    "office chair": "chair",
    "oven": "appliances",
    "painting": "picture",
    "pendant lamp": "lighting",
    "photo": "picture",
    "pillow": "cushion",
    "pouf": "seating",
    "range hood": "appliances",
    "refrigerator": "appliances",
    "shelf": "shelving",
    "shoe rack": "shelving",
    "side table": "table",
    "sideboard": "cabinet",
    "stove": "appliances",
    "table lamp": "lighting",
    "television": "tv monitor",
    "tv stand": "furniture",
    "wall cabinet": "cabinet",
    "wall shelf": "shelving",
    "wardrobe": "cabinet",
    "washing machine": "appliances",
}
"""Other words for these categories, including those of the apartments."""
OTHER_CATEGORY = CATEGORIES.index("objects")
"""Category of words that neither list has."""


class Semantics(ABC):
    """Labels each pixel of a panorama with a category."""

    needs: tuple[str, ...] = ()
    """"depth", or the simulator's instance "ids"."""

    @abstractmethod
    def label_panoramas(
        self,
        images: NDArray[np.uint8],
        depth: NDArray[np.float32] | None = None,
        ids: NDArray[np.uint32] | None = None,
    ) -> NDArray[np.uint32]:
        """Return ids of `CATEGORIES`, uint32 [B, H, W], as in `Conditioning.semantic`.

        Args:
            images: uint8 [B, H, W, 3] panoramas.
            depth: float32 [B, H, W] distances along the ray in metres, where needed.
            ids: uint32 [B, H, W] instance ids, where needed.

        Raises:
            ArgumentError: arrays of other shapes, or without what is needed.
        """

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity for the run's manifest."""
        return {"name": type(self).__name__}


class TrueSemantics(Semantics):
    """The simulator's own labels: each instance's category; 0 where nothing is hit.

    Args:
        categories: id to category; `read_semantic_categories(scene)`.
    """

    needs = ("ids",)

    def __init__(self, categories: Mapping[int, str]) -> None:
        self.categories = {number: find_category_id(name) for number, name in categories.items()}

    def label_panoramas(
        self,
        images: NDArray[np.uint8],
        depth: NDArray[np.float32] | None = None,
        ids: NDArray[np.uint32] | None = None,
    ) -> NDArray[np.uint32]:
        """Look up each instance's category; unknown instances are objects."""
        if ids is None or ids.shape != images.shape[:3]:
            raise ArgumentError(
                f"TrueSemantics: expected ids {images.shape[:3]}, got {None if ids is None else ids.shape}"
            )
        numbers, places = np.unique(ids, return_inverse=True)
        table = np.array(
            [self.categories.get(int(number), OTHER_CATEGORY) if number else 0 for number in numbers], np.uint32
        )
        return np.asarray(table[places.reshape(ids.shape)])


def read_semantic_categories(scene: Any) -> dict[int, str]:
    """Return the category of each of a scene's instances, by id: Matterport3D's own where its scans have it."""
    return {each["id"]: each["attributes"].get("mpcat40") or each["category"] for each in scene.instances}


def find_category_id(name: str) -> int:
    """Return the id of a category or of a synonym; of "objects" for unknown words."""
    word = name.strip().casefold().replace("_", " ")
    word = SYNONYMS.get(word, word)
    return CATEGORIES.index(word) if word in CATEGORIES else OTHER_CATEGORY
