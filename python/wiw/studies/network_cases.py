# SPDX-License-Identifier: Apache-2.0
"""The small networks as they are measured: shipped weights, inputs of the right shapes, a rollout and a training step.

Inputs are random, for the time does not depend on them. A training step is the network in training mode, the mean
square of what it returns as the loss, its gradient, and a step of AdamW: what the real losses add is little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import torch
from torch import Tensor, nn

Inputs = tuple[Any, ...]


@dataclass(frozen=True)
class NetworkCase:
    """One network, and how it is called. All is made on torch's default device."""

    make: Callable[[], nn.Module]
    """With the shipped weights; with random ones where none are shipped."""
    draw: Callable[[nn.Module, int], Inputs]
    """Inputs of a batch."""
    call: Callable[..., Any]
    """One pass of network and inputs, as in training; returns tensors, alone or in tuples and dataclasses."""
    unit: str
    """One row of the batch."""
    roll_out: Callable[..., Any] | None = None
    """Work done when it is used, if that is more than one pass."""


def list_cases() -> dict[str, NetworkCase]:
    """Return the cases by the networks' names, as in `wiw train NAME`."""
    return {
        "warpnet": NetworkCase(_make_warpnet, _draw_warpnet, _call, "view"),
        "armnet": NetworkCase(_make_armnet, _draw_armnet, _call, "view"),
        "navigator": NetworkCase(_make_navigator, _draw_navigator, _call, "place"),
        "recogniser": NetworkCase(_make_recogniser, _draw_recogniser, _call, "glimpse"),
        "perception": NetworkCase(_make_labeller, _draw_labeller, _call, "view"),
        "pocket": NetworkCase(_make_pocket, _draw_pocket, _call, "plan", _sample_pocket),
        "diffuser": NetworkCase(_make_diffuser, _draw_diffuser, _denoise, "scene", _sample_diffuser),
    }


def compute_loss(case: NetworkCase, network: nn.Module, inputs: Inputs) -> Tensor:
    """Return the mean square of all floating-point tensors that one pass returns."""
    found = [value.float().square().mean() for value in _list_tensors(case.call(network, *inputs))]
    return torch.stack(found).mean()


def _list_tensors(value: Any) -> list[Tensor]:
    if isinstance(value, Tensor):
        return [value] if value.is_floating_point() else []
    if is_dataclass(value):
        return [each for field in fields(value) for each in _list_tensors(getattr(value, field.name))]
    return [each for part in value for each in _list_tensors(part)]


def _call(network: nn.Module, *inputs: Any) -> Any:
    return network(*inputs)


# -- warpnet -----------------------------------------------------------------------------------------------------------


def _make_warpnet() -> nn.Module:
    from wiw.world_models.warpnet.model import BUILT_IN
    from wiw.world_models.warpnet.weights import load

    return load(BUILT_IN)[0]


def _draw_warpnet(network: Any, batch: int) -> Inputs:
    return torch.rand(batch, 3, *network.size) * 2 - 1, torch.rand(batch) + 0.2


# -- armnet ------------------------------------------------------------------------------------------------------------


def _make_armnet() -> nn.Module:
    from wiw.world_models.armnet.model import BUILT_IN
    from wiw.world_models.armnet.weights import load

    return load(BUILT_IN)[0]


def _draw_armnet(network: Any, batch: int) -> Inputs:
    from wiw.world_models.armnet.network import SCALARS, WINDOW, Arm, Motion

    size = tuple(side.stop - side.start for side in WINDOW)
    mask = (torch.rand(batch, 1, *size) > 0.8).float()
    here, there = (torch.rand(batch, 3) * torch.tensor([size[1], size[0], 1.0]) for _ in range(2))
    motion = Motion(here, there, torch.rand(batch, SCALARS), there[:, :2])
    arm = Arm(torch.rand(batch, 3, *size), mask)
    return torch.rand(batch, 3, *size), arm, mask, motion, torch.rand(1, 3, *size)


# -- navigator ---------------------------------------------------------------------------------------------------------


def _make_navigator() -> nn.Module:
    from wiw.policies.navigator.policy import WEIGHTS
    from wiw.policies.navigator.weights import load

    return load(WEIGHTS)[0]


def _draw_navigator(network: Any, batch: int) -> Inputs:
    return torch.rand(batch, 4, 32, 128) * 2 - 1, torch.rand(1, 4, 32, 32) * 2 - 1


# -- recogniser --------------------------------------------------------------------------------------------------------


def _make_recogniser() -> nn.Module:
    from wiw.perception.recogniser import Recogniser
    from wiw.policies.recogniser.policy import SHIPPED

    return Recogniser.load(SHIPPED["pictures"]).network


def _draw_recogniser(network: Any, batch: int) -> Inputs:
    from wiw.perception.glimpses import SCALARS, SIDE
    from wiw.perception.recognition_network import CHANNELS

    owners = torch.zeros(batch, dtype=torch.int64)
    return torch.rand(batch, CHANNELS, SIDE, SIDE), torch.rand(batch, SCALARS) * 0.1 + 0.1, owners, 1


# -- perception --------------------------------------------------------------------------------------------------------


def _make_labeller() -> nn.Module:
    from wiw.perception.labeller_weights import load
    from wiw.perception.learned_labeller import WEIGHTS

    return load(WEIGHTS)[0]


def _draw_labeller(network: Any, batch: int) -> Inputs:
    from wiw.perception.labelling_network import CHANNELS, InputSize

    size = InputSize.of((480, 480), 105.0)
    return (torch.rand(batch, CHANNELS, size.height, size.width),)


# -- pocket ------------------------------------------------------------------------------------------------------------

PLACES = 4
"""Places of a plan."""


def _make_pocket() -> nn.Module:
    from wiw.world_models.pocket.model import BUILT_IN
    from wiw.world_models.pocket.weights import load

    return load(BUILT_IN)[0]


def _draw_pocket(network: Any, batch: int) -> Inputs:
    from wiw.world_models.pocket.network import Views

    views = Views.around(torch.rand(batch, 3, *network.size) * 2 - 1, torch.rand(batch, PLACES, 2) + 0.2)
    return torch.randn(batch, PLACES, 3, *network.size), torch.rand(batch), views.sweep, views.places


def _sample_pocket(network: Any, noisy: Tensor, levels: Tensor, sweep: Tensor, places: Tensor) -> Any:
    from wiw.world_models.pocket.model import STEPS
    from wiw.world_models.pocket.network import Views
    from wiw.world_models.pocket.sampler import sample_views

    return sample_views(network, Views(noisy[:, 0], places, sweep), noisy, STEPS)


# -- diffuser ----------------------------------------------------------------------------------------------------------

PATHS, STEPS = 16, 20
"""Paths of a scene that are denoised at once, and passes for each."""


def _make_diffuser() -> nn.Module:
    from wiw.policies.diffuser.policy import BUILT_IN
    from wiw.policies.diffuser.weights import load

    return load(BUILT_IN)[0]


def _draw_diffuser(network: Any, batch: int) -> Inputs:
    from wiw.policies.diffuser.workspace import CELL

    cells, pixels = (16, 16), (16 * CELL, 16 * CELL)
    image = torch.randint(0, 256, (batch, *pixels, 3), dtype=torch.uint8)
    scene = image, torch.rand(batch, *pixels) * 0.1, torch.rand(batch, *cells, 3), torch.rand(batch, 10)
    return *scene, torch.randn(batch, PATHS, network.shape.poses, 9), torch.randint(0, 100, (batch, PATHS))


def _encode_scene(network: Any, image: Tensor, height: Tensor, places: Tensor, now: Tensor) -> Any:
    from wiw.policies.diffuser.network import Views

    cameras = 2 if network.shape.wrist else 1
    return network.encode_scene([Views(image, height, places)] * cameras, now)


def _denoise(network: Any, *inputs: Any) -> Any:
    *scene, noised, level = inputs
    return network.denoise(_encode_scene(network, *scene), noised, level)


def _sample_diffuser(network: Any, *inputs: Any) -> Any:
    *scene, noised, level = inputs
    encoded = _encode_scene(network, *scene)
    for _ in range(STEPS):
        noised, _ = network.denoise(encoded, noised, level)
    return noised
