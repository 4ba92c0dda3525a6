# SPDX-License-Identifier: Apache-2.0
"""Slow, readable twins of the nav room, and rooms to try them on."""

import numpy as np
from scipy.sparse.csgraph import dijkstra

GRAZE = 1e-5  # metres: points are stored in single precision, so a way may cut a wall by that much


def quad(corners):
    return np.asarray(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]])


def floor(x0, z0, x1, z1, y=0.0):
    return quad([[x0, y, z0], [x0, y, z1], [x1, y, z1], [x1, y, z0]])


def pillar(x, z, width, depth, angle, *, height=1.2):
    """A turned block, too low inside for an agent to stand there."""
    c, s = np.cos(angle), np.sin(angle)
    unit = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [0.5, -0.5]])
    foot = unit * [width, depth] @ np.array([[c, s], [-s, c]]) + [x, z]
    low, high = (np.insert(foot, 1, y, axis=1) for y in (0, height))
    parts = [quad(high)]
    for k in range(4):
        n = (k + 1) % 4
        parts.append(quad([low[k], low[n], high[n], high[k]]))
    return join(parts)


def join(parts):
    vertices, faces, base = [], [], 0
    for v, f in parts:
        vertices.append(v)
        faces.append(f + base)
        base += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def wall_boxes(boxes, height=1.2):
    return [pillar((x0 + x1) / 2, (z0 + z1) / 2, x1 - x0, z1 - z0, 0.0, height=height) for x0, z0, x1, z1 in boxes]


def read_obj(path):
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(w) for w in words[1:4]])
        elif words[:1] == ["f"]:
            ids = [int(w.split("/")[0]) - 1 for w in words[1:]]
            faces += [[ids[0], ids[k], ids[k + 1]] for k in range(1, len(ids) - 1)]
    return np.array(vertices, np.float32), np.array(faces)


def horizontal_length(path):
    return float(np.linalg.norm(np.diff(np.asarray(path, float)[:, [0, 2]], axis=0), axis=1).sum())


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def distance_to_walls(point, walls):
    a, d = walls[:, 0], walls[:, 1] - walls[:, 0]
    t = np.clip(((point - a) * d).sum(1) / (d * d).sum(1), 0, 1)
    return np.linalg.norm(a + t[:, None] * d - point, axis=1).min()


def is_free(point, walls):
    """Inside by the even-odd rule, or on a wall."""
    (x, z), a, b = point, walls[:, 0], walls[:, 1]
    straddles = (a[:, 1] > z) != (b[:, 1] > z)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (z - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
    return bool((straddles & (at > x)).sum() % 2) or distance_to_walls(point, walls) < GRAZE


def sees(p, q, walls):
    """Whether every part of the segment between the places where it meets walls is free."""
    way = q - p
    length = np.linalg.norm(way)
    if length < GRAZE:
        return True
    a, side = walls[:, 0], walls[:, 1] - walls[:, 0]
    turn = cross(way, side)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = cross(a - p, side) / turn
        s = cross(a - p, way) / turn
    margin = GRAZE / np.linalg.norm(side, axis=1)
    meets = t[(np.abs(turn) > 1e-12) & (s > -margin) & (s < 1 + margin) & (t > 0) & (t < 1)]
    on_line = np.abs(cross(walls.reshape(-1, 2) - p, way)) / length < GRAZE
    ends = (((walls.reshape(-1, 2) - p) @ way) / length**2)[on_line]
    stops = np.sort(np.concatenate([[0, 1], meets, ends[(ends > 0) & (ends < 1)]]))
    gaps = np.diff(stops) * length > 2 * GRAZE
    middles = ((stops[:-1] + stops[1:]) / 2)[gaps]
    return all(is_free(p + m * way, walls) for m in middles)


def brute_force_distances(points, walls):
    """All pairs by the textbook: every wall end and every point a node, an edge where nothing lies between, Dijkstra.

    `points` [N, 2] and `walls` [S, 2, 2] in the plane, one island of one floor.
    """
    nodes = np.concatenate([points, np.unique(walls.reshape(-1, 2), axis=0)]).astype(float)
    walls = walls.astype(float)
    weights = np.zeros((len(nodes), len(nodes)))
    for i in range(len(nodes)):
        for j in range(i):
            if sees(nodes[i], nodes[j], walls):
                weights[i, j] = weights[j, i] = max(np.linalg.norm(nodes[i] - nodes[j]), 1e-6)
    return dijkstra(weights, directed=False)[: len(points), : len(points)]
