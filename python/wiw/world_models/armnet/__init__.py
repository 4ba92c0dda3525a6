# SPDX-License-Identifier: Apache-2.0
"""The built-in learned world model of manipulation: from one front view to that after each pose of a plan."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw.networks import one_thread
from wiw.types import Conditioning, Control
from wiw.world_models import devices
from wiw.world_models.base import Requirements, WorldModel, accepts
from wiw.world_models.fingerprint import code_digest

if TYPE_CHECKING:
    from wiw.world_models.armnet.network import Network

BUILT_IN = Path(__file__).with_name("weights.safetensors")
SIZE = (480, 480)
"""Of the front views that come in and go out."""


class ArmNet(WorldModel):
    """Draws the arm at each pose, which it knows, and guesses what becomes of the things, which it has learnt.

    A network composes each pixel of the next view of what is seen there now, of what is carried along with the gripper,
    of the arm over the bare table, and of new paint; then goes on from there. The first three are in full resolution.

    Args:
        weights: a file of `wiw train armnet`; None means those that come with wiw.

    Raises:
        DependencyError: torch or safetensors is not installed.
        WeightsError: no such file, damaged, or of another version.
    """

    accepts = accepts(
        control="action", space="pose7", view="perspective", size=SIZE, causal=True, best_batch=16, cacheable=True
    )
    requires = Requirements(("torch", "safetensors"), "torch")

    def __init__(self, weights: str | Path | None = None) -> None:
        devices.require(self.requires)
        from wiw.world_models.armnet.weights import load

        self.weights = None if weights is None else str(weights)
        self._network, self.card = load(weights or BUILT_IN)

    @classmethod
    def of(cls, network: Network) -> ArmNet:
        """The world model of a network at hand, such as one in training."""
        model = cls.__new__(cls)
        model.weights, model._network, model.card = None, network.eval(), {}
        return model

    def describe(self) -> dict[str, Any]:
        """The weights' file and a digest of them, and torch's version."""
        import torch

        return {
            "name": type(self).__name__,
            "weights": self.weights,
            "digest": self._digest(),
            "torch": torch.__version__,
        }

    def fingerprint(self) -> str:
        """Digest of code, weights and torch's version; where the weights lie does not count."""
        said = {**self.describe(), "weights": None}
        return blake2b(f"{code_digest(type(self))}{sorted(said.items())}".encode(), digest_size=20).hexdigest()

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Front views; frames of padding are left unwritten."""
        from wiw.world_models.armnet.imagine import imagined

        frames = np.empty((len(controls), 1 + len(controls[0].actions), *observations.image.shape[1:]), np.uint8)
        frames[:, 0] = observations.image
        with one_thread():
            for image, control, future in zip(observations.image, controls, frames, strict=True):
                assert control.ids is not None
                poses = np.asarray(control.ids[: control.length + 1], np.float64)
                for made, frame in zip(imagined(self._network, image, poses), future[1:], strict=False):
                    frame[:] = made
        return frames

    def _digest(self) -> str:
        digest = blake2b(digest_size=8)
        for name, value in self._network.state_dict().items():
            digest.update(name.encode() + value.numpy().tobytes())
        return digest.hexdigest()
