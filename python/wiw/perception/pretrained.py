# SPDX-License-Identifier: Apache-2.0
"""Networks of `transformers` with their weights, and images as they want them; torchvision is never needed."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, DependencyError, WeightsError
from wiw.networks import explained, is_path

MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
"""Of ImageNet, channel by channel."""


def network(loader: str, kinds: Sequence[str], weights: str | Path, revision: str | None, device: str) -> Any:
    """A network with all its weights, ready to be asked.

    Args:
        loader: a class of `transformers`.
        kinds: `model_type` of the configurations it may have.
        weights: a folder as `save_pretrained` writes it, or a name on the Hugging Face hub.
        revision: of the hub's repository: pins a commit.
        device: of torch.

    Raises:
        DependencyError: torch or transformers is not installed.
        WeightsError: there are no such weights, or they are another network's.
        ArgumentError: a revision of a folder.
    """
    transformers = library()
    config = part("AutoConfig", weights, revision)
    if config.model_type not in kinds:
        raise WeightsError(f"{weights} holds a '{config.model_type}': expected {' or '.join(kinds)}", "unfit")
    load = getattr(transformers, loader).from_pretrained
    model, report = _read(load, weights, revision, output_loading_info=True)
    if missing := sorted(report["missing_keys"]):
        raise WeightsError(
            f"{weights} has no weights for {len(missing)} parts of {type(model).__name__}: {', '.join(missing[:5])}",
            "unfit",
        )
    return model.to(device).float().eval().requires_grad_(False)


def part(loader: str, weights: str | Path, revision: str | None) -> Any:
    """What lies beside the weights: `transformers.LOADER.from_pretrained`; raises what `network` does."""
    return _read(getattr(library(), loader).from_pretrained, weights, revision)


def image_processor(kind: str, weights: str | Path, revision: str | None) -> Any:
    """What scales and normalises images for a network of a kind, in NumPy and Pillow; raises what `network` does."""
    in_numpy = f"{kind}ImageProcessorPil"  # before transformers 5 it was the one without a suffix
    return part(in_numpy if hasattr(library(), in_numpy) else f"{kind}ImageProcessor", weights, revision)


def library() -> Any:
    """The module `transformers`, with torch.

    Raises:
        DependencyError: one of them is not installed.
    """
    try:
        importlib.import_module("torch")
        return importlib.import_module("transformers")
    except ImportError as error:
        raise DependencyError(f"{error.name or error} not installed; pip install 'wiw[torch]'") from error


def square(images: Sequence[NDArray[np.uint8]], side: int, device: str) -> Any:
    """Float tensor [B, 3, side, side] around 0: each image resized, whatever its aspect ratio, as SAM 2 has it."""
    import torch

    resized = []
    for image in images:
        pixels = torch.from_numpy(np.ascontiguousarray(image)).to(device).permute(2, 0, 1)[None].float() / 255
        resized.append(torch.nn.functional.interpolate(pixels, (side, side), mode="bilinear", antialias=True))
    mean, std = (torch.tensor(values, device=device)[:, None, None] for values in (MEAN, STD))
    return (torch.cat(resized) - mean) / std


def _read(load: Callable[..., Any], weights: str | Path, revision: str | None, **options: Any) -> Any:
    folder = Path(weights).expanduser()
    local = folder.is_dir()
    if local and revision is not None:
        raise ArgumentError(f"revision: '{revision}' names a state of a hub repository, but {folder} is a folder")
    if not local and is_path(str(weights)):
        raise WeightsError(
            f"no folder {folder.resolve()}; give one that save_pretrained wrote, or a name on the Hugging Face hub"
        )
    try:
        with _quiet():
            return load(folder, **options) if local else load(str(weights), revision=revision, **options)
    except Exception as error:
        if not local:
            raise explained(error, str(weights), revision) from error
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise WeightsError(f"{folder}: {first}; give a folder that save_pretrained wrote", "unfit") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Holds back the library's progress bars and remarks: a run has its own, and what matters is checked."""
    from transformers.utils import logging

    shown, level = logging.is_progress_bar_enabled(), logging.get_verbosity()
    logging.disable_progress_bar()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if shown:
            logging.enable_progress_bar()
