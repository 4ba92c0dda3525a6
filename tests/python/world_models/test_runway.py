# SPDX-License-Identifier: Apache-2.0
"""Runway's service, played by a server on the loopback."""

from __future__ import annotations

import base64
import pickle

import cv2
import numpy as np
import pytest

import fake_runway
import wiw
from wiw import action
from wiw.action import FORWARD, TURN_LEFT
from wiw.errors import ArgumentError, DependencyError, InfrastructureError
from wiw.types import Conditioning, Control

pytest.importorskip("runwayml", reason="no runwayml: pip install 'wiw[runway]'")


@pytest.fixture
def service(monkeypatch):
    monkeypatch.setenv("RUNWAYML_API_SECRET", "a key")
    monkeypatch.setattr("runwayml._base_client.INITIAL_RETRY_DELAY", 0.01)
    with fake_runway.serving() as server:
        yield server


@pytest.fixture
def made(service):
    return lambda **options: wiw.world_model(
        "runway-gen4", **{"url": service.url, "poll": 0.0, "size": (64, 64), "frames": 6, **options}
    )


def rollout(model, plans=((FORWARD, TURN_LEFT),), seeds=(7,)):
    controls = []
    for plan in plans:
        padded = action.pad(plan, model.frames - 1)
        views = action.to_trajectory(padded), action.to_viewpoints(padded)
        controls.append(Control(padded, *views, action.to_text(plan), length=len(plan)))
    image = np.random.default_rng(0).integers(0, 256, (len(plans), *model.size, 3), np.uint8)
    return image, model.rollout(Conditioning(image), controls, np.array(seeds, np.uint64))


def brightness(frames):
    """Of the half of each frame that tells its place in the clip."""
    return frames[..., 40:60, 0].astype(float).mean((-1, -2))


def test_an_order_says_what_the_row_says(service, made):
    image, _ = rollout(made(duration=2), seeds=[2**40 + 5])
    (order,) = service.orders
    png = base64.b64decode(order.pop("promptImage").removeprefix("data:image/png;base64,"))
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], image[0])
    prompt = order.pop("promptText")
    assert "move forward 0.2 m, then turn left 22.5 degrees." in prompt
    assert order == {"model": "gen4_turbo", "ratio": "960:960", "duration": 2, "seed": 5}


def test_the_clip_shows_the_plan_evenly(made):
    image, frames = rollout(made(), [(FORWARD,) * 2, (FORWARD,) * 5], [1, 2])
    np.testing.assert_array_equal(frames[:, 0], image)
    last = fake_runway.FRAMES - 1
    np.testing.assert_allclose(brightness(frames[0, 1:3]), [20 * round(last / 2 + 0.01), 20 * last], atol=6)
    assert (frames[0, 3:] == frames[0, 2]).all(), "padding is the plan's end"
    np.testing.assert_allclose(np.diff(brightness(frames[1, 1:])), [40, 60, 40, 40], atol=6 + 20)


def test_rows_are_ordered_together_and_never_twice(service, made):
    model = made()
    _, first = rollout(model, [(FORWARD,), (TURN_LEFT,), (FORWARD,)], [1, 1, 2])
    assert len(service.orders) == 3 and model.credits == 3 * fake_runway.COST
    _, again = rollout(model, [(FORWARD,), (TURN_LEFT,), (FORWARD,)], [1, 1, 2])
    np.testing.assert_array_equal(first, again)
    assert len(service.orders) == 3 and model.credits == 3 * fake_runway.COST, "no credit is paid twice"
    assert np.abs(first[0].astype(int) - first[2]).max() > 0, "the seed counts"


@pytest.mark.parametrize("end", ["FAILED", "CANCELLED"])
def test_it_ends_with_every_end_of_a_task(end, service, made):
    service.plan = ("RUNNING", end)
    model = made()
    with pytest.raises(InfrastructureError, match=f"ended as {end}"):
        rollout(model)
    service.plan = ("SUCCEEDED",)
    rollout(model)
    assert len(service.orders) == 2, "what failed is ordered anew"


def test_a_task_that_takes_for_ever_is_given_up_and_found_again(service, made):
    service.plan = ("THROTTLED",)
    model = made(patience=0.05)
    with pytest.raises(InfrastructureError, match="have not finished"):
        rollout(model)
    service.plan = ("SUCCEEDED",)
    rollout(model)
    assert len(service.orders) == 1


def test_the_budget_is_kept(service, made):
    model = made(budget=2 * fake_runway.COST)
    rollout(model, [(FORWARD,), (TURN_LEFT,)], [1, 2])
    with pytest.raises(InfrastructureError, match="50 credits of budget=50 are spent"):
        rollout(model, seeds=[3])
    assert len(service.orders) == 2


@pytest.mark.parametrize(
    ("fault", "said"), [("broken_videos", "not a video"), ("cut_videos", "its last 16 bytes did not come")]
)
def test_a_broken_download_costs_no_second_order(fault, said, service, made):
    """Nor is a video that was cut short on its way taken for a shorter one."""
    setattr(service, fault, 1)
    model = made()
    with pytest.raises(InfrastructureError, match=said):
        rollout(model)
    rollout(model)
    assert len(service.orders) == 1


@pytest.mark.parametrize(("refusal", "said"), [(401, "RUNWAYML_API_SECRET is refused"), (400, "BadRequestError")])
def test_refusals_are_said(refusal, said, service, made):
    service.refusals = [refusal]
    with pytest.raises(InfrastructureError, match=said):
        rollout(made())


def test_a_busy_service_is_asked_again(service, made):
    service.refusals = [429, 503]
    rollout(made())
    assert len(service.orders) == 1


def test_without_a_key_or_with_options_out_of_range(made, monkeypatch):
    wrong = [("2 to 10", {"duration": 1}), ("whole seconds", {"duration": 5.5}), ("gen4", {"model": "gen3"})]
    wrong += [("batch", {"batch": 0}), ("frames", {"frames": 1}), ("frames", {"frames": "many"})]
    wrong += [("square", {"size": size}) for size in ((64, 96), 64, (0, 0), (1024, 1024))]
    for said, options in wrong:
        with pytest.raises(ArgumentError, match=said):
            made(**options)
    with pytest.raises(ArgumentError, match="prompts of up to 1000"):
        rollout(made(frames=60), [(TURN_LEFT,) * 59])
    monkeypatch.delenv("RUNWAYML_API_SECRET")
    with pytest.raises(ArgumentError, match="set RUNWAYML_API_SECRET"):
        made()


def test_a_missing_sdk_is_named(made, monkeypatch):
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(DependencyError, match=r"runwayml not installed; pip install 'wiw\[runway\]'"):
        made()


def test_the_key_is_nowhere_in_the_records(made):
    model = made()
    assert "a key" not in str(model.describe()) and b"a key" not in pickle.dumps(model)
    assert pickle.loads(pickle.dumps(model)).fingerprint() == model.fingerprint()


def test_a_model_that_costs_nothing_has_no_credits() -> None:
    assert wiw.world_model("copy").credits is None


def test_an_agent_notes_the_credits(service, made, two_rooms, tmp_path):
    from wiw.tasks.imagenav import ImageNav

    model = made()
    task = ImageNav(scenes=two_rooms, decisions=1)
    log = wiw.evaluate(
        task.environment(), wiw.Agent("matcher", model), episodes=1, progress=False, out=tmp_path / "run"
    )
    assert [episode["status"] for episode in log.episodes] == ["done"]
    assert log.decisions[0]["spent"]["credits"] == model.credits == fake_runway.COST * len(service.orders) > 0
