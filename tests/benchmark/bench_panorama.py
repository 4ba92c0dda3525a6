# SPDX-License-Identifier: Apache-2.0
"""Perspective views of panoramas against OpenCV, py360convert and pyequilib, each on one thread.

Peers keep what they can keep between calls (OpenCV its maps, wrapping at the seam). Differences are in grey levels from
bilinear interpolation in float64.
"""

from __future__ import annotations

import os

os.environ.setdefault("WIW_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from harness import measure, optional, report, spread

from wiw import panorama

PANO, VIEW, HFOV = (576, 1024), (384, 384), 105.0
YAWS = (0.0, 90.0, 180.0, 270.0)


def coordinates(yaw_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Column and row in the panorama of each pixel of a view."""
    height, width = VIEW
    focal = width / (2 * np.tan(np.radians(HFOV) / 2))
    u, v = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    longitude = np.arctan2(u, 1.0) - np.radians(yaw_deg)
    x = (longitude / (2 * np.pi) + 0.5) * PANO[1] - 0.5
    return x % PANO[1], (0.5 + np.arctan2(v, np.hypot(u, 1.0)) / np.pi) * PANO[0] - 0.5


def exact(pano: np.ndarray, yaw_deg: float) -> np.ndarray:
    """The view in float64."""
    x, y = coordinates(yaw_deg)
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - column)[..., None], (y - row)[..., None]

    def at(r: np.ndarray, c: np.ndarray) -> np.ndarray:
        return pano[r, c % PANO[1]].astype(np.float64)

    top = at(row, column) * (1 - fx) + at(row, column + 1) * fx
    return top * (1 - fy) + (at(row + 1, column) * (1 - fx) + at(row + 1, column + 1) * fx) * fy


def main() -> None:
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    pano = rng.integers(0, 256, (*PANO, 3), dtype=np.uint8)
    batch = rng.integers(0, 256, (14, *PANO, 3), dtype=np.uint8)
    plan = panorama.PerspectivePlan(PANO, VIEW, HFOV)
    floats = [tuple(axis.astype(np.float32) for axis in coordinates(yaw)) for yaw in YAWS]
    fixed = [cv2.convertMaps(*maps, cv2.CV_16SC2) for maps in floats]
    out, out_batch = np.empty((4, *VIEW, 3), np.uint8), np.empty((14, 4, *VIEW, 3), np.uint8)

    def remap(frame: np.ndarray, maps: list, into: np.ndarray) -> None:
        for pair, view in zip(maps, into, strict=True):
            cv2.remap(frame, *pair, cv2.INTER_LINEAR, dst=view, borderMode=cv2.BORDER_WRAP)

    def remap_batch(maps: list) -> None:
        for frame, into in zip(batch, out_batch, strict=True):
            remap(frame, maps, into)

    for name, draw in {
        "wiw": lambda: plan(pano, YAWS, out=out),
        "cv2 16SC2": lambda: remap(pano, fixed, out),
        "cv2 float": lambda: remap(pano, floats, out),
    }.items():
        draw()
        errors = [np.abs(view - exact(pano, yaw)).max() for view, yaw in zip(out, YAWS, strict=True)]
        print(f"{name}: at most {max(errors):.2f} grey levels from float64 on noise")

    py360, equilib = optional("py360convert"), optional("equilib")
    chw = np.ascontiguousarray(pano.transpose(2, 0, 1))
    rotations = [{"roll": 0.0, "pitch": 0.0, "yaw": np.radians(yaw)} for yaw in YAWS]
    cases = {
        "wiw": lambda: plan(pano, YAWS, out=out),
        "wiw, four calls": lambda: [plan(pano, yaw) for yaw in YAWS],
        "cv2.remap, 16SC2 maps kept": lambda: remap(pano, fixed, out),
        "cv2.remap, float maps kept": lambda: remap(pano, floats, out),
        "py360convert.e2p": py360 and (lambda: [py360.e2p(pano, HFOV, -yaw, 0, VIEW) for yaw in YAWS]),
        "pyequilib (NumPy)": equilib
        and (
            lambda: equilib.equi2pers(
                np.stack([chw] * 4), rotations, height=VIEW[0], width=VIEW[1], fov_x=HFOV, mode="bilinear"
            )
        ),
    }
    title = "four 384x384 views of a 576x1024 panorama"
    timings = measure(cases, repeats=31)
    report(title, cases, timings, "wiw", "4 against the faster cv2.remap")
    fastest_peer = min((timings[name] for name in cases if name.startswith("cv2")), key=lambda t: np.median(t.cpu))
    ratio = spread(fastest_peer.cpu / timings["wiw, four calls"].cpu)
    print(f"  one view a call: {ratio} times faster than the faster cv2.remap (target: 3.5)")
    cases = {
        "wiw": lambda: plan(batch, YAWS, out=out_batch),
        "cv2.remap, 16SC2 maps kept": lambda: remap_batch(fixed),
        "cv2.remap, float maps kept": lambda: remap_batch(floats),
    }
    report("the same of 14 panoramas", cases, measure(cases, repeats=11), "wiw", "7")


if __name__ == "__main__":
    main()
