# SPDX-License-Identifier: Apache-2.0
"""The 3D diffusion policy: gripper paths by denoising, given views of the scene with their depth.

Paper, appendix "Policies in Embodied Tasks".
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.errors import ArgumentError, DependencyError
from wiw.networks import single_thread
from wiw.policies.base import Policy, Situation
from wiw.policies.diffuser.paths import densify_path, drop_repeated_poses, thin_path, to_poses, to_vectors
from wiw.policies.diffuser.workspace import PinholeCamera, WorkspaceView, stack_views
from wiw.tabletop.workbench import CAMERAS, WRIST
from wiw.types import GRIPPER_POSES, ArmObservation, Proposal

if TYPE_CHECKING:
    from wiw.policies.diffuser.network import Network


BUILT_IN = Path(__file__).with_name("weights.safetensors")
STEPS = 20
"""Denoising steps."""

PATH_LENGTH = 50
"""L, poses of a path (paper, appendix "Robotic Manipulation")."""


class Diffuser(Policy):
    """Proposes plausible paths of 50 poses; it reads no instruction, so the reviser must choose the requested one.

    Each path starts from its own noise and achieves one subtask: a button pushed, the block slid, an object placed.
    Where fewer poses are requested, a path is thinned to those that its shape needs.

    Args:
        weights: a file of `wiw train diffuser`; None means those that come with wiw.
        steps: number of denoising steps, up to 100.

    Raises:
        ArgumentError: no steps, or too many.
        DependencyError: torch or safetensors is not installed.
        WeightsError: no such file, damaged, or of another version.
    """

    space = GRIPPER_POSES
    needs: tuple[str, ...] = ("depth",)
    default_revision = "scripted"

    def __init__(self, weights: str | Path | None = None, steps: int = STEPS) -> None:
        if not isinstance(steps, int) or not 1 <= steps <= 100:
            raise ArgumentError(f"diffuser: expected 1 to 100 steps, got {steps}")
        require_torch()
        from wiw.policies.diffuser.weights import load

        self.steps = steps
        file = BUILT_IN if weights is None else Path(weights).expanduser()
        self._network, self.card = load(file)
        self.needs = choose_needs(self._network)
        self._digest = blake2b(file.read_bytes(), digest_size=8).hexdigest()

    @classmethod
    def from_network(cls, network: Network, steps: int = STEPS) -> Diffuser:
        """Create the policy from a network in memory, such as one in training."""
        policy = cls.__new__(cls)
        policy.steps, policy._network, policy.card, policy._digest = steps, network.eval(), {}, ""
        policy.needs = choose_needs(network)
        return policy

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity, with a digest of the weights."""
        return {"policy": type(self).__name__, "weights": self._digest, "steps": self.steps}

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return as many paths as candidates; only one where no world model will imagine them."""
        return [self._build_plans(each, candidates if each.imagines else 1, horizon) for each in situations]

    def _build_plans(self, situation: Situation, count: int, horizon: int) -> list[Proposal]:
        pose = situation.observation.pose
        stops = self._sample_poses(situation, [_derive_seed(situation, number) for number in range(count)])
        return [
            Proposal(thin_path(pose, densify_path(pose, drop_repeated_poses(pose, each), PATH_LENGTH), horizon))
            for each in stops
        ]

    def _sample_poses(self, situation: Situation, seeds: Sequence[int]) -> NDArray[np.float64]:
        """Sample successive poses for each seed, float64 [R, K, 7]."""
        import torch

        from wiw.policies.diffuser.diffusion import sample_ddim
        from wiw.policies.diffuser.network import to_tensors

        pose, network = situation.observation.pose, self._network
        views = view_scene(situation.observation, network.shape.wrist)
        drawn = [torch.randn(network.shape.poses, 9, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        with single_thread(), torch.inference_mode():
            now = torch.from_numpy(to_vectors(pose))[None]
            scene = network.encode_scene([to_tensors(stack_views([each])) for each in views], now)
            noise = torch.stack(drawn)[None]
            clean, open_ = sample_ddim(lambda noised, level: network.denoise(scene, noised, level), noise, self.steps)
            return to_poses(torch.cat([clean, open_[..., None]], dim=-1)[0].numpy())


def choose_needs(network: Network) -> tuple[str, ...]:
    """Return what observations must have for a network."""
    return ("depth", "wrist") if network.shape.wrist else ("depth",)


def view_scene(observation: ArmObservation, wrist: bool) -> list[WorkspaceView]:
    """Return what the cameras see of the workspace: the front one, and that on the hand where asked for."""
    assert observation.depth is not None
    front = PinholeCamera.from_camera(CAMERAS["front"], observation.depth.shape)
    views = [front.view_workspace(observation.front, observation.depth)]
    if wrist:
        seen = observation.wrist
        assert seen is not None and seen.depth is not None
        camera = PinholeCamera.from_camera(CAMERAS[WRIST], seen.depth.shape, seen.T_world_camera)
        views.append(camera.view_from_wrist(seen.image, seen.depth))
    return views


def require_torch() -> None:
    """Raise a DependencyError that says how to install torch and safetensors, unless they are installed."""
    try:
        import safetensors  # noqa: F401
        import torch  # noqa: F401
    except ImportError as error:
        raise DependencyError(f"diffuser needs torch and safetensors ({error}): pip install 'wiw[torch]'") from error


def _derive_seed(situation: Situation, number: int) -> int:
    key = situation.key
    return int(core.fold_key([key.seed, key.episode, key.decision, number, 0xD1FF])) % 2**63
