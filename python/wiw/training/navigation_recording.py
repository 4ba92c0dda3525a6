# SPDX-License-Identifier: Apache-2.0
"""Record the segments of a traversal: what the camera sees in each frame, encoded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.cameras import CAMERA_HEIGHT, camera_pose
from wiw.datasets.navigation_segment import NavigationSegment, encode_color, encode_millimetres
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError
from wiw.render import resolve_backend
from wiw.training.jobs import count_threads
from wiw.training.navigation_rules import NavigationRules, make_rules
from wiw.training.traversal import HEADINGS, TURN_RAD, Traversal, TraversalSegment
from wiw.typed_values import read_values

Backend = Literal["auto", "cpu", "gpu"]
BATCH = 32
"""Pictures rendered in one call: 100 MB at 576 x 1024."""
HFOV_DEG = 90.0
"""Field of view of perspective views, as of the agent's front view."""
PANORAMA, FRONT = (576, 1024), (480, 480)


@dataclass(frozen=True)
class NavigationCollection:
    """Options of a navigation dataset.

    Raises:
        ArgumentError: a number is out of range.
    """

    passes: int = 1
    """Passes over each scene, each with other waypoints and starts."""
    seed: int = 0
    rules: NavigationRules = field(default_factory=NavigationRules)
    perspective: bool = False
    """Whether the camera takes perspective front views in place of panoramas."""
    size: tuple[int, int] | None = None
    """Height and width in pixels; 576 x 1024 for panoramas and 480 x 480 for perspective views if None."""
    height: float = CAMERA_HEIGHT
    """Metres of the camera above the floor."""
    depth: bool = True
    lossless: bool = False
    """Whether colour is lossless WebP; otherwise JPEG of quality 95."""
    backend: Backend = "auto"
    """Renderer; images of different ones differ slightly."""

    def __post_init__(self) -> None:
        if self.passes < 1 or not 0 <= self.seed < 2**63:
            raise ArgumentError(
                f"collect: expected 1 pass or more and a seed from 0 to 2^63 - 1, got {self.passes} and {self.seed}"
            )
        if not 0.1 <= self.height <= 3:
            raise ArgumentError(f"collect: expected a camera height from 0.1 to 3 m, got {self.height}")
        size = self.image_size
        if len(size) != 2 or not all(16 <= side <= 8192 for side in size):
            raise ArgumentError(f"collect: expected height and width from 16 to 8192 pixels, got {size}")
        if not self.perspective and size[1] % HEADINGS:
            raise ArgumentError(
                f"collect: expected panoramas whose width is a multiple of {HEADINGS}, so that turns are whole "
                f"columns, got {size[1]}"
            )

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the pictures."""
        return self.size or (FRONT if self.perspective else PANORAMA)

    def describe(self) -> dict[str, Any]:
        """Return the options as JSON values; of equal descriptions are equal datasets."""
        return {**asdict(self), "size": list(self.image_size)}


def read_collection(preset: str, rules: Mapping[str, object] | None, given: Mapping[str, Any]) -> NavigationCollection:
    """Return the options of a dataset, with a renderer that works here.

    Args:
        preset: of the rules: "default" or "paper".
        rules: fields of `NavigationRules` to replace.
        given: other fields of `NavigationCollection`, by name.

    Raises:
        ArgumentError: an option is unknown, of another type or out of range.
        BackendError: the requested renderer does not work here.
    """
    options = read_values(NavigationCollection, given, "collect", "option")
    collection = NavigationCollection(rules=make_rules(preset, rules), **options)
    return replace(collection, backend=resolve_backend(collection.backend))


def record_segment(
    world: World,
    scene: str,
    pass_index: int,
    number: int,
    traversal: Traversal,
    index: int,
    options: NavigationCollection,
) -> NavigationSegment:
    """Render and encode one segment of a traversal.

    Args:
        world: of the scene.
        scene: its name in the dataset.
        pass_index: number of the pass over the scene.
        number: of the segment within the pass.
        traversal: that the segment belongs to.
        index: of the segment within the traversal.
        options: of the dataset.
    """
    segment = traversal.segments[index]
    floor = world.ground.put_down(segment.positions).astype(np.float64)
    yaws = traversal.north + segment.headings * TURN_RAD
    poses = np.stack([camera_pose(p, float(yaw), options.height) for p, yaw in zip(floor, yaws, strict=True)])
    sources = find_sources(segment, options)
    width = options.image_size[1]
    turns = (segment.headings - segment.headings[sources]) % HEADINGS
    rolls = np.where(turns > HEADINGS // 2, turns - HEADINGS, turns) * (0 if options.perspective else width // HEADINGS)
    shown = np.flatnonzero(sources == np.arange(len(segment)))
    pictures = _picture(world, traversal, segment, poses, floor, shown, options)
    by_frame = dict(zip(shown.tolist(), pictures, strict=True))
    return NavigationSegment(
        scene=scene,
        pass_index=pass_index,
        island=traversal.island,
        segment=number,
        seed=options.seed,
        height=options.height,
        actions=segment.actions,
        poses=poses,
        sources=sources.astype(np.int32),
        rolls=rolls.astype(np.int32),
        encoded_images=tuple(by_frame[i][0] if i in by_frame else None for i in range(len(segment))),
        encoded_depths=tuple(by_frame[i][1] if i in by_frame else None for i in range(len(segment)))
        if options.depth
        else None,
    )


def find_sources(segment: TraversalSegment, options: NavigationCollection) -> NDArray[np.int64]:
    """Return for each frame the one whose picture shows it: the first at its position, or itself in perspective."""
    frames = np.arange(len(segment))
    if options.perspective:
        return frames
    moved = np.concatenate([[True], (np.diff(segment.positions, axis=0) != 0).any(axis=1)])
    return np.maximum.accumulate(np.where(moved, frames, 0))


def _picture(
    world: World,
    traversal: Traversal,
    segment: TraversalSegment,
    poses: NDArray[np.float64],
    floor: NDArray[np.float64],
    shown: NDArray[np.int64],
    options: NavigationCollection,
) -> list[tuple[bytes, bytes]]:
    """Return colour and depth of the frames `shown`, encoded; depth is empty if none is wanted.

    Panoramas are rendered facing the traversal's north and rolled, so that what is seen from one position is the same
    to the last bit whichever way the agent faces.
    """
    outputs: tuple[Any, ...] = ("color", "depth") if options.depth else ("color",)
    size, width = options.image_size, options.image_size[1]
    rolls = segment.headings * (0 if options.perspective else width // HEADINGS)
    made: list[tuple[bytes, bytes]] = []
    for batch in (shown[at : at + BATCH] for at in range(0, len(shown), BATCH)):
        if options.perspective:
            seen = world.renderer.perspective(poses[batch], size, HFOV_DEG, outputs)
        else:
            north = np.stack([camera_pose(floor[frame], traversal.north, options.height) for frame in batch])
            seen = world.renderer.panorama(north, size, outputs)
        pictures = [{name: image[place] for name, image in seen.items()} for place in range(len(batch))]
        made += _map_threads(partial(_encode, options), pictures, rolls[batch].tolist())
    return made


def _encode(options: NavigationCollection, picture: dict[str, NDArray[Any]], roll: int) -> tuple[bytes, bytes]:
    rolled = {name: np.roll(image, roll, axis=1) for name, image in picture.items()}
    depth = encode_millimetres(rolled["depth"]) if options.depth else b""
    return encode_color(rolled["color"], options.lossless), depth


def _map_threads(function: Callable[..., Any], *items: Sequence[Any]) -> list[Any]:
    """Call a function that releases the GIL for each item, on all threads of this process; return results in order."""
    if count_threads() == 1:
        return list(map(function, *items))
    with ThreadPoolExecutor(count_threads()) as pool:
        return list(pool.map(function, *items))
