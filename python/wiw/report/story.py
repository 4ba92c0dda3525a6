# SPDX-License-Identifier: Apache-2.0
"""Episodes as values that the page templates show."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from wiw.metrics.metric import is_success
from wiw.report import cuts
from wiw.report.beliefs import Belief, Verdict, list_expected
from wiw.report.maps import MapFrame, Mark, Trail
from wiw.report.stage import Drawing
from wiw.types import Episode, Wording


@dataclass(frozen=True)
class Picture:
    """A picture on a page."""

    source: str
    """Address or data URI."""
    id: str = ""
    """Id among the pictures that the page defines once; empty if `source` is the address of a file."""
    width: int = 0
    height: int = 0
    """Pixels; 0 where the browser reads them from the file."""


class Album:
    """Pictures inside a page, as data URIs; equal pictures, such as those of two arms, are stored once."""

    panorama_width, frame_height, quality = 520, 64, 30
    front_side, end_side = 256, 128
    """Pixels of the front views of a gripper: of real ones, and of imagined ones."""
    goal_side, map_side = 280, 700
    belief_width, belief_quality = 440, 35
    """Pixels across and JPEG quality of pictures of what policies believe, which have lines and letters."""
    belief_count: int | None = 1
    """How many of these a decision shows at most; None means all."""
    whole = False
    """Whether imagined futures of a gripper are shown frame by frame, or only their last frames."""

    def __init__(self, scale: float = 1.0) -> None:
        """Store pictures, except maps, at `scale` of their size; pages show them as large as others."""
        self._pictures: dict[bytes, Picture] = {}
        self.scale = scale

    @property
    def pictures(self) -> list[Picture]:
        """All pictures that the page has to define."""
        return list(self._pictures.values())

    def put(self, name: str, kind: str, data: bytes) -> str:
        """Return the `src` attribute of a picture; `name` is unique within the run."""
        return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"

    def put_map(self, name: str, webp: bytes) -> Picture:
        """Return the picture of a scene's map, whose coordinates are pixels of `webp` whatever its file's size."""
        width, height = Image.open(io.BytesIO(webp)).size
        small = cuts.shrink_map(webp, self.map_side)
        return Picture(self.put(name, "webp", small), name, width, height)

    def draw(self, name: str, make: Callable[[], bytes]) -> Picture:
        """Return a picture of which `make` returns the WebP bytes; `name` is unique within the run."""
        data = make()
        key = hashlib.sha256(data).digest()
        if key not in self._pictures:
            width, height = (round(side / self.scale) for side in Image.open(io.BytesIO(data)).size)
            self._pictures[key] = Picture(self.put(name, "webp", data), f"p{len(self._pictures)}", width, height)
        return self._pictures[key]


@dataclass(frozen=True)
class Candidate:
    """One candidate plan and its imagined future."""

    actions: str
    score: float | None
    share: float
    """0 (worst of the decision) to 1 (best), for a bar."""
    chosen: bool
    note: str
    strip: Picture | None
    """Imagined future."""
    true: Picture | None
    """True future."""
    truth: str
    """Score of what would really have been seen, and how near to it imagination came; empty if not measured."""
    truly_best: bool
    real_frames: int
    """How many leading frames are the real view turned."""
    frames: int
    """Frames of the strips."""
    drawing: Drawing | None = None
    """The plan on what the camera sees, where it is one of poses."""
    text: str = ""
    """The plan in the policy's words."""


@dataclass(frozen=True)
class Step:
    """One decision."""

    number: int
    executed: str
    seen: Picture | None
    """Observation."""
    candidates: tuple[Candidate, ...]
    rewritten: str
    """The plan, where it is none of the candidates."""
    before: float | None
    after: float | None
    """Metres of shortest way to the goal or target; straight-line if there is no way; None if the task has none.
    """
    note: str
    fidelity: str
    """How well imagination ranked the plans; empty if not measured."""
    seconds: Mapping[str, float]
    calls: Mapping[str, float]
    answer: str = ""
    """Belief of the agent and how sure it was, where the task asks."""
    refused: str = ""
    """Why ways of a gripper ended early."""
    shot: str = ""
    """Id of what a gripper's camera saw among the story's shots; empty if plans are not of poses."""
    belief: Belief | None = None
    """The same for a timeline."""
    believed: tuple[tuple[str, Picture], ...] = ()
    """Pictures of what the policy believed, with their names."""

    @property
    def gain(self) -> float:
        """Metres that the decision brought the agent nearer."""
        return 0.0 if self.before is None or self.after is None else self.before - self.after


@dataclass(frozen=True)
class Attempt:
    """One arm's run of an episode."""

    arm: str
    outcome: Mapping[str, Any]
    steps: tuple[Step, ...]
    trail: Trail | None
    words: Wording
    choices: Sequence[str] = ()
    """Possible answers, where the task asks for one of several."""
    film: str | None = None
    """Film of the episode; as `Album.put` returns it."""
    end: str = ""
    """Id of what was seen at the end among the story's shots; empty if it was not kept."""
    verdict: Verdict | None = None
    """Judgement of the answer in words, where the task asks for one."""

    @property
    def success(self) -> bool:
        """Whether the episode was a success."""
        return is_success(self.outcome["metrics"])

    @property
    def text(self) -> str:
        """Outcome in words."""
        if self.outcome["status"] == "error":
            return "infrastructure error, excluded from scores"
        metrics = self.outcome["metrics"]
        count = f"{len(self.steps)} decision{'' if len(self.steps) == 1 else 's'}"
        due = f" · to blame: {self.outcome['blame']}" if "blame" in self.outcome else ""
        if self.verdict is not None:
            return f"{self.verdict.text}, after {count}{due}"
        if self.success:
            return f"{self.words.won} in {count}"
        if self.choices:
            label = final_answer(metrics, self.choices)
            return (f"answered {label} after {count}" if label else f"no answer after {count}") + due
        left = f", {metrics['distance_to_goal']:.1f} m from the goal" if "distance_to_goal" in metrics else ""
        return f"{self.words.lost} after {count}{left}{due}"


@dataclass(frozen=True)
class Story:
    """One episode with all its arms."""

    index: int
    episode: Episode
    goal: Picture | None
    picture: str | None
    """Id of the scene's map among the page's shared pictures."""
    frame: MapFrame | None
    """None if plans are of poses: the way is drawn on what the camera sees."""
    ends: tuple[Mark, Mark | None] | None
    """Start and goal on the map."""
    attempts: tuple[Attempt, ...]
    words: Wording
    poses: bool = False
    """Whether plans are of poses of a gripper."""
    shots: Mapping[str, Picture] = field(default_factory=dict)
    """Images of a gripper's camera, by id."""

    @property
    def place(self) -> str:
        """The scene's name without its folders, or the kind of task."""
        return name_place(self.episode)

    @property
    def instruction(self) -> str:
        """Instruction in words, where the task gives one."""
        return str(self.episode.info.get("instruction", ""))

    @property
    def expected_answers(self) -> tuple[str, ...]:
        """The answers in words that count as right, where the task is a question."""
        return list_expected(self.episode) if "question" in self.episode.info else ()

    @property
    def way(self) -> str:
        """E.g. " · 4.2 m to the goal"; empty if no arm could measure it."""
        length = self.episode.geodesic
        return f" · {length:.1f} m {self.words.way}" if np.isfinite(length) else ""

    @property
    def target(self) -> str:
        """Return the category to be recognised, in tasks of recognition."""
        return str(self.episode.info.get("category", ""))


def final_answer(metrics: Mapping[str, Any], choices: Sequence[str]) -> str:
    """Return the final answer, where the task asks for one; empty if none was given."""
    predicted = int(metrics.get("predicted", -1))
    return choices[predicted] if 0 <= predicted < len(choices) else ""


def place(scene: str) -> str:
    """Return a scene's name without its folders."""
    return scene if scene.startswith("apartments:") else Path(scene).name


def name_place(episode: Episode) -> str:
    """Return the kind of an episode where its task has several, else its scene's name without its folders, and tier."""
    return episode.kind.replace("_", " ") or " · ".join(filter(None, (place(episode.scene), episode.tier)))
