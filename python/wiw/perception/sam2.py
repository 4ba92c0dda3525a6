# SPDX-License-Identifier: Apache-2.0
"""SAM 2 as a tracker (Ravi et al. 2024; the paper's choice), through the classes of `transformers`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.networks import resolve_device
from wiw.perception import pretrained
from wiw.perception.boxes import Mask, find_box
from wiw.perception.frame_tracking import FrameTracker
from wiw.types import Box

WEIGHTS = "facebook/sam2.1-hiera-tiny"
"""Repository on the hub."""


class Sam2(FrameTracker):
    """Segments the target in the imagined frames, treated as a video that begins with a real view.

    Args:
        weights: a folder or hub name that `transformers.Sam2VideoModel.from_pretrained` takes, or such a model.
        prompt: how the target is marked in the first view: by its "box", as in the paper, or its "mask".
        device: of torch; the GPU if there is one.
        revision: of the hub's repository.

    Raises:
        ArgumentError: an unknown prompt, or there is no such device.
        DependencyError: torch or transformers is not installed.
        WeightsError: the weights cannot be loaded or belong to another network; its `kind` says why.
    """

    def __init__(
        self,
        weights: Any = WEIGHTS,
        prompt: Literal["box", "mask"] = "box",
        device: str | None = None,
        revision: str | None = None,
    ) -> None:
        if prompt not in ("box", "mask"):
            raise ArgumentError(f"Sam2: prompt: expected 'box' or 'mask', got {prompt!r}")
        pretrained.import_transformers()
        self.prompt, self.device = prompt, resolve_device(device)
        if isinstance(weights, str | Path):
            weights = pretrained.load_network("Sam2VideoModel", ("sam2_video",), weights, revision, self.device)
        self._model = weights.to(self.device).eval()

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity, with a digest of the weights."""
        from wiw.weight_file import digest

        return {**super().describe(), "prompt": self.prompt, "weights": digest(self._model.state_dict())}

    def follow(
        self, views: NDArray[np.uint8], masks: NDArray[np.bool_], frames: NDArray[np.uint8]
    ) -> NDArray[np.bool_]:
        """Segment a video of the views and the frames, marked in its first image."""
        import torch

        box = find_box(masks[0])
        assert box is not None
        first, found = len(views), np.zeros(frames.shape[:3], bool)
        with torch.inference_mode():
            session = self._create_session(np.concatenate([views, frames]))
            self._prompt_target(session, masks[0], box)
            for output in self._model.propagate_in_video_iterator(session, start_frame_idx=0):
                if output.frame_idx >= first and bool((output.object_score_logits > 0).all()):
                    found[output.frame_idx - first] = _upsample_mask(output.pred_masks, frames.shape[1:3])
        return found

    def _create_session(self, video: NDArray[np.uint8]) -> Any:
        """Create the network's memory of one video, with its preprocessed frames."""
        import torch
        from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

        return Sam2VideoInferenceSession(
            video=pretrained.to_square_batch(list(video), self._side, self.device),
            video_height=video.shape[1],
            video_width=video.shape[2],
            inference_device=self.device,
            inference_state_device=self.device,
            video_storage_device=self.device,
            dtype=torch.float32,
        )

    def _prompt_target(self, session: Any, seed: Mask, box: Box) -> None:
        """Mark the target in frame 0."""
        import torch

        number = session.obj_id_to_idx(1)
        if self.prompt == "mask":
            mask = torch.from_numpy(np.ascontiguousarray(seed))[None, None].float()
            session.add_mask_inputs(number, 0, torch.nn.functional.interpolate(mask, (self._side, self._side)))
        else:
            scale = np.array([self._side / seed.shape[1], self._side / seed.shape[0]])
            corners = torch.tensor(np.array(box).reshape(2, 2) * scale, dtype=torch.float32)
            labels = torch.tensor([[[2, 3]]], dtype=torch.int32)  # the network's names of a box's corners
            session.add_point_inputs(number, 0, {"point_coords": corners[None, None], "point_labels": labels})
        session.obj_with_new_inputs = [1]

    @property
    def _side(self) -> int:
        return int(self._model.image_size)


def _upsample_mask(logits: Any, size: Sequence[int]) -> NDArray[np.bool_]:
    """Upsample the network's small mask to bool [H, W] of the frame's size."""
    import torch

    whole = torch.nn.functional.interpolate(logits.float(), tuple(size), mode="bilinear", align_corners=False)
    return (whole[0, 0] > 0).cpu().numpy()
