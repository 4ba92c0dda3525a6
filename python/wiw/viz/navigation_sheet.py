# SPDX-License-Identifier: Apache-2.0
"""A sheet of a navigation dataset: a map of each traversal, and frames of one of its segments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wiw.datasets.navigation import NavigationData
from wiw.datasets.navigation_segment import NavigationSegment
from wiw.viz.navigation_maps import draw_traversal

HEIGHT, GAP, CAPTION = 300, 12, 24
"""Pixels: of a row's pictures, between pictures, of a line of text."""
MAP_WIDTH = 420
PAPER, INK = (250, 249, 246), (40, 40, 38)
ACTIONS = ("start", "forward", "turn left", "turn right", "stop")


def draw_sheet(data: NavigationData, traversals: int = 6, frames: int = 4) -> Image.Image:
    """Draw one row per traversal: its map, then frames of its longest segment, colour above depth.

    Args:
        data: the dataset.
        traversals: number of rows, spread evenly over the dataset.
        frames: number of frames of each.
    """
    known = [(record, each) for record in data.meta["passes"] for each in record["traversals"] if each["frames"]]
    step = max(1.0, len(known) / traversals)
    chosen = [known[int(number * step)] for number in range(min(traversals, len(known)))]
    rows = [_draw_row(data, record, traversal, frames) for record, traversal in chosen]
    if not rows:
        raise ValueError("a finished dataset has frames")
    sheet = Image.new("RGB", (max(row.width for row in rows) + 2 * GAP, GAP + sum(r.height + GAP for r in rows)), PAPER)
    top = GAP
    for row in rows:
        sheet.paste(row, (GAP, top))
        top += row.height + GAP
    return sheet


def _draw_row(
    data: NavigationData, record: Mapping[str, Any], traversal: Mapping[str, Any], frames: int
) -> Image.Image:
    indices = [
        index
        for index, row in enumerate(data.segments)
        if (row["scene"], row["pass"], row["island"]) == (record["scene"], record["pass"], traversal["island"])
    ]
    paths = [data.read(index, pictures=False).poses[:, [0, 2], 3] for index in indices]
    segment = data[max(indices, key=lambda index: data.segments[index]["frames"])]
    pictures = [_fit(draw_traversal(traversal, paths), (HEIGHT, MAP_WIDTH)), *_draw_frames(segment, frames)]
    title = (
        f"{record['scene']}, pass {record['pass']}, island {traversal['island']} of {traversal['area']:.0f} m2: "
        f"{traversal['frames']} frames, {len(indices)} segments, {traversal['coverage']:.0%} covered, "
        f"{traversal['dropped']} waypoints dropped. At right: segment {segment.segment}, {len(segment)} frames"
    )
    row = Image.new("RGB", (sum(p.width + GAP for p in pictures) - GAP, CAPTION + HEIGHT), PAPER)
    ImageDraw.Draw(row).text((0, 2), title, INK, ImageFont.load_default(15))
    left = 0
    for picture in pictures:
        row.paste(picture, (left, CAPTION))
        left += picture.width + GAP
    return row


def _draw_frames(segment: NavigationSegment, count: int) -> list[Image.Image]:
    """Return pictures of `count` frames one after another from the middle of a segment, each with its action."""
    first = max(0, (len(segment) - count) // 2)
    drawn = []
    clip = segment.clip(first, min(count, len(segment)))
    for place, color in enumerate(clip.images):
        parts = [color] if clip.depths is None else [color, color_depth(clip.depths[place])]
        height = (HEIGHT - CAPTION) // len(parts)
        scaled = [_fit(part, (height, 10**4)) for part in parts]
        picture = Image.new("RGB", (scaled[0].width, HEIGHT), PAPER)
        for number, part in enumerate(scaled):
            picture.paste(part, (0, number * height))
        text = f"frame {first + place}: {ACTIONS[segment.actions[first + place]]}"
        ImageDraw.Draw(picture).text((0, HEIGHT - CAPTION + 2), text, INK, ImageFont.load_default(14))
        drawn.append(picture)
    return drawn


def color_depth(depth: NDArray[np.float32], longest: float = 6.0) -> NDArray[np.uint8]:
    """Return depth [H, W] as colours, near ones bright; uint8 [H, W, 3], black where nothing is hit."""
    share = np.clip(1 - depth / longest, 0, 1)
    colors = cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where((depth > 0)[..., None], colors, 0).astype(np.uint8)


def _fit(image: NDArray[np.uint8], size: tuple[int, int]) -> Image.Image:
    """Return a picture scaled to fit into (height, width)."""
    scale = min(size[0] / image.shape[0], size[1] / image.shape[1])
    width, height = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return Image.fromarray(np.ascontiguousarray(image)).resize((width, height), Image.Resampling.LANCZOS)
