# SPDX-License-Identifier: Apache-2.0
"""Locating the goal camera by features, depth and a pose solver, which works when the goal is in view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw.policies.base import Situation
from wiw.policies.matcher import appearance
from wiw.policies.matcher.exploration import FAR_DISTANCE, compute_distance_field
from wiw.policies.matcher.policy import HEADINGS, Matcher, Memory
from wiw.types import Goal, Key, Observation

VIEW = 320
"""Side in pixels of the square views that features are extracted from; HFOV 90."""
YAWS_DEG = (0.0, 90.0, 180.0, 270.0)
RATIO = 0.8
"""Lowe's ratio test."""
INLIERS = 14
"""Minimum number of inliers for a pose to be accepted."""
REACH = 8.0
"""Metres beyond which a solved pose is rejected."""
PULL = 3.0
"""Weight of one metre closer to the solved place, in units of the matcher's prior."""


@dataclass
class GeometricMemory(Memory):
    """The matcher's memory, and the solved place of the goal."""

    keypoints: NDArray[np.float32] | None = None
    descriptors: NDArray[np.float32] | None = None
    place: NDArray[np.float64] | None = None
    """float64 [2]: x forward, y left in the start frame."""
    support: int = 0


class Geometric(Matcher):
    """The matcher, attracted to the goal camera's position, which SIFT matches, true depth and PnP with RANSAC give.

    A classical baseline for comparison with learned imagination: it needs depth and texture, but no imagination.
    """

    def begin(self, goal: Goal, key: Key) -> GeometricMemory:
        """Extract features of the goal image; start with an empty map.

        Raises:
            ArgumentError: the goal has no image.
        """
        image = self._require_goal_image(goal)
        points, descriptors = _extract_features(cv2.resize(image, (VIEW, VIEW), interpolation=cv2.INTER_AREA))
        return GeometricMemory(appearance.build_goal_template(image), keypoints=points, descriptors=descriptors)

    def observe(self, situations: Sequence[Situation]) -> None:
        """Observe as the matcher; besides, solve for the goal camera, and keep the answer with most inliers."""
        super().observe(situations)
        for situation in situations:
            memory: GeometricMemory = situation.memory
            solved = locate_goal(situation.observation, memory)
            if solved is not None and solved[1] >= memory.support:
                memory.place, memory.support = solved

    def _judge_headings(
        self, memory: Memory, odometry: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        prior, runs = super()._judge_headings(memory, odometry)
        assert isinstance(memory, GeometricMemory)
        if memory.place is None:
            return prior, runs
        azimuth = odometry[2] + np.arange(HEADINGS) * 2 * np.pi / HEADINGS
        stride = np.minimum(runs, 0.6)[:, None]
        ends = odometry[:2] + stride * np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
        distance = _measure_distances(memory, memory.place)
        gain = memory.map.sample_grid(distance, odometry[None, :2])[0] - memory.map.sample_grid(distance, ends)
        return prior + PULL * np.clip(gain, -1, 1), runs


def _measure_distances(memory: GeometricMemory, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the metres to the place through free cells; straight-line metres where no path is known."""
    free = memory.map.find_free_cells()
    free[memory.map.to_cells(memory.map.trail[-1][:1], memory.map.trail[-1][1:])] = True
    source = np.zeros_like(free)
    row, column = memory.map.to_cells(place[:1], place[1:])
    source[row, column] = True
    free |= source
    walked = compute_distance_field(free, source)
    centres = memory.map.centres
    straight = np.hypot(centres[:, None] - place[0], centres[None] - place[1])
    return np.where(walked < FAR_DISTANCE, walked, straight + 1.0)


def locate_goal(observation: Observation, memory: GeometricMemory) -> tuple[NDArray[np.float64], int] | None:
    """Solve for the goal camera's position (x, y in the start frame), by one observation; return it with its inlier
    count.
    """
    if memory.descriptors is None or len(memory.descriptors) < INLIERS or observation.depth is None:
        return None
    points, pixels = [], []
    for yaw in YAWS_DEG:
        view = panorama.to_perspective(observation.panorama, 90.0, (VIEW, VIEW), yaw_deg=yaw)
        found, descriptors = _extract_features(view)
        if descriptors is None or len(descriptors) < 2:
            continue
        for mine, theirs in _match_descriptors(descriptors, memory.descriptors):
            point = _unproject_pixel(found[mine], yaw, observation.depth)
            if point is not None:
                points.append(point)
                pixels.append(memory.keypoints[theirs])  # type: ignore[index]
    return _solve_pose(np.array(points), np.array(pixels), observation.odometry) if len(points) >= INLIERS else None


def _solve_pose(
    points: NDArray[np.float64], pixels: NDArray[np.float32], odometry: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int] | None:
    """Solve PnP with RANSAC in OpenCV's camera frame (x right, y down, z ahead); the agent's camera is the origin."""
    focal = VIEW / 2
    intrinsics = np.array([[focal, 0, VIEW / 2 - 0.5], [0, focal, VIEW / 2 - 0.5], [0, 0, 1]])
    cv2.setRNGSeed(0)
    try:
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            points,
            pixels.astype(np.float64),
            intrinsics,
            None,
            iterationsCount=300,
            reprojectionError=4.0,
            flags=cv2.SOLVEPNP_EPNP,
        )
    except cv2.error:  # the solver's word for points that determine no pose, e.g. all on one spot
        return None
    if not found or inliers is None or len(inliers) < INLIERS:
        return None
    centre = -cv2.Rodrigues(rotation)[0].T @ translation[:, 0]
    right, down, ahead = centre
    if abs(down) > 0.5 or np.hypot(right, ahead) > REACH:  # all cameras are at one height
        return None
    cos, sin = np.cos(odometry[2]), np.sin(odometry[2])
    place = odometry[:2] + np.array([cos * ahead + sin * right, sin * ahead - cos * right])
    return place, len(inliers)


def _unproject_pixel(
    pixel: NDArray[np.float32], yaw_deg: float, depth: NDArray[np.float32]
) -> NDArray[np.float64] | None:
    """Return the 3D point at a view's pixel, in the frame of the front camera; None if nothing was hit."""
    x, y = (pixel[0] + 0.5) / (VIEW / 2) - 1, (pixel[1] + 0.5) / (VIEW / 2) - 1
    yaw = np.radians(yaw_deg)
    ray = np.array([x * np.cos(yaw) - np.sin(yaw), y, x * np.sin(yaw) + np.cos(yaw)])
    ray /= np.linalg.norm(ray)
    height, width = depth.shape
    column = int((np.arctan2(ray[0], ray[2]) / (2 * np.pi) + 0.5) * width) % width
    row = min(int((np.arcsin(ray[1]) / np.pi + 0.5) * height), height - 1)
    distance = float(depth[row, column])
    return ray * distance if distance > 0 else None


@cache
def _sift() -> cv2.SIFT:
    return cv2.SIFT_create(600)  # type: ignore[attr-defined]


def _extract_features(view: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return pixels float32 [N, 2] and root-SIFT descriptors [N, 128] (Arandjelovic and Zisserman, CVPR 2012)."""
    keypoints, descriptors = _sift().detectAndCompute(cv2.cvtColor(view, cv2.COLOR_RGB2GRAY), None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), None
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return np.array([k.pt for k in keypoints], np.float32), descriptors.astype(np.float32)


def _match_descriptors(mine: NDArray[np.float32], theirs: NDArray[np.float32]) -> list[tuple[int, int]]:
    """Return pairs of indices that pass the ratio test."""
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(mine, theirs, k=2)
    return [(p[0].queryIdx, p[0].trainIdx) for p in pairs if len(p) == 2 and p[0].distance < RATIO * p[1].distance]
