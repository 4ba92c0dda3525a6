# SPDX-License-Identifier: Apache-2.0
"""The 3D diffusion policy: paths of the gripper out of noise, given the front view with its depth.

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
from wiw.policies.diffuser.paths import dense, moving, thinned, to_poses, to_vectors
from wiw.policies.diffuser.sight import Lens
from wiw.tabletop.workbench import CAMERAS
from wiw.types import Proposal, Space

if TYPE_CHECKING:
    from wiw.policies.diffuser.network import Network


LENGTH = 50
"""L, poses of a path (paper, appendix "Robotic Manipulation")."""


class Diffuser(Policy):
    """Proposes paths of 50 poses that might be meant; it reads no words, so that what is asked for is chosen by others.

    Each path starts from noise of its own and comes to something: a button pushed, the block slid, a thing put
    elsewhere. Where fewer poses are asked for, a path is thinned to those that its shape needs.

    Args:
        weights: a file of `wiw train diffuser`.
        steps: in which noise is taken away, up to 100.

    Raises:
        ArgumentError: no steps, or too many.
        DependencyError: torch or safetensors is not installed.
        WeightsError: no such file, damaged, or of another version.
    """

    space: Space = "pose7"
    needs = ("depth",)
    default_revision = "scripted"

    def __init__(self, weights: str | Path, steps: int = 20) -> None:
        if not 1 <= steps <= 100:
            raise ArgumentError(f"diffuser: expected 1 to 100 steps, got {steps}")
        require_torch()
        from wiw.policies.diffuser.weights import load

        self.steps = steps
        self._network, self.card = load(weights)
        self._digest = blake2b(Path(weights).expanduser().read_bytes(), digest_size=8).hexdigest()

    @classmethod
    def of(cls, network: Network, steps: int = 20) -> Diffuser:
        """The policy of a network at hand, such as one in training."""
        policy = cls.__new__(cls)
        policy.steps, policy._network, policy.card, policy._digest = steps, network.eval(), {}, ""
        return policy

    def describe(self) -> dict[str, Any]:
        """With a digest of the weights."""
        return {"policy": type(self).__name__, "weights": self._digest, "steps": self.steps}

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """As many paths as candidates; one where no world model is asked about them, which takes the first."""
        return [self._plans(each, candidates if each.imagines else 1, horizon) for each in situations]

    def _plans(self, situation: Situation, count: int, horizon: int) -> list[Proposal]:
        pose = situation.observation.pose
        stops = self._stops(situation, [_seed(situation, number) for number in range(count)])
        return [Proposal(thinned(pose, dense(pose, moving(pose, each), LENGTH), horizon)) for each in stops]

    def _stops(self, situation: Situation, seeds: Sequence[int]) -> NDArray[np.float64]:
        """float64 [R, K, 7]: poses to go to one after another, for each seed."""
        import torch

        from wiw.policies.diffuser.diffusion import sampled

        observation, pose, network = situation.observation, situation.observation.pose, self._network
        sight = Lens.of(CAMERAS["front"], observation.depth.shape).sight(observation.front, observation.depth)
        drawn = [torch.randn(network.shape.poses, 9, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        with single_thread(), torch.inference_mode():
            seen = sight.image, sight.height, sight.places, to_vectors(pose)
            image, height, places, now = (torch.from_numpy(each)[None] for each in seen)
            scene = network.look(image, height, places, now)
            noise = torch.stack(drawn)[None]
            clean, open_ = sampled(lambda noised, level: network.denoise(scene, noised, level), noise, self.steps)
            return to_poses(torch.cat([clean, open_[..., None]], dim=-1)[0].numpy())


def require_torch() -> None:
    """Raises a DependencyError that says how to install torch and safetensors, unless they are."""
    try:
        import safetensors  # noqa: F401
        import torch  # noqa: F401
    except ImportError as error:
        raise DependencyError(f"diffuser needs torch and safetensors ({error}): pip install 'wiw[torch]'") from error


def _seed(situation: Situation, number: int) -> int:
    key = situation.key
    return int(core.fold_key([key.seed, key.episode, key.decision, number, 0xD1FF])) % 2**63
