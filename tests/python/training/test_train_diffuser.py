# SPDX-License-Identifier: Apache-2.0
"""What the diffusion policy learns from: demonstrations that succeeded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wiw.datasets.demonstration import Demonstration
from wiw.errors import ArgumentError
from wiw.policies.diffuser.workspace import PinholeCamera
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import CAMERAS
from wiw.training.recording import Collection, record_demonstration

pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.training import diffuser_weights
from wiw.training.diffuser import Recipe, extract_samples
from wiw.training.diffuser_weights import make_weights

LENS = PinholeCamera.from_camera(CAMERAS["front"], (480, 480))


@pytest.fixture(scope="module")
def shown() -> Demonstration:
    """A block slid."""
    return record_demonstration(TABLETOP_TASKS["slide_block"], 3, Collection(frames=16, depth=True))[0]


def test_failed_demonstrations_are_left_out_and_counted(shown: Demonstration) -> None:
    failed = replace(shown, success=False, seed=4)
    alone, samples = extract_samples([shown], LENS), extract_samples([failed, shown, failed], LENS)
    assert (alone.failed, samples.failed) == (0, 2) and samples.demonstrations == alone.demonstrations
    np.testing.assert_array_equal(samples.path, alone.path)
    assert samples.select(np.arange(1)).failed == 2
    with pytest.raises(ArgumentError, match="to learn from, got 1 that failed; collect others without --keep-failed"):
        extract_samples([failed], LENS)


def test_the_card_says_how_many_failed(
    shown: Demonstration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, one_torch_thread: None
) -> None:
    class Two(list[Demonstration]):
        config, camera, wrist_intrinsics = {"size": 480}, LENS, None

    monkeypatch.setattr(diffuser_weights, "Demonstrations", lambda _: Two([shown, replace(shown, success=False)]))
    recipe = Recipe(epochs=1, batch=1, levels=1, width=24, layers=1)
    card = make_weights(tmp_path / "d.safetensors", tmp_path, recipe)
    assert card["failed"] == 1 and card["moments"] > 0
