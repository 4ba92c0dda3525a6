# SPDX-License-Identifier: Apache-2.0
"""LoRA of a stock denoiser, in the layouts that trainers write.

diffusers       transformer.blocks.0.attn1.to_q.lora_A.weight              (of a second denoiser transformer_2.)
LTX-Trainer     diffusion_model.transformer_blocks.0.attn1.to_q.lora_A.weight
DiffSynth       blocks.0.self_attn.q.lora_A.default.weight                 (the names of Wan's own repository)

Libraries pass over names that they do not know, and a model that is only half adapted looks like one that is. So every
layer of a file must be one of the denoiser, with matrices of its sizes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open

from wiw.errors import WeightsError
from wiw.world_models.base import Requirements

ADAPTER = "lora"
"""Name of the LoRA in the pipeline."""
METADATA = "lora_adapter_metadata"
"""The place where diffusers keeps rank and alpha."""
_PREFIX = re.compile(r"^(?:pipe\.(?:dit|transformer)\.|base_model\.model\.|diffusion_model\.)+")
_OTHER_DENOISER = re.compile(
    r"^(transformer(?:_2)?)\.(?=(?:transformer_)?blocks|single|condition|proj|time|patch|x_|norm)"
)
_WAN_NAMES = re.compile(r"^blocks\.\d+\.(?:self_attn|cross_attn|ffn\.\d)")
_PART = re.compile(r"^(?P<layer>.+)\.lora_(?P<side>[AB])\.(?:weight|bias)$")
SHOWN = 3
"""Names that an error lists."""


def find_lora(source: str | Path) -> Path:
    """Return the file of a LoRA: the source itself, or the only one in a folder.

    Raises:
        WeightsError: there is none, or several.
    """
    path = Path(source).expanduser()
    if path.is_file():
        return path
    found = sorted(path.glob("*.safetensors"))
    if len(found) != 1:
        raise WeightsError(
            f"{path}: expected the .safetensors file of a LoRA, or a folder with one, found {len(found) or 'nothing'}"
        )
    return found[0]


def load_lora(file: Path, place: str, pipeline: Any) -> None:
    """Put the LoRA of a file into a denoiser of a pipeline.

    Raises:
        DependencyError: peft is not installed.
        WeightsError: a damaged file, a layout that is not known, or layers that the denoiser does not have, all or
            some; names them.
    """
    Requirements(("peft",), "diffusers").require()
    tensors, metadata = _read_file(file)
    denoiser = getattr(pipeline, place)
    adapted = convert_names(tensors, place, pipeline, file)
    require_layers(adapted, denoiser, f"{file}: {place}")
    try:
        denoiser.load_lora_adapter(
            adapted, prefix=None, adapter_name=ADAPTER, metadata=_select_metadata(metadata, place), _pipeline=pipeline
        )
    except torch.OutOfMemoryError:
        raise
    except (ValueError, KeyError, RuntimeError, TypeError) as error:
        raise WeightsError(f"{file} cannot be loaded ({error})", "unfit") from error


def convert_names(tensors: Mapping[str, Any], place: str, pipeline: Any, file: Path) -> dict[str, Any]:
    """Return the tensors under diffusers' names of the denoiser's layers.

    Raises:
        WeightsError: names of no known layout.
    """
    plain = {_PREFIX.sub("", name).replace(".default.", "."): value for name, value in tensors.items()}
    plain = _select_denoiser(plain, place, file)
    if not any(map(_WAN_NAMES.match, plain)):
        return plain
    named = {f"diffusion_model.{name}": value for name, value in plain.items()}
    try:
        converted = pipeline.lora_state_dict(named)
    except (AttributeError, ValueError, KeyError) as error:
        raise WeightsError(
            f"{file} has names of Wan's own layout, which cannot be converted for {type(pipeline).__name__} ({error})",
            "unfit",
        ) from error
    return {name.removeprefix("transformer."): value for name, value in converted.items()}


def require_layers(adapted: Mapping[str, Any], denoiser: Any, where: str) -> None:
    """Raise WeightsError unless each tensor adapts a layer of the denoiser, from both sides, in its sizes."""
    parts = {name: _PART.match(name) for name in adapted}
    if strange := [name for name, part in parts.items() if part is None]:
        raise WeightsError(
            f"{where}: expected names that end with lora_A.weight or lora_B.weight, got {_shorten(strange)}", "unfit"
        )
    layers = sorted({part["layer"] for part in parts.values() if part is not None})
    modules = dict(denoiser.named_modules())
    lacking = [layer for layer in layers if not isinstance(getattr(modules.get(layer), "weight", None), torch.Tensor)]
    if not layers or len(lacking) == len(layers):
        raise WeightsError(f"{where}: the LoRA matches no layer: {_shorten(lacking) or 'it is empty'}", "unfit")
    if lacking:
        raise WeightsError(
            f"{where}: {len(lacking)} of {len(layers)} layers of the LoRA are not in the network: {_shorten(lacking)}",
            "unfit",
        )
    unfit = [layer for layer in layers if not _fits(adapted, layer, modules[layer].weight)]
    if unfit:
        raise WeightsError(
            f"{where}: {len(unfit)} of {len(layers)} layers of the LoRA lack one side or differ in size from the "
            f"network's: {_shorten(unfit)}",
            "unfit",
        )


def _fits(adapted: Mapping[str, Any], layer: str, weight: Any) -> bool:
    inward, outward = (adapted.get(f"{layer}.lora_{side}.weight") for side in "AB")
    if inward is None or outward is None or inward.ndim < 2 or outward.ndim < 2:
        return False
    return bool(
        inward.shape[1] == weight.shape[1]
        and outward.shape[0] == weight.shape[0]
        and inward.shape[0] == outward.shape[1]
    )


def _read_file(file: Path) -> tuple[dict[str, Any], dict[str, Any] | None]:
    try:
        with safe_open(file, framework="pt") as content:
            tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118 - no mapping
            said = (content.metadata() or {}).get(METADATA)
        return tensors, None if said is None else dict(json.loads(said))
    except (OSError, SafetensorError, ValueError) as error:
        raise WeightsError(f"{file} is damaged or not a .safetensors file ({error})", "unfit") from error


def _select_metadata(metadata: Mapping[str, Any] | None, place: str) -> dict[str, Any] | None:
    """Return what the file says of the denoiser's LoRA; None if it says nothing."""
    prefixes = (f"{place}.", "transformer.")
    own = [
        {name.removeprefix(prefix): value for name, value in (metadata or {}).items() if name.startswith(prefix)}
        for prefix in prefixes
    ]
    return own[0] or own[1] or None


def _select_denoiser(tensors: Mapping[str, Any], place: str, file: Path) -> dict[str, Any]:
    """Return the tensors of one denoiser without its name; of a file of one denoiser alone, all."""
    named = {name: match[1] for name in tensors if (match := _OTHER_DENOISER.match(name))}
    places = set(named.values())
    wanted = place if place in places or len(places) > 1 else next(iter(places), place)
    if places and wanted not in places:
        raise WeightsError(f"{file} has a LoRA of {', '.join(sorted(places))}, but none of {place}", "unfit")
    return {
        name.removeprefix(f"{wanted}."): value
        for name, value in tensors.items()
        if name not in named or named[name] == wanted
    }


def _shorten(names: list[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more
