# SPDX-License-Identifier: Apache-2.0
"""Action-conditioned checkpoints: the action encoders, and the denoisers or the LoRA trained with them.

config.json                          `ActionConfig`
action_encoder.safetensors           one encoder a denoiser, names led by the denoiser's place in the pipeline
unet/ or transformer/                the trained denoiser as `save_pretrained` writes it, or
pytorch_lora_weights.safetensors     a LoRA of it (of a second denoiser: pytorch_lora_weights_2.safetensors)
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from wiw.errors import ArgumentError, WeightsError
from wiw.world_models.base import Requirements
from wiw.world_models.video.actions.config import ActionConfig
from wiw.world_models.video.actions.encoder import ActionEncoder

ENCODERS = "action_encoder.safetensors"
ADAPTER = "actions"
"""Name of the LoRA in the pipeline."""


def save(
    folder: str | Path,
    encoders: Mapping[str, ActionEncoder],
    pipeline: Any,
    lora: bool = False,
) -> Path:
    """Write a checkpoint.

    Args:
        folder: where to; made if it does not exist.
        encoders: one for each denoiser, by its place in the pipeline ("unet", "transformer", "transformer_2").
        pipeline: holds the trained denoisers.
        lora: write their LoRA (peft's adapter "actions") instead of all their weights.

    Raises:
        ArgumentError: encoders of different configurations, or a LoRA for a pipeline that takes none.
    """
    if lora and not supports_lora(pipeline):
        raise ArgumentError(f"{type(pipeline).__name__} does not support LoRA: save its whole denoiser (lora=False)")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    configs = {encoder.config for encoder in encoders.values()}
    if len(configs) != 1:
        raise ArgumentError("a checkpoint has one configuration, but its encoders have different ones")
    configs.pop().save(folder)
    tensors = {
        f"{place}.{name}": value.contiguous().cpu()
        for place, encoder in encoders.items()
        for name, value in encoder.state_dict().items()
    }
    save_file(tensors, folder / ENCODERS)
    for place in encoders:
        denoiser = getattr(pipeline, place)
        if lora:
            _save_lora(folder, place, pipeline, denoiser)
        else:
            denoiser.save_pretrained(folder / place)
    return folder


def _save_lora(folder: Path, place: str, pipeline: Any, denoiser: Any) -> None:
    from peft.utils import get_peft_model_state_dict

    options = denoiser.peft_config[ADAPTER].to_dict()
    pipeline.save_lora_weights(
        folder,
        transformer_lora_layers=get_peft_model_state_dict(denoiser, adapter_name=ADAPTER),
        transformer_lora_adapter_metadata={
            name: sorted(value) if isinstance(value, set) else value for name, value in options.items()
        },
        weight_name=name_lora_file(place),
    )
    _sort_metadata(folder / name_lora_file(place))


def _sort_metadata(path: Path) -> None:
    """Sort a file's metadata by name, so that equal weights are equal bytes: safetensors writes them in any order."""
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text = text.ljust(-(-len(text) // 8) * 8)  # the format aligns what follows
    path.write_bytes(len(text).to_bytes(8, "little") + text + data[end:])


def name_lora_file(place: str) -> str:
    """Return the name of the file with the LoRA of a denoiser."""
    return f"pytorch_lora_weights{'_2' if place.endswith('_2') else ''}.safetensors"


def supports_lora(pipeline: Any) -> bool:
    """Return whether a pipeline, or a class of them, loads and saves LoRA: those of SVD and Cosmos-Predict2 do not."""
    return hasattr(pipeline, "load_lora_weights")


def has_lora(folder: Path, places: Sequence[str], pipeline: type) -> bool:
    """Return whether the denoisers' training is kept as LoRA; else it is kept whole.

    Raises:
        WeightsError: neither is there for each denoiser, or a LoRA for a pipeline that takes none.
    """
    loras = list(map(name_lora_file, places))
    if supports_lora(pipeline) and all((folder / name).is_file() for name in loras):
        return True
    if all((folder / place / "config.json").is_file() for place in places):
        return False
    other = f"or {' and '.join(loras)}" if supports_lora(pipeline) else f"since {pipeline.__name__} takes no LoRA"
    raise WeightsError(
        f"{folder} holds no trained denoiser: expected {' and '.join(f'{place}/' for place in places)}, as written by "
        f"save_pretrained, {other}"
    )


def load_encoders(folder: Path, config: ActionConfig, places: Sequence[str]) -> dict[str, ActionEncoder]:
    """Return one encoder for each denoiser.

    Raises:
        WeightsError: the file is missing or damaged, or has other parameters (says which).
    """
    file = folder / ENCODERS
    if not file.is_file():
        raise WeightsError(f"no {file}; a checkpoint has one next to its config.json")
    try:
        tensors = load_file(file)
    except SafetensorError as error:
        raise WeightsError(f"{file} is damaged ({error})", "unfit") from error
    encoders = {place: ActionEncoder(config) for place in places}
    wanted = {
        f"{place}.{name}": value.shape for place, each in encoders.items() for name, value in each.state_dict().items()
    }
    found = {name: value.shape for name, value in tensors.items()}
    if wrong := sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name)):
        raise WeightsError(
            f"{file} does not fit its config.json: {wrong[0]} is {_format_shape(found, wrong[0])}, expected "
            f"{_format_shape(wanted, wrong[0])}" + (f", and {len(wrong) - 1} more" if len(wrong) > 1 else ""),
            "unfit",
        )
    for place, encoder in encoders.items():
        start = f"{place}."
        encoder.load_state_dict({n.removeprefix(start): v for n, v in tensors.items() if n.startswith(start)})
    return {place: encoder.eval().requires_grad_(False) for place, encoder in encoders.items()}


def _format_shape(shapes: Mapping[str, Any], name: str) -> str:
    return str(tuple(shapes[name])) if name in shapes else "not there"


def load_denoisers(folder: Path, places: Sequence[str], dtype: Any) -> dict[str, Any]:
    """Return the trained denoisers, by their place in the pipeline.

    Raises:
        WeightsError: damaged files.
    """
    import diffusers

    try:
        return {
            place: diffusers.AutoModel.from_pretrained(str(folder / place), dtype=dtype, local_files_only=True)
            for place in places
        }
    except (OSError, ValueError, KeyError, SafetensorError) as error:
        raise WeightsError(f"{folder}: the denoiser cannot be loaded ({error})", "unfit") from error


def load_lora(folder: Path, places: Sequence[str], pipeline: Any) -> None:
    """Put the LoRA into the pipeline's denoisers.

    Raises:
        DependencyError: peft is not installed.
        WeightsError: a LoRA of other layers or of another network.
    """
    Requirements(("peft",), "diffusers").require()
    for place in places:
        file = folder / name_lora_file(place)
        second = {"load_into_transformer_2": True} if place.endswith("_2") else {}
        try:
            pipeline.load_lora_weights(
                folder, weight_name=file.name, adapter_name=ADAPTER, local_files_only=True, **second
            )
        except torch.OutOfMemoryError:
            raise
        except (OSError, ValueError, KeyError, RuntimeError, SafetensorError) as error:
            raise WeightsError(f"{file} cannot be loaded ({error})", "unfit") from error
        if ADAPTER not in getattr(getattr(pipeline, place), "peft_config", {}):
            raise WeightsError(
                f"{file} holds no LoRA of the denoiser: expected names that begin with 'transformer.'", "unfit"
            )
