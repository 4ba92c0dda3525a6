# SPDX-License-Identifier: Apache-2.0
"""One virtual environment a peer, built on demand: their requirements exclude each other (PyOpenGL, NumPy)."""

from __future__ import annotations

import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).parents[3] / "build/bench-env"

PACKAGES = {
    "mujoco": ["mujoco>=3.3", "PyOpenGL>=3.1.9", "numpy", "opencv-python-headless"],
    "moderngl": ["moderngl>=5.12", "numpy", "opencv-python-headless"],
    "pyrender": ["pyrender==0.1.45", "numpy<2", "opencv-python-headless<4.12"],
    "open3d": ["open3d>=0.19", "numpy"],
    "pybullet": ["pybullet>=3.2.6", "numpy<2", "opencv-python-headless<4.12"],
}


def python_for(peer: str, install: bool) -> str | None:
    """The peer's interpreter; None where it is not installed and cannot be."""
    folder = ROOT / peer
    python = folder / "bin/python"
    if (folder / "ready").exists():
        return str(python)
    if not install:
        return None
    print(f"installing {peer} ...", file=sys.stderr, flush=True)
    venv.create(folder, with_pip=True, clear=True)
    result = subprocess.run(
        [python, "-m", "pip", "install", "-q", *PACKAGES[peer]], check=False, capture_output=True, text=True
    )
    if result.returncode != 0:
        print(f"  {peer} cannot be installed: {result.stderr.strip().splitlines()[-1]}", file=sys.stderr)
        return None
    (folder / "ready").touch()
    return str(python)
