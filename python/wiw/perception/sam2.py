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
from wiw.networks import resolve_device
from wiw.perception import pretrained
from wiw.perception.boxes import Mask, box_width, find_box
from wiw.perception.tracking import Tracker, get_target
from wiw.types import Box, Observation


class Sam2(Tracker):
    """Segments the target in the imagined frames as a video that begins with the real observation.

    A panorama is rotated first, so that the target is at its centre and not across the seam.

    Args:
        weights: a folder or hub name that `transformers.Sam2VideoModel.from_pretrained` takes, or such a model.
        prompt: how the target is marked in the first frame: by its "box", as in the paper, or its "mask".
        device: of torch; the GPU if there is one.
        revision: of the hub's repository.

    Raises:
        ArgumentError: an unknown prompt, or there is no such device.
        DependencyError: torch or transformers is not installed.
        WeightsError: the weights cannot be loaded or belong to another network; its `kind` says why.
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
        pretrained.import_transformers()
        self.prompt, self.device = prompt, resolve_device(device)
        if isinstance(weights, str | Path):
            weights = pretrained.load_network("Sam2VideoModel", ("sam2_video",), weights, revision, self.device)
        self._model = weights.to(self.device).eval()

    def predict_masks(
        self,
        observations: Sequence[Observation],
        viewpoints: Sequence[NDArray[np.float64]],
        frames: Sequence[NDArray[np.uint8]],
        panoramic: bool,
    ) -> list[NDArray[np.bool_]]:
        """Track one video per plan; a target that is out of sight at the start gets empty masks."""
        return [
            self._track_panoramas(observation, images) if panoramic else self._track_front_views(observation, images)
            for observation, images in zip(observations, frames, strict=True)
        ]

    def _track_panoramas(self, observation: Observation, frames: NDArray[np.uint8]) -> NDArray[np.bool_]:
        mask, columns = get_target(observation).mask, frames.shape[2]
        box = find_box(mask, wraps=True)
        if box is None:
            return np.zeros(frames.shape[:3], bool)
        middle = (box[0] + box_width(box, mask.shape[1]) / 2) / mask.shape[1]
        shift = columns // 2 - round(middle * columns)
        start = np.roll(_resize_to_frames(observation.panorama, frames), shift, axis=1)
        seed = np.roll(mask, round(shift * mask.shape[1] / columns), axis=1)
        found = self._track_video(start, np.roll(frames, shift, axis=2), seed, find_box(seed))
        return np.roll(found, -shift, axis=2)

    def _track_front_views(self, observation: Observation, frames: NDArray[np.uint8]) -> NDArray[np.bool_]:
        seed = panorama.to_perspective(
            get_target(observation).mask.astype(np.uint8), 90.0, observation.front.shape[:2], interpolation="nearest"
        ).astype(bool)
        return self._track_video(
            _resize_to_frames(observation.front, frames), frames, seed, get_target(observation).front_box
        )

    def _track_video(
        self, start: NDArray[np.uint8], frames: NDArray[np.uint8], seed: Mask, box: Box | None
    ) -> NDArray[np.bool_]:
        """Return masks of the frames after `start`, in which the target has the mask `seed`, or the box around it."""
        import torch

        if box is None or not seed.any() or not len(frames):
            return np.zeros(frames.shape[:3], bool)
        with torch.inference_mode():
            session = self._create_session(np.concatenate([start[None], frames]))
            self._prompt_target(session, seed, box)
            found = np.zeros(frames.shape[:3], bool)
            for output in self._model.propagate_in_video_iterator(session, start_frame_idx=0):
                if output.frame_idx > 0 and bool((output.object_score_logits > 0).all()):
                    found[output.frame_idx - 1] = _upsample_mask(output.pred_masks, frames.shape[1:3])
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


def _resize_to_frames(image: NDArray[np.uint8], frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Resize a real image to the frames' size."""
    import cv2

    height, width = frames.shape[1:3]
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _upsample_mask(logits: Any, size: Sequence[int]) -> NDArray[np.bool_]:
    """Upsample the network's small mask to bool [H, W] of the frame's size."""
    import torch

    whole = torch.nn.functional.interpolate(logits.float(), tuple(size), mode="bilinear", align_corners=False)
    return (whole[0, 0] > 0).cpu().numpy()
