# SPDX-License-Identifier: Apache-2.0
"""The networks that a world model holds: which of them are still in training mode, and where they compute."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from wiw.isolation.child import Host
from wiw.isolation.models import IsolatedModel
from wiw.world_models.base import WorldModel
from wiw.world_models.remote.model import Remote

NESTED = 3
"""Objects inside each other that are looked into for networks."""


def find_training_networks(model: WorldModel) -> list[tuple[str, list[str]]]:
    """Return where a model holds networks in training mode, wherever it runs; see `training_networks`."""
    if not isinstance(model, IsolatedModel):
        return training_networks(model)
    return [(str(path), list(map(str, layers))) for path, layers in model.ask(_list_training_networks)]


def find_place_of_computation(model: WorldModel) -> str:
    """Return where a model computes, wherever it runs; see `place_of_computation`."""
    return str(model.ask(_find_place)) if isinstance(model, IsolatedModel) else place_of_computation(model)


def _list_training_networks(host: Host) -> list[tuple[str, list[str]]]:
    return training_networks(host.made.unwrapped)


def _find_place(host: Host) -> str:
    return place_of_computation(host.made.unwrapped)


def training_networks(model: WorldModel) -> list[tuple[str, list[str]]]:
    """Return where a model holds networks in training mode, and their layers that act otherwise in it.

    Only torch's networks in the model's attributes are found.
    """
    found = [(path, _training_layers(network)) for path, network in networks(model)]
    return [(path, layers) for path, layers in found if layers]


def place_of_computation(model: WorldModel) -> Literal["cpu", "gpu", "elsewhere"]:
    """Return where a model computes, as far as this process can know."""
    torch = sys.modules.get("torch")
    if isinstance(model, Remote) or "jax" in sys.modules or "tensorflow" in sys.modules:
        return "elsewhere"
    if torch is None:
        return "cpu"
    kinds = {value.device.type for _, network in networks(model) for value in network.parameters()}
    return "gpu" if kinds - {"cpu"} or torch.cuda.is_initialized() else "cpu"


def networks(model: WorldModel) -> Iterator[tuple[str, Any]]:
    """Yield the outermost torch networks of a model, with the names of the attributes that lead to them."""
    if torch := sys.modules.get("torch"):
        yield from _networks(model, type(model).__name__, torch.nn.Module, NESTED, set())


def _networks(value: Any, path: str, kind: type, nested: int, seen: set[int]) -> Iterator[tuple[str, Any]]:
    if id(value) in seen or isinstance(value, type):
        return
    seen.add(id(value))
    if isinstance(value, kind):
        yield path, value
    elif nested >= 0:
        for name, part in _parts(value):
            yield from _networks(part, f"{path}{name}", kind, nested - 1, seen)


def _parts(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        yield from ((f"[{name!r}]", part) for name, part in value.items())
    elif isinstance(value, list | tuple | set | frozenset):
        yield from ((f"[{place}]", part) for place, part in enumerate(value))
    elif hasattr(value, "__dict__"):
        yield from ((f".{name}", part) for name, part in list(vars(value).items()))


def _training_layers(network: Any) -> list[str]:
    """Return the kinds of a network's layers that draw at random or mix rows as they are now."""
    return sorted({type(layer).__name__ for layer in network.modules() if layer.training and _depends_on_mode(layer)})


def _depends_on_mode(layer: Any) -> bool:
    """Return whether a layer behaves differently in training mode."""
    from torch.nn.modules.batchnorm import _BatchNorm
    from torch.nn.modules.dropout import _DropoutNd

    if isinstance(layer, _DropoutNd):
        return layer.p > 0
    dropout = getattr(layer, "dropout", None)  # of attention and recurrent layers
    return isinstance(layer, _BatchNorm) or (isinstance(dropout, float) and dropout > 0)
