# SPDX-License-Identifier: Apache-2.0
"""Devices for networks, and clear errors when pretrained weights cannot be downloaded."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from wiw.errors import ArgumentError, DeviceMemoryError, WeightsError

if TYPE_CHECKING:
    import torch

NETWORK_ERRORS = {"ConnectionError", "TransportError"}
"""Names of network errors in `requests` and `httpx`; the hub's client has used either."""


def resolve_device(name: str | None) -> str:
    """Return the requested device; "cuda" if available where none is requested.

    Raises:
        ArgumentError: torch does not know it, or the machine lacks it.
    """
    import torch

    if name is None:
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        asked = torch.device(name)
    except RuntimeError as error:
        raise ArgumentError(f"device: expected a torch device, such as cpu, cuda or cuda:1, got '{name}'") from error
    if asked.type == "cuda" and not 0 <= (asked.index or 0) < torch.cuda.device_count():
        raise ArgumentError(
            f"device: torch sees {torch.cuda.device_count()} CUDA devices, so there is no '{name}'; check the driver "
            f"(nvidia-smi) and that torch {torch.__version__} is a CUDA build, or use device='cpu'"
        )
    try:
        if asked.type not in ("cpu", "cuda"):  # other back ends are asked: torch.device knows their names everywhere
            torch.empty(1, device=asked)
    except (RuntimeError, AssertionError, ImportError) as error:
        raise ArgumentError(
            f"device: torch {torch.__version__} cannot use '{name}' on this machine; leave the device out, or use "
            "device='cpu'"
        ) from error
    return name


def describe_device(device: str) -> str:
    """Return the name of a device's hardware where that matters: of a GPU."""
    import torch

    return torch.cuda.get_device_name(device) if device.startswith("cuda") else device


def has_bfloat16() -> bool:
    """Return whether the CPU has instructions for products in bfloat16; without them, float32 is faster."""
    import torch

    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def autocast_bfloat16(device: str, wanted: bool) -> torch.autocast:
    """Return a context that computes products in bfloat16 if `wanted`, on a CPU only where that is faster."""
    import torch

    kind = torch.device(device).type
    return torch.autocast(kind, torch.bfloat16, enabled=wanted and (kind != "cpu" or has_bfloat16()))


def autocast_uncached(device: torch.device, wanted: bool) -> torch.autocast:
    """Return a context that computes products in bfloat16 if `wanted`, and keeps no copies of weights in bfloat16.

    Copies of all weights would last until the end of a pass, also those that sharding (FSDP2) frees after their use.
    """
    import torch

    return torch.autocast(device.type, torch.bfloat16, enabled=wanted, cache_enabled=False)


OUT_OF_MEMORY_WORDS = ("out of memory", "ALLOC_FAILED", "can't allocate memory")
"""Error texts of CUDA and its libraries where they allocate memory past torch's allocator, and of main memory."""


@contextmanager
def memory_guard(what: str, cures: str) -> Iterator[None]:
    """Turn out-of-memory errors into one that says how to use less memory; of nested guards, the outermost says it.

    Raises:
        DeviceMemoryError: the memory is exhausted.
    """
    import torch

    try:
        yield
    except (RuntimeError, MemoryError, DeviceMemoryError) as error:
        if not is_out_of_memory(error):
            raise
        torch.cuda.empty_cache()
        cause = (error.__cause__ or error) if isinstance(error, DeviceMemoryError) else error
        said = (str(cause).splitlines() or ["out of memory"])[0]
        raise DeviceMemoryError(f"{what} does not fit into the device's memory ({said}); {cures}") from cause


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error says that the memory of a device, or the main memory, is exhausted."""
    import torch

    full = isinstance(error, torch.OutOfMemoryError | MemoryError | DeviceMemoryError)
    return full or (isinstance(error, RuntimeError) and any(said in str(error) for said in OUT_OF_MEMORY_WORDS))


def in_hub_cache(repository: str) -> bool:
    """Return whether some state of a repository lies in the Hugging Face cache."""
    snapshots = hub_cache() / f"models--{repository.replace('/', '--')}" / "snapshots"
    return any(snapshots.glob("*/*"))


def hub_cache() -> Path:
    """Return the folder where the hub's client keeps what it has downloaded."""
    home = os.environ.get("HF_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "huggingface"
    return Path(os.environ.get("HF_HUB_CACHE") or Path(home) / "hub").expanduser()


def is_path(name: str) -> bool:
    """Return whether a name is a path rather than a hub repository, OWNER/NAME."""
    return name.startswith(("/", ".", "~")) or name.count("/") != 1


def explain_hub_error(error: BaseException, name: str, revision: str | None) -> WeightsError:
    """Return a `WeightsError` that explains an error of the hub's client to the user."""
    from huggingface_hub import errors

    chain = list(_walk_causes(error))

    def is_caused_by(*kinds: type[BaseException]) -> bool:
        return any(isinstance(link, kinds) for link in chain)

    by_hand = f"or download it elsewhere (hf download {name} --local-dir FOLDER) and give weights=FOLDER"
    if is_caused_by(errors.GatedRepoError):
        text = f"'{name}' is gated: accept its terms at https://huggingface.co/{name}, then `hf auth login`"
        return WeightsError(text, "gated")
    if is_caused_by(errors.RevisionNotFoundError):
        text = f"'{name}' has no revision '{revision}'; https://huggingface.co/{name}/commits/main lists its commits"
        return WeightsError(text, "revision")
    if is_caused_by(errors.RepositoryNotFoundError):
        text = (
            f"the hub has no repository '{name}', or it is private: check the name, or log in with `hf auth login`; "
            "weights= also accepts a folder"
        )
        return WeightsError(text, "missing")
    unreachable = any(kind.__name__ in NETWORK_ERRORS for link in chain for kind in type(link).__mro__)
    if unreachable or is_caused_by(errors.OfflineModeIsEnabled, errors.LocalEntryNotFoundError):
        text = (
            f"'{name}' is not on this machine and the hub cannot be reached: connect (unset HF_HUB_OFFLINE), {by_hand}"
        )
        return WeightsError(text, "network")
    return WeightsError(f"'{name}' cannot be downloaded: {error}; try again, {by_hand}")


def _walk_causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and those it was raised from or while handling, the last one first."""
    seen: set[int] = set()
    pending = [error]
    while pending:
        link = pending.pop()
        if link is not None and id(link) not in seen:
            seen.add(id(link))
            yield link
            pending += [link.__context__, link.__cause__]


@contextmanager
def single_thread() -> Iterator[None]:
    """Run torch on one thread: faster for small networks, above all on a busy machine, and rounding alike on any number
    of cores.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
