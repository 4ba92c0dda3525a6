# SPDX-License-Identifier: Apache-2.0
"""Values that travel through the closed loop. All are frozen; arrays follow `docs/conventions.md`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError

ControlKind = Literal["image", "text", "trajectory", "viewpoint", "action"]
View = Literal["perspective", "panorama"]
PRIMITIVES: Final = "discrete"
"""Plans are ids of `wiw.action`, int8 [K]."""
GRIPPER_POSES: Final = "pose7"
"""Plans are poses of a gripper (x, y, z, roll, pitch, yaw, gripper), float64 [K, 7]."""


@dataclass(frozen=True)
class Key:
    """Identifies one decision; all randomness is derived from it, so results never depend on batch size or worker
    count.
    """

    seed: int
    episode: int
    decision: int = 0

    def at(self, decision: int) -> Key:
        """Return the key of another decision in the same episode."""
        return Key(self.seed, self.episode, decision)


def check_seed(seed: Any) -> int:
    """Check a seed and return it.

    Raises:
        ArgumentError: it is not a whole number from 0 to 2**64 - 1.
    """
    if not isinstance(seed, int | np.integer) or not 0 <= seed < 2**64:
        raise ArgumentError(f"seed: expected a whole number from 0 to 2**64 - 1, got {seed!r}")
    return int(seed)


Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels, 0 at the left (upper) edge of the first pixel; left > right if it crosses the
seam."""


@dataclass(frozen=True)
class Target:
    """The one object in view that a task is about, marked as by a red box, without saying what it is."""

    mask: NDArray[np.bool_]
    """bool [576, 1024]: its visible pixels in the panorama."""
    panorama_box: Box | None
    """Box around the mask; None if no part is visible."""
    front_box: Box | None
    """Box around its visible pixels in the front view."""


@dataclass(frozen=True)
class Answer:
    """An agent's belief at a decision: a distribution over the goal's choices."""

    choices: tuple[str, ...]
    probabilities: NDArray[np.float64]
    """float64 [len(choices)], sum 1."""
    raw: NDArray[np.float64] | None = None
    """float64 [len(choices)], sum at most 1: the probabilities a language model gave, before normalisation; None if
    they summed to 1."""

    @property
    def label(self) -> str:
        """The likeliest choice."""
        return self.choices[int(np.argmax(self.probabilities))]

    @property
    def confidence(self) -> float:
        """Its probability, the raw one if known, so that probability outside the choices counts against an answer."""
        given = self.probabilities if self.raw is None else self.raw
        return float(given[int(np.argmax(self.probabilities))])


@dataclass(frozen=True)
class TextAnswer:
    """An agent's belief at a decision, in words, if the goal is a question."""

    text: str = ""
    """Empty while the agent believes nothing."""
    confidence: float = 0.0
    """From 0 to 1."""
    final: bool = False
    """Whether the agent commits to this as its answer; the task's rules say when that ends the episode."""


class Outlook(Protocol):
    """The view from one place, rendered on demand."""

    def draw(self, outputs: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return images by name: "panorama", "front", "depth"; see `Observation`."""


@dataclass(frozen=True)
class Observation:
    """The agent's perception: images, odometry since the start of the episode, and depth if the run grants it.

    Nothing here reveals where in the scene the agent is: poses are relative to the first observation of the episode.
    """

    panorama: NDArray[np.uint8]
    """uint8 [576, 1024, 3] equirectangular."""
    front: NDArray[np.uint8]
    """uint8 [480, 480, 3], HFOV 90 degrees."""
    odometry: NDArray[np.float64]
    """float64 [3]: x forward and y left in metres, azimuth in radians (left positive), in the frame of the start."""
    depth: NDArray[np.float32] | None = field(default_factory=lambda: None)
    """float32 [576, 1024] distance along the ray in metres, 0 where nothing is hit; None unless requested."""
    target: Target | None = None
    """Set if the task marks an object."""

    @classmethod
    def from_outlook(
        cls, outlook: Outlook, odometry: NDArray[np.float64], images: Mapping[str, NDArray[Any]], depth: bool
    ) -> Observation:
        """Return an observation whose images are rendered when first read, except those given here.

        Args:
            outlook: renders them at the place of the observation, even after the agent has moved on.
            odometry: float64 [3].
            images: by field name.
            depth: whether the observation has depth.
        """
        observation = object.__new__(cls)
        observation.__dict__.update(images, odometry=odometry, target=None, _outlook=outlook)
        if not depth:
            observation.__dict__["depth"] = None
        return observation

    def __getattr__(self, name: str) -> Any:
        """Render an image on first access; the panorama and its depth are rendered together."""
        outlook = self.__dict__.get("_outlook")
        if outlook is None or name not in ("panorama", "front", "depth"):
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")
        names = ["front"] if name == "front" else [one for one in ("panorama", "depth") if one not in self.__dict__]
        self.__dict__.update(outlook.draw(names))
        return self.__dict__[name]

    def __getstate__(self) -> dict[str, Any]:
        """Return all fields, with images rendered, so that the observation can be copied and sent elsewhere."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def as_dict(self) -> dict[str, Any]:
        """Return the observation as a dict for gymnasium spaces; `depth` only where present.

        If there is a target, its box is drawn in red on the images and given as "panorama_box" and "front_box", float32
        [4], all -1 if no part is visible; the mask is left out.
        """
        views: tuple[Literal["panorama", "front"], ...] = ("panorama", "front")
        values: dict[str, Any] = {name: self.mark_target(name) for name in views}
        values["odometry"] = self.odometry
        if self.depth is not None:
            values["depth"] = self.depth
        if self.target is not None:
            for name in views:
                box = self._find_box(name)
                values[f"{name}_box"] = np.full(4, -1, np.float32) if box is None else np.array(box, np.float32)
        return values

    def mark_target(self, view: Literal["panorama", "front"]) -> NDArray[np.uint8]:
        """Return one of the images, with the target's box drawn in red if there is a target in sight."""
        image: NDArray[np.uint8] = getattr(self, view)
        box = self._find_box(view)
        if box is None:
            return image
        from wiw import annotate

        return annotate.box(image, box, thickness=2, outside=True)

    def _find_box(self, view: Literal["panorama", "front"]) -> Box | None:
        if self.target is None:
            return None
        return self.target.panorama_box if view == "panorama" else self.target.front_box


@dataclass(frozen=True)
class CameraView:
    """A view from one of a manipulator's cameras other than the fixed front one."""

    image: NDArray[np.uint8]
    """uint8 [480, 480, 3]."""
    T_world_camera: NDArray[np.float64]
    """float64 [4, 4]: the camera looks along -z with +y up."""
    depth: NDArray[np.float32] | None = None
    """float32 [480, 480] planar z in metres, 0 where nothing is hit; None unless requested."""


@dataclass(frozen=True)
class ArmObservation:
    """A manipulator's perception; its goals are given in words and its plans are poses."""

    front: NDArray[np.uint8]
    """uint8 [480, 480, 3]: the fixed camera in front of the table."""
    pose: NDArray[np.float64]
    """float64 [7]: the gripper's pose in the world frame; `docs/conventions.md` has axes and units."""
    depth: NDArray[np.float32] | None = None
    """float32 [480, 480] planar z of the front view in metres, 0 where nothing is hit; None unless requested."""
    places: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """float64 [4, 4] by name: the objects' exact poses, which the paper gives to policies that cannot see them
    precisely."""
    wrist: CameraView | None = None
    """The camera on the hand; None unless requested."""

    def as_dict(self) -> dict[str, Any]:
        """Return the observation as a dict for gymnasium spaces; `depth`, `wrist` and `wrist_depth` only where
        present.
        """
        wrist = self.wrist
        more = {
            "depth": self.depth,
            "wrist": None if wrist is None else wrist.image,
            "wrist_depth": None if wrist is None else wrist.depth,
        }
        found = {name: image for name, image in more.items() if image is not None}
        return {"front": self.front, "pose": self.pose, **found}


@dataclass(frozen=True)
class Goal:
    """What the task asks of the agent. `image` is set for image goals, `text` for questions and instructions."""

    task: str
    """The built-in task that it is a goal of; for a task derived from one, that one's name, which prompts go by."""
    image: NDArray[np.uint8] | None = None
    """uint8 [480, 480, 3], HFOV 90 degrees."""
    text: str | None = None
    choices: tuple[str, ...] = ()
    """The possible answers, if the task asks for a choice."""
    question: bool = False
    """Whether `text` is a question to be answered in words (`TextAnswer`)."""
    budget: int | None = None
    """Most primitives of the episode; None where the agent is not told."""
    free_turns: bool = False
    """Whether the turns that a decision's actions begin with do not count towards the budget."""

    @property
    def expects_answer(self) -> bool:
        """Whether the agent must state its belief at every decision."""
        return self.question or bool(self.choices)


@dataclass(frozen=True)
class Wording:
    """The words that reports and views use for a task's episodes."""

    succeeded: str = "succeeded"
    """What a successful episode did, e.g. "reached the goal"."""
    won: str = "succeeded"
    """The same in one word, e.g. "reached"."""
    lost: str = "not succeeded"
    """The outcome of any other episode, e.g. "not reached"."""
    goal: str = "goal"
    """The point to which distances are measured."""
    way: str = "to the goal"
    """The end of an episode's shortest path."""
    asked: str = "The goal"
    """Caption of the goal, e.g. "The goal: find where this was taken"."""
    steps: str = "primitives"
    """Unit in which the length of an episode is counted."""


@dataclass(frozen=True)
class TableSpec:
    """Contents of the tables and plots of a task's runs, besides each arm's metrics."""

    kinds: tuple[str, ...] = ("success",)
    """Metrics shown for each kind of episode, if there are several kinds."""
    judged: tuple[str, ...] = ()
    """Metrics that depend on a judge's marks."""
    cuts: tuple[int, ...] = ()
    """Numbers of primitives at which the anytime curve is read, from metrics such as "score_at_30"; if empty, the curve
    is success over decisions."""
    kind: str = "kind of task"
    """The word for a kind."""


@dataclass(frozen=True)
class Proposal:
    """One candidate plan: primitive ids int8 [K] or gripper poses float64 [K, 7], 1 <= K <= horizon."""

    actions: NDArray[Any]
    prior: float = 0.0
    """The proposing policy's own preference; higher is better."""
    note: str = ""
    text: str = ""
    """The plan in the policy's words, for world models that read text; only for plans of poses."""

    def __post_init__(self) -> None:
        actions = np.asarray(self.actions)
        whole = actions.ndim == 1 and actions.dtype.kind in "biu"
        object.__setattr__(self, "actions", actions.astype(np.int8 if whole else np.float64, copy=False))


@dataclass(frozen=True)
class Control:
    """One row of a world model's batch: one plan in every form, of which the model reads the one it declared.

    Frame 0 is the observation; frame k is what follows action k. Frames 1..`shared` of this row are never read, as an
    earlier row of the batch has the same ones or the policy only reads the ends of plans; a model that computes frames
    one by one may leave them unwritten.
    """

    actions: NDArray[np.int8]
    """int8 [K] primitive ids, padded to the model's frames - 1; null tokens if the plan consists of poses."""
    trajectory: NDArray[np.float64]
    """float64 [K, 3]: x forward, y left, azimuth, in the frame of frame 0."""
    viewpoints: NDArray[np.float64]
    """float64 [K, 4, 4]: T_start_camera after each action; start is the camera of frame 0."""
    text: str = ""
    ids: NDArray[np.generic] | None = None
    """[K] or [K + 1] ids or vectors in the model's own vocabulary (primitive ids by default), with a leading null token
    if it needs one; in space "pose7", float64 [K + 1, 7] gripper poses, or [K + 1, D] in its vocabulary, beginning with
    that of frame 0; None unless the model reads actions."""
    length: int = 0
    """Number of actions in the agent's plan; the rest is padding."""
    shared: int = 0

    @staticmethod
    def of_poses(count: int, text: str = "", ids: NDArray[np.float64] | None = None, shared: int = 0) -> Control:
        """Return a plan of `count` gripper poses without padding: in words, or as poses [count + 1, 7].

        The frames after the first `shared` poses are not read.
        """
        actions = np.zeros(count, np.int8)  # null tokens are 0
        still = np.broadcast_to(np.eye(4), (count, 4, 4))
        return Control(actions, np.zeros((count, 3)), still, text, ids, length=count, shared=shared)


@dataclass(frozen=True)
class History:
    """The observations up to the start of each row's rollout: N frames, oldest first, the last being frame 0.

    The agent observes once per decision, so the frames are those of the decisions so far and a varying number of
    actions apart. If a plan begins with turns, frame 0 is the present observation after these turns, and the frame
    before it is the present observation itself. If a plan is longer than the model's rollout, each further call gets
    the latest frames, including imagined ones, which are one action apart.
    """

    images: NDArray[np.uint8]
    """uint8 [B, N, H, W, 3] in the model's view and size; `images[:, -1]` is `Conditioning.image`."""
    poses: NDArray[np.float64]
    """float64 [B, N, 3]: where each frame was taken, in the frame of frame 0 (x forward, y left, azimuth), so that
    `poses[:, -1]` is 0. In plans of gripper poses [B, N, 7], in the world's frame like `Control.ids`."""
    actions: NDArray[Any]
    """int8 [B, N - 1, L]: the primitives executed between neighbouring frames, padded at the end with null tokens; L is
    the maximum over the batch, at least 1. In plans of gripper poses float64 [B, N - 1, L, 7], padded with the last
    pose."""
    lengths: NDArray[np.int64]
    """int64 [B, N - 1]: how many actions were executed between neighbouring frames; the rest of `actions` is
    padding."""
    count: NDArray[np.int64]
    """int64 [B], from 1 to N: how many of the frames are not padding. If an episode has fewer than N, its first frame
    is repeated in front, with no actions in between."""

    def __len__(self) -> int:
        return len(self.images)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether each frame is not padding, bool [B, N]."""
        most = self.images.shape[1]
        return np.arange(most) >= most - self.count[:, None]

    def rows(self, rows: Sequence[int]) -> History:
        """Return some rows, with only as much action padding as they need."""
        index = np.asarray(rows, np.int64)
        lengths = self.lengths[index]
        longest = max(1, int(lengths.max(initial=0)))
        actions = self.actions[index][:, :, :longest]
        return History(self.images[index], self.poses[index], actions, lengths, self.count[index])

    @staticmethod
    def concatenate(parts: Sequence[History]) -> History:
        """Return the rows of several histories of equal N, with actions padded to the longest."""
        longest = max(part.actions.shape[2] for part in parts)
        return History(
            np.concatenate([part.images for part in parts]),
            np.concatenate([part.poses for part in parts]),
            np.concatenate([_pad_actions(part.actions, longest) for part in parts]),
            np.concatenate([part.lengths for part in parts]),
            np.concatenate([part.count for part in parts]),
        )


def _pad_actions(actions: NDArray[Any], longest: int) -> NDArray[Any]:
    more = longest - actions.shape[2]
    if actions.ndim == 3:
        return np.pad(actions, ((0, 0), (0, 0), (0, more)))  # null tokens are 0
    return np.pad(actions, ((0, 0), (0, 0), (0, more), (0, 0)), mode="edge")


@dataclass(frozen=True)
class Conditioning:
    """Input of a world model, batched over candidates and episodes. Besides `image`, only what `accepts.needs` lists
    is set.
    """

    image: NDArray[np.uint8]
    """uint8 [B, H, W, 3] in the model's view and size."""
    depth: NDArray[np.float32] | None = None
    """float32 [B, H, W], in the model's view and size: planar z in a perspective view, distance in a panorama."""
    semantic: NDArray[np.uint32] | None = None
    """uint32 [B, H, W]: ids of `wiw.perception.semantics.CATEGORIES`."""
    history: History | None = None
    """The latest observations up to this one, with poses and actions between them."""
    simulators: Sequence[Any] | None = None
    """Forks of the environment, one per row; only for `oracle`."""

    def __len__(self) -> int:
        return len(self.image)

    def rows(self, rows: Sequence[int]) -> Conditioning:
        """Return some rows, or the batch itself if these are all of them."""
        if list(rows) == list(range(len(self))):
            return self
        index = list(rows)
        return Conditioning(
            self.image[index],
            depth=None if self.depth is None else self.depth[index],
            semantic=None if self.semantic is None else self.semantic[index],
            history=None if self.history is None else self.history.rows(index),
            simulators=None if self.simulators is None else [self.simulators[row] for row in index],
        )


@dataclass(frozen=True)
class Rollout:
    """The imagined future of one candidate, in the views that the reviser requested."""

    frames: NDArray[np.uint8]
    """uint8 [K, H, W, 3] (or [K, V, H, W, 3] for several views): frame k - 1 is what follows action k."""
    real: NDArray[np.bool_]
    """bool [K]: True if the frame is the real panorama, rotated, rather than imagined."""
    view: str = "front"
    """"front", "surround" or "panorama"; a perspective model always gives "front"."""


@dataclass(frozen=True)
class Fidelity:
    """True views along each plan of a decision. Privileged, like `Truth`."""

    rollouts: tuple[Rollout, ...]
    scores: NDArray[np.float64]
    """float64 [M]: the reviser's scores of the true futures."""
    rank: float
    """Kendall's tau between the scores of imagined and true futures; NaN if either does not distinguish the plans."""
    psnr: NDArray[np.float64]
    """float64 [M] dB: mean over a plan's imagined frames, latitude-weighted for panoramas; NaN without any."""
    ssim: NDArray[np.float64]
    lpips: NDArray[np.float64] | None = None
    """float64 [M]: the same for perspective views, lower is better; None if not measured."""
    pose_errors: NDArray[np.float64] | None = None
    """float64 [M, 2], metres and degrees: distance of the frames' viewpoints from the right ones; None if unknown."""

    def regret(self, chosen: int | None) -> float:
        """Return the best true score minus that of the chosen plan; NaN if the reviser wrote a new plan."""
        return float("nan") if chosen is None else float(self.scores.max() - self.scores[chosen])


@dataclass(frozen=True)
class Exchange:
    """A question to a language model during a decision, and its outcome."""

    purpose: str
    """The purpose of the call, such as "propose/0" or "answer"."""
    model: str
    said: tuple[Mapping[str, Any], ...]
    """Every completion: `call` (the digest of its question), `text`, `finish`, `logprobs`, `prompt_tokens`,
    `completion_tokens`. They suffice to replay a run without the model."""
    result: Mapping[str, Any] = field(default_factory=dict)
    """How it was read: `by` ("logprobs" or "votes"), `mass` of the choices, whether it was `doubtful`, `repaired` or
    `adapted` (keys or values read in another form than they were written in)."""
    problem: str = ""
    """Why the answer could not be used, "<kind>: <detail>"; empty if it could."""
    instead: str = ""
    """The policy's fallback."""


@dataclass(frozen=True)
class Decision:
    """The outcome of one pass of propose, imagine, revise, with all evidence."""

    actions: NDArray[Any]
    """The chosen or newly written plan: int8 [K], or float64 [K, 7] gripper poses."""
    execute: int
    """How many of `actions` are executed before the next decision."""
    proposals: tuple[Proposal, ...]
    rollouts: tuple[Rollout, ...] | None = None
    scores: NDArray[np.float64] | None = None
    chosen: int | None = None
    """Index into `proposals`; None when the reviser wrote a new plan."""
    observation: Observation | ArmObservation | None = None
    goal: Goal | None = None
    key: Key | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time by stage: propose, platform, world_model, cache, revise, environment (execution). Episodes decided in
    one batch share the time equally."""
    calls: Mapping[str, int] = field(default_factory=dict)
    """Requests of this decision, independent of batching: calls of the world model (at most one per level of the
    beam search), and the rows and frames of its rollouts."""
    note: str = ""
    answer: Answer | TextAnswer | None = None
    """The agent's present belief, if the goal has choices or is a question."""
    fidelity: Fidelity | None = None
    """How faithful imagination was, if the run measures it."""
    spent: Mapping[str, float] = field(default_factory=dict)
    """Resources used, an equal share of the batch's: calls of the world model with their rows and frames, retries among
    the calls, cached_rows that needed no call, vlm_tokens; credits of a paid service. A language model adds vlm_calls,
    vlm_cached, vlm_retries, vlm_input_tokens, vlm_output_tokens, vlm_usd if its price is known, and, where there are
    any, the calls without a count of tokens (vlm_uncounted) and of models without a price (vlm_unpriced).
    """
    exchanges: tuple[Exchange, ...] = ()
    """Questions to a language model, and its answers."""
    pictures: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    """Pictures of beliefs, uint8 [H, W, 3] by name (`Policy.draw`); empty if the record keeps no images."""

    def __repr__(self) -> str:
        scores = None if self.scores is None else np.round(self.scores, 3).tolist()
        return (
            f"{type(self).__name__}(actions={np.round(self.actions, 3).tolist()}, execute={self.execute}, "
            f"{len(self.proposals)} proposals, {len(self.rollouts or ())} rollouts, scores={scores}, "
            f"chosen={self.chosen}; wiw.show draws it)"
        )


@dataclass(frozen=True)
class Truth:
    """Privileged state of an episode. It reaches metrics, records and reports, but never a policy or a world model."""

    position: NDArray[np.float64]
    """float64 [3] world metres, on the floor."""
    yaw: float
    distance_to_goal: float
    """Straight-line metres to the goal's position."""
    geodesic_to_goal: float


@dataclass(frozen=True)
class Episode:
    """Start and goal of one episode in one scene, as stored in the episode file."""

    episode_id: str
    scene: str
    """Scene spec of a single scene, e.g. `apartments:val/3` or a path."""
    start_position: tuple[float, float, float]
    start_yaw: float
    """Radians, left positive."""
    goal_position: tuple[float, float, float]
    goal_yaw: float
    geodesic: float
    """Length of the shortest path from start to goal in metres; NaN if an episode file does not give it."""
    info: Mapping[str, Any] = field(default_factory=dict)
    """ImageNav reads "ideal_primitives" (the smallest number of primitives), "radius" (the goal's own, in metres) and
    "goal_image" (the file of a panorama at the goal); "tier" is the tier it was generated for. AR reads "target", an
    instance's id, and "category", what it is. Manipulation reads "task", "seed" and "variation", and gives reports the
    "instruction"."""

    @property
    def kind(self) -> str:
        """The subtask it belongs to, if the task has several; otherwise empty."""
        return str(self.info.get("task", ""))

    @property
    def tier(self) -> str:
        """The tier it was generated for; empty if none."""
        return str(self.info.get("tier", ""))

    @property
    def group(self) -> str:
        """Its kind or tier, which reports show separately; empty if it has neither."""
        return self.kind or self.tier


@dataclass(frozen=True)
class DecisionRecord:
    """One row of the run store: what was decided, and what really happened."""

    episode: int
    """Index in the run's episode list."""
    index: int
    """0 for the first decision of the episode."""
    decision: Decision
    executed: NDArray[Any]
    """The executed part of the plan (less than planned if the episode ended on the way)."""
    before: Truth
    after: Truth
    path: NDArray[np.float64]
    """float64 [len(executed) + 1, 3]: world positions from before the first to after the last primitive."""
    refused: tuple[str, ...] = ()
    """Why gripper motions ended early, one reason for each that did."""
    end: Observation | ArmObservation | None = None
    """The final observation, if the episode ended with this decision."""


@dataclass(frozen=True)
class EpisodeResult:
    """The end of one episode. `status` is "error" if something broke; such an episode is not scored."""

    episode: int
    episode_id: str
    scene: str
    status: Literal["done", "error"]
    metrics: Mapping[str, float] = field(default_factory=dict)
    """ImageNav: success (0 or 1), actions, decisions, travelled, shortest, spl (0..1), distance_to_goal. AR: success,
    actions, decisions, confidence, visible_start, visible_end (0..1), category, predicted (indices of choices). A-EQA:
    see `wiw.tasks.aeqa.AEQA.measure`."""
    seconds: float = 0.0
    error: str = ""
    """Traceback."""
    kind: str = ""
    """The part that failed: "environment", "agent", "worker" (its process died), "world_model/" and a
    `RolloutError.kind`, "vlm/" and a `VlmError.kind`, or "judge/" and a `JudgeError.kind`."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """Facts about the episode other than numbers, as JSON. A-EQA: "answer" and its "judgement"."""
