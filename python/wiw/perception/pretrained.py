# SPDX-License-Identifier: Apache-2.0
"""Loading of networks and image processors of `transformers`; torchvision is never needed."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, DependencyError, WeightsError
from wiw.networks import explain_hub_error, is_path

MEAN = (0.485, 0.456, 0.406)
"""ImageNet's mean, channel by channel."""
STD = (0.229, 0.224, 0.225)
"""ImageNet's standard deviation, channel by channel."""


def load_network(loader: str, kinds: Sequence[str], weights: str | Path, revision: str | None, device: str) -> Any:
    """Load a network with all its weights, in evaluation mode.

    Args:
        loader: a class of `transformers`.
        kinds: accepted values of the configuration's `model_type`.
        weights: a folder written by `save_pretrained`, or a name on the Hugging Face hub.
        revision: of the hub's repository: pins a commit.
        device: of torch.

    Raises:
        DependencyError: torch or transformers is not installed.
        WeightsError: the weights do not exist, or belong to another network.
        ArgumentError: a revision was given for a folder.
    """
    transformers = import_transformers()
    config = load_component("AutoConfig", weights, revision)
    if config.model_type not in kinds:
        raise WeightsError(f"{weights} holds a '{config.model_type}': expected {' or '.join(kinds)}", "unfit")
    load = getattr(transformers, loader).from_pretrained
    model, report = _load(load, weights, revision, output_loading_info=True)
    if missing := sorted(report["missing_keys"]):
        raise WeightsError(
            f"{weights} has no weights for {len(missing)} parts of {type(model).__name__}: {', '.join(missing[:5])}",
            "unfit",
        )
    return model.to(device).float().eval().requires_grad_(False)


def load_component(loader: str, weights: str | Path, revision: str | None) -> Any:
    """Load a file beside the weights by `transformers.LOADER.from_pretrained`; raises what `load_network` does."""
    return _load(getattr(import_transformers(), loader).from_pretrained, weights, revision)


def load_image_processor(kind: str, weights: str | Path, revision: str | None) -> Any:
    """Load the image processor of a network, in NumPy and Pillow; raises what `load_network` does."""
    in_numpy = f"{kind}ImageProcessorPil"  # before transformers 5 it was the one without a suffix
    return load_component(
        in_numpy if hasattr(import_transformers(), in_numpy) else f"{kind}ImageProcessor", weights, revision
    )


def import_transformers() -> Any:
    """Import the module `transformers`, with torch.

    Raises:
        DependencyError: one of them is not installed.
    """
    try:
        importlib.import_module("torch")
        return importlib.import_module("transformers")
    except ImportError as error:
        raise DependencyError(f"{error.name or error} not installed; pip install 'wiw[torch]'") from error


def require_batch(where: str, batch: int) -> None:
    """Check the number of images in one call of a network.

    Raises:
        ArgumentError: there is none.
    """
    if batch < 1:
        raise ArgumentError(f"{where}: expected a batch of at least 1, got {batch}")


def to_square_batch(images: Sequence[NDArray[np.uint8]], side: int, device: str) -> Any:
    """Resize images to a normalised float tensor [B, 3, side, side], ignoring aspect ratios, as SAM 2 expects."""
    import torch

    resized = []
    for image in images:
        pixels = torch.from_numpy(np.ascontiguousarray(image)).to(device).permute(2, 0, 1)[None].float() / 255
        resized.append(torch.nn.functional.interpolate(pixels, (side, side), mode="bilinear", antialias=True))
    mean, std = (torch.tensor(values, device=device)[:, None, None] for values in (MEAN, STD))
    return (torch.cat(resized) - mean) / std


def _load(load: Callable[..., Any], weights: str | Path, revision: str | None, **options: Any) -> Any:
    folder = Path(weights).expanduser()
    local = folder.is_dir()
    if local and revision is not None:
        raise ArgumentError(f"revision: '{revision}' is a revision of a hub repository, but {folder} is a folder")
    if not local and is_path(str(weights)):
        raise WeightsError(
            f"no folder {folder.resolve()}; give one written by save_pretrained, or a name on the Hugging Face hub"
        )
    try:
        with _silence_transformers():
            return load(folder, **options) if local else load(str(weights), revision=revision, **options)
    except Exception as error:
        if not local:
            raise explain_hub_error(error, str(weights), revision) from error
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise WeightsError(f"{folder}: {first}; give a folder written by save_pretrained", "unfit") from error


@contextmanager
def _silence_transformers() -> Iterator[None]:
    """Suppress the library's progress bars and warnings: a run has its own, and everything relevant is checked."""
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
