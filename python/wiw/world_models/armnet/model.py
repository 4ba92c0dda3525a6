# SPDX-License-Identifier: Apache-2.0
"""The built-in learned world model of manipulation: from one front view to that after each pose of a plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.networks import single_thread
from wiw.types import GRIPPER_POSES, Conditioning, Control
from wiw.world_models.base import accepts
from wiw.world_models.trained import Trained

if TYPE_CHECKING:
    from wiw.world_models.armnet.network import Network

BUILT_IN = Path(__file__).with_name("weights.safetensors")
SIZE = (480, 480)
"""Height and width of the front views that come in and go out."""
ROBOT = {"name": "panda"}
"""What runs record of the arm that it draws."""


class ArmNet(Trained):
    """Draw the arm at each pose, which is known, and predict what happens to the objects, which is learned.

    A network composes each pixel of the next view of what is seen there now, of what is carried along with the gripper,
    of the arm over the bare table, and of new paint; then goes on from there. The first three are in full resolution.

    Args:
        weights: a file of `wiw train armnet`; None means those that come with wiw.

    Raises:
        DependencyError: torch or safetensors is not installed.
        WeightsError: no such file, damaged, or of another version.
    """

    accepts = accepts(
        control="action",
        space=GRIPPER_POSES,
        view="perspective",
        size=SIZE,
        causal=True,
        best_batch=16,
        cacheable=True,
        seeded=False,
    )

    @classmethod
    def require(cls, task: Mapping[str, Any]) -> None:
        """Require the arm that it draws to be the task's.

        Raises:
            ArgumentError: the task's arm is another one.
        """
        if task.get("robot", ROBOT) != ROBOT:
            raise ArgumentError(
                f"world model armnet: expected the built-in arm, which is the only one it draws, got {task['robot']}; "
                "leave --robot out, or ask oracle, copy or a model of your own"
            )

    @staticmethod
    def _load(weights: str | Path | None) -> tuple[Network, dict[str, Any]]:
        from wiw.world_models.armnet.weights import load

        return load(weights or BUILT_IN)

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return front views; frames of padding are left unwritten."""
        from wiw.world_models.armnet.imagine import imagine_views

        frames = np.empty((len(controls), 1 + len(controls[0].actions), *observations.image.shape[1:]), np.uint8)
        frames[:, 0] = observations.image
        with single_thread():
            for image, control, future in zip(observations.image, controls, frames, strict=True):
                assert control.ids is not None
                poses = np.asarray(control.ids[: control.length + 1], np.float64)
                for made, frame in zip(imagine_views(self._network, image, poses), future[1:], strict=False):
                    frame[:] = made
        return frames
