# SPDX-License-Identifier: Apache-2.0
"""Validation while training: what it finds, that training does not notice it, and that the best weights are kept."""

from __future__ import annotations

import json
import sys
import types
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw.datasets.decisions import Decisions, save_decisions
from wiw.datasets.navigation import NavigationData
from wiw.errors import ArgumentError, DependencyError, FileError

pytest.importorskip("diffusers", reason="no diffusers: pip install 'wiw[diffusers]'")
pytest.importorskip("peft", reason="no peft: pip install 'wiw[diffusers]'")
pytest.importorskip("pyarrow", reason="no pyarrow: pip install 'wiw[export]'")

import torch
from post_training_parts import (
    make_trainer,
    read_log,
    require_same_bytes_when_stopped_at_sample,
    require_sampling_unnoticed,
    save_dataset,
    save_stock,
    tiny_recipe,
    with_nightly,
)

from wiw.training.held_out_clips import imagine_with
from wiw.training.post_training import validation
from wiw.training.post_training.families import FAMILIES, VideoFamily
from wiw.training.post_training.sampling import create_sampler
from wiw.training.post_training.trackers import open_tracker
from wiw.training.post_training.train import post_train, write_checkpoint
from wiw.training.post_training.training_log import TrainingLog
from wiw.training.post_training.validation import ValidatedTrainer
from wiw.types import Conditioning

NAMES = sorted(name for name, family in FAMILIES.items() if isinstance(family, VideoFamily))
SPLIT = {"held_out": 0.76, "validate_every": 2, "validate_clips": 3}
"""Share of the three scenes that leaves "house" for training."""
pytestmark = pytest.mark.usefixtures("one_torch_thread", "fewer_denoising_steps")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_dataset(tmp_path_factory.mktemp("validation") / "data")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory):
    return partial(save_stock, tmp_path_factory.mktemp("stock"))


@pytest.fixture
def train(data: Path, weights: Any):
    def train(out: Path, **options: Any) -> dict[str, Any]:
        recipe = tiny_recipe("ltx-action", **{"epochs": 5, **SPLIT, **options.pop("numbers", {})})
        given = {"weights": weights("ltx-action"), "device": "cpu", "recipe": recipe, "seconds": 0, **options}
        return post_train("ltx-action", data, out, **given)

    return train


@pytest.mark.parametrize("name", with_nightly(NAMES, ("ltx-action", "wan2.2-a14b-action")))
def test_training_does_not_notice_that_it_is_sampled(name: str, data: Path, weights: Any) -> None:
    plain, sampled = (make_trainer(name, data, weights(name), epochs=4, rows=4) for _ in range(2))
    sampler, last = create_sampler(sampled), plain.recipe.frames - 1
    images = Conditioning(np.full((2, *sampled.recipe.size, 3), 90, np.uint8))
    asked = images, np.ones((2, last), np.int8), np.arange(2, dtype=np.uint64), np.tile([1, last], (2, 1))
    require_sampling_unnoticed(plain, sampled, lambda: sampler(*asked))
    assert sampler(*asked).shape == (2, 2, *sampled.recipe.size, 3)


def test_what_is_sampled_in_training_is_what_the_checkpoint_imagines(data: Path, weights: Any, tmp_path: Path) -> None:
    name = "ltx-action"
    trainer = make_trainer(name, data, weights(name))
    trainer.train_step(1e-2)
    write_checkpoint(tmp_path / "out", trainer, {})
    recipe = trainer.recipe
    model = wiw.world_model(
        name, checkpoint=str(tmp_path / "out"), device="cpu", size=recipe.size, frames=recipe.frames
    )
    images = np.random.default_rng(0).integers(0, 255, (2, *recipe.size, 3)).astype(np.uint8)
    plans, wanted = np.array([[1, 2, 1, 1], [3, 3, 1, 2]], np.int8), np.array([[1, 4], [2, 3]])
    asked = Conditioning(images), plans, np.arange(2, dtype=np.uint64), wanted
    np.testing.assert_array_equal(create_sampler(trainer)(*asked), imagine_with(model)(*asked))


@pytest.mark.parametrize("name", with_nightly(NAMES, ("svd-action", "wan2.1-action")))
def test_in_half_precision_the_autoencoder_computes_as_in_the_world_model(name: str, data: Path, weights: Any) -> None:
    trainer = make_trainer(name, data, weights(name), precision="bfloat16")
    pipeline, found = trainer.model.objective.pipeline, {}

    def note(network: Any, _: Any, made: Any) -> None:
        found[network] = (made[0] if isinstance(made, tuple) else made).dtype

    denoisers = [getattr(pipeline, place) for place in trainer.model.places]
    for network in (pipeline.vae.decoder, *denoisers):
        network.register_forward_hook(note)
    size, last = trainer.recipe.clip_size, trainer.recipe.frames - 1
    observations = Conditioning(np.random.default_rng(0).integers(0, 256, (1, *size, 3), np.uint8))
    asked = np.ones((1, last), np.int8), np.zeros(1, np.uint64), np.array([[last]])
    assert create_sampler(trainer)(observations, *asked).std() > 0
    assert found == {pipeline.vae.decoder: pipeline.vae.dtype, **dict.fromkeys(denoisers, torch.bfloat16)}
    assert trainer.train_step(1e-3) > 0


def test_the_checkpoint_has_the_weights_that_were_best(train: Any, tmp_path: Path, monkeypatch: Any) -> None:
    scores = {0: 50.0, 2: 11.0, 4: 13.0, 5: 12.0}
    measured = []

    def measure(self: Any, imagine: Any, seed: int, between: Any) -> Any:
        measured.append(list(scores)[len(measured)])
        return {"psnr": scores[measured[-1]]}, np.zeros((8, 8, 3), np.uint8)

    monkeypatch.setattr(validation.ValidationSet, "measure", measure)
    told: list[tuple[int, float]] = []
    card = train(tmp_path / "out", on_validation=lambda step, found: told.append((step, found["psnr"])))
    assert measured == [0, 2, 4, 5] and told == list(scores.items())
    assert card["steps"] == 4 and card["validation"] == {"psnr": 13.0} and card["trained_steps"] == 5
    assert json.loads((tmp_path / "out" / "training.json").read_text()) == card
    monkeypatch.undo()
    shorter = train(tmp_path / "four", numbers={"epochs": 4, "validate_every": None, "schedule": "constant"})
    assert shorter["steps"] == 4 and "validation" not in shorter
    log = read_log(tmp_path / "out")
    assert [line["step"] for line in log if "loss" in line] == [1, 2, 3, 4, 5]
    assert {line["step"]: line["validation/psnr"] for line in log if "loss" not in line} == scores
    assert (tmp_path / "out.log" / "step-0000004.png").exists() and not (tmp_path / "out.log" / "best").exists()


def test_validation_is_on_held_out_scenes(data: Path, train: Any, tmp_path: Path) -> None:
    card = train(tmp_path / "out", numbers={"epochs": 2})
    assert card["validated_on"]["scenes"] == ["flat", "loft"]
    assert {row["scene"] for row in NavigationData(data, "train", 0.76).segments} == {"house"}
    names = {"psnr", "psnr/1", "psnr/4", "psnr/8", "ssim/1", "ssim/4", "ssim/8", "gap", "gap/displacements"}
    assert names <= set(card["validation"]) and card["steps"] == 2
    assert all(np.isfinite(value) for value in card["validation"].values())
    with pytest.raises(ArgumentError, match=r"no scene of .* is held out; collect more scenes"):
        train(tmp_path / "none", numbers={"held_out": 0.0})
    with pytest.raises(ArgumentError, match="scenes that are not trained on, got house"):
        train(tmp_path / "same", validation=data)


def test_another_dataset_may_be_validated_on(data: Path, train: Any, tmp_path: Path) -> None:
    other = save_dataset(tmp_path / "other", scenes=("attic", "barn"))
    card = train(tmp_path / "out", part="all", validation=other, numbers={"epochs": 1})
    assert card["validated_on"]["scenes"] == ["attic", "barn"]
    assert "validation" not in train(tmp_path / "alone", part="all", numbers={"epochs": 1})


@pytest.mark.parametrize("name", ["place/house", "house.v2"])
def test_a_scene_that_has_another_name_in_the_other_dataset_is_not_validated_on(
    name: str, train: Any, tmp_path: Path
) -> None:
    other = save_dataset(tmp_path / "other", scenes=("attic", name))
    with pytest.raises(ArgumentError, match=rf"scenes that are not trained on, got {name}; leave them out of .*other"):
        train(tmp_path / "out", part="all", validation=other)


@pytest.mark.parametrize("content", [None, "folder", "{}", "PAR1"])
def test_what_is_no_file_of_decisions_is_not_to_be_deleted(content: str | None, train: Any, tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    if content == "folder":
        path.mkdir()
    elif content is not None:
        path.write_text(content)
    with pytest.raises(FileError, match=r"mine\.json.*`wiw collect decisions` writes") as caught:
        train(tmp_path / "out", decisions=path)
    assert "delete" not in str(caught.value) and not (tmp_path / "out.log").exists()


@pytest.mark.parametrize(
    ("part", "every", "given", "said"),
    [
        ("all", 2, ["decisions"], "decisions: .*nowhere has no effect on a training without validation: --part all"),
        ("train", None, ["decisions"], "decisions: .*nowhere has no effect .*: the recipe's validate_every is null"),
        (
            "all",
            None,
            ["validation", "decisions"],
            "validation: .*nowhere has no effect .*: the recipe's validate_every is null",
        ),
    ],
)
def test_what_is_given_for_a_validation_that_there_is_not_is_refused(
    part: str, every: int | None, given: list[str], said: str, train: Any, tmp_path: Path
) -> None:
    with pytest.raises(ArgumentError, match=said):
        train(
            tmp_path / "out",
            part=part,
            numbers={"validate_every": every},
            **dict.fromkeys(given, tmp_path / "nowhere"),
        )
    assert not list(tmp_path.iterdir())


def test_rank_agreement_is_measured_on_stored_decisions(train: Any, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    seen = rng.integers(0, 255, (2, 5, 32, 64, 3)).astype(np.uint8)
    plans = np.array([[[1, 1, 0], [2, 1, 1], [3, 1, 0]]] * 2, np.int8)
    stored = Decisions(("a", "b"), seen[:, 0], seen[:, 1], plans, seen[:, 2:], rng.random((2, 3)))
    save_decisions(tmp_path / "d.parquet", stored)
    card = train(tmp_path / "out", decisions=tmp_path / "d.parquet", numbers={"epochs": 1})
    assert -1 <= card["validation"]["rank"] <= 1 and card["validation"]["regret"] >= 0
    assert len(card["validated_on"]["decisions"]) == 64
    save_decisions(tmp_path / "long.parquet", replace(stored, plans=np.ones((2, 3, 9), np.int8)))
    with pytest.raises(ArgumentError, match="at most 8 actions"):
        train(tmp_path / "other", decisions=tmp_path / "long.parquet")
    save_decisions(tmp_path / "seen.parquet", replace(stored, scenes=("a", "house")))
    with pytest.raises(ArgumentError, match="decisions: expected scenes that are not trained on, got house"):
        train(tmp_path / "third", decisions=tmp_path / "seen.parquet")


def test_a_training_that_is_stopped_while_it_validates_ends_with_the_same_bytes(
    train: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    require_same_bytes_when_stopped_at_sample(5, 4, train, tmp_path, monkeypatch)


@pytest.mark.parametrize("psnr", [8.0, 10.0])
def test_best_weights_of_a_step_that_is_to_come_stay_until_better_ones_are_found(psnr: float, tmp_path: Path) -> None:
    class Resumed:
        step_count = 0
        recipe = types.SimpleNamespace(seed=0)

        def load_state_dict(self, state: Any) -> None:
            self.step_count = state["count"]

    class Checked:
        every = 2

        def measure(self, *_: Any) -> Any:
            return {"psnr": psnr}, np.zeros((2, 2, 3), np.uint8)

    def save(folder: Path, found: Any) -> None:
        (folder / "training.json").write_text(json.dumps(found))

    log = TrainingLog(tmp_path / "metrics.jsonl")
    for step in (2, 4, 6):
        log.write(step, {"validation/psnr": float(step)})
    (tmp_path / "best").mkdir()
    save(tmp_path / "best", {"steps": 6, "validation": {"psnr": 9.0}})
    resumed = ValidatedTrainer(Resumed(), lambda *_: None, Checked(), log, save)  # type: ignore[arg-type]
    resumed.load_state_dict({"count": 4})
    assert [line["step"] for line in log.read()] == [2, 4]
    resumed.trainer.step_count = 6
    resumed.validate()  # on a GPU, with other weights than before it was stopped
    assert json.loads((resumed.best / "training.json").read_text())["validation"]["psnr"] == max(psnr, 9.0)


def test_a_log_forgets_what_comes_later_and_half_a_line(tmp_path: Path) -> None:
    log = TrainingLog(tmp_path / "a" / "metrics.jsonl")
    assert log.read() == []
    for step in (1, 2, 3):
        log.write(step, {"loss": step / 2})
    with log.path.open("a") as file:
        file.write('{"step": 4, "lo')
    assert [line["step"] for line in log.read()] == [1, 2, 3]
    log.rewind(2)
    assert [line["loss"] for line in log.read()] == [0.5, 1.0] and log.path.read_text().endswith("}\n")
    log.path.write_text("loss\n")
    with pytest.raises(FileError, match="one JSON object per line"):
        log.read()


# -- trackers ----------------------------------------------------------------------------------------------------------


class _Run:
    def __init__(self, told: list[Any], project: str) -> None:
        self.told, self.project = told, project

    def log(self, values: dict[str, float], step: int | None = None) -> None:
        self.told.append((step, values))

    def finish(self) -> None:
        self.told.append("finished")


@pytest.mark.parametrize("name", ["trackio", "wandb"])
def test_trackers_are_told_what_the_log_is(name: str, train: Any, tmp_path: Path, monkeypatch: Any) -> None:
    """A stand-in for the package, called by accelerate's own tracker."""
    told: list[Any] = []
    package = types.ModuleType(name)
    package.__spec__ = types.SimpleNamespace()  # type: ignore[assignment]
    begun: list[dict[str, Any]] = []

    def init(project: str, **options: Any) -> _Run:
        begun.append(options)
        return _Run(told, project)

    package.init = init  # type: ignore[attr-defined]
    package.config = types.SimpleNamespace(update=lambda values, **_: told.append(values))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, name, package)
    train(tmp_path / "out", tracker=name, numbers={"epochs": 2})
    config, *rest, end = told
    assert config["rate"] == 1e-5 and config["size"] == "[64, 128]" and end == "finished"
    log = [{**line} for line in read_log(tmp_path / "out")]
    assert rest == [(line.pop("step"), {k: v for k, v in line.items() if k != "seconds"}) for line in log]
    open_tracker(name, "out", tmp_path / "out.log", {})  # as when it resumes
    open_tracker(name, "out", tmp_path / "other.log", {})
    first, resumed, other = (options.get("id") or options["name"] for options in begun)
    assert first == resumed != other and all(options["resume"] == "allow" for options in begun)


@pytest.mark.extra
def test_tensorboard_is_told_what_the_log_is(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    tracker = open_tracker("tensorboard", "ltx", tmp_path, {"rate": 1e-3, "lora": None})
    tracker.log({"loss": 0.5, "validation/psnr": 20.0}, step=3)
    tracker.finish()
    events = EventAccumulator(str(tmp_path / "ltx")).Reload()
    assert [(each.step, each.value) for each in events.Scalars("loss")] == [(3, 0.5)]


def test_trackers_that_are_not_there_are_refused(tmp_path: Path, monkeypatch: Any) -> None:
    with pytest.raises(ArgumentError, match="one of trackio, wandb, tensorboard, got 'mlflow'"):
        open_tracker("mlflow", "run", tmp_path, {})
    monkeypatch.setattr("wiw.training.post_training.trackers.find_spec", lambda name: None if name == "wandb" else 1)
    with pytest.raises(DependencyError, match="needs wandb, which is not installed: pip install wandb"):
        open_tracker("wandb", "run", tmp_path, {})


def test_averaged_weights_are_what_is_validated(data: Path, weights: Any) -> None:
    name = "ltx-action"
    trainer = make_trainer(name, data, weights(name), ema=0.5)
    trainer.train_step(1e-1)
    sampler = create_sampler(trainer)
    shape = (1, *trainer.recipe.clip_size, 3)
    asked = (
        Conditioning(np.full(shape, 90, np.uint8)),
        np.ones((1, 4), np.int8),
        np.zeros(1, np.uint64),
        np.array([[4]]),
    )
    shown = sampler(*asked)
    with trainer.use_averages():
        averages = {key: value.detach().clone() for key, value in trainer.trained.items()}
    with torch.no_grad():
        for key, value in trainer.trained.items():
            value.copy_(averages[key])
            trainer.averages[key].copy_(averages[key])
    np.testing.assert_array_equal(sampler(*asked), shown)
