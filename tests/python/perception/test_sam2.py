# SPDX-License-Identifier: Apache-2.0
"""SAM 2 with tiny random weights: that videos are made, marked and read back as they should, not what it recognises."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from wiw.errors import ArgumentError, DependencyError
from wiw.types import Observation, Target


def test_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    from wiw.perception.sam2 import Sam2

    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(DependencyError, match=r"transformers not installed; pip install 'wiw\[torch\]'"):
        Sam2("facebook/sam2.1-hiera-tiny")
    with pytest.raises(ArgumentError, match="prompt: expected 'box' or 'mask'"):
        Sam2("facebook/sam2.1-hiera-tiny", prompt="point")  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the weights of a network of about a million numbers, 64 pixels a side."""
    pytest.importorskip("torch", reason="torch is not installed: pip install wiw[torch]")
    pytest.importorskip("transformers", reason="transformers is not installed: pip install wiw[torch]")
    import tiny_detectors

    return tiny_detectors.save_sam2(tmp_path_factory.mktemp("sam2"), video=True)


def observation(across_the_seam: bool = False) -> Observation:
    rng = np.random.default_rng(3)
    mask = np.zeros((64, 128), bool)
    mask[20:40, 60:76] = True
    mask = np.roll(mask, 56, axis=1) if across_the_seam else mask
    front = (10.0, 20.0, 30.0, 40.0)
    target = Target(mask, (0, 0, 1, 1), front)
    images = rng.integers(0, 255, (64, 128, 3), np.uint8), rng.integers(0, 255, (48, 48, 3), np.uint8)
    return Observation(*images, np.zeros(3), None, target)


def follow(tracker: Any, seen: Observation, panoramic: bool = True) -> Any:
    frames = np.random.default_rng(4).integers(0, 255, (3, 64, 128, 3) if panoramic else (3, 40, 40, 3), np.uint8)
    return tracker.track([seen], [np.tile(np.eye(4), (3, 1, 1))], [frames], panoramic=panoramic)[0]


@pytest.mark.parametrize("prompt", ["box", "mask"])
@pytest.mark.parametrize("panoramic", [True, False])
def test_tracks_have_the_frames_shape_and_are_repeatable(weights: Path, prompt: Any, panoramic: bool) -> None:
    from wiw.perception.sam2 import Sam2

    tracker = Sam2(weights, prompt)
    track, again = (follow(tracker, observation(), panoramic) for _ in range(2))
    assert track.masks.shape == ((3, 64, 128) if panoramic else (3, 40, 40))
    assert track.masks.dtype == bool
    assert len(track.boxes) == 3
    np.testing.assert_array_equal(track.masks, again.masks)


def test_nothing_is_followed_from_where_nothing_is_seen(weights: Path) -> None:
    from wiw.perception.sam2 import Sam2

    gone = observation()
    gone.target.mask[:] = False
    assert follow(Sam2(weights), gone).boxes == (None, None, None)


@pytest.mark.parametrize(("score", "found"), [(1.0, True), (-1.0, False)])
def test_masks_are_read_back_and_lost_targets_left_out(
    weights: Path, monkeypatch: pytest.MonkeyPatch, score: float, found: bool
) -> None:
    import torch

    from wiw.perception.sam2 import Sam2

    tracker = Sam2(weights)
    logits = torch.full((1, 1, 16, 16), -5.0)
    logits[..., 4:8, 8:12] = 5.0

    def answer(session: Any, start_frame_idx: int) -> Any:
        points = session.point_inputs_per_obj[0][0]["point_coords"]
        np.testing.assert_allclose(points.numpy().ravel(), [28, 20, 36, 40])  # the box, of 64 pixels a side
        for frame in range(session.num_frames):
            yield type(
                "Output",
                (),
                {"frame_idx": frame, "pred_masks": logits, "object_score_logits": torch.full((1, 1), score)},
            )

    monkeypatch.setattr(tracker._model, "propagate_in_video_iterator", answer)
    track = follow(tracker, observation())
    assert track.visible.tolist() == [found] * 3
    if found:
        left, top, right, bottom = track.boxes[0]
        shift = 4  # the target's middle is 4 columns right of the panorama's
        np.testing.assert_allclose([left, top, right, bottom], [64 + shift, 16, 96 + shift, 32], atol=2)


def test_the_video_begins_with_the_real_views_and_is_read_after_them(
    weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A target behind the agent: the network is shown it in the first view, and asked about the frames alone."""
    import torch

    from wiw.perception.sam2 import Sam2

    tracker, behind = Sam2(weights), observation(across_the_seam=True)
    shown: list[int] = []

    def answer(session: Any, start_frame_idx: int) -> Any:
        shown.append(session.num_frames)
        assert list(session.point_inputs_per_obj[0]) == [0] and start_frame_idx == 0
        for frame in range(session.num_frames):
            logits = torch.full((1, 1, 16, 16), -5.0)
            logits[..., frame, :8] = 5.0
            yield SimpleNamespace(frame_idx=frame, pred_masks=logits, object_score_logits=torch.ones(1, 1))

    monkeypatch.setattr(tracker._model, "propagate_in_video_iterator", answer)
    track = follow(tracker, behind, panoramic=False)
    (count,) = shown
    views = count - 3
    assert views >= 8, "half a turn from the target to the front, and the front view itself"
    for k, box in enumerate(track.boxes):
        assert (box[1] + box[3]) / 2 == pytest.approx(40 / 16 * (views + k + 0.5), abs=2.5), "the masks are the frames'"


def test_it_is_known_by_its_weights(weights: Path, tmp_path: Path) -> None:
    import torch

    from wiw.perception.sam2 import Sam2

    said = Sam2(weights).describe()
    assert said["name"] == "Sam2" and said == Sam2(shutil.copytree(weights, tmp_path / "moved")).describe()
    other = Sam2(weights)
    with torch.no_grad():
        next(other._model.parameters()).add_(1.0)
    assert other.describe()["weights"] != said["weights"]
