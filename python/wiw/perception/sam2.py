# SPDX-License-Identifier: Apache-2.0
"""SAM 2 as a tracker (Ravi et al. 2024; the paper's choice), through the classes of `transformers`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw.errors import ArgumentError
from wiw.networks import device as usable
from wiw.perception import pretrained
from wiw.perception.boxes import Mask, box_of, width_of
from wiw.perception.tracking import Tracker, target_of
from wiw.types import Box, Observation


class Sam2(Tracker):
    """Segments the target in the imagined frames as a video that begins with the real observation.

    A panorama is turned first, so that the target is at its centre and not across the seam.

    Args:
        weights: a folder or hub name that `transformers.Sam2VideoModel.from_pretrained` takes, or such a model.
        prompt: what the first frame is marked with: the target's "box", as in the paper, or its "mask".
        device: of torch; the GPU if there is one.
        revision: of the hub's repository.

    Raises:
        ArgumentError: an unknown prompt, or there is no such device.
        DependencyError: torch or transformers is not installed.
        WeightsError: the weights cannot be had or are another network's; its `kind` says why.
    """

    def __init__(
        self,
        weights: Any = "facebook/sam2.1-hiera-tiny",
        prompt: Literal["box", "mask"] = "box",
        device: str | None = None,
        revision: str | None = None,
    ) -> None:
        if prompt not in ("box", "mask"):
            raise ArgumentError(f"Sam2: prompt: expected 'box' or 'mask', got {prompt!r}")
        pretrained.library()
        self.prompt, self.device = prompt, usable(device)
        if isinstance(weights, str | Path):
            weights = pretrained.network("Sam2VideoModel", ("sam2_video",), weights, revision, self.device)
        self._model = weights.to(self.device).eval()

    def masks(
        self,
        observations: Sequence[Observation],
        viewpoints: Sequence[NDArray[np.float64]],
        frames: Sequence[NDArray[np.uint8]],
        panoramic: bool,
    ) -> list[NDArray[np.bool_]]:
        """One video a plan; where the target is not in sight at the start there is nothing to follow."""
        return [
            self._panoramas(observation, images) if panoramic else self._front_views(observation, images)
            for observation, images in zip(observations, frames, strict=True)
        ]

    def _panoramas(self, observation: Observation, frames: NDArray[np.uint8]) -> NDArray[np.bool_]:
        mask, columns = target_of(observation).mask, frames.shape[2]
        box = box_of(mask, wraps=True)
        if box is None:
            return np.zeros(frames.shape[:3], bool)
        middle = (box[0] + width_of(box, mask.shape[1]) / 2) / mask.shape[1]
        shift = columns // 2 - round(middle * columns)
        start = np.roll(_fitted(observation.panorama, frames), shift, axis=1)
        seed = np.roll(mask, round(shift * mask.shape[1] / columns), axis=1)
        found = self._follow(start, np.roll(frames, shift, axis=2), seed, box_of(seed))
        return np.roll(found, -shift, axis=2)

    def _front_views(self, observation: Observation, frames: NDArray[np.uint8]) -> NDArray[np.bool_]:
        seed = panorama.to_perspective(
            target_of(observation).mask.astype(np.uint8), 90.0, observation.front.shape[:2], interpolation="nearest"
        ).astype(bool)
        return self._follow(_fitted(observation.front, frames), frames, seed, target_of(observation).front_box)

    def _follow(
        self, start: NDArray[np.uint8], frames: NDArray[np.uint8], seed: Mask, box: Box | None
    ) -> NDArray[np.bool_]:
        """Masks of the frames after `start`, in which the target has the mask `seed`, or the box around it."""
        import torch

        if box is None or not seed.any() or not len(frames):
            return np.zeros(frames.shape[:3], bool)
        with torch.inference_mode():
            session = self._session(np.concatenate([start[None], frames]))
            self._mark(session, seed, box)
            found = np.zeros(frames.shape[:3], bool)
            for output in self._model.propagate_in_video_iterator(session, start_frame_idx=0):
                if output.frame_idx > 0 and bool((output.object_score_logits > 0).all()):
                    found[output.frame_idx - 1] = _upsampled(output.pred_masks, frames.shape[1:3])
        return found

    def _session(self, video: NDArray[np.uint8]) -> Any:
        """The network's memory of one video: its frames, as it wants them."""
        import torch
        from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

        return Sam2VideoInferenceSession(
            video=pretrained.square(list(video), self._side, self.device),
            video_height=video.shape[1],
            video_width=video.shape[2],
            inference_device=self.device,
            inference_state_device=self.device,
            video_storage_device=self.device,
            dtype=torch.float32,
        )

    def _mark(self, session: Any, seed: Mask, box: Box) -> None:
        """Points the target out in frame 0."""
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


def _fitted(image: NDArray[np.uint8], frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A real image in the frames' size."""
    import cv2

    height, width = frames.shape[1:3]
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _upsampled(logits: Any, size: Sequence[int]) -> NDArray[np.bool_]:
    """Bool [H, W] of the frame's size from the network's small masks."""
    import torch

    whole = torch.nn.functional.interpolate(logits.float(), tuple(size), mode="bilinear", align_corners=False)
    return (whole[0, 0] > 0).cpu().numpy()
