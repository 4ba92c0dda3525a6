# SPDX-License-Identifier: Apache-2.0
"""armnet's training: what plays are, that lessons can be repeated, and that a short one is worth something."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw.cli.app import main
from wiw.errors import ArgumentError
from wiw.tabletop.colours import compare_colour
from wiw.tabletop.push_buttons import UNLIT_COLOUR
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import LAMPS, TABLE

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.training.armnet import (  # noqa: E402
    CHANGE_THRESHOLD,
    HELD_OUT_SEED_OFFSET,
    Recipe,
    build_sequences,
    evaluate,
    predict_free_running,
    predict_teacher_forced,
    sample_sequences,
    train,
)
from wiw.training.armnet_events import evaluate_events  # noqa: E402
from wiw.training.checkpoint import Checkpoint  # noqa: E402
from wiw.training.plays import (  # noqa: E402
    EVENTS,
    POSES,
    Plays,
    corrupt_plan,
    find_events,
    gather_plays,
    merge_plays,
    read_demonstration_plays,
    record_plays,
)
from wiw.world_models.armnet.model import ArmNet  # noqa: E402
from wiw.world_models.armnet.network import WINDOW, Network  # noqa: E402
from wiw.world_models.armnet.weights import load  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SMALL = (8, 16, 16)


@pytest.fixture(scope="module")
def plays() -> Plays:
    """One of each task."""
    return record_plays(0, 0, 4)


def test_a_play_is_a_function_of_its_number(plays: Plays) -> None:
    again = record_plays(0, 2, 1)
    for each in fields(Plays):
        np.testing.assert_array_equal(getattr(again, each.name)[0], getattr(plays, each.name)[2])
    assert plays.views.shape == (4, POSES + 1, *np.zeros((160, 160))[WINDOW].shape, 3) == plays.bare.shape
    assert plays.arm.dtype == np.bool_ and 0.01 < plays.arm.mean() < 0.3
    hidden = np.abs(plays.views.astype(int) - plays.bare).max(axis=-1)[plays.arm]
    assert np.mean(hidden < 8) > 0.9
    assert np.abs(plays.views.astype(int) - plays.bare).max(axis=-1)[~plays.arm].max() > 60  # things


def test_plans_are_spoilt_in_many_ways() -> None:
    plan = np.array([[0.1 * k, 0.0, TABLE + 0.1, np.pi, 0, 0, k % 2] for k in range(6)])
    made = [corrupt_plan(plan, np.random.default_rng(seed)) for seed in range(200)]
    same = [len(each) == len(plan) and np.array_equal(each, plan) for each in made]
    assert 0.2 < np.mean(same) < 0.45
    assert any(len(each) == 5 for each in made)
    whole = [each for each in made if len(each) == 6]
    assert any((each[:, 6] != plan[:, 6]).any() and np.array_equal(each[:, :6], plan[:, :6]) for each in whole)
    shifts = [each[:, :2] - plan[:, :2] for each in whole]
    assert any(np.ptp(shift, axis=0).max() < 1e-9 < np.abs(shift).max() for shift in shifts)
    assert all(each[:, 6].min() >= 0 and each[:, 6].max() <= 1 and each[:, 2].min() > TABLE for each in made)


def test_a_way_goes_on_from_what_the_network_made(plays: Plays) -> None:
    batch = sample_sequences(plays, 5, 3, np.random.default_rng(0))
    assert len(batch.views) == len(batch.arms) == 4 and len(batch.motions) == 3
    assert all(view.shape == (5, 3, 64, 120) for view in batch.views)
    torch.manual_seed(0)
    network, batch = Network(SMALL), build_sequences(plays, np.arange(4), np.zeros(4, np.int64), 2)
    steps, (whole,) = list(predict_free_running(network, batch)), predict_teacher_forced(network, batch)
    assert len(steps) == 2 and len(whole.prediction) == 8
    torch.testing.assert_close(whole.prediction[:4], steps[0].prediction)  # from the same canvas
    assert (whole.prediction[4:] - steps[1].prediction).abs().max() > 0.05  # from that of the true view
    for step in steps:
        assert step.prediction.requires_grad and not step.static_view.requires_grad
        assert (step.static_view - step.target).abs().mean() < (step.prediction - step.target).abs().mean() * 2


def test_the_same_lesson_gives_the_same_network_stopped_or_not(plays: Plays, tmp_path: Path) -> None:
    once, again, other = (
        train(plays, Recipe(epochs=1, batch=4, widths=(4, 4, 4), seed=seed))[0].state_dict() for seed in (1, 1, 2)
    )
    assert all(torch.equal(once[name], again[name]) for name in once)
    assert not torch.equal(once["last.weight"], other["last.weight"])
    checkpoint = Checkpoint(tmp_path / "kept", {}, seconds=0)

    def cut(step: int, steps: int, loss: float) -> None:
        if step == 2:
            raise KeyboardInterrupt

    recipe = Recipe(epochs=3, batch=4, steps=1, widths=(4, 4, 4))
    whole = train(plays, recipe)[0].state_dict()
    with pytest.raises(KeyboardInterrupt):
        train(plays, recipe, on_step=lambda step, steps, loss: cut(step - 1, steps, loss), checkpoint=checkpoint)
    assert checkpoint.load().step == 2
    resumed = train(plays, recipe, checkpoint=checkpoint)[0].state_dict()
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
    for wrong, message in (
        ({"epochs": 0}, "epochs must be positive, got 0"),
        ({"steps": POSES + 1}, f"at most {POSES} steps, got {POSES + 1}"),
    ):
        with pytest.raises(ArgumentError, match=message):
            Recipe(**wrong)


def test_training_teaches_what_becomes_of_things(plays: Plays) -> None:
    """By heart, of one play: it is nearer to what changes than one who leaves things alone."""
    one = Plays(*(getattr(plays, each.name)[:1] for each in fields(Plays)))
    network, _ = train(one, Recipe(epochs=40, batch=4, steps=2, free=0, widths=SMALL, rate=5e-3))
    batch = build_sequences(one, np.zeros(7, np.int64), np.arange(7), 1)
    with torch.inference_mode():
        (step,) = predict_free_running(network, batch)
        changed = (step.target - step.static_view).abs().amax(1, keepdim=True) > CHANGE_THRESHOLD
        wrong, alone = (((view - step.target).abs() * changed).sum() for view in (step.prediction, step.static_view))
    assert wrong < 0.95 * alone


def find_plan_events(name: str) -> tuple[Any, list[str]]:
    """Return an expert's target, and what becomes of things at its poses, one after another."""
    task = TABLETOP_TASKS[name]
    setup = task.create_setup(3, 2)
    bench, found = setup.build_workbench(), []
    for pose in task.plan_expert(bench.get_poses(setup.objects), setup.target, bench.pose):
        before = bench.fork()
        bench.move_to(pose)
        events = zip(bench.things, find_events(before, bench), strict=True)
        found += [f"{thing} {EVENTS[event]}" for thing, event in events if event]
    return setup.target, found


def test_events_are_what_becomes_of_each_thing() -> None:
    assert find_plan_events("slide_block")[1] == ["block pushed"]
    buttons, found = find_plan_events("push_buttons")
    assert found == [f"{button} lit {turn}" for button, turn in zip(buttons, ("first", "second", "third"), strict=True)]
    base, found = find_plan_events("stack_cups")
    first, second = (each.split()[0] for each in found if each.endswith("placed"))
    assert base not in (first, second) and first != second
    assert [each for each in found if each.startswith(first)][:3] == [f"{first} carried"] * 2 + [f"{first} placed"]


def test_things_are_where_they_are_seen(plays: Plays) -> None:
    """A press play's rings, by their own dark colour, are within the pixels of buttons, and the arm is not."""
    things, views = plays.things[0, 0], plays.views[0, 0].astype(int)
    assert set(np.unique(things)) == {0, 1, 2, 3} and not things[:10].any()
    dark = (views.max(axis=-1) < 75) & ~plays.arm[0, 0]
    assert np.mean(things[dark] > 0) > 0.9


@pytest.mark.parametrize(("lamps", "right"), [("true", (1, 1, 1)), ("amber", (0, 1, 0)), ("off", (0, 0, 0))])
def test_events_are_measured_by_themselves(lamps: str, right: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of views that are true but for the lamps: errors where these light up and nowhere else."""
    pushes = [record_plays(1000, number, 1) for number in (0, 8)]
    shown = merge_plays(pushes)
    assert {1, 2, 3} <= set(shown.events.ravel().tolist())

    def predict(network: Network, sequences: Any) -> Any:
        for step in predict_free_running(network, sequences):
            made = step.target.permute(0, 2, 3, 1).clone()
            for colour in LAMPS.values():
                likeness = compare_colour((made * 255).round().byte().numpy(), colour)
                new = {"true": made, "amber": torch.tensor(LAMPS["amber"]), "off": torch.tensor(UNLIT_COLOUR)}[lamps]
                made = torch.where(torch.from_numpy(likeness > 0.45)[..., None], new, made).float()
            yield replace(step, prediction=made.permute(0, 3, 1, 2))

    monkeypatch.setattr("wiw.training.armnet_events.predict_free_running", predict)
    found = evaluate_events(Network(SMALL), shown)
    for mode in found.values():
        assert [mode[f"lit {turn}"]["right"] for turn in ("first", "second", "third")] == list(right)
        for event, figures in mode.items():
            assert figures["count"] == (shown.events == EVENTS.index(event)).sum() or event == "still"
            assert figures["arm"] > 20 or event == "still"
            if lamps == "true":
                assert figures["armnet"] == 0 and abs(figures["sharpness"] - 1) < 1e-4
        if lamps == "amber":
            assert mode["lit second"]["armnet"] < 0.5 * min(
                mode[f"lit {turn}"]["armnet"] for turn in ("first", "third")
            )


def test_figures_are_those_of_a_model_that_knows_the_arm_and_no_more(plays: Plays) -> None:
    network = Network(SMALL)
    torch.nn.init.zeros_(network.last.weight)
    found = evaluate(network, plays)
    assert found["plays"] == 4 and set(found["psnr"]) == {"copy", "arm", "armnet"}
    assert found["psnr"]["arm"]["1"] > found["psnr"]["copy"]["1"] + 3
    assert abs(found["psnr"]["armnet"]["1"] - found["psnr"]["arm"]["1"]) < 6
    assert found["changed"]["arm"]["5"] > 10


def test_plays_are_kept(tmp_path: Path, plays: Plays, monkeypatch: pytest.MonkeyPatch) -> None:
    def record(seed: int, first: int, count: int) -> Plays:
        return Plays(*(getattr(plays, each.name)[first : first + count] for each in fields(Plays)))

    monkeypatch.setattr("wiw.training.plays.record_plays", record)
    monkeypatch.setattr("wiw.training.plays.PLAYS_PER_FILE", 2)
    bars: list[tuple[str, int]] = []

    def bar(items: Any, text: str, total: int) -> Any:
        bars.append((text, total))
        return items

    once = gather_plays(3, 0, tmp_path, 1, bar)
    again = gather_plays(3, 0, tmp_path, 1, bar)
    assert len(once) == 3 and bars == [("3 plays", 2), ("3 plays", 0)]
    np.testing.assert_array_equal(once.views, again.views)


def test_demonstrations_are_plays_too(tmp_path: Path, plays: Plays) -> None:
    pytest.importorskip("pyarrow")
    out = str(tmp_path / "demos")
    command = ["collect", "manipulation", "--out", out, "--episodes", "1", "--tasks", "slide_block", "--size", "160"]
    assert main(command) == 0
    found = read_demonstration_plays(tmp_path / "demos")
    assert len(found) == 1 and found.views.shape[1:] == plays.views.shape[1:]
    hidden = np.abs(found.views.astype(int) - found.bare).max(axis=-1)[found.arm]
    assert np.mean(hidden < 12) > 0.85
    np.testing.assert_array_equal(found.views[0, 4], found.views[0, 8])  # four poses, then it stays
    np.testing.assert_allclose(found.poses[0, 4, :3], found.poses[0, 8, :3], atol=1e-3)


def test_the_command_makes_a_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wiw.training.armnet_weights.HELD_OUT", 4)
    monkeypatch.setattr("wiw.training.plays.PLAYS_PER_FILE", 4)
    monkeypatch.setattr("wiw.training.armnet.Recipe", partial(Recipe, widths=SMALL, rate=5e-3))
    out, cache = tmp_path / "weights.safetensors", tmp_path / "plays"
    command = ["train", "armnet", "--plays", "4", "--epochs", "12", "--out", str(out), "--cache", str(cache)]
    assert main([*command, "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert "poses ahead" in said and "all poses in a row" in said and "  still " in said
    card = ArmNet(out).card
    assert card["plays"] == 4 and card["recipe"]["epochs"] == 12
    held_out = gather_plays(4, HELD_OUT_SEED_OFFSET, cache, 1, lambda items, text, total: items)
    torch.manual_seed(0)
    untrained = evaluate(Network(SMALL).eval(), held_out)["changed"]
    changed = card["held_out"]["changed"]
    assert changed["arm"] == untrained["arm"]
    assert changed["armnet"]["5"] < 0.95 * untrained["armnet"]["5"]
    assert changed["armnet"]["5"] < 0.8 * changed["arm"]["5"]


def test_the_command_goes_on_only_with_the_same_demonstrations_and_until_all_is_measured(
    tmp_path: Path, plays: Plays, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def learnt(plays: Plays, recipe: Recipe, minutes: Any, show: Any, checkpoint: Checkpoint) -> Any:
        checkpoint.load()
        checkpoint.seconds = 0
        checkpoint.save_if_due(_Nothing(), 1, 1)
        return Network(SMALL), recipe

    def stopped(network: Network, plays: Plays) -> Any:
        raise KeyboardInterrupt

    demos, out = tmp_path / "demos", tmp_path / "w"
    demos.mkdir()
    monkeypatch.setattr("wiw.training.armnet_weights.gather_plays", lambda *_, **__: plays)
    monkeypatch.setattr("wiw.training.armnet_weights.read_demonstration_plays", lambda folder: plays)
    monkeypatch.setattr("wiw.training.armnet_weights.train", learnt)
    monkeypatch.setattr("wiw.training.armnet_weights.evaluate", stopped)
    command = ["train", "armnet", "--out", str(out), "--demonstrations", str(demos)]
    (demos / "manifest.json").write_text('{"tasks": ["slide_block"], "episodes": 1, "seed": 0}')
    assert main(command) == 130
    assert (tmp_path / "w.checkpoint").exists(), "it is done only once it is measured"
    assert load(out)[1]["collection"]["seed"] == 0
    (demos / "manifest.json").write_text('{"tasks": ["slide_block"], "episodes": 1, "seed": 1}')
    assert main(command) == 2
    assert "a training with different data or options" in capsys.readouterr().err


class _Nothing:
    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: Any) -> None:
        pass
