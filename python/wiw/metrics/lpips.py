# SPDX-License-Identifier: Apache-2.0
"""LPIPS, the perceptual distance of Zhang et al. 2018, version 0.1 on AlexNet's features.

Two published files make it what papers call LPIPS; they are identified by their SHA-256. Without them there is no
value: there is no substitute. Of the larger one, AlexNet, only the convolutions are used; a file of these alone, with
the same values, serves as well.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.errors import ArgumentError, DependencyError, WeightsError

AT_ONCE = 32
"""Pairs that go through the network together."""
LEAST = 32
"""Pixels of an image's shorter side that leave something of it after three poolings."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Normalisation of the network's input by channel, from images in [-1, 1]."""
STAGES = (("0", 4, 2, False), ("3", 1, 2, True), ("6", 1, 1, True), ("8", 1, 1, False), ("10", 1, 1, False))
"""Number of a convolution among AlexNet's `features`, its stride and padding, and whether a pooling leads to it."""


@dataclass(frozen=True)
class Weights:
    """A published file."""

    url: str
    sha256: str
    """Or its beginning, as torch.hub writes it into names."""
    size: str

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.url.rpartition("/")[2]


BACKBONE = Weights("https://download.pytorch.org/models/alexnet-owt-7be5be79.pth", "7be5be79", "233 MB")
HEADS = Weights(
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/alex.pth",
    "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    "6 kB",
)
"""Also in the `lpips` package, as `lpips/weights/v0.1/alex.pth`."""
CONVOLUTIONS = "alexnet-owt-7be5be79-convolutions.safetensors"
"""Name of a file that may take the backbone's place: its tensors `features.*` alone (10 MB; docs/quality.md)."""
CONVOLUTIONS_SHA256 = "276812cc7430109e87ad2847e4409809bf867956c8a5e9621ae88a1bfcb08e76"
"""SHA-256 of their values: float32, little-endian, one tensor after the other in the order of their names."""


def default_folder() -> Path:
    """Return the folder of the weights: `$WIW_CACHE/weights`, or `~/.cache/wiw/weights`."""
    root = os.environ.get("WIW_CACHE")
    return (Path(root).expanduser() if root else Path.home() / ".cache/wiw") / "weights"


class Lpips:
    """Distance between images in AlexNet's features, calibrated on human judgements: 0 for equal ones, no unit.

    Made for perspective images: it is not defined on a sphere, so take views of a panorama.

    Args:
        folder: with both files of weights; "auto" is `default_folder()`.
        device: torch device; "auto" is the GPU if there is one.

    Raises:
        WeightsError: a file is missing ("missing"; says where to get both), or differs from the published one
            ("unfit").
        DependencyError: torch is not installed.
    """

    def __init__(self, folder: str | Path = "auto", device: str = "auto") -> None:
        self.folder = default_folder() if str(folder) == "auto" else Path(folder).expanduser()
        self._where, self._weights = _read(self.folder, device)

    def __call__(self, a: ArrayLike, b: ArrayLike) -> float | NDArray[np.float64]:
        """Return the distances between two sets of uint8 images [..., H, W, 3]: a float, or float64 [...] for batches.

        Raises:
            ArgumentError: another type or shape, or images that are too small.
        """
        first, second = np.asarray(a), np.asarray(b)
        if first.shape != second.shape or any(x.dtype != np.uint8 or x.shape[-1:] != (3,) for x in (first, second)):
            raise ArgumentError(
                "LPIPS: expected two uint8 images [..., H, W, 3] of one shape, got "
                f"{first.dtype} {first.shape} and {second.dtype} {second.shape}"
            )
        if first.ndim < 3 or min(first.shape[-3:-1]) < LEAST:
            raise ArgumentError(f"LPIPS: expected images of at least {LEAST} pixels a side, got {first.shape}")
        left, right = (images.reshape(-1, *images.shape[-3:]) for images in (first, second))
        values = np.empty(len(left))
        for begin in range(0, len(left), AT_ONCE):
            part = slice(begin, begin + AT_ONCE)
            values[part] = self._distances(left[part], right[part])
        return values.reshape(first.shape[:-3]) if first.ndim > 3 else float(values[0])

    def __reduce__(self) -> Any:
        return Lpips, (self.folder, self._where)

    def _distances(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float64]:
        import torch

        with torch.inference_mode():
            images = torch.from_numpy(np.concatenate([left, right])).to(self._where).permute(0, 3, 1, 2).float()
            shift, scale = (torch.tensor(values, device=self._where)[:, None, None] for values in (SHIFT, SCALE))
            total = torch.zeros(len(left), device=self._where)
            for stage, features in enumerate(_features((images / 127.5 - 1 - shift) / scale, self._weights)):
                unit = features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)
                apart = (unit[: len(left)] - unit[len(left) :]).square()
                total += (apart * self._weights[f"lin{stage}.model.1.weight"]).sum(1).mean((1, 2))
            return np.asarray(total.double().cpu().numpy())


def _features(x: Any, weights: Mapping[str, Any]) -> Iterator[Any]:
    """Return the outputs of AlexNet's five convolutions, each after its ReLU."""
    from torch.nn import functional

    for number, stride, padding, pooled in STAGES:
        if pooled:
            x = functional.max_pool2d(x, 3, 2)
        kernel, bias = (weights[f"features.{number}.{part}"] for part in ("weight", "bias"))
        x = functional.conv2d(x, kernel, bias, stride, padding).relu()
        yield x


@cache
def _read(folder: Path, device: str) -> tuple[str, dict[str, Any]]:
    """Return the device and both files' tensors on it, without AlexNet's classifier."""
    alone = folder / CONVOLUTIONS
    files = [HEADS] if alone.is_file() else [BACKBONE, HEADS]
    absent = [file.name for file in files if not (folder / file.name).is_file()]
    if absent:
        raise WeightsError(
            f"LPIPS: {' and '.join(absent)} not found in {folder}. It needs two published files there, {BACKBONE.name} "
            f"({BACKBONE.size}) and {HEADS.name} ({HEADS.size}, also in the lpips package as "
            f"lpips/weights/v0.1/{HEADS.name}):\n  curl -L --create-dirs --output-dir {folder} -O {BACKBONE.url} -O "
            f"{HEADS.url}\nWhere only Python packages can be fetched, see docs/quality.md"
        )
    for file in files:
        _require_published(folder / file.name, file)
    try:
        import torch
    except ModuleNotFoundError:
        raise DependencyError("LPIPS needs torch, which is not installed: pip install 'wiw[torch]'") from None

    where = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    weights = _read_convolutions(alone) if BACKBONE not in files else {}
    for file in files:
        weights |= torch.load(folder / file.name, map_location="cpu", weights_only=True)
    return where, {name: value.to(where) for name, value in weights.items() if not name.startswith("classifier")}


def _read_convolutions(path: Path) -> dict[str, Any]:
    """Return the tensors of a file of AlexNet's convolutions alone, whose values must be the published ones."""
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    names = sorted(f"features.{number}.{part}" for number, *_ in STAGES for part in ("weight", "bias"))
    try:
        weights = load_file(path)
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a safetensors file: {error}", "unfit") from None
    state = hashlib.sha256()
    if sorted(weights) == names and all(weights[name].dtype == torch.float32 for name in names):
        for name in names:
            state.update(weights[name].contiguous().numpy().astype("<f4").tobytes())
    if state.hexdigest() != CONVOLUTIONS_SHA256:
        raise WeightsError(
            f"{path}: expected the convolutions of the published {BACKBONE.name} as float32 ({', '.join(names)}), got "
            f"other tensors or values; with other weights the distance would not be LPIPS. Delete it, and fetch "
            f"{BACKBONE.url} in its place",
            "unfit",
        )
    return dict(weights)


def _require_published(path: Path, file: Weights) -> None:
    state = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            state.update(block)
    digest = state.hexdigest()
    if not digest.startswith(file.sha256):
        raise WeightsError(
            f"{path}: expected the published file, of SHA-256 {file.sha256[:8]}..., got {digest[:8]}...; with other "
            f"weights the distance would not be LPIPS. Fetch it again: {file.url}",
            "unfit",
        )
