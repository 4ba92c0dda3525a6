# SPDX-License-Identifier: Apache-2.0
"""One step of four episodes in an apartment: as a batch, and one by one under gymnasium's own vector."""

from __future__ import annotations

import numpy as np
from gymnasium.vector import SyncVectorEnv
from harness import measure, report

import wiw

PLACES = 4


def main() -> None:
    """Prints what a step of all places takes."""
    ours = wiw.make_vec("ImageNav-v0", PLACES, scenes="apartments:val:1", backend="cpu")
    task = ours.task
    peer = SyncVectorEnv([lambda: task.environment(depth=True)] * PLACES)
    ours.reset()
    peer.reset()
    for place, env in enumerate(peer.envs):  # gymnasium hands the same options to all
        env.reset(options={"episode": place})
    turn = np.full(PLACES, int(wiw.action.TURN_LEFT))
    cases = {"wiw.envs.VectorEnv": lambda: ours.step(turn), "SyncVectorEnv of single ones": lambda: peer.step(turn)}
    title = f"a step of {PLACES} environments: panorama, front view and depth"
    report(title, cases, measure(cases, 20), "wiw.envs.VectorEnv")


if __name__ == "__main__":
    main()
