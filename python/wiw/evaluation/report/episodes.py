# SPDX-License-Identifier: Apache-2.0
"""What the page shows of the episodes that keep pictures."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT
from wiw.evaluation.blame import blame
from wiw.evaluation.report.maps import (
    MapFrame,
    Mark,
    Trail,
    all_points,
    frame_of_picture,
    frame_of_points,
    start_and_goal,
    trail,
)
from wiw.evaluation.rows import decode_jpeg, encode_jpeg
from wiw.evaluation.store import RunStore
from wiw.types import Episode, Wording

GLYPHS = {int(FORWARD): "↑", int(TURN_LEFT): "↖", int(TURN_RIGHT): "↗", int(STOP): "■"}
BAND = (0.2, 0.8)
"""Rows of a panorama that are shown: 54 degrees up and down; the rest is ceiling and floor."""
FRONT = (0.25, 0.75)
"""Columns of an imagined panorama that are shown: the front half, where the plan leads."""
GAP = 3
"""Pixels between the frames of a strip."""


class Album:
    """Where the pictures of a page go: into the page itself, as data URIs."""

    panorama_width, frame_height, quality = 760, 104, 68

    def put(self, name: str, kind: str, data: bytes) -> str:
        """What an `src` attribute says of a picture; `name` tells it from the others of the run."""
        return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"

    def draw(self, name: str, make: Callable[[], bytes]) -> str:
        """The same for a JPEG that is still to be made."""
        return self.put(name, "jpeg", make())


@dataclass(frozen=True)
class Candidate:
    """One plan and what was imagined of it."""

    actions: str
    score: float | None
    share: float
    """0 (worst of the decision) to 1 (best), for a bar."""
    chosen: bool
    note: str
    strip: str | None
    """What was imagined; as `Album.put` says."""
    true: str | None
    """What would really have been seen."""
    truth: str
    """Score of what would really have been seen, and how near to it imagination came; empty where not measured."""
    truly_best: bool
    real_frames: int
    """How many leading frames are the real view turned."""
    frames: int


@dataclass(frozen=True)
class Step:
    """One decision."""

    number: int
    executed: str
    panorama: str | None
    candidates: tuple[Candidate, ...]
    rewritten: str
    """The plan, where it is none of the candidates."""
    before: float
    after: float
    """Metres of shortest way to the goal or target; straight-line where there is no way."""
    note: str
    fidelity: str
    """How well imagination ranked the plans; empty where not measured."""
    seconds: Mapping[str, float]
    calls: Mapping[str, float]
    answer: str = ""
    """What the agent believed and how surely, where the task asks."""

    @property
    def gain(self) -> float:
        """Metres that the decision brought the agent nearer."""
        return self.before - self.after


@dataclass(frozen=True)
class Attempt:
    """One arm's run of an episode."""

    arm: str
    outcome: Mapping[str, Any]
    steps: tuple[Step, ...]
    trail: Trail | None
    words: Wording
    choices: Sequence[str] = ()
    """What answers are chosen from, where the task asks for any."""

    @property
    def reached(self) -> bool:
        """Whether the episode was a success."""
        return bool(self.outcome["metrics"].get("success"))

    @property
    def text(self) -> str:
        """How it ended, in words."""
        if self.outcome["status"] == "failed":
            return "failed for infrastructure"
        metrics = self.outcome["metrics"]
        count = f"{len(self.steps)} decision{'' if len(self.steps) == 1 else 's'}"
        if self.reached:
            return f"{self.words.won} in {count}"
        due = f" · to blame: {self.outcome['blame']}" if "blame" in self.outcome else ""
        if self.choices:
            label = taken_for(metrics, self.choices)
            return (f"taken for {label} in {count}" if label else f"not answered in {count}") + due
        left = f", {metrics['distance_to_goal']:.1f} m short" if "distance_to_goal" in metrics else ""
        return f"{self.words.lost} in {count}{left}{due}"


@dataclass(frozen=True)
class Story:
    """One episode with all its arms."""

    index: int
    episode: Episode
    goal: str | None
    picture: str | None
    """Id of the scene's map among the page's shared pictures."""
    frame: MapFrame
    start_mark: Mark
    goal_mark: Mark
    attempts: tuple[Attempt, ...]
    words: Wording

    @property
    def place(self) -> str:
        """The scene's name without its folders."""
        return place(self.episode.scene)

    @property
    def way(self) -> str:
        """E.g. " · 4.2 m to the goal"; nothing where no arm could measure it."""
        length = self.episode.geodesic
        return f" · {length:.1f} m {self.words.way}" if np.isfinite(length) else ""

    @property
    def target(self) -> str:
        """What is to be recognised, where the task is that."""
        return str(self.episode.info.get("category", ""))


def stories(store: RunStore, arms: Sequence[str]) -> tuple[list[Story], dict[str, str]]:
    """The episodes that keep pictures and have ended, and the scene maps by id as data URIs."""
    outcomes = outcomes_by_episode(store, arms)
    episodes, pictures = store.episodes(), dict[str, str]()
    kept = [index for index in store.info["pictures"] if outcomes.get(index)]
    return [tell(store, index, episodes[index], outcomes[index], pictures, Album()) for index in kept], pictures


def outcomes_by_episode(store: RunStore, arms: Sequence[str]) -> dict[int, dict[str, Mapping[str, Any]]]:
    """How each episode ended, by arm in the order of `arms`; episodes that no arm has ended are left out."""
    blamed = blame(store)
    verdicts = blamed.verdicts() if blamed is not None else {}
    by_arm = {(row["arm"], row["episode"]): row for row in store.outcomes()}
    by_arm |= {key: {**by_arm[key], "blame": verdict} for key, verdict in verdicts.items()}
    found: dict[int, dict[str, Mapping[str, Any]]] = {}
    for index in sorted({episode for _, episode in by_arm}):
        found[index] = {arm: by_arm[arm, index] for arm in arms if (arm, index) in by_arm}
    return found


def tell(
    store: RunStore,
    index: int,
    episode: Episode,
    outcomes: Mapping[str, Mapping[str, Any]],
    pictures: dict[str, str],
    album: Album,
) -> Story:
    """One episode; its scene's map joins `pictures`."""
    decisions = {arm: store.decisions(arm, index) for arm in outcomes}
    kept = store.scene_map(episode.scene)
    if kept is not None:
        webp, matrix = kept
        frame = frame_of_picture(Image.open(io.BytesIO(webp)).size, matrix)
        picture = f"scene-{hashlib.sha256(episode.scene.encode()).hexdigest()[:12]}"
        pictures[picture] = album.put(picture, "webp", webp)
    else:
        frame = frame_of_points(all_points(episode, [row for rows in decisions.values() for row in rows]))
        picture = None
    attempts = tuple(
        _attempt(store, frame, outcome, decisions[arm], album, f"{index}-{number}")
        for number, (arm, outcome) in enumerate(outcomes.items())
    )
    goal = next((found for arm in outcomes if (found := store.images(arm, index, 0).get("goal"))), None)
    start, end = start_and_goal(frame, episode)
    shown = album.put(f"{index}-goal", "jpeg", goal) if goal else None
    return Story(index, episode, shown, picture, frame, start, end, attempts, wording(store))


def wording(store: RunStore) -> Wording:
    """How the run's task speaks of its episodes."""
    return Wording(**store.info.get("wording", {}))


def taken_for(metrics: Mapping[str, Any], choices: Sequence[str]) -> str:
    """The final answer, where the task asks for any; empty where none was given."""
    predicted = int(metrics.get("predicted", -1))
    return choices[predicted] if 0 <= predicted < len(choices) else ""


def place(scene: str) -> str:
    """A scene's name without its folders."""
    return scene if scene.startswith("apartments:") else Path(scene).name


def _attempt(
    store: RunStore,
    frame: MapFrame,
    outcome: Mapping[str, Any],
    decisions: list[dict[str, Any]],
    album: Album,
    name: str,
) -> Attempt:
    arm = outcome["arm"]
    steps = tuple(
        _step(row, store.images(arm, row["episode"], row["decision"]), album, f"{name}-{row['decision']}")
        for row in decisions
    )
    choices = store.config.get("task", {}).get("categories", ())
    return Attempt(arm, outcome, steps, trail(frame, arm, decisions) if decisions else None, wording(store), choices)


def _step(row: Mapping[str, Any], images: Mapping[str, bytes], album: Album, name: str) -> Step:
    panorama = images.get("panorama")
    written_anew = row["chosen"] is None
    return Step(
        row["decision"] + 1,
        glyphs(row["executed"]),
        album.draw(f"{name}-seen", partial(_panorama, panorama, album.panorama_width, album.quality))
        if panorama
        else None,
        tuple(_candidates(row, images, album, name)),
        glyphs(row["actions"]) if written_anew else "",
        _way(row, "before"),
        _way(row, "after"),
        row["note"],
        _fidelity(row["fidelity"]),
        row["seconds"],
        row["calls"],
        f"{row['answer']['label']}, {100 * row['answer']['confidence']:.0f} %" if row["answer"] else "",
    )


def _fidelity(found: Mapping[str, Any] | None) -> str:
    """E.g. "rank agreement +0.33 · regret 0.120"."""
    said = {"rank agreement": ("rank", "{:+.2f}"), "regret": ("regret", "{:.3f}")}
    return _spoken(found or {}, said)


def _truth(found: Mapping[str, Any] | None, index: int) -> tuple[str, bool]:
    """What is known of a candidate's true future, in words, and whether that scores best."""
    if found is None:
        return "", False
    own = {name: found[name][index] for name in ("scores", "psnr", "ssim", "lpips") if name in found}
    said = {"true score": ("scores", "{:.3f}"), "PSNR": ("psnr", "{:.1f} dB"), "SSIM": ("ssim", "{:.2f}")}
    said["LPIPS"] = ("lpips", "{:.2f}")
    known = [score for score in found["scores"] if score is not None]
    return _spoken(own, said), own["scores"] is not None and own["scores"] == max(known)


def _spoken(values: Mapping[str, Any], said: Mapping[str, tuple[str, str]]) -> str:
    """The numbers that are there, with their names."""
    return " · ".join(
        f"{title} {form.format(values[name])}" for title, (name, form) in said.items() if values.get(name) is not None
    )


def _way(row: Mapping[str, Any], when: str) -> float:
    geodesic = row[f"{when}_geodesic"]
    return geodesic if geodesic is not None and np.isfinite(geodesic) else row[f"{when}_distance"]


def _candidates(row: Mapping[str, Any], images: Mapping[str, bytes], album: Album, name: str) -> list[Candidate]:
    proposals = row["proposals"]
    scores = row["scores"] or [None] * len(proposals)
    finite = [score for score in scores if score is not None]
    low, high = (min(finite), max(finite)) if finite else (0.0, 0.0)
    found = []
    for index, (proposal, score) in enumerate(zip(proposals, scores, strict=True)):
        strips = {kind: images.get(f"{kind}/{index}") for kind in ("imagined", "true")}
        real = row["real_frames"][index] if row["real_frames"] else []
        frames = len(real) or len(proposal["actions"])
        shown = {
            kind: album.draw(f"{name}-{kind}-{index}", partial(_strip, jpeg, frames, album.frame_height, album.quality))
            for kind, jpeg in strips.items()
            if jpeg
        }
        share = (score - low) / (high - low) if score is not None and high > low else 1.0
        found.append(
            Candidate(
                glyphs(proposal["actions"]),
                score,
                share,
                index == row["chosen"],
                proposal["note"],
                shown.get("imagined"),
                shown.get("true"),
                *_truth(row["fidelity"], index),
                sum(real),
                len(real),
            )
        )
    return found


def glyphs(actions: Sequence[int]) -> str:
    """Primitives as arrows; ids without one as numbers."""
    return "".join(GLYPHS.get(action, f"({action})") for action in actions)


def _panorama(jpeg: bytes, width: int, quality: int) -> bytes:
    """The part of a panorama that is shown, at most so many pixels wide."""
    band = _part(decode_jpeg(jpeg), BAND, (0, 1))
    return _jpeg(band, min(1.0, width / band.shape[1]), quality)


def _strip(jpeg: bytes, frames: int, height: int, quality: int) -> bytes:
    """Frames side by side, at most so many pixels high; of panoramas only the part towards which the agent looks."""
    image = decode_jpeg(jpeg)
    tiles = np.split(image, frames, axis=1)
    if tiles[0].shape[1] > 1.6 * tiles[0].shape[0]:
        tiles = [_part(tile, BAND, FRONT) for tile in tiles]
    gap = np.full((len(tiles[0]), GAP, 3), 255, np.uint8)
    spaced = np.concatenate([part for tile in tiles for part in (tile, gap)][:-1], axis=1)
    return _jpeg(spaced, min(1.0, height / len(spaced)), quality)


def _part(image: NDArray[np.uint8], rows: tuple[float, float], columns: tuple[float, float]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    return image[
        round(rows[0] * height) : round(rows[1] * height), round(columns[0] * width) : round(columns[1] * width)
    ]


def _jpeg(image: NDArray[np.uint8], scale: float, quality: int) -> bytes:
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return encode_jpeg(image, quality)
