# SPDX-License-Identifier: Apache-2.0
"""Load a pipeline from a folder of weights onto its device, and say what to do where it does not fit."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

from wiw.errors import ArgumentError, WeightsError
from wiw.networks import memory_guard
from wiw.world_models.base import Requirements

Precision = Literal["float32", "bfloat16", "float16"]
Offload = Literal["none", "model", "sequential"]


class Loadable(Protocol):
    """The attributes of a video model that are read here (`wiw.world_models.video.model.VideoModel`)."""

    pipeline_class: ClassVar[str]
    half_precision: ClassVar[Precision]
    network_precisions: ClassVar[Mapping[str, Precision]]
    variant: str | None
    device: str | None
    precision: Precision | None
    offload: Offload
    size: Any
    batch: int
    frames: int


def load_pipeline(model: Loadable, folder: Path, components: Mapping[str, Any]) -> Any:
    """Return the pipeline, ready to be called; `components` are parts of it that are not in the folder.

    Raises:
        DependencyError: a tokenizer is kept in a form that takes another package to read.
        WeightsError: files are missing or damaged.
        DeviceMemoryError: it does not fit on the device.
    """
    import diffusers
    import torch

    _require_readers(folder)
    with model_memory_guard(model), _hide_progress_bars():
        try:
            pipeline = getattr(diffusers, model.pipeline_class).from_pretrained(
                folder, dtype=_choose_dtypes(model), variant=model.variant, local_files_only=True, **components
            )
        except torch.OutOfMemoryError:
            raise
        except (OSError, ValueError, KeyError, RuntimeError, _safetensors_error()) as error:
            raise WeightsError(
                f"{folder} cannot be loaded as a {model.pipeline_class}: {type(error).__name__}: {error}; files may be "
                f"missing or damaged, or of a different variant than {model.variant}",
                "unfit",
            ) from error
        _require_all_parameters(pipeline, folder)
        pipeline.set_progress_bar_config(disable=True)
        _move_to_device(pipeline, model)
    return pipeline


def _require_readers(folder: Path) -> None:
    """Raise DependencyError where a tokenizer is sentencepiece's model alone and what reads that is not installed."""
    models = [*folder.glob("*/spiece.model"), *folder.glob("*/tokenizer.model")]
    if any(not model.with_name("tokenizer.json").is_file() for model in models):
        Requirements(("sentencepiece", "google.protobuf"), "diffusers").require()


def _require_all_parameters(pipeline: Any, folder: Path) -> None:
    """Raise WeightsError where a network's files lack parameters, which diffusers leaves without values."""
    import torch

    lacking = [
        f"{place}.{name}"
        for place, network in pipeline.components.items()
        if isinstance(network, torch.nn.Module)
        for name, value in network.named_parameters()
        if value.is_meta
    ]
    if lacking:
        raise WeightsError(
            f"{folder} lacks {len(lacking)} parameters, such as {lacking[0]}: download the weights again", "unfit"
        )


@contextmanager
def _hide_progress_bars() -> Iterator[None]:
    """Hold back the libraries' progress bars: a run has its own, and theirs leave locks behind in worker processes."""
    from diffusers.utils import logging as of_diffusers
    from transformers.utils import logging as of_transformers

    with_bars = [library for library in (of_diffusers, of_transformers) if library.is_progress_bar_enabled()]
    for library in with_bars:
        library.disable_progress_bar()
    try:
        yield
    finally:
        for library in with_bars:
            library.enable_progress_bar()


def _choose_dtypes(model: Loadable) -> dict[str, Any]:
    """Return the precision of each network."""
    import torch

    assert model.precision is not None
    parts = model.network_precisions if model.precision == model.half_precision else {}
    return {name: getattr(torch, kind) for name, kind in {"default": model.precision, **parts}.items()}


def _move_to_device(pipeline: Any, model: Loadable) -> None:
    if model.offload == "none":
        pipeline.to(model.device)
    elif model.device == "cpu":
        raise ArgumentError(f"offload='{model.offload}' moves networks to a GPU and back; leave it out on the CPU")
    elif model.offload == "model":
        pipeline.enable_model_cpu_offload(device=model.device)
    else:
        pipeline.enable_sequential_cpu_offload(device=model.device)


def model_memory_guard(model: Loadable) -> AbstractContextManager[None]:
    """Turn torch's error of a full GPU into one that says which options need less."""
    return memory_guard(f"{type(model).__name__} on {model.device}", "; ".join(_list_remedies(model)))


def _list_remedies(model: Loadable) -> list[str]:
    """List the options that need less memory than the present ones, the mildest first."""
    height, width = model.size
    remedies = [f"batch=1 (now {model.batch})"] if model.batch > 1 else []
    remedies += [f"precision='{model.half_precision}' (now float32)"] if model.precision == "float32" else []
    remedies += ["offload='model'"] if model.offload == "none" else []
    remedies += ["offload='sequential' (slow)"] if model.offload != "sequential" else []
    return [*remedies, f"a smaller size than {height}x{width}", f"fewer frames than {model.frames}"]


def versions() -> dict[str, str]:
    """Return the versions of the libraries that frames depend on."""
    return {name: importlib.metadata.version(name) for name in ("torch", "diffusers", "transformers")}


def _safetensors_error() -> type[Exception]:
    from safetensors import SafetensorError

    return SafetensorError
