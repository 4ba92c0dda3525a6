# SPDX-License-Identifier: Apache-2.0
"""Encode the clips of a training ahead of it, in this process or by a pool of actors of Ray, into its cache.

A training with this cache then reads every clip as the frozen networks encode it, and decodes and encodes none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wiw.errors import ArgumentError
from wiw.networks import memory_guard, resolve_device
from wiw.ray_cluster import HERE, Engine, map_batches
from wiw.training.post_training.clip_trainer import arrange_clips
from wiw.training.post_training.corpora import CorpusPart, open_corpus
from wiw.training.post_training.families import PretrainedWeights, announce_shape, find_family
from wiw.training.post_training.latent_cache import require_folder
from wiw.training.post_training.recipe import PostTrainingRecipe, load_recipe
from wiw.training.post_training.train import choose_precision, list_smaller, open_cache
from wiw.training.post_training.trainable import Encoded
from wiw.training.post_training.trainer import encode_clip, load_clip

BATCH = 16
"""Clips of a call of an actor."""
Progress = Callable[[int, int], None]
"""Called with the number of clips that are done, and of all."""


def encode_clips(
    name: str,
    data: str | Path,
    cache: str | Path,
    *,
    recipe: PostTrainingRecipe | None = None,
    part: CorpusPart = "train",
    workers: int = 1,
    place: Engine = HERE,
    progress: Progress = lambda *_: None,
    **weights: Any,
) -> int:
    """Encode all clips that `post_train` with the same arguments will use; those in the cache stay as they are.

    Args:
        name: such as "ltx-action".
        data: folder of `wiw collect navigation` or `wiw collect manipulation`.
        cache: folder of encoded clips; on a Ray cluster one that all machines see.
        recipe: the numbers; the shipped recipe if None.
        part: of the data: "train" or "all".
        workers: number of actors of Ray, each with its own networks.
        place: this process, or actors on a Ray cluster.
        progress: called as clips are done.
        **weights: pretrained weights: weights, revision, variant and device, as of `post_train`.

    Returns:
        The number of clips, mirrored ones counted by themselves.

    Raises:
        ArgumentError: several workers without Ray, or see `post_train`.
        FileError, WeightsError, DependencyError, DeviceMemoryError, InfrastructureError: likewise.
    """
    place.require_valid("encode")
    require_folder(Path(cache))
    if workers < 1 or (workers > 1 and place.engine != "ray"):
        raise ArgumentError(f"encode: expected 1 worker, or several with engine ray, got {workers}")
    device = choose_encoding_device(place, weights.pop("device", None))
    recipe = recipe or choose_precision(load_recipe(name), device)
    source = PretrainedWeights(weights.pop("weights", None), device=device, **weights)
    given: dict[str, Any] = {
        "name": name,
        "data": str(data),
        "cache": str(cache),
        "recipe": recipe,
        "part": part,
        "source": source,
    }
    rows = list(_list_rows(name, data, recipe, part))
    done = 0
    if place.engine == "ray":
        for _ in map_batches(place, ClipEncoder, given, rows, workers, BATCH):
            progress(done := done + 1, len(rows))
        return len(rows)
    encoder = ClipEncoder(**given)
    for row in rows:
        encoder({key: np.array([value]) for key, value in row.items()})
        progress(done := done + 1, len(rows))
    return len(rows)


def choose_encoding_device(place: Engine, requested: str | None) -> str:
    """Return the device that clips are encoded on: of Ray's actors, which may be on other machines, or of this process.

    Raises:
        ArgumentError: this process lacks it.
    """
    if place.engine == "ray":
        return requested or ("cuda" if place.worker_gpus else "cpu")
    return resolve_device(requested)


class ClipEncoder:
    """The frozen networks of a training, and the cache that they fill; made once in each process.

    Raises:
        DeviceMemoryError: the device's memory is too small, here or in a call.
    """

    def __init__(
        self, name: str, data: str, cache: str, recipe: PostTrainingRecipe, part: CorpusPart, source: PretrainedWeights
    ) -> None:
        family = find_family(name)
        corpus, recipe = family.fit(open_corpus(data, part, recipe.held_out), recipe)
        self._guard = partial(
            memory_guard, f"encoding clips for {name} on {source.device}", "; ".join(list_smaller(recipe))
        )
        with self._guard():
            loaded = family.load(corpus, recipe, source)
        self._model, self._size = loaded.model, loaded.recipe.clip_size
        self._clips = corpus.clips(loaded.recipe.frames)
        self._cache = open_cache(Path(cache), loaded, corpus)

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Encode the clips of a batch, "clip" int [B] and "mirrored" bool [B]; return the same."""
        with self._guard():
            for index, mirror in zip(batch["clip"].tolist(), batch["mirrored"].tolist(), strict=True):
                self._cache.encode(index, mirror, partial(self._encode, index, mirror), self._model.device)
        return {"clip": batch["clip"], "mirrored": batch["mirrored"]}

    def _encode(self, index: int, mirror: bool) -> tuple[Encoded, Any]:
        return encode_clip(self._model, load_clip(self._clips, self._size, index, mirror).to(self._model.device))


def _list_rows(name: str, data: str | Path, recipe: PostTrainingRecipe, part: CorpusPart) -> Iterator[dict[str, Any]]:
    """Yield the clips that a training uses, including mirrored ones where it mirrors some."""
    corpus, fitted = find_family(name).fit(open_corpus(data, part, recipe.held_out), recipe)
    announce_shape(name, recipe, fitted)
    order = arrange_clips(len(corpus.clips(fitted.frames)), fitted)
    sides = [side for side, share in ((False, 1 - fitted.mirror), (True, fitted.mirror)) if share > 0]
    for index in np.sort(order.chosen).tolist():
        for side in sides:
            yield {"clip": index, "mirrored": side}
