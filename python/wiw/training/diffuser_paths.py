# SPDX-License-Identifier: Apache-2.0
"""How near the paths that the diffusion policy draws come to those of held-out demonstrations."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from wiw.policies.diffuser.diffusion import sample_ddim
from wiw.policies.diffuser.network import Network, to_tensors
from wiw.policies.diffuser.paths import SCALE, to_vectors
from wiw.policies.diffuser.policy import STEPS
from wiw.training.diffuser import Samples

NEAR = 0.03
"""Metres by which no pose of a path is off if it counts as the expert's; a button's plate has a radius of 0.034 m."""
PATHS = (1, 5, 10)
"""Numbers of paths of which one has to be near."""
BATCH = 16
"""Samples that are encoded together."""


def measure_paths(network: Network, samples: Samples, seed: int = 0) -> dict[str, float]:
    """Draw ten paths for each sample and return how they relate to the expert's, by name.

    "near/5": the share of samples for which one of five paths is near; "off": how far the nearest of all is off, in
    metres, median over samples; "spread": mean distance in metres between the ends of two paths for one sample. A
    policy that is not told which target is meant should try several: where the spread falls to nothing it has learnt by
    heart which were meant in training.
    """
    paths = _draw_paths(network.eval(), samples, seed)
    true = to_vectors(samples.path)[:, None, :, :3] * SCALE
    off = np.linalg.norm(paths - true, axis=-1).max(axis=-1)
    found = {f"near/{count}": float((off[:, :count].min(axis=1) < NEAR).mean()) for count in PATHS}
    spread = np.mean([pdist(ends).mean() for ends in paths[:, :, -1]])
    return {**found, "off": float(np.median(off.min(axis=1))), "spread": float(spread)}


@torch.inference_mode()
def _draw_paths(network: Network, samples: Samples, seed: int) -> NDArray[np.float64]:
    """Return the places of ten paths for N samples, float64 [N, 10, L, 3]: metres from the middle of the workspace."""
    generator, drawn = torch.Generator().manual_seed(seed), []
    for first in range(0, len(samples), BATCH):
        part = samples.select(np.arange(first, min(first + BATCH, len(samples))))
        noise = torch.randn(len(part), max(PATHS), network.shape.poses, 9, generator=generator)
        views, now = [to_tensors(view) for view in part.views], torch.from_numpy(to_vectors(part.pose))
        denoise = partial(network.denoise, network.encode_scene(views, now))
        clean, _ = sample_ddim(denoise, noise, STEPS)
        drawn.append(clean[..., :3].double().numpy() * SCALE)
    return np.concatenate(drawn)
