# SPDX-License-Identifier: Apache-2.0
"""Plans made of poses of a gripper before one fixed camera (paper, appendix "Robotic Manipulation")."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, ContractError
from wiw.loop.contract import check_needs, check_plan_space
from wiw.loop.imagination import Imagination, Request
from wiw.loop.imagine_poses import imagine_poses
from wiw.loop.plan_space import PlanSpace
from wiw.types import GRIPPER_POSES
from wiw.world_models.base import WorldModel


class GripperPoses(PlanSpace):
    """float64 [K, 7]: x, y, z in metres, roll, pitch, yaw in radians, and how open the gripper is, 0 to 1."""

    words = "poses of a gripper"

    def check_plan(self, source: str, actions: Any, longest: int) -> NDArray[np.float64]:
        """Return float64 [K, 7]; see `PlanSpace.check_plan`."""
        poses = np.asarray(actions)
        if poses.ndim != 2 or poses.shape[1] != 7 or not 1 <= len(poses) <= longest:
            raise ContractError(
                f"{source}: expected plans of 1 to {longest} poses, float [K, 7], got shape {poses.shape}"
            )
        if not np.isfinite(poses).all() or not ((poses[:, 6] >= 0) & (poses[:, 6] <= 1)).all():
            raise ContractError(f"{source}: expected finite poses with a gripper from 0 to 1, got {poses.tolist()}")
        return poses.astype(np.float64)

    def check_model(self, model: WorldModel, longest: int) -> None:
        """See `PlanSpace.check_model`: the model must show what happens in a front view, from a fixed camera."""
        accepts, name = model.accepts, type(model.unwrapped).__name__
        check_plan_space(model, GRIPPER_POSES, self.words)
        if accepts.control not in ("image", "text", "action"):
            raise ArgumentError(
                f"{name} follows a camera {accepts.control}, but gripper poses do not move the camera; declare "
                "control='action' to be given the poses, or 'text' or 'image'"
            )
        if accepts.view != "perspective":
            raise ArgumentError(f"{name} imagines panoramas, but manipulation is seen in a front view")
        if "semantic" in accepts.needs:
            raise ArgumentError(f"{name} needs semantics of a panorama, but the manipulation camera has none")
        check_needs(model)

    def imagine(self, model: WorldModel, request: Request) -> Imagination:
        """Imagine plans of all episodes in one batch; see `wiw.loop.imagine_poses`."""
        return imagine_poses(model, request)
