# SPDX-License-Identifier: Apache-2.0
"""The values that travel through the closed loop. All are frozen; arrays follow `docs/conventions.md`."""

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
    """Names one decision for all randomness: results are functions of it, never of batch size or worker count."""

    seed: int
    episode: int
    decision: int = 0

    def at(self, decision: int) -> Key:
        """Return the key of another decision of the same episode."""
        return Key(self.seed, self.episode, decision)


def check_seed(seed: Any) -> int:
    """Return a seed as it is, once it is checked.

    Raises:
        ArgumentError: it is no whole number from 0 to 2**64 - 1.
    """
    if not isinstance(seed, int | np.integer) or not 0 <= seed < 2**64:
        raise ArgumentError(f"seed: expected a whole number from 0 to 2**64 - 1, got {seed!r}")
    return int(seed)


Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels, 0 at the left (upper) edge of the first pixel; left > right: across the seam."""


@dataclass(frozen=True)
class Target:
    """The one thing in view that a task is about, as a red box would point it out; nothing says what it is."""

    mask: NDArray[np.bool_]
    """bool [576, 1024]: its visible pixels in the panorama."""
    panorama_box: Box | None
    """Around the mask; None where nothing of it is visible."""
    front_box: Box | None
    """Around its visible pixels in the front view."""


@dataclass(frozen=True)
class Answer:
    """What an agent believes at a decision: a distribution over the goal's choices."""

    choices: tuple[str, ...]
    probabilities: NDArray[np.float64]
    """float64 [len(choices)], sum 1."""
    raw: NDArray[np.float64] | None = None
    """float64 [len(choices)], sum at most 1: the probabilities as a language model gave them, before they were made to
    sum to 1; None where nothing was left out."""

    @property
    def label(self) -> str:
        """The likeliest choice."""
        return self.choices[int(np.argmax(self.probabilities))]

    @property
    def confidence(self) -> float:
        """Its probability, the raw one where it is known: what is left out counts against an answer."""
        given = self.probabilities if self.raw is None else self.raw
        return float(given[int(np.argmax(self.probabilities))])


@dataclass(frozen=True)
class TextAnswer:
    """An agent's belief at a decision, in words, where the goal is a question."""

    text: str = ""
    """Empty while the agent believes nothing."""
    confidence: float = 0.0
    """From 0 to 1."""
    final: bool = False
    """Whether the agent gives this as its answer; the task's rules say when that ends the episode."""


class Outlook(Protocol):
    """The view from one place, to be drawn when somebody looks."""

    def draw(self, outputs: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return images by name: "panorama", "front", "depth"; see `Observation`."""


@dataclass(frozen=True)
class Observation:
    """What the agent perceives: images, odometry since the episode's start, and depth where the run grants it.

    Nothing here tells where in the scene the agent is: poses are relative to the first observation of the episode.
    """

    panorama: NDArray[np.uint8]
    """uint8 [576, 1024, 3] equirectangular."""
    front: NDArray[np.uint8]
    """uint8 [480, 480, 3], HFOV 90 degrees."""
    odometry: NDArray[np.float64]
    """float64 [3]: x forward and y left in metres, azimuth in radians (left positive), in the frame of the start."""
    depth: NDArray[np.float32] | None = field(default_factory=lambda: None)
    """float32 [576, 1024] distance along the ray in metres, 0 where nothing is hit; None unless asked for."""
    target: Target | None = None
    """Where the task points something out."""

    @classmethod
    def from_outlook(
        cls, outlook: Outlook, odometry: NDArray[np.float64], images: Mapping[str, NDArray[Any]], depth: bool
    ) -> Observation:
        """Return an observation whose images are drawn when they are first read, but for those that are given.

        Args:
            outlook: that draws them, of the place of the observation, wherever the agent goes.
            odometry: float64 [3].
            images: by the names of fields.
            depth: whether the observation has depth.
        """
        observation = object.__new__(cls)
        observation.__dict__.update(images, odometry=odometry, target=None, _outlook=outlook)
        if not depth:
            observation.__dict__["depth"] = None
        return observation

    def __getattr__(self, name: str) -> Any:
        """Draw an image that has not been read before; the panorama and its depth are drawn at once."""
        outlook = self.__dict__.get("_outlook")
        if outlook is None or name not in ("panorama", "front", "depth"):
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")
        names = ["front"] if name == "front" else [one for one in ("panorama", "depth") if one not in self.__dict__]
        self.__dict__.update(outlook.draw(names))
        return self.__dict__[name]

    def __getstate__(self) -> dict[str, Any]:
        """Return all fields, drawn: what can be copied and sent elsewhere."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def as_dict(self) -> dict[str, Any]:
        """Return the observation as gymnasium spaces see it; `depth` only where present.

        Where something is pointed out, its box is drawn in red on the images and given as "panorama_box" and
        "front_box", float32 [4], all -1 where nothing of it is visible; the mask is left out.
        """
        values: dict[str, Any] = {"panorama": self.panorama, "front": self.front, "odometry": self.odometry}
        if self.depth is not None:
            values["depth"] = self.depth
        return values if self.target is None else {**values, **_draw_boxes(self, self.target)}


def _draw_boxes(observation: Observation, target: Target) -> dict[str, Any]:
    """Return images with the target's box drawn, and the boxes."""
    from wiw import annotate

    values: dict[str, Any] = {}
    for name, image, box in (
        ("panorama", observation.panorama, target.panorama_box),
        ("front", observation.front, target.front_box),
    ):
        values[name] = image if box is None else annotate.box(image, box, thickness=2, outside=True)
        values[f"{name}_box"] = np.full(4, -1, np.float32) if box is None else np.array(box, np.float32)
    return values


@dataclass(frozen=True)
class CameraView:
    """A view by a manipulator's camera other than the fixed front one."""

    image: NDArray[np.uint8]
    """uint8 [480, 480, 3]."""
    T_world_camera: NDArray[np.float64]
    """float64 [4, 4]: the camera looks along -z with +y up."""
    depth: NDArray[np.float32] | None = None
    """float32 [480, 480] planar z in metres, 0 where nothing is hit; None unless asked for."""


@dataclass(frozen=True)
class ArmObservation:
    """What a manipulator perceives; its goals are in words and its plans are poses."""

    front: NDArray[np.uint8]
    """uint8 [480, 480, 3]: the fixed camera in front of the table."""
    pose: NDArray[np.float64]
    """float64 [7]: of the gripper, in the world's frame; `docs/conventions.md` has axes and units."""
    depth: NDArray[np.float32] | None = None
    """float32 [480, 480] planar z in metres of the front view, 0 where nothing is hit; None unless asked for."""
    places: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """float64 [4, 4] by name: the objects' exact poses, which the paper gives policies that cannot see them so well."""
    wrist: CameraView | None = None
    """The camera on the hand; None unless asked for."""

    def as_dict(self) -> dict[str, Any]:
        """Return the observation as gymnasium spaces see it; `depth`, `wrist` and `wrist_depth` only where present."""
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
    image: NDArray[np.uint8] | None = None
    """uint8 [480, 480, 3], HFOV 90 degrees."""
    text: str | None = None
    choices: tuple[str, ...] = ()
    """What an answer is chosen from, where the task asks for one."""
    question: bool = False
    """Whether `text` is a question that is answered in words (`TextAnswer`)."""

    @property
    def expects_answer(self) -> bool:
        """Whether the agent says at every decision what it believes."""
        return self.question or bool(self.choices)


@dataclass(frozen=True)
class Wording:
    """How reports and views speak of a task's episodes."""

    succeeded: str = "succeeded"
    """What a successful episode did, e.g. "reached the goal"."""
    won: str = "succeeded"
    """The same in a word, e.g. "reached"."""
    lost: str = "not succeeded"
    """Any other episode, e.g. "not reached"."""
    goal: str = "goal"
    """What distances end at."""
    way: str = "to the goal"
    """Where an episode's shortest way leads."""
    asked: str = "The goal"
    """Over what the agent is shown, e.g. "The goal: find where this was taken"."""
    steps: str = "primitives"
    """What the length of an episode counts."""


@dataclass(frozen=True)
class TableSpec:
    """Contents of the tables and plots of a task's runs, beside the metrics of each arm."""

    kinds: tuple[str, ...] = ("success",)
    """Metrics that are shown for each kind of episode, where there are several."""
    judged: tuple[str, ...] = ()
    """Metrics that depend on a judge's marks."""
    cuts: tuple[int, ...] = ()
    """Primitives at which the anytime curve is read, from the metrics "score_at_30" and so on; without any, it is that
    of success over decisions."""
    kind: str = "kind of task"
    """Word for a kind."""


@dataclass(frozen=True)
class Proposal:
    """One candidate plan: primitive ids int8 [K] or gripper poses float64 [K, 7], 1 <= K <= horizon."""

    actions: NDArray[Any]
    prior: float = 0.0
    """The proposing policy's own preference; higher is better."""
    note: str = ""
    text: str = ""
    """The plan in the policy's words, for world models that read text; only of plans made of poses."""

    def __post_init__(self) -> None:
        actions = np.asarray(self.actions)
        whole = actions.ndim == 1 and actions.dtype.kind in "biu"
        object.__setattr__(self, "actions", actions.astype(np.int8 if whole else np.float64, copy=False))


@dataclass(frozen=True)
class Control:
    """One row of a world model's batch: the same plan in every form, of which the model reads what it declared.

    Frame 0 is the observation; frame k is what follows action k. Frames 1..`shared` of this row are answered by an
    earlier row of the batch, or the policy reads only ends; they are never read, so a model that computes frames one by
    one may leave them unwritten.
    """

    actions: NDArray[np.int8]
    """int8 [K] primitive ids, padded to the model's frames - 1; null tokens where the plan is made of poses."""
    trajectory: NDArray[np.float64]
    """float64 [K, 3]: x forward, y left, azimuth, in the frame of frame 0."""
    viewpoints: NDArray[np.float64]
    """float64 [K, 4, 4]: T_start_camera after each action; start is the camera of frame 0."""
    text: str = ""
    ids: NDArray[np.generic] | None = None
    """[K] or [K + 1] ids or vectors in the model's own vocabulary (else primitive ids), null token in front where it
    needs one; float64 [K + 1, 7] gripper poses in space "pose7", that of frame 0 in front; None unless the model reads
    actions."""
    length: int = 0
    """Actions that are the agent's own; the rest is padding."""
    shared: int = 0

    @staticmethod
    def of_poses(count: int, text: str = "", ids: NDArray[np.float64] | None = None) -> Control:
        """Return a plan of `count` gripper poses, all the agent's own: in words, or as poses [count + 1, 7]."""
        actions = np.zeros(count, np.int8)  # null tokens are 0
        still = np.broadcast_to(np.eye(4), (count, 4, 4))
        return Control(actions, np.zeros((count, 3)), still, text, ids, length=count)


@dataclass(frozen=True)
class History:
    """Observations before each row's rollout begins: N frames, oldest first, of which the last is frame 0.

    The frames are those of the decisions so far, as the agent observes once per decision, and so a varying number of
    actions apart. Where a plan begins with turns, frame 0 is the present observation after them, and the present
    observation itself is the frame before. Where a plan is longer than the model's rollout, each further call is shown
    the latest frames of all, one action apart where they are imagined.
    """

    images: NDArray[np.uint8]
    """uint8 [B, N, H, W, 3] in the model's view and size; `images[:, -1]` is `Conditioning.image`."""
    poses: NDArray[np.float64]
    """float64 [B, N, 3]: where each frame was taken, in the frame of frame 0 (x forward, y left, azimuth), so that
    `poses[:, -1]` is 0. In plans of gripper poses [B, N, 7], in the world's frame like `Control.ids`."""
    actions: NDArray[Any]
    """int8 [B, N - 1, L]: the primitives carried out between neighbours, padded at the end with null tokens, L being
    the most in the batch, at least 1. In plans of gripper poses float64 [B, N - 1, L, 7], padded with the last pose."""
    lengths: NDArray[np.int64]
    """int64 [B, N - 1]: how many actions were carried out between neighbours; the rest of `actions` is padding."""
    count: NDArray[np.int64]
    """int64 [B], from 1 to N: how many of the frames are not padding. Where an episode has fewer, its first one is
    repeated in front, with no action between the copies."""

    def __len__(self) -> int:
        return len(self.images)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether each frame is none of the padding, bool [B, N]."""
        most = self.images.shape[1]
        return np.arange(most) >= most - self.count[:, None]

    def rows(self, rows: Sequence[int]) -> History:
        """Return some rows, with no more padding of actions than they need."""
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
    """What a world model sees, batched over candidates and episodes. Only what `accepts.needs` names is set."""

    image: NDArray[np.uint8]
    """uint8 [B, H, W, 3] in the model's view and size."""
    depth: NDArray[np.float32] | None = None
    """float32 [B, H, W], in the model's view and size: planar z in a perspective view, distance in a panorama."""
    semantic: NDArray[np.uint32] | None = None
    """uint32 [B, H, W]: ids of `wiw.perception.semantics.CATEGORIES`."""
    history: History | None = None
    """The latest observations up to this one, with poses and actions between them."""
    simulators: Sequence[Any] | None = None
    """Forks of the environment, one a row; given to `oracle` alone."""

    def __len__(self) -> int:
        return len(self.image)

    def rows(self, rows: Sequence[int]) -> Conditioning:
        """Return some rows; the batch itself where it is all of them."""
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
    """Imagined future of one candidate, in the views that the revising policy asked for."""

    frames: NDArray[np.uint8]
    """uint8 [K, H, W, 3] (or [K, V, H, W, 3] for several views): frame k - 1 is what follows action k."""
    real: NDArray[np.bool_]
    """bool [K]: True where the frame is the real panorama turned, not imagination."""
    view: str = "front"
    """"front", "surround" or "panorama"; a perspective model gives "front" whatever was asked."""


@dataclass(frozen=True)
class Fidelity:
    """What would really have been seen along each plan of a decision. Privileged, as `Truth` is."""

    rollouts: tuple[Rollout, ...]
    scores: NDArray[np.float64]
    """float64 [M]: what the reviser gives the true futures."""
    rank: float
    """Kendall's tau between scores of imagined and of true futures, NaN where either tells no plans apart."""
    psnr: NDArray[np.float64]
    """float64 [M] dB: mean over a plan's imagined frames, latitude-weighted for panoramas; NaN without any."""
    ssim: NDArray[np.float64]
    lpips: NDArray[np.float64] | None = None
    """float64 [M]: the same of perspective views, lower is truer; None where it is not measured."""
    pose_errors: NDArray[np.float64] | None = None
    """float64 [M, 2], metres and degrees: how far from their places the frames were taken; None where nobody knows."""

    def regret(self, chosen: int | None) -> float:
        """Return how much less than the best the chosen plan scores in truth; NaN for a plan made anew."""
        return float("nan") if chosen is None else float(self.scores.max() - self.scores[chosen])


@dataclass(frozen=True)
class Exchange:
    """A question to a language model during a decision, and its outcome."""

    purpose: str
    """What the policy wanted, such as "propose/0" or "answer"."""
    model: str
    said: tuple[Mapping[str, Any], ...]
    """Every completion: `call` (its question's name), `text`, `finish`, `logprobs`, `prompt_tokens`,
    `completion_tokens`. With these a run can be replayed without the model."""
    result: Mapping[str, Any] = field(default_factory=dict)
    """How it was read: `by` ("logprobs" or "votes"), `mass` of the choices, whether it was `repaired`."""
    problem: str = ""
    """Why the answer could not be used, "<kind>: <detail>"; empty where it could."""
    instead: str = ""
    """What the policy did instead."""


@dataclass(frozen=True)
class Decision:
    """The outcome of one pass through propose, imagine, revise, with all evidence kept."""

    actions: NDArray[Any]
    """The plan that was chosen or written anew: int8 [K], or float64 [K, 7] gripper poses."""
    execute: int
    """How many of `actions` are carried out before the next decision."""
    proposals: tuple[Proposal, ...]
    rollouts: tuple[Rollout, ...] | None = None
    scores: NDArray[np.float64] | None = None
    chosen: int | None = None
    """Index into `proposals`; None when the reviser wrote a new plan."""
    observation: Observation | ArmObservation | None = None
    goal: Goal | None = None
    key: Key | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time by stage: propose, platform, world_model, cache, revise, environment (carrying it out). Episodes that
    were decided for at once share the time equally."""
    calls: Mapping[str, int] = field(default_factory=dict)
    """What this decision asked for, a function of the decision alone: consultations of the world model (0 or 1, one a
    level of the beam search), and the rows and frames of its rollouts."""
    note: str = ""
    answer: Answer | TextAnswer | None = None
    """What the agent believes now, where the goal has choices or is a question."""
    fidelity: Fidelity | None = None
    """How true imagination was, where the run measures it."""
    spent: Mapping[str, float] = field(default_factory=dict)
    """What answering took, an equal share of the batch's: calls of the world model with their rows and frames, retries
    among the calls, cached_rows that needed none, vlm_tokens; credits where a paid service imagines. A language model
    adds vlm_calls, vlm_cached, vlm_retries, vlm_input_tokens, vlm_output_tokens, and vlm_usd where its price is known.
    """
    exchanges: tuple[Exchange, ...] = ()
    """What a language model was asked, and what it said."""
    pictures: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    """What the policies believe, uint8 [H, W, 3] by name (`Policy.draw`); empty where the record keeps no pictures."""


@dataclass(frozen=True)
class Truth:
    """Privileged state of an episode. It reaches metrics, records and reports, never a policy or a world model."""

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
    """Shortest path from start to goal in metres; NaN where an episode file does not give it."""
    info: Mapping[str, Any] = field(default_factory=dict)
    """ImageNav reads "ideal_primitives", the least number of primitives, "radius", the goal's own in metres, and
    "goal_image", the file of a panorama at the goal; "tier" is the tier that it was generated for.
    AR reads "target", an instance's id, and "category", what it is. Manipulation reads "task", "seed" and
    "variation", and tells reports the "instruction"."""

    @property
    def kind(self) -> str:
        """Which of several tasks in one it is of; empty where there is one."""
        return str(self.info.get("task", ""))

    @property
    def tier(self) -> str:
        """The tier that it was generated for; empty for none."""
        return str(self.info.get("tier", ""))

    @property
    def group(self) -> str:
        """Its kind or tier, which reports show apart; empty for neither."""
        return self.kind or self.tier


@dataclass(frozen=True)
class DecisionRecord:
    """One row of the run store: what was decided, and what truly happened."""

    episode: int
    """Index in the run's episode list."""
    index: int
    """0 for the first decision of the episode."""
    decision: Decision
    executed: NDArray[Any]
    """What was carried out of the plan (less than planned when the episode ended on the way)."""
    before: Truth
    after: Truth
    path: NDArray[np.float64]
    """float64 [len(executed) + 1, 3]: world positions from before the first to after the last primitive."""
    refused: tuple[str, ...] = ()
    """Why ways of a gripper were not gone to their ends, one for each that was not."""
    end: Observation | ArmObservation | None = None
    """What is seen when the episode has ended with this decision."""


@dataclass(frozen=True)
class EpisodeResult:
    """The end of one episode. `status` is "error" where something broke; it then counts in no score."""

    episode: int
    episode_id: str
    scene: str
    status: Literal["done", "error"]
    metrics: Mapping[str, float] = field(default_factory=dict)
    """ImageNav: success (0 or 1), actions, decisions, travelled, shortest, spl (0..1), distance_to_goal.
    AR: success, actions, decisions, confidence, visible_start, visible_end (0..1), category, predicted (numbers of
    choices). A-EQA: see `wiw.tasks.aeqa.AEQA.measure`."""
    seconds: float = 0.0
    error: str = ""
    """Traceback."""
    kind: str = ""
    """What failed: "environment", "agent", "worker" (its process died), "world_model/" and a `RolloutError.kind`,
    "vlm/" and a `VlmError.kind`, or "judge/" and a `JudgeError.kind`."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """Facts about the episode besides numbers, JSON-able. A-EQA: "answer" and its "judgement"."""
