# SPDX-License-Identifier: Apache-2.0
"""Whether Active Recognition ranks world models by how well they follow a plan, with each kind of tracker.

Three models of equal image quality: one that ignores the plan (nothing moves), one that follows it two primitives
late, and one that follows it (the oracle). The policy is the built-in recogniser; with `flow` the target is located by
the pixels of the frames, with `reprojection` where the plan was to lead.

    python tests/benchmark/tracker_order.py --episodes 100 --workers 2
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import wiw
from wiw.runs.recipes import AgentRecipe
from wiw.types import Conditioning, Control
from wiw.world_models.base import accepts
from wiw.world_models.oracle import Oracle

DELAY = 2
"""Primitives by which `Late` lags behind."""


class Late(Oracle):
    """The truth, `DELAY` primitives late."""

    accepts = accepts(control="action", view="panorama", needs=("simulator",), best_batch=64)

    def rollout(self, observations: Conditioning, controls: Sequence[Control], seeds: Any) -> Any:
        """Return true panoramas; the first ones repeat the observation."""
        frames = super().rollout(observations, controls, seeds)
        return frames[:, np.maximum(np.arange(frames.shape[1]) - DELAY, 0)]


ARMS = {"ignores": "copy", "late": f"{Path(__file__).resolve()}:Late", "follows": "oracle"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--scenes", default="apartments:val")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    out = given.out or Path(tempfile.mkdtemp())
    for tracker in ("flow", "reprojection"):
        recipe = AgentRecipe("recogniser", tracker=tracker)
        log = wiw.evaluate(
            "ar", recipe, given.episodes, arms=ARMS, seed=0, scenes=given.scenes, workers=given.workers, keep_images=0,
            out=out / tracker, resume=True, backend="cpu",
        )  # fmt: skip
        log.summary()
    print(out)


if __name__ == "__main__":
    main()
