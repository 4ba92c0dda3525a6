# SPDX-License-Identifier: Apache-2.0
"""Loads the CDiT and the image codec from files or the Hugging Face hub."""

from __future__ import annotations

import pickle
from argparse import Namespace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from safetensors.torch import save_file
from torch import Tensor

from wiw.errors import ArgumentError, WeightsError
from wiw.networks import explain_hub_error, is_path
from wiw.world_models.nwm.cdit import Architecture, CDiT

CODEC = "stabilityai/sd-vae-ft-ema"
TRAINED = "cdit.safetensors"
"""Name of the file that `save` writes."""


def fetch(weights: str, file: str, revision: str | None) -> Path:
    """Return the checkpoint on this machine: a file, `file` or what `save` wrote in a folder, or in a hub repository.

    Raises:
        WeightsError: there is none; says what to do.
        ArgumentError: a revision of a file or folder.
    """
    local = Path(weights).expanduser()
    _refuse_revision("revision", revision, local)
    for found in (local / file, local / TRAINED, local):
        if found.is_file():
            return found
    if local.is_dir() or is_path(weights):
        raise WeightsError(
            f"no file {local / file if local.is_dir() else local}; `hf download facebook/nwm {file}` fetches it (CC "
            "BY-NC 4.0: research only)"
        )
    from huggingface_hub import hf_hub_download

    try:
        return Path(hf_hub_download(weights, file, revision=revision))
    except Exception as error:
        raise explain_hub_error(error, weights, revision) from error


def codec_beside(checkpoint: Path) -> str:
    """Return the codec's folder beside a checkpoint, else the published one on the hub."""
    folder = checkpoint.with_name("vae")
    return str(folder) if folder.is_dir() else CODEC


def load_cdit(path: Path) -> CDiT:
    """Return the network with the weights in a file.

    Raises:
        WeightsError: not readable, or not the parameters of a CDiT; says which are missing or too many.
    """
    state = _state(path)
    try:
        size = Architecture.of(state)
    except KeyError as error:
        raise WeightsError(
            f"{path}: not weights of a CDiT: expected {error}; it has {_list_some(sorted(state))}", "unfit"
        ) from None
    with torch.device("meta"):
        network = CDiT(size)
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in state.items()}
    if expected != found:
        raise WeightsError(f"{path}: not weights of a CDiT of size {size}: {_difference(expected, found)}", "unfit")
    network.load_state_dict(state, assign=True)
    return network.float().eval().requires_grad_(False)


def save(folder: Path, network: CDiT, codec: Any) -> None:
    """Write a network and its codec into a folder, which is then a complete checkpoint."""
    state = {name: value.detach().contiguous().cpu() for name, value in network.state_dict().items()}
    save_file(state, folder / TRAINED)
    codec.save_pretrained(folder / "vae")


def load_codec(vae: str, revision: str | None) -> Any:
    """Load the image codec from a local folder or the hub.

    Raises:
        WeightsError: the folder is empty, or the AutoencoderKL is incomplete.
        ArgumentError: a revision of a folder.
    """
    _refuse_revision("vae_revision", revision, Path(vae).expanduser())
    try:
        codec: Any = AutoencoderKL.from_pretrained(vae, revision=revision)
    except (OSError, ValueError, RuntimeError) as error:
        if not is_path(vae):
            raise explain_hub_error(error, vae, revision) from error
        raise WeightsError(
            f"no AutoencoderKL in {vae} ({_first_line(error)}); `hf download {CODEC} --local-dir FOLDER` fetches one"
        ) from error
    if lacking := [name for name, value in codec.named_parameters() if value.is_meta]:
        raise WeightsError(f"{vae} lacks {len(lacking)} parameters: {_list_some(lacking)}; fetch it again", "unfit")
    return codec.float().eval().requires_grad_(False)


def _refuse_revision(option: str, revision: str | None, local: Path) -> None:
    if revision is not None and local.exists():
        raise ArgumentError(f"{option}: '{revision}' is a revision of a hub repository, but {local} is on this machine")


def digest(*networks: torch.nn.Module) -> str:
    """Digest names, shapes and first numbers of all parameters in hex: training changes them all."""
    total = blake2b(digest_size=20)
    for network in networks:
        for name, value in network.state_dict().items():
            total.update(f"{name}{tuple(value.shape)}".encode())
            total.update(value.flatten()[:64].float().cpu().numpy().tobytes())
    return total.hexdigest()


def _state(path: Path) -> dict[str, Tensor]:
    """Return the averaged weights of a training checkpoint, or the tensors of a safetensors file."""
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except SafetensorError as error:
            raise WeightsError(f"{path} is damaged ({error}); fetch or write it again", "unfit") from error
    try:
        with torch.serialization.safe_globals([Namespace]):  # the trainer's options lie beside the weights
            checkpoint: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise WeightsError(
            f"{path}: not a checkpoint that can be read without running code from it ({_first_line(error)}); save its "
            "'ema' with safetensors.torch.save_file and use that file",
            "unfit",
        ) from error
    if not isinstance(checkpoint, dict) or not isinstance(checkpoint.get("ema"), dict):
        keys = sorted(map(str, checkpoint)) if isinstance(checkpoint, dict) else [type(checkpoint).__name__]
        raise WeightsError(f"{path}: expected a checkpoint with the key 'ema', found {_list_some(keys)}", "unfit")
    return {name: value.clone() for name, value in checkpoint["ema"].items()}  # apart from the file


def _difference(expected: dict[str, tuple[int, ...]], found: dict[str, tuple[int, ...]]) -> str:
    other = [f"{n} {found[n]} for {expected[n]}" for n in sorted(expected) if found.get(n, expected[n]) != expected[n]]
    missing, unknown = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    named = (("missing", missing), ("unknown", unknown), ("of another shape", other))
    return "; ".join(f"{len(names)} {kind}: {_list_some(names)}" for kind, names in named if names)


def _list_some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
