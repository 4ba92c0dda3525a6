# SPDX-License-Identifier: Apache-2.0
"""Where networks run, and what to do where the weights of those that others have trained cannot be had."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from wiw.errors import ArgumentError, DeviceMemoryError, WeightsError

UNREACHABLE = {"ConnectionError", "TransportError"}
"""Names of the errors of a network in `requests` and `httpx`, of which the hub's client has had either."""


def device(name: str | None) -> str:
    """The device asked for; "cuda" where there is one if none is.

    Raises:
        ArgumentError: torch does not know it, or has none.
    """
    import torch

    if name is None:
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        asked = torch.device(name)
    except RuntimeError as error:
        raise ArgumentError(f"device: expected one of torch, such as cpu, cuda or cuda:1, got '{name}'") from error
    if asked.type == "cuda" and not 0 <= (asked.index or 0) < torch.cuda.device_count():
        raise ArgumentError(
            f"device: torch sees {torch.cuda.device_count()} CUDA devices, so there is no '{name}'; check the driver "
            f"(nvidia-smi) and that torch {torch.__version__} is a CUDA build, or use device='cpu'"
        )
    return name


FULL = ("out of memory", "ALLOC_FAILED")
"""What CUDA and its libraries say of a full GPU where they take memory themselves, past torch's allocator."""


@contextmanager
def memory_guard(what: str, cures: str) -> Iterator[None]:
    """Turns the errors of a full GPU into one that says what needs less.

    Raises:
        DeviceMemoryError: there is no memory left.
    """
    import torch

    try:
        yield
    except RuntimeError as error:
        if not isinstance(error, torch.OutOfMemoryError) and not any(said in str(error) for said in FULL):
            raise
        torch.cuda.empty_cache()
        raise DeviceMemoryError(f"{what} does not fit on the device ({str(error).splitlines()[0]}); {cures}") from error


def is_path(name: str) -> bool:
    """Whether a name is a path and not a hub repository, OWNER/NAME."""
    return name.startswith(("/", ".", "~")) or name.count("/") != 1


def explained(error: BaseException, name: str, revision: str | None) -> WeightsError:
    """What an error of the hub's client means for the user."""
    from huggingface_hub import errors

    chain = list(_chain(error))

    def met(*kinds: type[BaseException]) -> bool:
        return any(isinstance(link, kinds) for link in chain)

    by_hand = f"or download it elsewhere (hf download {name} --local-dir FOLDER) and give weights=FOLDER"
    if met(errors.GatedRepoError):
        text = f"'{name}' is gated: accept its terms at https://huggingface.co/{name}, then `hf auth login`"
        return WeightsError(text, "gated")
    if met(errors.RevisionNotFoundError):
        text = f"'{name}' has no revision '{revision}'; https://huggingface.co/{name}/commits/main lists its commits"
        return WeightsError(text, "revision")
    if met(errors.RepositoryNotFoundError):
        text = (
            f"the hub has no repository '{name}', or it is private: check the name, or `hf auth login`; "
            "weights= also takes a folder"
        )
        return WeightsError(text, "missing")
    unreachable = any(kind.__name__ in UNREACHABLE for link in chain for kind in type(link).__mro__)
    if unreachable or met(errors.OfflineModeIsEnabled, errors.LocalEntryNotFoundError):
        text = f"'{name}' is not on this machine and the hub is out of reach: connect (unset HF_HUB_OFFLINE), {by_hand}"
        return WeightsError(text, "network")
    return WeightsError(f"'{name}' cannot be downloaded: {error}; try again, {by_hand}")


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error and what it was raised from or while handling, the last one first."""
    seen: set[int] = set()
    pending = [error]
    while pending:
        link = pending.pop()
        if link is not None and id(link) not in seen:
            seen.add(id(link))
            yield link
            pending += [link.__context__, link.__cause__]


@contextmanager
def one_thread() -> Iterator[None]:
    """Of torch: faster for small networks, above all on a busy machine, and rounds alike on any number of cores."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
