# SPDX-License-Identifier: Apache-2.0
"""Every registered world model keeps the contract; so does a stranger's, found through an entry point."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import wiw
from wiw.action import FORWARD, TURN_LEFT
from wiw.errors import RegistryError
from wiw.loop.attempts import Attempted
from wiw.loop.clock import Clock
from wiw.loop.imagination import ModelInput, Request
from wiw.loop.plan_space import plan_space
from wiw.policies.base import FrameSpec
from wiw.tasks.imagenav import ImageNav
from wiw.types import Key, Proposal

NAMES = [name for name in wiw.registry.list_world_models() if name != "none" and not name.endswith(":")]
SMALL = dict.fromkeys(("copy", "oracle", "warp", "warpnet", "pocket"), (144, 256)) | {"armnet": (160, 160)}
"""(height, width) in which these are checked for every change: they draw in any, at a cost that grows with it."""
PLANS = [[FORWARD] * 3, [TURN_LEFT, FORWARD], [FORWARD, TURN_LEFT, FORWARD, FORWARD]]


def imagined(name_or_model, two_rooms: str, episodes: int = 2, plans=PLANS, first: int = 0, **options):
    """Rollouts of the plans, whose seeds are those of candidates `first`, `first` + 1, ..."""
    task = ImageNav(scenes=two_rooms)
    observations, inputs = [], []
    for index in range(episodes):
        env = task.environment(depth=True)
        observation = env.begin(task.episode(index))
        observations.append(observation)
        inputs.append(ModelInput(observation, env.fork()))
    model, space = wiw.world_model(name_or_model, **options), plan_space("discrete")
    request = Request(
        space,
        [Key(0, index) for index in range(episodes)],
        observations,
        inputs,
        [[Proposal(plan) for plan in plans]] * episodes,
        [range(first, first + len(plans))] * episodes,
        FrameSpec("panorama", (144, 256)),
        Clock(),
    )
    return space.imagine(Attempted(model), request).rollouts


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] if f"{name}-action" in NAMES else []) for name in NAMES]
)
def test_every_model_keeps_the_contract(name: str, two_rooms: str, world_model_options) -> None:
    options = world_model_options(name)
    if name in SMALL:
        model = wiw.world_model(name, **options)
        model.accepts = replace(model.accepts, size=SMALL[name])
        findings = wiw.check_model(model, two_rooms)
    else:
        findings = wiw.check_model(name, two_rooms, **options)
    noisy = "weights" in options  # tiny random ones, whose pictures are noise
    broken = [finding for finding in findings if finding.serious and not (noisy and finding.kind == "pictures")]
    assert not [finding.text for finding in broken]


@pytest.mark.nightly
@pytest.mark.parametrize("name", SMALL)
def test_every_model_keeps_the_contract_in_full_size(name: str, two_rooms: str) -> None:
    assert not [finding.text for finding in wiw.check_model(name, two_rooms) if finding.serious]


@pytest.mark.parametrize("name", ["copy", "warp", "oracle"])
def test_frames_follow_actions_and_do_not_depend_on_the_batch(name: str, two_rooms: str) -> None:
    whole = imagined(name, two_rooms)
    assert [[len(r.frames) for r in rows] for rows in whole] == [[3, 2, 4]] * 2
    alone = imagined(name, two_rooms, episodes=1, plans=PLANS[2:], first=2)
    np.testing.assert_array_equal(alone[0][0].frames, whole[0][2].frames)


def test_the_floor_stands_still_and_the_references_move(two_rooms: str) -> None:
    copy, warp, oracle = (imagined(name, two_rooms)[0][0].frames.astype(float) for name in ("copy", "warp", "oracle"))
    assert np.abs(copy[0] - copy[2]).max() == 0
    error_copy, error_warp = np.abs(copy[2] - oracle[2]).mean(), np.abs(warp[2] - oracle[2]).mean()
    assert error_warp < error_copy / 4


STRANGER = '''
import numpy as np
import wiw


class Fog(wiw.WorldModel):
    """Everything fades."""

    accepts = wiw.accepts(control="trajectory", view="perspective", size=(120, 120), frames=14)

    def rollout(self, observations, controls, seeds):
        fade = np.linspace(1, 0, 14)[None, :, None, None, None]
        return (observations.image[:, None] * fade).astype(np.uint8)
'''


@pytest.fixture
def strangers_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed distribution of one file that declares an entry point and nothing else."""
    (tmp_path / "fog_model.py").write_text(STRANGER)
    info = tmp_path / "fog_model-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fog-model\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[wiw.world_models]\nfog = fog_model:Fog\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("fog_model", None)


def test_a_stranger_adds_a_model_in_one_file(strangers_package: Path, two_rooms: str) -> None:
    assert "fog" in wiw.registry.list_world_models()
    rollouts = imagined("fog", two_rooms)
    brightness = rollouts[0][0].frames.mean((1, 2, 3))
    assert brightness[0] > brightness[2]
    task = ImageNav(scenes=two_rooms, decisions=2)
    out = strangers_package / "run"
    log = wiw.evaluate(task.environment(), wiw.Agent("matcher", "fog"), episodes=2, progress=False, out=out)
    assert [episode["status"] for episode in log.episodes] == ["done", "done"]
    assert all(decision["calls"]["rows"] > 0 for decision in log.decisions)


def test_or_names_a_class_in_a_file(tmp_path: Path, two_rooms: str) -> None:
    file = tmp_path / "mine.py"
    file.write_text(STRANGER)
    assert len(imagined(f"{file}:Fog", two_rooms)[0]) == 3
    with pytest.raises(RegistryError, match="cannot be loaded"):
        wiw.world_model(f"{file}:Fgo")


def test_or_hands_over_a_function_from_a_notebook(two_rooms: str) -> None:
    def fog(observations, controls, seeds):
        return np.repeat(observations.image[:, None] // 2, len(controls[0].actions) + 1, 1)

    declared = wiw.accepts(control="image")
    model = wiw.world_model(fog, accepts=declared)
    assert len(imagined(model, two_rooms)[0]) == 3 and model.describe()["name"].endswith("fog")
    assert wiw.world_model(wiw.world_model("copy").rollout, accepts=declared).accepts is declared
    assert not model.fingerprint()
    with pytest.raises(wiw.errors.ArgumentError, match="expected a function and accepts"):
        wiw.world_model(fog, accepts="image")


def test_unknown_names_and_options_are_answered_with_what_is_known() -> None:
    with pytest.raises(RegistryError, match="Did you mean warp"):
        wiw.world_model("wrap")
    with pytest.raises(RegistryError, match="unexpected keyword"):
        wiw.world_model("copy", depth=3)


def test_a_model_without_a_declaration_is_refused_when_it_is_written() -> None:
    with pytest.raises(wiw.errors.ContractError, match="accepts"):

        class Half(wiw.WorldModel):
            def rollout(self, observations, controls, seeds):
                return observations.image
