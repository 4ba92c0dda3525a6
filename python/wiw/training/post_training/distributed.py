# SPDX-License-Identifier: Apache-2.0
"""One training on several processes, as torchrun starts them; in a single process all of this does nothing.

Each process takes its share of the passes of a step, and gradients are added up, so that a training on several
processes is that of one, but for rounding. The first process alone writes. With shards (FSDP2), each process keeps
its part of weights, gradients and moments, and a layer's weights are put together while it computes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn

from wiw.errors import ArgumentError
from wiw.training.launcher import count_started

PATIENCE = timedelta(hours=1)
"""How long a process waits for the others, such as for the first one to write the state."""

T = TypeVar("T")


@contextmanager
def join_processes() -> Iterator[None]:
    """Join the processes that torchrun has started, as its environment variables say, as long as the context lasts."""
    if count_started() == 1 or distributed.is_initialized():
        yield
        return
    if _find_local_rank() < torch.cuda.device_count():
        torch.cuda.set_device(_find_local_rank())
    distributed.init_process_group(timeout=PATIENCE)  # gloo for tensors in main memory, NCCL for those on GPUs
    yield
    distributed.destroy_process_group()  # not after an error, when it would wait for processes that are gone


def require_own_gpu(device: str) -> None:
    """Check that several processes on GPUs have one each.

    Raises:
        ArgumentError: there are fewer GPUs than processes on this machine, or one of them is named.
    """
    if count_processes() == 1 or not device.startswith("cuda"):
        return
    if device != "cuda":
        raise ArgumentError(f"device: expected cuda, as each process takes its own GPU, got {device}")
    if _find_local_rank() >= torch.cuda.device_count():
        raise ArgumentError(f"expected a GPU for each process, got {torch.cuda.device_count()} GPUs here; lower --gpus")


def _find_local_rank() -> int:
    return int(os.environ.get("LOCAL_RANK", "0"))


def count_processes() -> int:
    """Return the number of processes of this training."""
    return distributed.get_world_size() if _is_in_group() else 1


def is_main() -> bool:
    """Return whether this is the first process, which writes and reports."""
    return not _is_in_group() or distributed.get_rank() == 0


def select_share(items: Sequence[T]) -> Sequence[T]:
    """Return this process's share of items."""
    return items[distributed.get_rank() :: distributed.get_world_size()] if _is_in_group() else items


def call_on_main(function: Callable[[], T]) -> T:
    """Return what a call in the first process returns, in all of them; an error there is raised in all of them."""
    if not _is_in_group():
        return function()
    outcome: list[Any] = [None, None]
    if is_main():
        try:
            outcome[0] = function()
        except Exception as error:
            outcome[1] = error
    distributed.broadcast_object_list(outcome, src=0)
    if outcome[1] is not None:
        raise outcome[1]
    return outcome[0]


def collect(item: T) -> list[T]:
    """Return the item of each process, in their order."""
    if not _is_in_group():
        return [item]
    found: list[Any] = [None] * count_processes()
    distributed.all_gather_object(found, item)
    return found


def sum_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Add up the gradients of all processes; those of sharded parameters are added up as they are computed."""
    if not _is_in_group():
        return
    whole = [value.grad for value in parameters if value.grad is not None and not _is_sharded(value)]
    for work in [distributed.all_reduce(each, async_op=True) for each in whole]:
        work.wait()


def shard_modules(modules: Sequence[nn.Module], device: torch.device) -> None:
    """Spread the parameters of modules over all processes, parts before the whole, each module's as one group."""
    if not _is_in_group():
        return
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import fully_shard

    mesh = init_device_mesh(device.type, (count_processes(),))
    for module in modules:
        name = type(module).__name__
        fully_shard(module, mesh=mesh, reshard_after_forward=True)
        type(module).__name__ = name  # diffusers writes it into config.json
    sharded: Any = modules
    for module in sharded:  # makes FSDP's buffers outside of inference mode, in which a validation would make them
        module.unshard()
        module.reshard()


def is_sharded(module: nn.Module) -> bool:
    """Return whether a module's parameters are spread over processes."""
    return any(map(_is_sharded, module.parameters()))


@contextmanager
def gather_state_dicts(modules: Iterable[nn.Module]) -> Iterator[None]:
    """Have the trained parameters of sharded modules whole in their `state_dict` in the first process, for a while."""
    whole: dict[nn.Parameter, Tensor] = {}
    hooks = []
    for module in filter(is_sharded, modules):
        own = {name: value for name, value in module.named_parameters() if value.requires_grad}
        whole |= {value: gather_tensor(value) for value in own.values() if value not in whole}
        found = {name: whole[value] for name, value in own.items()}
        hooks.append(module.register_state_dict_post_hook(partial(_replace_tensors, found)))
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def _replace_tensors(
    found: Mapping[str, Tensor], module: nn.Module, state: dict[str, Any], prefix: str, metadata: Any
) -> None:
    state.update({f"{prefix}{name}": value for name, value in found.items()})


def gather_tensor(value: Tensor) -> Tensor:
    """Return a tensor, put together if it is sharded, in the first process's main memory; in others an empty one."""
    whole = join_tensor(value.detach())
    return whole.cpu() if is_main() else torch.empty(0)


def shard_like(value: Tensor, like: Tensor) -> Tensor:
    """Return this process's part of a whole tensor, if one of the same shape that it belongs to is sharded."""
    if not _is_sharded(like) or value.shape != like.shape:
        return value
    from torch.distributed.tensor import distribute_tensor

    mesh, placements = like.device_mesh, like.placements  # type: ignore[attr-defined]
    return distribute_tensor(value.to(like.device), mesh, placements)


def join_tensor(value: Tensor) -> Tensor:
    """Return a sharded tensor as a whole one, in every process; any other as it is."""
    return value.full_tensor() if _is_sharded(value) else value  # type: ignore[attr-defined]


def _is_in_group() -> bool:
    return distributed.is_available() and distributed.is_initialized()


def _is_sharded(value: Tensor) -> bool:
    if not _is_in_group():
        return False
    from torch.distributed.tensor import DTensor

    return isinstance(value, DTensor)
