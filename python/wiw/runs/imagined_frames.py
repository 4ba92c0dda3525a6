# SPDX-License-Identifier: Apache-2.0
"""Imagined frames of a run, as its store keeps them: which there are, the ones that arms share, and their pixels.

A rollout is stored as one JPEG, a strip of frames of `rows.STRIP_HEIGHT` pixels; frames of several views stand above
one another. Here each view is a frame of its own.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wiw.errors import StoreError
from wiw.runs.pictures import choose_pictured_episodes
from wiw.runs.rows import STRIP_HEIGHT, decode_jpeg, select_frames, to_json
from wiw.runs.store import RunStore


@dataclass(frozen=True, order=True)
class FrameKey:
    """Identity of an imagined future: two arms that imagined the same one have frames of the same key."""

    episode: int
    decision: int
    pose: tuple[float, ...]
    """Where the agent truly was, to a micrometre: x, y, z, yaw."""
    plan: str
    """JSON of the plan's actions."""
    frame: int
    """Index among the rollout's frames."""
    view: int
    """Index among the frame's views."""
    size: tuple[int, int]
    """Height and width in pixels."""

    @property
    def order(self) -> str:
        """Place in a sample, like drawn by lot and always the same."""
        return hashlib.sha256(to_json(asdict(self)).encode()).hexdigest()


@dataclass(frozen=True)
class FramePlace:
    """Where a frame lies in the store of its run."""

    arm: str
    plan: int
    """Index of the plan among the decision's proposals."""
    column: int
    columns: int
    """Frames in the strip."""
    views: int


Frames = Mapping[FrameKey, FramePlace]


def list_frames(store: RunStore, arm: str) -> dict[FrameKey, FramePlace]:
    """Return the stored frames that an arm imagined; views of the real world turned are none.

    Raises:
        StoreError: a picture is damaged.
    """
    found: dict[FrameKey, FramePlace] = {}
    for episode in sorted(choose_pictured_episodes(store)):
        for row in store.decisions(arm, episode):
            if row["real_frames"] is not None:
                for key, place in _frames_of_decision(store, row):
                    found.setdefault(key, place)
    return found


def sample_frames(keys: Collection[FrameKey], count: int) -> list[FrameKey]:
    """Return `count` frames, as many of each episode as it has; fewer are always among more.

    The choice depends on the keys alone.
    """
    episodes: dict[int, list[FrameKey]] = {}
    for key in sorted(keys, key=lambda key: (key.order, key)):
        episodes.setdefault(key.episode, []).append(key)
    turns = [(turn, key.episode, key) for own in episodes.values() for turn, key in enumerate(own)]
    return [key for _, _, key in sorted(turns)[:count]]


def common_frames(arms: Iterable[Frames]) -> set[FrameKey]:
    """Return the frames that all arms have."""
    sets = [set(frames) for frames in arms]
    return set.intersection(*sets) if sets else set()


def read_frames(
    store: RunStore, places: Mapping[FrameKey, FramePlace], keys: Sequence[FrameKey], kind: str = "imagined"
) -> Iterator[tuple[FrameKey, NDArray[np.uint8]]]:
    """Yield the pixels of frames, uint8 [H, W, 3] RGB, as stored; those that are not there are left out.

    Args:
        store: of the run.
        places: where its frames lie.
        keys: of the frames to read.
        kind: "imagined", or "true" for what would really have been seen.

    Raises:
        StoreError: a picture is damaged.
    """
    at: tuple[Any, ...] = ()
    images: dict[str, bytes] = {}
    for key in sorted(keys):
        place = places[key]
        if at != (place.arm, key.episode, key.decision):
            at = place.arm, key.episode, key.decision
            images = store.images(*at)
        jpeg = images.get(f"{kind}/{place.plan}")
        if jpeg is not None:
            yield key, _cut_frame(decode_jpeg(jpeg), place, key.view)


def digest_frame(frame: NDArray[np.uint8]) -> str:
    """Return the SHA-256 of a frame's size and pixels."""
    return hashlib.sha256(f"{frame.shape}".encode() + np.ascontiguousarray(frame).tobytes()).hexdigest()


def _frames_of_decision(store: RunStore, row: Mapping[str, Any]) -> Iterator[tuple[FrameKey, FramePlace]]:
    images = store.images(row["arm"], row["episode"], row["decision"])
    pose = tuple(round(float(row[f"before_{name}"]), 6) for name in ("x", "y", "z", "yaw"))
    for plan, (proposal, real) in enumerate(zip(row["proposals"], row["real_frames"], strict=True)):
        jpeg = images.get(f"imagined/{plan}")
        if jpeg is None:
            continue
        kept = select_frames(len(real))
        height, width = _measure(jpeg)
        views, actions = height // STRIP_HEIGHT, to_json(proposal["actions"])
        if height % STRIP_HEIGHT or width % len(kept):
            raise StoreError(
                f"{store.path}: picture imagined/{plan} (arm {row['arm']}, episode {row['episode']}, decision "
                f"{row['decision']}): expected {len(kept)} frames of {STRIP_HEIGHT} pixels, got {width}x{height}; the "
                "run store is damaged"
            )
        for column, frame in enumerate(kept):
            for view in range(views) if not real[frame] else ():
                size = STRIP_HEIGHT, width // len(kept)
                key = FrameKey(row["episode"], row["decision"], pose, actions, int(frame), view, size)
                yield key, FramePlace(row["arm"], plan, column, len(kept), views)


def _measure(jpeg: bytes) -> tuple[int, int]:
    """Return height and width without decoding the pixels."""
    try:
        with Image.open(io.BytesIO(jpeg)) as image:
            return image.height, image.width
    except OSError as error:
        raise StoreError(f"a picture of {len(jpeg)} bytes is not a JPEG; the run store is damaged") from error


def _cut_frame(strip: NDArray[np.uint8], place: FramePlace, view: int) -> NDArray[np.uint8]:
    column = np.split(strip, place.columns, axis=1)[place.column]
    return np.ascontiguousarray(np.split(column, place.views, axis=0)[view])
