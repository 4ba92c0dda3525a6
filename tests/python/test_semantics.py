# SPDX-License-Identifier: Apache-2.0
"""Semantics in the loop: what world models that need them are given, by the simulator or by a network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw import panorama
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.cli import main
from wiw.errors import ArgumentError
from wiw.loop.agent import Query
from wiw.loop.attempts import Attempts
from wiw.loop.clock import Clock
from wiw.loop.imagine import imagine
from wiw.loop.labels import labelled, semantics_source
from wiw.perception.semantics import CATEGORIES, OTHER_CATEGORY, Semantics
from wiw.policies.base import FrameSpec
from wiw.runs.recipes import AgentRecipe
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


def query(two_rooms: str, index: int = 0) -> Query:
    env = ImageNav(scenes=two_rooms).environment(depth=True)
    observation = env.begin(ImageNav(scenes=two_rooms).episode(index))
    return Query(observation, env.goal, Key(0, index), semantic=env.semantic())


def given(model: Any, queries: list[Query]) -> Conditioning:
    """What a model is given for the plans."""

    class Listener(Attempts):
        def __call__(self, observations: Conditioning, controls: Any, seeds: Any) -> Any:
            self.heard = observations
            return np.repeat(observations.image[:, None], 1 + len(controls[0].actions), 1)

    listener = Listener(model)
    plans = [[Proposal(plan) for plan in PLANS] for _ in queries]
    imagine(listener, queries, plans, [range(3)] * len(plans), FrameSpec("front", (48, 48)), Clock())
    return listener.heard


class Front(wiw.WorldModel):
    accepts = wiw.accepts("trajectory", view="perspective", size=(64, 64), needs=("semantic", "depth"))

    def rollout(self, observations, controls, seeds):
        raise NotImplementedError


class Half(Front):
    accepts = wiw.accepts("trajectory", size=(288, 512), needs=("semantic",))


def test_the_simulator_names_things_as_the_scene_does(two_rooms: str) -> None:
    labels = query(two_rooms).semantic
    assert labels is not None and labels.shape == (576, 1024) and labels.dtype == np.uint32
    names = {"floor": 2, "wall_n": OTHER_CATEGORY}  # "wall_n" is no category
    assert labels[560, 512] == names["floor"] and set(np.unique(labels)) <= set(range(len(CATEGORIES)))


def test_labels_are_turned_with_the_panorama(two_rooms: str, reader: str) -> None:
    one = query(two_rooms)
    model = wiw.world_model(reader)
    heard = given(model, [one, query(two_rooms, 1)])
    for row, turns in enumerate((0, 1, -2)):
        np.testing.assert_array_equal(heard.semantic[row], np.roll(one.semantic, 64 * turns, 1))
        np.testing.assert_array_equal(heard.image[row], np.roll(one.observation.panorama, 64 * turns, 1))
    assert heard.semantic.dtype == np.uint32 and heard.semantic.flags.c_contiguous
    assert set(np.unique(given(Half(), [one]).semantic)) <= set(np.unique(one.semantic))


def test_front_views_have_labels_of_their_own_pixels(two_rooms: str) -> None:
    one = query(two_rooms)
    heard = given(Front(), [one])
    assert heard.semantic.shape == heard.depth.shape == (3, 64, 64)
    for row, yaw in enumerate((0, 22.5, -45)):
        expected = panorama.to_perspective(one.semantic, 90, (64, 64), yaw, interpolation="nearest")
        np.testing.assert_array_equal(heard.semantic[row], expected)
    edges = np.abs(np.diff(heard.depth[0], axis=1)) > 0.5  # depth and labels break at the same places
    steps = heard.semantic[0, :, 1:] != heard.semantic[0, :, :-1]
    assert not edges.any() or steps[edges].mean() > 0.3


def test_without_a_source_it_is_said_what_to_choose(reader: str, two_rooms: str) -> None:
    with pytest.raises(ArgumentError, match="--semantics simulator or --semantics rednet"):
        wiw.Agent("matcher", reader)
    agent = wiw.Agent("matcher", reader, semantics="simulator")
    assert "semantic" in agent.needs and agent.describe()["semantics"] == "simulator"
    assert agent.but(candidates=2).semantics == "simulator"
    one = query(two_rooms)
    with pytest.raises(ArgumentError, match=r"semantic=env\.semantic\(\)"):
        agent.decide_batch([Query(one.observation, one.goal, one.key)])
    assert agent.decide_batch([one])[0].calls["rows"] > 0
    plain = wiw.Agent("matcher", "copy", semantics="simulator")
    assert "semantic" not in plain.needs
    with pytest.raises(ArgumentError, match="knows one scene"):
        semantics_source(wiw.registry.SEMANTICS.make("simulator", categories={}))


class Stripes(Semantics):
    """Tells categories by columns, and looks at depth."""

    needs = ("depth",)

    def label_panoramas(self, images, depth=None, ids=None):
        assert depth is not None and depth.shape == images.shape[:3]
        return np.broadcast_to(np.arange(images.shape[2], dtype=np.uint32) // 64, images.shape[:3]).copy()


def test_a_source_of_your_own_is_asked_for_all_episodes_at_once(two_rooms: str, reader: str) -> None:
    agent = wiw.Agent("matcher", reader, semantics=Stripes)
    assert "semantic" not in agent.needs and "depth" in agent.needs
    assert agent.describe()["semantics"] == {"name": "Stripes"}
    agent.decide_batch([query(two_rooms), query(two_rooms, 1)])
    shown = type(agent.model).seen[-1]
    assert set(np.unique(shown)) == set(range(16)) and all(len(np.unique(row[0])) == 16 for row in shown)
    blind = query(two_rooms)
    with pytest.raises(ArgumentError, match="needs depth"):
        labelled(
            Stripes(),
            [replace(blind, observation=replace(blind.observation, depth=None))],
        )


def test_rednet_labels_what_the_model_is_given(two_rooms: str, reader: str, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from wiw.perception.rednet_network import RedNet

    torch.manual_seed(0)
    torch.save({"model_state": RedNet(width=2).state_dict()}, tmp_path / "tiny.pth")
    options = {"weights": str(tmp_path / "tiny.pth"), "device": "cpu", "face": 32}
    recipe = AgentRecipe("matcher", reader, semantics="rednet", semantics_options=options)
    assert recipe.describe()["semantics_options"]["face"] == 32
    agent = AgentRecipe(**recipe.to_json()).build({})
    assert agent.describe()["semantics"] == {"name": "RedNet", "weights": "tiny.pth", "face": 32, "metres": [0.0, 10.0]}
    agent.decide_batch([query(two_rooms)])
    shown = type(agent.model).seen[-1]
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


def test_an_arm_without_a_model_loads_no_network(tmp_path: Path) -> None:
    options = {"weights": str(tmp_path / "not there")}
    assert AgentRecipe("matcher", semantics="rednet", semantics_options=options).build({}).semantics is None
    with pytest.raises(wiw.errors.WeightsError):
        AgentRecipe("matcher", "copy", semantics="rednet", semantics_options=options).build({})


def test_scaling_takes_a_source_too(two_rooms: str, reader: str, tmp_path: Path) -> None:
    begin = ["scale", "imagenav", "--scenes", two_rooms, "--world-model", reader, "--episodes", "1"]
    begin += ["--task-option", "decisions=1", "--candidates", "1,2", "--cache", str(tmp_path / "kept")]
    assert main([*begin, "--semantics", "simulator", "--out", str(tmp_path / "run")]) == 0
