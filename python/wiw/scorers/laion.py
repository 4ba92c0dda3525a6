# SPDX-License-Identifier: Apache-2.0
"""LAION's improved aesthetic predictor: a small network on the image embeddings of CLIP ViT-L/14.

Source: github.com/christophschuhmann/improved-aesthetic-predictor (Apache-2.0), on openai/clip-vit-large-patch14 (MIT).
Neither is downloaded by this package: the head is where the user put it, and CLIP there too or in the hub's cache.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from wiw.errors import WeightsError
from wiw.metrics.lpips import default_folder
from wiw.perception import pretrained
from wiw.scorers.scorer import ScorerCard, read_png

HEAD = "sac+logos+ava1-l14-linearMSE.pth"
"""The published file, 3.7 MB."""
HEAD_URL = (
    "https://github.com/christophschuhmann/improved-aesthetic-predictor/raw/main/sac%2Blogos%2Bava1-l14-linearMSE.pth"
)
CLIP = "clip-vit-large-patch14"
"""Folder of CLIP beside the head; without it, the repository of this name on the Hugging Face hub."""
LAYERS = {
    "layers.0": (1024, 768),
    "layers.2": (128, 1024),
    "layers.4": (64, 128),
    "layers.6": (16, 64),
    "layers.7": (1, 16),
}
"""Weights of the head: affine maps without anything between them but the dropout of training."""
AT_ONCE = 16
"""Images that go through the network together."""


class LaionScorer:
    """Score images as LAION's predictor does, about 1 (worst) to 10 (best).

    Args:
        folder: holds the head's file, and CLIP in a folder of its own; "auto" is the folder of all weights,
            `~/.cache/wiw/weights`.
        device: of torch; "auto" is the GPU if there is one.

    Raises:
        WeightsError: weights do not exist (says where to get them) or belong to another network.
        DependencyError: torch or transformers is not installed.
    """

    def __init__(self, folder: str | Path = "auto", device: str = "auto") -> None:
        where = default_folder() if str(folder) == "auto" else Path(folder).expanduser()
        head = _require_head(where / HEAD)
        pretrained.import_transformers()
        import torch

        from wiw.weight_file import digest

        self._device = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
        self._head = {name: value.to(self._device) for name, value in _read_head(head).items()}
        clip = str(where / CLIP) if (where / CLIP).is_dir() else f"openai/{CLIP}"
        kinds = ("clip", "clip_vision_model")
        self._clip = pretrained.load_network("CLIPVisionModelWithProjection", kinds, clip, None, self._device)
        self._prepare = pretrained.load_image_processor("CLIP", clip, None)
        wide = self._clip.config.projection_dim
        if wide != LAYERS["layers.0"][1]:
            raise WeightsError(
                f"{clip}: expected embeddings of 768 numbers, as CLIP ViT-L/14 gives, got {wide}; put {CLIP} there",
                "unfit",
            )
        networks = {"head": self._head, "clip": self._clip.state_dict()}
        values = {f"{part}/{name}": value for part, own in networks.items() for name, value in own.items()}
        self._digest = digest(values)[:12]

    @property
    def card(self) -> ScorerCard:
        """Its identity; the version is a digest of the weights of head and CLIP."""
        licence = "Apache-2.0 (head), MIT (CLIP)"
        return ScorerCard("laion-improved-aesthetic", self._digest, licence, {"laion_aesthetic": None})

    def score(self, paths: Sequence[Path]) -> Iterator[tuple[Path, dict[str, float]]]:
        """Yield the score of each PNG file, in their order."""
        for begin in range(0, len(paths), AT_ONCE):
            part = paths[begin : begin + AT_ONCE]
            for path, value in zip(part, self._rate([read_png(path) for path in part]), strict=True):
                yield path, {"laion_aesthetic": value}

    def _rate(self, images: Sequence[Any]) -> list[float]:
        import torch

        with torch.inference_mode():
            pixels = self._prepare(images=list(images), return_tensors="pt")["pixel_values"].to(self._device)
            x = self._clip(pixel_values=pixels).image_embeds
            x = x / x.norm(dim=-1, keepdim=True)
            for name in LAYERS:
                x = torch.nn.functional.linear(x, self._head[f"{name}.weight"], self._head[f"{name}.bias"])
            return [float(value) for value in x[:, 0].double().cpu()]

    def __enter__(self) -> LaionScorer:
        return self

    def __exit__(self, *exception: object) -> None:
        """Close nothing."""


def _require_head(path: Path) -> Path:
    if not path.is_file():
        raise WeightsError(
            f"LAION's aesthetic predictor: no {HEAD} in {path.parent}. Download the published file (3.7 MB) with:\n  "
            f"curl -L --create-dirs -o '{path}' '{HEAD_URL}'\nCLIP ViT-L/14 comes from the folder "
            f"{path.parent / CLIP}, or from openai/{CLIP} on the Hugging Face hub"
        )
    return path


def _read_head(path: Path) -> dict[str, Any]:
    """Return the tensors of the head, checked against the published architecture."""
    import torch

    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
        shapes = {name: tuple(value.shape) for name, value in found.items()}
    except Exception as error:
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise WeightsError(f"{path}: {first}; fetch it again: {HEAD_URL}", "unfit") from error
    wanted: dict[str, tuple[int, ...]] = {f"{name}.weight": shape for name, shape in LAYERS.items()}
    wanted |= {f"{name}.bias": shape[:1] for name, shape in LAYERS.items()}
    if shapes != wanted:
        differing = sorted(name for name in shapes.keys() | wanted.keys() if shapes.get(name) != wanted.get(name))
        raise WeightsError(
            f"{path}: expected LAION's five layers, but {', '.join(differing[:3])} differs; fetch it again: {HEAD_URL}",
            "unfit",
        )
    return {name: value.float() for name, value in found.items()}
