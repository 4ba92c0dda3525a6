# SPDX-License-Identifier: Apache-2.0
"""The navigator's training: what places are recorded, how labels move with pictures, and that it can be repeated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw.cli.app import main
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.policies.navigator.policy import WEIGHTS, Navigator  # noqa: E402
from wiw.policies.navigator.weights import load  # noqa: E402
from wiw.training.checkpoint import Checkpoint  # noqa: E402
from wiw.training.goal_places import GoalPlaces, PlaceRules, record_goal_places, require_places  # noqa: E402
from wiw.training.navigator import Recipe, evaluate, measure_prior, sample_pairs, spread_bearings, train  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SMALL = Recipe(epochs=1, scenes=1, places=4, cluster=2, width=8, heads=2)
RULES = PlaceRules(anchors=6, neighbours=1, reach=1.0)


@pytest.fixture(scope="module")
def places(two_rooms: str) -> GoalPlaces:
    return record_goal_places(world(two_rooms, "cpu"), 0, RULES)


def test_places_know_the_ways_between_them(places: GoalPlaces, two_rooms: str) -> None:
    count = len(places)
    assert 6 < count <= 12 and places.bands.shape == (count, 32, 128, 3)
    np.testing.assert_allclose(places.distances, places.distances.T, atol=0.02)
    assert (np.diag(places.distances) == 0).all() and np.isfinite(places.distances).all()
    assert 0.2 < places.visible.mean() < 1
    seen = places.visible & (places.distances > 0.5)
    back = np.remainder(places.bearings.T - places.bearings, 2 * np.pi)  # in sight, both ways are one straight line
    assert np.median(np.abs(back[seen] - np.pi)) < 0.05
    again = record_goal_places(world(two_rooms, "cpu"), 0, RULES)
    np.testing.assert_array_equal(again.bands, places.bands)
    with pytest.raises(ArgumentError, match="from one place to another"):
        require_places([])


def marked_places(count: int = 6) -> GoalPlaces:
    """Grey places with a bright stripe in the direction of every way, which is the same for all."""
    rng = np.random.default_rng(0)
    bands = np.full((count, 32, 128, 3), 60, np.uint8)
    bearings = np.zeros((count, count), np.float16)
    for i, column in enumerate(rng.integers(0, 128, count)):
        bands[i, :, column] = 255
        bearings[i] = np.pi - (column + 0.5) * 2 * np.pi / 128
    distances = np.full((count, count), 3.0, np.float16)
    return GoalPlaces(bands, np.ones((count, 128), np.float16), distances, bearings, np.ones((count, count), bool))


def test_bearings_move_with_the_pictures() -> None:
    scene, rng = marked_places(), np.random.default_rng(1)
    recipe = Recipe(places=6, cluster=3)
    off = []
    for _ in range(8):
        pairs = sample_pairs(scene, recipe, rng)
        assert pairs.places.shape == (6, 4, 32, 128) and pairs.goals.shape == (6, 4, 32, 32)
        shown = pairs.places[:, 3].mean(dim=(1, 2)) == 1
        column = pairs.places[:, :3].mean(dim=(1, 2)).argmax(dim=1)
        taught = spread_bearings(pairs.bearings).argmax(dim=1).reshape(6, 6)[:, 0]
        off += ((column / 4 - 0.5 - taught + 16) % 32 - 16)[shown].tolist()
    assert np.median(np.abs(off)) < 0.8 and len(off) > 36  # a hidden part or much blur may mislead some


def test_bearings_are_taught_around_their_heading() -> None:
    taught = spread_bearings(torch.tensor([0.0, np.pi / 2, np.pi - 0.01, -np.pi + 0.01]))
    torch.testing.assert_close(taught.sum(dim=1), torch.ones(4))
    assert set(taught[0].topk(2).indices.tolist()) == {15, 16}
    assert set(taught[1].topk(2).indices.tolist()) == {7, 8}
    torch.testing.assert_close(taught[2][0], taught[3][31])  # behind, the left edge is the right one


def test_the_same_training_gives_the_same_network_even_if_it_was_interrupted(
    places: GoalPlaces, tmp_path: Path
) -> None:
    whole, used = train([places], Recipe(**{**vars(SMALL), "epochs": 3}))
    assert used.epochs == 3
    checkpoint = Checkpoint(tmp_path / "state", {"of": "this"}, seconds=0)

    class StopError(Exception):
        pass

    def stop(step: int, steps: int, loss: float) -> None:
        assert np.isfinite(loss)
        if step == 3:
            raise StopError

    with pytest.raises(StopError):
        train([places], used, on_step=stop, checkpoint=checkpoint)
    again, _ = train([places], used, checkpoint=checkpoint)
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=0, atol=0)
    with pytest.raises(ArgumentError, match="cluster"):
        Recipe(cluster=0)


def test_the_network_learns_and_is_measured_beside_the_similarity(places: GoalPlaces) -> None:
    losses: list[float] = []
    recipe = Recipe(epochs=8, scenes=1, places=6, cluster=3, width=8, heads=2)
    network, _ = train([places], recipe, on_step=lambda step, steps, loss: losses.append(loss))
    assert losses[-1] < losses[0] - 0.05  # a running mean
    prior = measure_prior([places], recipe, draws=4)
    assert sum(prior["shares"]) == pytest.approx(1, abs=1e-3) and len(prior["similarity"]) == 9
    assert prior["similarity"][0][0] > prior["similarity"][5][0]  # near places look more like the goal
    found = evaluate(network, prior, [places], 0, most=40)
    assert found["pairs"] == 40 and 0.7 < found["auc"]["similarity"] <= 1 and 0 <= found["auc"]["network"] <= 1
    assert sum(row["pairs"] for row in found["bearing"].values()) <= 40
    for row in found["bearing"].values():
        assert row["pairs"] == 0 or 0 <= row["network"] <= 180


def test_the_shipped_network_knows_nearness_in_a_house_by_other_hands(data_dir: Path) -> None:
    network, card = load(WEIGHTS)
    house = record_goal_places(world(str(data_dir / "small_house" / "worlds" / "small_house.world"), "cpu"), 0)
    found = evaluate(network, card, [house], 0, 600)
    assert found["pairs"] == 600
    assert found["auc"]["network"] >= 0.85  # of "within 2 m"; docs/navigation-tasks.md has all figures


def test_scenes_without_ways_are_left_out_and_what_cannot_be_measured_is_none(places: GoalPlaces) -> None:
    network, _ = train([places], SMALL)
    prior = measure_prior([places], SMALL, draws=2)
    apart = replace(places, distances=np.where(np.eye(len(places)) > 0, 0, np.inf).astype(np.float16))
    assert require_places([apart, places]) == [places]
    with pytest.raises(ArgumentError, match="from one place to another"):
        require_places([apart])
    assert evaluate(network, prior, [apart, places], 0, most=10)["pairs"] == 10
    with pytest.raises(ArgumentError, match="within 9 m"):
        evaluate(network, prior, [apart], 0)
    far = replace(places, distances=np.where(np.eye(len(places)) > 0, 0, 5).astype(np.float16))
    found = evaluate(network, prior, [far], 0, most=10)
    assert found["auc"] == {"network": None, "similarity": None, "both": None}
    assert [row["pairs"] for row in found["bearing"].values()] == [0, 0, 10]


@pytest.mark.nightly
def test_the_command_trains_on_apartments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "weights.safetensors"
    command = ["train", "navigator", "--scenes", "apartments:train:2", "--val", "apartments:val:1", "--places", "6"]
    options: list[Any] = ["--epochs", "1", "--workers", "1", "--out", str(out), "--cache", str(tmp_path / "looks")]
    assert main([*command, *options]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "AUC within 2 m: network" in said and "matcher's similarity" in said and "median error" in said
    card = Navigator(out).card
    assert card["scenes"] == "apartments:train:2" and card["held_out"]["pairs"] == 400
    assert not list(tmp_path.glob("*.checkpoint"))
