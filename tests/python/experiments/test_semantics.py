# SPDX-License-Identifier: Apache-2.0
"""Semantics in the loop: what world models that need them are given, by the simulator or by a network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import LineTask

import wiw
from wiw import panorama
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.cli import main
from wiw.errors import ArgumentError
from wiw.experiments.gating import Gated
from wiw.experiments.placebos import ShuffledPlacebo, SwappedPlacebo
from wiw.experiments.semantics import Labelled, find_source
from wiw.loop.clock import Clock
from wiw.loop.imagination import ModelInput, Request
from wiw.loop.memory import Query
from wiw.loop.plan_space import plan_space
from wiw.loop.privileged import LiveEnvironments
from wiw.perception.semantics import CATEGORIES, OTHER_CATEGORY, Semantics
from wiw.policies.base import FrameSpec
from wiw.runs.compose import RunContext
from wiw.runs.recipes import AgentRecipe, arm_recipes, require_semantics_use
from wiw.tasks.imagenav import ImageNav
from wiw.types import Conditioning, Key, Proposal

READER = '''
import numpy as np
import wiw


class Reader(wiw.WorldModel):
    """Paints what it is told that things are."""

    accepts = wiw.accepts("trajectory", needs=("semantic",), cacheable=True)
    version = "1"
    seen = []

    def rollout(self, observations, controls, seeds):
        type(self).seen.append(observations.semantic)
        frames = np.repeat(observations.image[:, None], 1 + len(controls[0].actions), 1)
        frames[:, 1:] = (6 * observations.semantic).astype(np.uint8)[:, None, :, :, None]
        return frames
'''
PLANS = [[FORWARD], [TURN_LEFT, FORWARD], [TURN_RIGHT, TURN_RIGHT, FORWARD]]


@pytest.fixture
def reader(tmp_path: Path) -> str:
    (tmp_path / "reader.py").write_text(READER)
    return f"{tmp_path / 'reader.py'}:Reader"


def begin(two_rooms: str, index: int = 0) -> Any:
    """Return an environment in which an episode has begun."""
    task = ImageNav(scenes=two_rooms)
    env = task.environment(depth=True)
    env.begin(task.episode(index))
    return env


def query(env: Any, index: int = 0) -> Query:
    return Query(env.observation, env.goal, Key(0, index))


def decide(agent: wiw.Agent, *envs: Any) -> Any:
    """Decide with the live environments granted, as a run grants them."""
    environments = LiveEnvironments()
    for index, env in enumerate(envs):
        environments.add(Key(0, index), env)
    agent.grant(environments)
    return agent.decide_batch([query(env, index) for index, env in enumerate(envs)])


class Listener(wiw.WorldModel):
    """Keeps what it is given in another model's place."""

    accepts = wiw.accepts("trajectory")

    def __init__(self, model: wiw.WorldModel) -> None:
        self.accepts = model.accepts

    def rollout(self, observations: Conditioning, controls: Any, seeds: Any) -> Any:
        self.given = observations
        return np.repeat(observations.image[:, None], 1 + len(controls[0].actions), 1)


def listen(model: wiw.WorldModel, *envs: Any) -> Conditioning:
    """Return what a model is given for the plans."""
    listener = Listener(model)
    plans = [[Proposal(plan) for plan in PLANS] for _ in envs]
    keys, observations = [Key(0, index) for index in range(len(envs))], [env.observation for env in envs]
    inputs = [ModelInput(env.observation, semantic=env.semantic()) for env in envs]
    space, origins = plan_space("discrete"), [range(3)] * len(envs)
    frames = FrameSpec("front", (48, 48))
    space.imagine(listener, Request(space, keys, observations, inputs, plans, origins, frames, Clock()))
    return listener.given


class Front(wiw.WorldModel):
    accepts = wiw.accepts("trajectory", view="perspective", size=(64, 64), needs=("semantic", "depth"))

    def rollout(self, observations, controls, seeds):
        raise NotImplementedError


class Half(Front):
    accepts = wiw.accepts("trajectory", size=(288, 512), needs=("semantic",))


def test_the_simulator_names_things_as_the_scene_does(two_rooms: str) -> None:
    labels = begin(two_rooms).semantic()
    assert labels.shape == (576, 1024) and labels.dtype == np.uint32
    names = {"floor": 2, "wall_n": OTHER_CATEGORY}  # "wall_n" is no category
    assert labels[560, 512] == names["floor"] and set(np.unique(labels)) <= set(range(len(CATEGORIES)))


def test_labels_are_turned_with_the_panorama(two_rooms: str, reader: str) -> None:
    one, labels = begin(two_rooms), begin(two_rooms).semantic()
    given = listen(wiw.world_model(reader), one, begin(two_rooms, 1))
    for row, turns in enumerate((0, 1, -2)):
        np.testing.assert_array_equal(given.semantic[row], np.roll(labels, 64 * turns, 1))
        np.testing.assert_array_equal(given.image[row], np.roll(one.observation.panorama, 64 * turns, 1))
    assert given.semantic.dtype == np.uint32 and given.semantic.flags.c_contiguous
    assert set(np.unique(listen(Half(), one).semantic)) <= set(np.unique(labels))


def test_front_views_have_labels_of_their_own_pixels(two_rooms: str) -> None:
    one = begin(two_rooms)
    given = listen(Front(), one)
    assert given.semantic.shape == given.depth.shape == (3, 64, 64)
    for row, yaw in enumerate((0, 22.5, -45)):
        expected = panorama.to_perspective(one.semantic(), 90, (64, 64), yaw, interpolation="nearest")
        np.testing.assert_array_equal(given.semantic[row], expected)
    edges = np.abs(np.diff(given.depth[0], axis=1)) > 0.5  # depth and labels break at the same places
    steps = given.semantic[0, :, 1:] != given.semantic[0, :, :-1]
    assert not edges.any() or steps[edges].mean() > 0.3


def test_without_a_source_it_is_said_what_to_choose(reader: str, two_rooms: str) -> None:
    with pytest.raises(ArgumentError, match=r"Reader needs semantics: .* --semantics simulator or --semantics rednet"):
        wiw.Agent("matcher", reader)
    with pytest.raises(ArgumentError, match="Reader needs semantics"):
        wiw.Agent("matcher", Gated(wiw.world_model(reader), 0.5))
    agent = wiw.Agent("matcher", Labelled(wiw.world_model(reader), "simulator"))
    assert agent.describe()["semantics"] == "simulator"
    assert agent.replace(candidates=2).describe()["semantics"] == "simulator"
    one = begin(two_rooms)
    with pytest.raises(ArgumentError, match="parts that need the simulator"):
        agent.decide_batch([query(one)])
    assert decide(agent, one)[0].calls["rows"] > 0
    with pytest.raises(ArgumentError, match="knows only one scene"):
        find_source(wiw.registry.SEMANTICS.make("simulator", categories={}))


def test_models_that_need_no_semantics_are_left_alone(two_rooms: str) -> None:
    agent = wiw.Agent("matcher", Labelled(wiw.world_model("copy"), "simulator"))
    assert agent.decide_batch([query(begin(two_rooms))])[0].calls["rows"] > 0  # nothing is granted


@pytest.mark.parametrize(
    "wrap",
    [
        lambda model: Gated(ShuffledPlacebo(Labelled(model, "simulator")), 1.0),
        lambda model: Labelled(Gated(ShuffledPlacebo(model), 1.0), "simulator"),
        lambda model: ShuffledPlacebo(Labelled(Gated(model, 1.0), "simulator")),
    ],
)
def test_labels_reach_the_model_through_any_wrappers(two_rooms: str, reader: str, wrap: Any) -> None:
    agent, one = (
        wiw.Agent("heuristic", wrap(wiw.world_model(reader, isolate=False)), reviser="matcher"),
        begin(two_rooms),
    )
    assert decide(agent, one)[0].calls["rows"] > 0
    assert set(np.unique(type(agent.model.unwrapped).seen[-1])) <= set(np.unique(one.semantic()))


def test_labels_that_a_swapped_placebo_brings_along_stay(two_rooms: str, reader: str) -> None:
    """Those of the other episode's first moment, wherever the source is put."""

    class Elsewhere:
        def of(self, key: Key) -> ModelInput:
            return ModelInput(begin(two_rooms, 1).observation, semantic=np.full((576, 1024), 7, np.uint32))

        def forget(self, key: Key) -> None: ...

    model = Labelled(wiw.world_model(reader, isolate=False), "simulator")
    agent = wiw.Agent("heuristic", SwappedPlacebo(model, Elsewhere()), reviser="matcher")
    decide(agent, begin(two_rooms))
    assert set(np.unique(type(agent.model.unwrapped).seen[-1])) == {7}


class Stripes(Semantics):
    """Tells categories by columns, and looks at depth."""

    needs = ("depth",)

    def label_panoramas(self, images, depth=None, ids=None):
        assert depth is not None and depth.shape == images.shape[:3]
        return np.broadcast_to(np.arange(images.shape[2], dtype=np.uint32) // 64, images.shape[:3]).copy()


def test_a_source_of_your_own_is_asked_for_all_episodes_at_once(two_rooms: str, reader: str) -> None:
    agent = wiw.Agent("heuristic", Labelled(wiw.world_model(reader, isolate=False), Stripes), reviser="matcher")
    assert agent.needs == ("depth",)
    assert agent.describe()["semantics"] == {"name": "Stripes"}
    one, other = begin(two_rooms), begin(two_rooms, 1)
    agent.decide_batch([query(one), query(other, 1)])
    shown = type(agent.model.unwrapped).seen[-1]
    assert set(np.unique(shown)) == set(range(16)) and all(len(np.unique(row[0])) == 16 for row in shown)
    blind = replace(query(one), observation=replace(one.observation, depth=None))
    with pytest.raises(ArgumentError, match="needs observations with depth"):
        agent.decide_batch([blind])


def test_rednet_labels_what_the_model_is_given(two_rooms: str, reader: str, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from wiw.perception.rednet_network import RedNet

    torch.manual_seed(0)
    torch.save({"model_state": RedNet(width=2).state_dict()}, tmp_path / "tiny.pth")
    options = {"weights": str(tmp_path / "tiny.pth"), "device": "cpu", "face": 32}
    own = {"isolate": False}
    recipe = AgentRecipe("matcher", reader, model_options=own, semantics="rednet", semantics_options=options)
    assert recipe.describe()["semantics_options"]["face"] == 32
    context = RunContext(ImageNav(scenes=two_rooms))
    agent = AgentRecipe.from_json(recipe.to_json()).build(context)
    described = agent.describe()["semantics"]
    assert len(described.pop("weights")) == 32, "a digest"
    assert described == {"name": "RedNet", "face": 32, "metres": [0.0, 10.0]}
    agent.decide_batch([query(begin(two_rooms))])
    shown = type(agent.model.unwrapped).seen[-1]
    assert shown.min() >= 1 and shown.max() <= 40 and len(np.unique(shown)) > 1


@pytest.mark.parametrize("arms", [[], ["--arms", "none,placebo-swapped"]])
def test_a_run_keeps_its_source_and_can_be_resumed_and_verified(
    arms: list[str], two_rooms: str, reader: str, tmp_path: Path
) -> None:
    out = str(tmp_path / "run")
    begin = ["run", "imagenav", "--scenes", two_rooms, "--world-model", reader, "--episodes", "2", "--live", "2"]
    begin += ["--task-option", "decisions=2", "--cache", str(tmp_path / "kept")]
    assert main([*begin, *arms, "--semantics", "simulator", "--out", out, "--no-report"]) == 0
    log = wiw.studies.run_log.RunLog(wiw.runs.store.RunStore.read(Path(out)))
    assert [arm["agent"]["semantics"] for arm in log.store.config["arms"]] == ["simulator"] * max(1, 3 * bool(arms))
    assert all(episode["status"] == "done" for episode in log.episodes)
    assert any(decision["calls"]["rows"] for decision in log.decisions)
    assert main(["resume", out, "--no-report"]) == 0
    assert main(["verify", out]) == 0


def test_options_need_their_source(reader: str) -> None:
    for flags in (["--semantics-option", "weights=x"], ["--semantics", "simulator", "--semantics-option", "face=32"]):
        assert main(["run", "imagenav", "--world-model", reader, *flags]) == 2


def test_semantics_need_a_world_model(two_rooms: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    begin = ["run", "imagenav", "--scenes", two_rooms, "--episodes", "1", "--semantics", "simulator", "--arms", "none"]
    assert main([*begin, "--out", str(tmp_path / "run")]) == 2
    assert "no arm has one" in capfd.readouterr().err and not (tmp_path / "run").exists()


def test_semantics_need_a_world_model_that_may_look_at_them(reader: str) -> None:
    def require(*arms: str) -> None:
        require_semantics_use(arm_recipes(AgentRecipe("matcher", semantics="simulator"), arms))

    with pytest.raises(ArgumentError, match="warp, copy would not look at them; give one that does"):
        require("none", "warp", "copy")
    for model in ("pathdreamer", reader, "remote:ws://host:80", "warp,x=pathdreamer"):
        require("none", *model.split(","))


def test_an_arm_without_a_model_loads_no_network(tmp_path: Path) -> None:
    options = {"weights": str(tmp_path / "not there")}
    context = RunContext(LineTask())
    plain = AgentRecipe("matcher", semantics="rednet", semantics_options=options).build(context)
    assert "semantics" not in plain.describe()
    with pytest.raises(wiw.errors.WeightsError):
        AgentRecipe("matcher", "copy", semantics="rednet", semantics_options=options).build(context)


def test_scaling_takes_a_source_too(two_rooms: str, reader: str, tmp_path: Path) -> None:
    begin = ["scale", "imagenav", "--scenes", two_rooms, "--world-model", reader, "--episodes", "1"]
    begin += ["--task-option", "decisions=1", "--candidates", "1,2", "--cache", str(tmp_path / "kept")]
    assert main([*begin, "--semantics", "simulator", "--out", str(tmp_path / "run")]) == 0
