# SPDX-License-Identifier: Apache-2.0
"""One renderer in its own process: `render_worker.py PEER[:OPTION] SCENE.npz`.

Answers every line "perspective" or "panorama" on stdin with one line of JSON: milliseconds a frame over the scene's
views, by the clock and summed over all threads, NumPy arrays of colour, depth and ids in hand. "save KIND PATH" writes
the first view, so that pictures can be compared.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from pathlib import Path

# Idle BLAS threads that spin would be counted as work. mujoco and pyrender must be told of EGL before their import.
os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_WAIT_POLICY="passive", MUJOCO_GL="egl", PYOPENGL_PLATFORM="egl")

import numpy as np
import render_scene


def timed(draw, views) -> dict[str, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    for view in views:
        draw(view)
    return {
        "wall": 1e3 * (time.perf_counter() - wall) / len(views),
        "cpu": 1e3 * (time.process_time() - cpu) / len(views),
    }


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # libraries print to stdout
    name, *options = sys.argv[1].split(":")
    arrays = render_scene.load(Path(sys.argv[2]))
    peer = importlib.import_module(f"render_peers.{name}").Peer(arrays, *options)
    print(json.dumps({"description": peer.description}), file=answers, flush=True)
    for line in sys.stdin:
        kind, *rest = line.split()
        if kind == "save":
            color, depth, ids = getattr(peer, rest[0])(arrays.views[0])
            np.savez(rest[1], color=color, depth=depth, ids=ids)
            answer = {}
        else:
            # Panoramas show all of a room from anywhere; four views keep a round short.
            views = arrays.views if kind == "perspective" else arrays.views[:4]
            answer = timed(getattr(peer, kind), views)
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
