# SPDX-License-Identifier: Apache-2.0
"""Errors on held-out clips and regret in stored decisions: what perfect, turning and idle models get."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw import action
from wiw.cli.app import main
from wiw.datasets.decisions import Decisions, load_decisions, read_scenes, save_decisions
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, FileError
from wiw.metrics import psnr
from wiw.training.construct_decisions import DecisionRules, construct_decisions
from wiw.training.decision_errors import measure_decisions
from wiw.training.held_out_clips import (
    fit_steps,
    imagine_with,
    measure_clips,
    shuffle_plans,
)
from wiw.training.held_out_panoramas import PanoramaClips, turn_panoramas
from wiw.types import Conditioning

pytest.importorskip("pyarrow", reason="no pyarrow: pip install 'wiw[export]'")

HEIGHT, WIDTH, STEPS = 16, 32, (1, 4, 8)


def show(image: np.ndarray, plan: np.ndarray, step: int) -> np.ndarray:
    """A world in which every place has a colour of its own and turns roll the picture."""
    x, y, azimuth = action.to_trajectory(plan)[step - 1]
    shifted = np.clip(image + 40.0 * np.array([x, y, 0.5 * x]), 0, 255).astype(np.uint8)
    return turn_panoramas(shifted, np.array(azimuth))


def imagine_truth(observations: Any, plans: Any, seeds: Any, wanted: Any) -> np.ndarray:
    rows = zip(observations.image, plans, wanted, strict=True)
    return np.stack([[show(image, plan, s) for s in own] for image, plan, own in rows])


def imagine_turns(observations: Any, plans: Any, seeds: Any, wanted: Any) -> np.ndarray:
    azimuth = np.stack([action.to_trajectory(plan)[own - 1, 2] for plan, own in zip(plans, wanted, strict=True)])
    return turn_panoramas(np.repeat(observations.image[:, None], wanted.shape[1], 1), azimuth)


@pytest.fixture(scope="module")
def clips() -> PanoramaClips:
    rng = np.random.default_rng(0)
    images = rng.integers(60, 180, (12, HEIGHT, WIDTH, 3)).astype(np.uint8)
    plans = rng.integers(1, 4, (12, 9)).astype(np.int8)
    plans[0] = 2  # turns alone
    wanted = np.tile(STEPS, (12, 1))
    frames = np.concatenate([images[:, None], imagine_truth(Conditioning(images), plans, None, wanted)], axis=1)
    return PanoramaClips(("a", "b") * 6, frames, plans, shuffle_plans(plans, rng), STEPS)


def test_a_perfect_model_has_no_error_and_a_gap(clips: PanoramaClips) -> None:
    errors, (own, _) = measure_clips(imagine_truth, clips, batch=5)
    found = errors.summarise()
    np.testing.assert_array_equal(own, clips.frames[:, 1:])
    assert found["psnr"] == found["psnr/4"] == found["psnr/turns"] == 100 and found["ssim/8"] == pytest.approx(1)
    assert found["gap"] > found["gap/displacements"] > 10


def test_a_model_of_turns_alone_has_no_gap_of_displacements(clips: PanoramaClips) -> None:
    found = measure_clips(imagine_turns, clips)[0].summarise()
    assert found["gap/displacements"] == 0 and found["gap"] > 1
    assert found["psnr/turns"] == 100 > found["psnr"]


def test_means_are_over_frames_from_another_place(clips: PanoramaClips) -> None:
    errors, _ = measure_clips(imagine_turns, clips)
    assert not errors.counted[0].any() and errors.counted.any()
    places = np.stack([action.to_trajectory(plan)[np.array(STEPS) - 1, :2] for plan in clips.plans])
    np.testing.assert_array_equal(errors.counted, np.linalg.norm(places, axis=-1) > 0.1)
    assert errors.summarise()["psnr/4"] == errors.psnr[errors.counted[:, 1], 1].mean()
    by_hand = psnr(
        imagine_turns(Conditioning(clips.frames[3:4, 0]), clips.plans[3:4], 0, np.array([[4]]))[0, 0],
        clips.frames[3, 2],
    )
    assert errors.psnr[3, 1] == pytest.approx(by_hand, abs=2)  # latitudes weigh a little


def test_shuffled_plans_are_those_of_other_clips() -> None:
    plans = np.arange(20, dtype=np.int8).reshape(10, 2)
    shuffled = shuffle_plans(plans, np.random.default_rng(1))
    assert sorted(map(tuple, shuffled)) == sorted(map(tuple, plans)) and (shuffled != plans).all()
    assert sorted(shuffle_plans(plans[:1], np.random.default_rng(1))[0]) == [0, 1]
    assert fit_steps((1, 4, 8, 14), 8) == (1, 4, 8) and fit_steps((1, 4), 2) == (1, 2)
    with pytest.raises(ArgumentError, match="at least 2 frames"):
        fit_steps((1,), 0)


def test_turning_is_rolling() -> None:
    frames = np.random.default_rng(0).integers(0, 255, (2, 3, 4, 32, 3)).astype(np.uint8)
    turned = turn_panoramas(frames, np.array([[0.0, np.pi / 8, -np.pi / 4]] * 2))
    for column, roll in enumerate((0, 2, -4)):
        np.testing.assert_array_equal(turned[:, column], np.roll(frames[:, column], roll, axis=2))


def test_a_world_model_imagines_what_is_wanted(clips: PanoramaClips) -> None:
    frames = imagine_with(wiw.world_model("copy"))(
        Conditioning(clips.frames[:, 0]), clips.plans, np.zeros(12, np.uint64), np.tile([1, 9], (12, 1))
    )
    np.testing.assert_array_equal(frames, np.repeat(clips.frames[:, :1], 2, axis=1))


# -- decisions ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def decisions(two_rooms: str) -> Decisions:
    return construct_decisions(world(two_rooms), 6, 0, DecisionRules(plans=3, size=(16, 32)))


def test_decisions_show_where_plans_lead(decisions: Decisions) -> None:
    assert decisions.futures.shape == (6, 3, 16, 32, 3) and len(decisions) == 6
    path = action.to_trajectory(decisions.plans)[np.arange(6)[:, None], np.arange(3), decisions.lengths - 1]
    assert (np.linalg.norm(path[..., :2], axis=-1) > 0.39).all()
    assert len({tuple(plan) for plan in decisions.plans[0]}) == 3
    errors = measure_decisions(lambda *asked: _answer(decisions, asked), decisions)
    np.testing.assert_array_equal(errors.regret, errors.oracle)  # who sees the true ends chooses as the oracle does
    assert (errors.agreement == 1).all() and errors.oracle.mean() < 0.5 * errors.chance.mean()


def _answer(decisions: Decisions, asked: Any) -> np.ndarray:
    images, plans = asked[0].image, asked[1]
    index = next(i for i, image in enumerate(decisions.images) if np.array_equal(image, images[0]))
    return turn_panoramas(decisions.futures[index], action.to_trajectory(plans)[:, -1, 2])[:, None]


def test_who_imagines_nothing_chooses_the_first(decisions: Decisions) -> None:
    errors = measure_decisions(imagine_turns, decisions)
    assert np.isnan(errors.agreement).all() and "rank" not in errors.summarise()
    np.testing.assert_array_equal(errors.regret, decisions.distances[:, 0] - decisions.distances.min(axis=1))


def test_decisions_are_stored(decisions: Decisions, tmp_path: Path) -> None:
    save_decisions(tmp_path / "d.parquet", decisions)
    again = load_decisions(tmp_path / "d.parquet")
    assert tuple(read_scenes(tmp_path / "d.parquet")) == again.scenes
    assert again.scenes == decisions.scenes
    for name in ("images", "goals", "plans", "futures", "distances"):
        np.testing.assert_array_equal(getattr(again, name), getattr(decisions, name))
    (tmp_path / "d.parquet").write_bytes(b"PAR1")
    with pytest.raises(FileError, match="damaged"):
        load_decisions(tmp_path / "d.parquet")
    with pytest.raises(FileError):
        read_scenes(tmp_path / "d.parquet")


def test_rules_of_decisions_are_checked() -> None:
    with pytest.raises(ArgumentError, match="8 actions more"):
        DecisionRules(actions=9)
    with pytest.raises(ArgumentError, match="2 to 16 plans"):
        DecisionRules(plans=1)


def test_the_command_collects_decisions(two_rooms: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "d.parquet"
    command = ["collect", "decisions", "--scenes", two_rooms, "--per-scene", "2", "--size", "16", "32"]
    assert main([*command, "--plans", "3", "--seed", "-1", "--out", str(out)]) == 2
    assert "seed: expected a whole number" in capsys.readouterr().err
    assert main([*command, "--plans", "3", "--out", str(out)]) == 0
    assert "2 decisions between 3 plans" in capsys.readouterr().out
    stored = load_decisions(out)
    same = construct_decisions(world(two_rooms), 2, 0, DecisionRules(plans=3, size=(16, 32)))
    np.testing.assert_array_equal(stored.futures, same.futures)
