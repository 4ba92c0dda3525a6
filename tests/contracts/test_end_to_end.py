# SPDX-License-Identifier: Apache-2.0
"""The tasks from end to end, with every registered world model: a vision-language model behind a server writes plans,
looks at what the world model imagines of them, answers and decides."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pydantic")
pytest.importorskip("openai")
pytest.importorskip("json_repair")

import question_file
import wiw
from recognition_file import CHOICES, a_file
from wiw import panorama
from wiw.errors import ArgumentError
from wiw.mapping.views import HFOV_DEG, SIZE, VIEW_YAWS_DEG
from wiw.policies.vlm.prompt_images import VIEW
from wiw.runs.recipes import AgentRecipe
from wiw.serving.background import serve_in_background
from wiw.serving.vlm_server import VlmServer
from wiw.vlm.messages import Call
from wiw.vlm.mock import MockClient

NAMES = wiw.registry.list_world_models()
TASKS = ("imagenav", "ar")
PLANS = (["forward", "turn_left"], ["turn_left", "forward"])
POSES = ([[50, 40, 40, 0, 60, 60, 1], [50, 40, 30, 0, 60, 60, 0]], [[50, 60, 40, 0, 60, 60, 1]])
MOVES_A_CAMERA = ("warp", "sana-wm", "nwm", "pathdreamer", "se3ds", "warpnet", "pocket", "remote:")
"""World models that know nothing of poses of a gripper."""
MOVES_AN_ARM = ("armnet",)
"""World models that know nothing else."""


def script(call: Call) -> Any:
    """The same two plans at every decision, and a doubtful liking for whatever comes first."""
    if call.schema is None:
        return {label: 0.5 / 2**k for k, label in enumerate(call.labels)}
    if call.schema["title"] in ("Command", "Commands", "Walk"):
        return json.dumps(_at_a_question(call.schema))
    plans = (
        [_at_the_table(plan) for plan in POSES]
        if "Step" in call.schema.get("$defs", {})
        else [_in_a_home(plan) for plan in PLANS]
    )
    return json.dumps({"plans": plans} if "plans" in call.schema["properties"] else plans[0])


def _in_a_home(plan: list[str]) -> Any:
    return {"reason": "free floor", "actions": plan}


def _at_a_question(schema: Any) -> Any:
    if schema["title"] == "Walk":
        return {"reason": "free floor", "actions": [{"action": "forward", "times": 2}]}
    plans = [
        {"reason": "free floor", "action_plan": "Go on.", "chosen_view": view, "chosen_landmark": mark}
        for view, mark in (("front", 1), ("right", None), ("back", None))
    ]
    return {"plans": [{**plan, "answer": None} for plan in plans]} if schema["title"] == "Commands" else plans[1]


def _at_the_table(plan: list[list[int]]) -> Any:
    return {
        "visual_state_description": "a block",
        "reasoning_and_reflection": "it is there",
        "language_plan": f"Go to it in {len(plan)} steps.",
        "executable_plan": [{"action": action} for action in plan],
    }


@pytest.fixture(scope="module")
def server() -> Iterator[VlmServer]:
    with VlmServer(MockClient(script, model="scripted")) as server:
        yield server


@pytest.fixture
def options(two_rooms: str, tmp_path: Path) -> Callable[[str], dict[str, Any]]:
    """What a task is made with: two decisions in the two rooms, or at a table."""
    return lambda task: (
        {"tasks": "slide_block", "actions": 4}
        if task == "manipulation"
        else {
            "decisions": 2,
            **({"episode_file": a_file(tmp_path, two_rooms)} if task == "ar" else {"scenes": two_rooms}),
        }
    )


@pytest.fixture
def run(server: VlmServer, options: Any, tmp_path: Path) -> Callable[[str, Any], Any]:
    """One episode of a task with a world model."""

    def run(task: str, model: Any) -> Any:
        server.client.calls.clear()
        space = "pose7" if task == "manipulation" else "discrete"
        asked: Any = {"model": "scripted", "dialect": "vllm", "proposals": "listed", "cache": "off"}
        if task == "ar":
            asked["tracker"] = "reprojection"  # frames of models here show nothing that could be followed
        policy = wiw.policy("vlm", vlm=server.url, space=space, **asked)
        labels = "simulator" if model is not None and "semantic" in model.accepts.needs else None
        agent = AgentRecipe(policy, model, semantics=labels, candidates=2, horizon=2)
        how: Any = {"progress": False, "keep_images": 0, "cache": "off"}
        return wiw.evaluate(task, agent, 1, seed=0, out=tmp_path / "run", **how, **options(task))

    return run


@pytest.fixture
def made(world_model_options: Any) -> Iterator[Callable[..., Any]]:
    """A world model by its registered name; one that is elsewhere is served."""
    with ExitStack() as stack:

        def make(name: str, kind: str = "discrete") -> Any:
            if name == "remote:":
                return wiw.world_model(name + stack.enter_context(serve_in_background("copy")).address)
            return wiw.world_model(name, **({} if name == "none" else world_model_options(name, kind)))

        yield make


def pictures(call: Call) -> list[tuple[str, Any]]:
    """What a question shows, each picture with the words before it."""
    parts = [part for message in call.messages for part in message.content]
    return [(before, part) for before, part in pairwise(parts) if not isinstance(part, str)]


def strips(call: Call) -> list[Any]:
    """The pictures under the plans' names."""
    return [picture for caption, picture in pictures(call) if str(caption).startswith("Plan ")]


def views(strip: Any) -> list[Any]:
    """The pictures side by side in a strip, below their titles."""
    count = strip.shape[1] // VIEW
    left = [k * (strip.shape[1] - VIEW) // max(1, count - 1) for k in range(count)]
    return [strip[-VIEW:, x : x + VIEW] for x in left]


OF_EVERY_KIND = ("none", "copy", "oracle", "remote:", "armnet", "wan2.1", "svd-action")
"""World models with which all tasks are run for every change; with the others recognition alone is."""


def nightly_unless(condition: bool) -> list[pytest.MarkDecorator]:
    return [] if condition else [pytest.mark.nightly]


@pytest.mark.parametrize(
    ("name", "task"),
    [
        pytest.param(name, task, marks=nightly_unless(task == "ar" or name in OF_EVERY_KIND))
        for name in NAMES
        for task in TASKS
    ],
)
def test_an_episode_with_every_world_model(name: str, task: str, run: Any, made: Any, server: VlmServer) -> None:
    if name in MOVES_AN_ARM:
        with pytest.raises(ArgumentError, match="discrete primitives"):
            run(task, made(name))
        return
    log = run(task, made(name))
    (episode,) = log.episodes
    assert episode["status"] == "done", episode["error"]
    decisions = list(log.store.decisions(episode["arm"]))
    assert len(decisions) == 2 and all(row["exchanges"] for row in decisions)
    shown = [strips(call) for call in server.client.calls if strips(call)]
    if name == "none":
        assert not shown
        return
    assert all(row["calls"]["rows"] >= 2 for row in decisions), "two plans with a step ahead each"
    assert [len(call) for call in shown] == [2] * len(decisions)
    for strip in (strip for call in shown for strip in call):
        assert [np.ptp(view) > 0 for view in views(strip)] == [True, True]


@pytest.mark.parametrize("name", [pytest.param(name, marks=nightly_unless(name in OF_EVERY_KIND)) for name in NAMES])
def test_an_arm_with_every_world_model(name: str, run: Any, made: Any, server: VlmServer) -> None:
    model = made(name, "pose7")
    if name in MOVES_A_CAMERA:
        with pytest.raises(ArgumentError, match=r"poses of a gripper|imagines panoramas"):
            run("manipulation", model)
        return
    log = run("manipulation", model)
    (episode,) = log.episodes
    assert episode["status"] == "done", episode["error"]
    decisions = list(log.store.decisions(episode["arm"]))
    assert len(decisions) == 2 and all(row["exchanges"] for row in decisions)
    shown = [strips(call) for call in server.client.calls if strips(call)]
    assert [len(call) for call in shown] == ([] if name == "none" else [2, 2])
    for strip, plan in ((strip, plan) for call in shown for strip, plan in zip(call, POSES, strict=True)):
        assert strip.shape[1] // VIEW == len(plan)
        assert all(np.ptp(view) > 0 for view in ([strip] if len(plan) == 1 else views(strip)))


def colours(rays: Any) -> Any:
    """Directions as colours: right, up and back from dark to bright."""
    return np.rint(127.5 + 127.5 * rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.uint8)


def front_rays(size: tuple[int, int]) -> Any:
    """Of the pixels of a front view, 90 degrees wide."""
    (height, width), focal = size, size[1] / 2
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, height / 2 - np.arange(height) - 0.5)
    return np.stack([x, y, np.full_like(x, -focal)], -1)


class Compass(wiw.WorldModel):
    """Remembers what it is handed; in the frames that it imagines colours tell where the camera looks."""

    accepts = wiw.accepts("trajectory")

    def __init__(self, view: str, size: tuple[int, int] | None, needs: tuple[str, ...]) -> None:
        self.accepts = wiw.accepts("trajectory", view, size, needs=needs)  # type: ignore[arg-type]
        self.handed: list[tuple[Any, ...]] = []
        """Of each row the control, the image, and depth and labels or None."""

    def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
        nothing = [None] * len(controls)
        depth = nothing if observations.depth is None else observations.depth
        labels = nothing if observations.semantic is None else observations.semantic
        self.handed += zip(controls, observations.image, depth, labels, strict=True)
        size = self.accepts.size
        picture = colours(front_rays(size) if self.accepts.view == "perspective" else panorama.directions(size))
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, axis=1)
        frames[:, 1:] = picture
        return frames


KINDS = [
    ("perspective", None, ()),
    ("perspective", None, ("depth",)),
    ("perspective", (272, 480), ()),
    ("panorama", None, ()),
    pytest.param(("panorama", None, ("depth",)), marks=pytest.mark.nightly),
    ("panorama", None, ("depth", "semantic")),
]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_every_kind_is_handed_its_views_and_its_own_become_the_tasks(
    kind: Any, task: str, run: Any, options: Any, server: VlmServer
) -> None:
    model = Compass(*kind)
    (episode,) = run(task, model).episodes
    assert episode["status"] == "done", episode["error"]
    made = wiw.registry.TASKS.make(task, **options(task))
    env = made.environment(depth=True)
    env.begin(made.episode(0))
    rows = {row[0].length: row for row in model.handed[:2]}
    assert rows.keys() == {2, 1}, "the turn that the second plan begins with is real"
    for row, turn in ((rows[2], 0), (rows[1], 22.5)):
        check_handed(row, turn, env, model.accepts)
    for call in filter(strips, server.client.calls):
        ahead, turned = map(views, strips(call))
        for view in (*ahead, turned[1]):
            check_front(view, model.accepts)
    if task == "ar" and kind[0] == "panorama":
        answering = next(call for call in server.client.calls if len(call.labels) == len(CHOICES))
        check_target(views(pictures(answering)[2][1]), rows[2][0], made.episode(0))


def check_handed(row: Any, turn: float, env: Any, accepts: Any) -> None:
    """The real view after a turn, and depth and labels where they are declared."""
    size, real = accepts.size, env.observation
    if accepts.view == "panorama":
        assert size == (576, 1024)
        image, depth = panorama.rotate(real.panorama, turn), panorama.rotate(real.depth, turn, "nearest")
    else:
        image = panorama.to_perspective(real.panorama, 90, size, turn)
        depth = panorama.distance_to_planar(panorama.to_perspective(real.depth, 90, size, turn, 0, "nearest"), 90)
        if size == (480, 480) and not turn:
            assert np.abs(image.astype(int) - real.front).mean() < 3, "what the agent sees, but for sharpness"
    np.testing.assert_array_equal(row[1], image)
    assert (row[2] is None) == ("depth" not in accepts.needs)
    if row[2] is not None:
        np.testing.assert_allclose(row[2], depth, rtol=1e-5)
    assert (row[3] is None) == ("semantic" not in accepts.needs)
    if row[3] is not None:
        np.testing.assert_array_equal(row[3], panorama.rotate(env.semantic(), turn, "nearest"))
        assert len(np.unique(row[3])) > 1


def check_front(view: Any, accepts: Any) -> None:
    """The directions of the front view, as far as the model's frames reach; the target's box hides some."""
    rays = front_rays((VIEW, VIEW))
    wanted = colours(rays).astype(int)
    if accepts.view == "perspective":
        up = np.abs(rays[..., 1] / rays[..., 2]) * accepts.size[1] / accepts.size[0]
        wanted[up > 1] = 0
        edge = np.abs(up - 1) < 0.02
    else:
        edge = np.zeros(view.shape[:2], bool)
    wrong = (np.abs(view - wanted).max(-1) > 3) & ~edge
    assert wrong.mean() < 0.03


def check_target(shown: Any, control: Any, episode: Any) -> None:
    """Views of imagined panoramas that look at the target, seen 1 m above the floor from the start of the episode."""
    there = np.array([*(np.array(episode.goal_position) - episode.start_position - [0, 1, 0]), 1])
    assert episode.start_yaw == 0 and len(shown) == control.length == 2
    for view, pose in zip(shown, control.viewpoints, strict=False):
        direction = (np.linalg.inv(pose) @ there)[:3]
        looked = view[VIEW // 2 - 1 : VIEW // 2 + 1, VIEW // 2 - 1 : VIEW // 2 + 1].mean((0, 1)) - 127.5
        cosine = direction @ looked / np.linalg.norm(direction) / np.linalg.norm(looked)
        assert np.degrees(np.arccos(cosine)) < 6


@pytest.mark.parametrize("kind", [None, *KINDS], ids=str)
def test_questions_with_every_kind(kind: Any, server: VlmServer, two_rooms: str, tmp_path: Path) -> None:
    """Three commands: to the table ahead, into the view on the right, and into the one behind."""
    server.client.calls.clear()
    model = None if kind is None else Compass(*kind)
    asked: Any = {"model": "scripted", "dialect": "vllm", "proposals": "listed", "cache": "off"}
    policy = wiw.policy("vlm", task="aeqa", vlm=server.url, perception=question_file.ByColor(), **asked)
    labels = "simulator" if model is not None and "semantic" in model.accepts.needs else None
    how: Any = {"progress": False, "keep_images": 0, "cache": "off", "actions": 8}
    file = question_file.a_file(tmp_path, two_rooms)
    log = wiw.evaluate(
        "aeqa", AgentRecipe(policy, model, semantics=labels), 1, seed=0, out=tmp_path / "run", episode_file=file, **how
    )
    (episode,) = log.episodes
    assert episode["status"] == "done", episode["error"]
    decisions = list(log.store.decisions(episode["arm"]))
    assert decisions and all(row["exchanges"] for row in decisions)
    if model is None:
        assert not any(strips(call) for call in server.client.calls)
        return
    made = wiw.registry.TASKS.make("aeqa", episode_file=file)
    env = made.environment(depth=True)
    env.begin(made.episode(0))
    first = model.handed[: len(model.handed) // len(decisions)]
    assert len(first) == 3 and [row[0].length for row in first[1:]] == [2, 2]
    for row, turn in zip(first[1:], (-90.0, 180.0), strict=True):
        check_handed(row, turn, env, model.accepts)
    for call in filter(strips, server.client.calls):
        assert len(strips(call)) == 3
        for end in strips(call):
            check_end(end, model.accepts)


def check_end(end: Any, accepts: Any) -> None:
    """Check the view at the end of a plan: the front view that was imagined, or four views around."""
    if accepts.view == "perspective":
        assert end.shape[1] == VIEW
        check_front(end[-VIEW:], accepts)
        return
    height, width = SIZE
    focal = width / 2 / np.tan(np.radians(HFOV_DEG) / 2)
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, height / 2 - np.arange(height) - 0.5)
    for number, yaw in enumerate(np.radians(VIEW_YAWS_DEG)):
        turned = np.stack([np.cos(yaw) * x - np.sin(yaw) * focal, y, -np.sin(yaw) * x - np.cos(yaw) * focal], -1)
        left = number * (end.shape[1] - width) // 3
        wrong = np.abs(end[-height:, left : left + width].astype(int) - colours(turned)).max(-1) > 4
        assert wrong.mean() < 0.02
