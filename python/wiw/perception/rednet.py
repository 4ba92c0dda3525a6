# SPDX-License-Identifier: Apache-2.0
"""RedNet as a source of semantics, with weights of the user's own: the published ones are CC BY-NC 4.0."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw.errors import ArgumentError, DependencyError, WeightsError
from wiw.networks import memory_guard, resolve_device
from wiw.perception.semantics import CATEGORIES, Semantics

FILE = "rednet_semmap_mp3d_tuned.pth"
CLASSES = len(CATEGORIES) - 1
"""The network's channel c is category c + 1; void has none."""
COLOUR_STATISTICS = ((0.493, 0.468, 0.438), (0.544, 0.521, 0.499))
DEPTH_STATISTICS = (0.213, 0.285)
"""Mean and standard deviation of the published weights' input, of colours and depth from 0 to 1."""
STRIDE = 32


class RedNet(Semantics):
    """Labels the six faces of a panorama's cube one by one.

    Args:
        weights: the checkpoint rednet_semmap_mp3d_tuned.pth or its folder: Matterport3D, 40 categories.
        device: of torch; the GPU if there is one.
        face: pixels of a face's side; 640 is the scale of the training images, 480 x 640 with HFOV 90.
        metres: depths that 0 and 1 of the network's input stand for, as of Habitat's depth sensor.
        batch: faces in one call of the network.

    Raises:
        DependencyError: torch is not installed.
        WeightsError: there is no such file ("missing"), or it is no such checkpoint ("unfit").
        ArgumentError: a face that is not a multiple of 32, no range of depths, a batch below 1, or no such device.
    """

    needs = ("depth",)

    def __init__(
        self,
        weights: str | Path,
        device: str | None = None,
        face: int = 640,
        metres: tuple[float, float] = (0.0, 10.0),
        batch: int = 6,
    ) -> None:
        if face < STRIDE or face % STRIDE:
            raise ArgumentError(f"face: expected a multiple of {STRIDE}, got {face}")
        if not 0 <= metres[0] < metres[1]:
            raise ArgumentError(f"metres: expected a range such as (0, 10), got {metres}")
        if batch < 1:
            raise ArgumentError(f"batch: expected at least 1, got {batch}")
        self.face, self.metres, self.batch = face, metres, batch
        path = Path(weights).expanduser()
        self.weights = path / FILE if path.is_dir() else path
        self._model, self.device = _load_network(self.weights, device)

    def describe(self) -> dict[str, Any]:
        """Return what the labels depend on, with a digest of the weights."""
        from wiw.weight_file import digest

        own = {"weights": digest(self._model.state_dict()), "face": self.face, "metres": list(self.metres)}
        return {**super().describe(), **own}

    def label_panoramas(
        self,
        images: NDArray[np.uint8],
        depth: NDArray[np.float32] | None = None,
        ids: NDArray[np.uint32] | None = None,
    ) -> NDArray[np.uint32]:
        """Return the likeliest category of each pixel, 1 to 40."""
        if depth is None or images.ndim != 4 or depth.shape != images.shape[:3]:
            raise ArgumentError(
                f"RedNet: expected panoramas [B, H, W, 3] and depth [B, H, W], got {images.shape} and "
                f"{None if depth is None else depth.shape}"
            )
        size = (images.shape[1], images.shape[2])
        found = np.empty((len(images), *size), np.uint32)
        for row, (image, distance) in enumerate(zip(images, depth, strict=True)):
            colours = panorama.to_cubemap(image, self.face)
            planar = panorama.distance_to_planar(panorama.to_cubemap(distance, self.face, "nearest"), 90.0)
            found[row] = panorama.from_cubemap(self.label_views(colours, planar), size, "nearest")
        return found

    def label_views(self, images: NDArray[np.uint8], depth: NDArray[np.float32]) -> NDArray[np.uint32]:
        """Label perspective views: uint8 [B, H, W, 3] and planar depth float32 [B, H, W] to uint32 [B, H, W].

        Raises:
            ArgumentError: arrays of other shapes, or sides that are not multiples of 32.
        """
        sides = images.shape[1:3]
        if images.ndim != 4 or depth.shape != images.shape[:3] or any(side % STRIDE for side in sides):
            raise ArgumentError(
                f"RedNet: expected views [B, H, W, 3] and depth [B, H, W] of multiples of {STRIDE} pixels, got "
                f"{images.shape} and {depth.shape}"
            )
        parts = [slice(first, first + self.batch) for first in range(0, len(images), self.batch)]
        with memory_guard("RedNet", "give a smaller batch or face"):
            return np.concatenate([self._predict_categories(images[part], depth[part]) for part in parts])

    def _predict_categories(self, images: NDArray[np.uint8], depth: NDArray[np.float32]) -> NDArray[np.uint32]:
        import torch

        nearest, farthest = self.metres
        with torch.inference_mode():
            colour = torch.from_numpy(np.ascontiguousarray(images)).to(self.device).permute(0, 3, 1, 2).float() / 255
            mean, std = (torch.tensor(values, device=self.device)[:, None, None] for values in COLOUR_STATISTICS)
            planar = torch.from_numpy(np.ascontiguousarray(depth)).to(self.device)[:, None].float()
            part = ((planar - nearest) / (farthest - nearest)).clamp(0, 1)
            scores = self._model((colour - mean) / std, (part - DEPTH_STATISTICS[0]) / DEPTH_STATISTICS[1])
            return np.asarray((scores.argmax(dim=1) + 1).cpu().numpy(), np.uint32)


def _load_network(path: Path, device: str | None) -> tuple[Any, str]:
    """Load the network with the weights of a file; return it with its device."""
    try:
        from wiw.perception.rednet_network import create_empty, infer_width
    except ImportError as error:
        raise DependencyError(f"{error.name or error} not installed; pip install 'wiw[torch]'") from error
    if not path.is_file():
        raise WeightsError(
            f"no file {path}; the pages of Semantic-MapNet and Habitat-Web link to {FILE} (CC BY-NC 4.0, research "
            "only). The simulator's semantics need no weights: wiw.perception.semantics.TrueSemantics"
        )
    state = _read_state(path)
    if "conv1.weight" not in state:
        raise WeightsError(f"{path}: not weights of RedNet: expected 'conv1.weight', got {sorted(state)[:5]}", "unfit")
    network = create_empty(CLASSES, infer_width(state))
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    differing = sorted(
        name
        for name in expected.keys() | state.keys()
        if name not in state or expected.get(name) != tuple(state[name].shape)
    )
    if differing:
        raise WeightsError(
            f"{path}: not weights of RedNet with {CLASSES} categories: {len(differing)} of {len(expected)} parameters "
            f"are missing, unknown or of another shape: {', '.join(differing[:5])}",
            "unfit",
        )
    network.load_state_dict(state, assign=True)
    where = resolve_device(device)
    return network.to(where).float().eval().requires_grad_(False), where


def _read_state(path: Path) -> dict[str, Any]:
    """Read the tensors of a checkpoint, by names without the prefix of parallel training."""
    import torch

    if path.suffix == ".safetensors":
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except (OSError, SafetensorError) as error:
            raise WeightsError(f"{path}: expected RedNet's weights (safetensors): {error}", "unfit") from error
    numbers = [(np.float64(0).__reduce__()[0], f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    allowed: list[Any] = [*numbers, np.dtype, type(np.dtype(np.float64))]  # best scores lie beside the weights
    try:
        with torch.serialization.safe_globals(allowed):
            checkpoint: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # of bytes that are no checkpoint, unpickling makes errors of any kind
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise WeightsError(
            f"{path}: not a checkpoint that can be read without running code from it ({first}); save its 'model_state' "
            "with safetensors.torch.save_file and use that file",
            "unfit",
        ) from error
    state = checkpoint.get("model_state") if isinstance(checkpoint, dict) else None
    if not isinstance(state, dict):
        raise WeightsError(f"{path}: expected a checkpoint with the key 'model_state'", "unfit")
    return {name.removeprefix("module."): value for name, value in state.items()}
