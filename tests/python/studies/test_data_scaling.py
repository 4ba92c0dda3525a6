# SPDX-License-Identifier: Apache-2.0
"""The data-scaling study: what its numbers mean, what is trained on what, and that it goes on where it was stopped."""

from __future__ import annotations

import itertools
import json
import math
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import wiw
from wiw.analysis.data_scaling import (
    EQUAL_UPDATES,
    FEWER_SCENES,
    ONE_EPOCH,
    Draws,
    Resampled,
    ScalingArm,
    ScalingTable,
    Success,
    fit_power_law,
    measure_trend,
    split_gain,
    summarise_scaling,
)
from wiw.analysis.statistics import estimate_mean
from wiw.cli import main
from wiw.errors import ArgumentError, FileError
from wiw.metrics.metric import SUCCESS
from wiw.policies.matcher.policy import SOURCE
from wiw.report.data_scaling_tables import explain

pytest.importorskip("pyarrow", reason="needs wiw[export]")
torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.datasets.navigation import NavigationData, SelectedClips, part_of  # noqa: E402
from wiw.runs.recipes import arm_recipes  # noqa: E402
from wiw.studies import data_scaling_plan as planning  # noqa: E402
from wiw.studies.data_scaling import DataScaling, _run_imagenav, make_plan, name_arms  # noqa: E402
from wiw.studies.data_scaling_plan import (  # noqa: E402
    SMALL,
    ScalingPlan,
    ScalingSettings,
    Training,
    choose_scenes,
    choose_sizes,
)
from wiw.studies.data_scaling_training import Material, TrainingJob, list_scenes  # noqa: E402
from wiw.studies.run_log import load_run  # noqa: E402
from wiw.training.collect_navigation import collect_navigation  # noqa: E402
from wiw.training.place_trainer import PlaceTrainer  # noqa: E402
from wiw.training.reduced_frames import reduce_frames  # noqa: E402
from wiw.training.warpnet import Recipe, compute_losses  # noqa: E402
from wiw.training.warpnet_clips import WarpNetClipRecipe, WarpNetClipTrainer, draw_pairs  # noqa: E402
from wiw.world_models.pocket.model import Pocket  # noqa: E402
from wiw.world_models.warpnet.network import Network, warp  # noqa: E402
from wiw.world_models.warpnet.weights import load  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SCENES = 10
SETTINGS = ScalingSettings(
    models=("warpnet",),
    size=(16, 32),
    length=6,
    batch=1,
    clips=9,
    sizes=3,
    held_out_clips=6,
    held_out=0.2,
    decisions_per_scene=3,
)


def tables(sums: Any, count: int = 10) -> dict[str, tuple[float, float]]:
    return {f"scene {row}": (count * float(value), count) for row, value in enumerate(sums)}


# -- numbers -----------------------------------------------------------------------------------------------------------


def test_a_power_law_is_found_again_and_its_interval_holds_it() -> None:
    sizes, rng = (32, 144, 688, 3200), np.random.default_rng(0)
    truth = 10 + 5 * (np.array(sizes) / 32) ** -0.5
    scenes = rng.normal(0, 1, 12)  # easy and hard scenes, the same for all trainings
    exact = Resampled({str(size): [tables(value + scenes)] for size, value in zip(sizes, truth, strict=True)})
    found = fit_power_law(sizes, [exact.mean(str(size)) for size in sizes])
    assert found.b.value == pytest.approx(5, abs=0.05) and found.c.value == pytest.approx(0.5, abs=0.011)
    assert found.a.value == pytest.approx(10 + scenes.mean(), abs=0.05)
    assert found.a.low < found.a.value < found.a.high and found.b.high - found.b.low < 0.1  # scenes move a alone


def test_draws_that_lack_a_training_have_no_part_in_the_interval_of_a_fit() -> None:
    sizes, rng = (32, 144, 688), np.random.default_rng(0)
    truth = 10 + 5 * (np.array(sizes) / 32) ** -0.5
    drawn = truth[:, None] + rng.normal(0, 0.01, (3, 400))
    whole = fit_power_law(sizes, [Draws(value, own) for value, own in zip(truth, drawn, strict=True)])
    drawn[1, ::3] = np.nan
    found = fit_power_law(sizes, [Draws(value, own) for value, own in zip(truth, drawn, strict=True)])
    assert whole.c.low > 0.4 and found.c.low == pytest.approx(whole.c.low, abs=0.03)


def test_a_fit_is_as_good_as_that_of_a_general_optimiser() -> None:
    from scipy.optimize import least_squares

    sizes, rng = np.array([32.0, 144.0, 688.0, 3200.0]), np.random.default_rng(1)
    for _ in range(4):
        values = rng.uniform(0.2, 1, 4)
        means = Resampled({str(row): [tables([value] * 3)] for row, value in enumerate(values)})
        own = fit_power_law(sizes.astype(int).tolist(), [means.mean(str(row)) for row in range(4)])

        def residuals(p: Any, values: Any = values) -> Any:
            return p[0] + p[1] * (sizes / 32) ** -p[2] - values

        starts = [least_squares(residuals, (0.3, 0.3, c), bounds=([0, 0, 0.01], [9, 9, 3])) for c in (0.05, 0.5, 2)]
        ours = residuals((own.a.value, own.b.value, own.c.value))
        assert own.a.value >= 0 and own.b.value >= 0
        assert (ours**2).sum() <= min(2 * each.cost for each in starts) + 1e-4


def test_a_trend_is_one_that_falls() -> None:
    rng = np.random.default_rng(0)
    falling = {str(row): [tables(5 - row + rng.normal(0, 0.1, 8)) for _ in range(4)] for row in range(4)}
    names = list(falling)
    assert measure_trend(Resampled(falling), names).p < 1e-4
    assert measure_trend(Resampled(falling), names[::-1]).p > 0.99
    assert np.isnan(measure_trend(Resampled(falling), names[:2]).p)  # of two sizes there is none


def draw_trainings(rng: Any, seeds: int, sizes: int, apart: float = 0.0) -> Resampled:
    """Trainings that differ by chance, each alike in all scenes; `apart` is what a size gains over the one before."""
    scenes, hard = rng.normal(0, 3, 12), rng.normal(0, 1, seeds)
    return Resampled(
        {
            str(size): [
                tables(30 - apart * size + hard[seed] + rng.normal(0, 0.3) + scenes + rng.normal(0, 0.05, 12))
                for seed in range(seeds)
            ]
            for size in range(sizes)
        }
    )


def test_what_trainings_differ_by_chance_is_no_trend() -> None:
    """Trainings vary more than their means over scenes are uncertain, so that each scene orders them alike."""
    rng, names = np.random.default_rng(0), [str(size) for size in range(4)]
    found = [measure_trend(draw_trainings(rng, 2, 4), names).p for _ in range(1500)]
    assert np.mean(np.array(found) <= 0.05) <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 1500)
    assert np.mean(np.array(found) <= 0.05) >= 0.02, "a test of nothing never rejects"
    assert np.mean([measure_trend(draw_trainings(rng, 2, 4, 0.5), names).p <= 0.05 for _ in range(200)]) > 0.9


@pytest.mark.parametrize(("seeds", "sizes"), [(2, 3), (2, 4), (3, 5)])
def test_the_trend_test_is_that_of_scipy_over_trainings(seeds: int, sizes: int) -> None:
    from scipy.stats import page_trend_test

    rng, names = np.random.default_rng(seeds), [str(size) for size in range(sizes)]
    for apart in (0.0, 0.1, 0.3):
        means = draw_trainings(rng, seeds, sizes, apart)
        own = measure_trend(means, names)
        peer = page_trend_test(-np.array([means.by_seed(name) for name in names]).T, method="exact")
        assert own.statistic == peer.statistic and own.p == pytest.approx(peer.pvalue)
        assert own.trainings == seeds * sizes


@pytest.mark.parametrize(("seeds", "sizes"), [(1, 3), (1, 4), (2, 4)])
def test_the_least_p_of_so_few_trainings_is_that_of_one_order_among_all(seeds: int, sizes: int) -> None:
    means = draw_trainings(np.random.default_rng(0), seeds, sizes, 10.0)
    found = measure_trend(means, [str(size) for size in range(sizes)])
    assert found.p == found.least_p == pytest.approx(math.factorial(sizes) ** -seeds)


def test_equal_trainings_share_their_rank() -> None:
    """With ties, p is the share of all orders of the shared ranks, tried one by one."""
    values = [[3.0, 2.0, 2.0], [3.0, 3.0, 1.0]]
    means = Resampled({str(size): [tables([own[size]] * 3) for own in values] for size in range(3)})
    found = measure_trend(means, ["0", "1", "2"])
    ranks = [[1, 2.5, 2.5], [1.5, 1.5, 3]]
    orders = [np.array(order) for order in itertools.product(*(itertools.permutations(row) for row in ranks))]
    seen = float((np.array(ranks) @ (1, 2, 3)).sum())
    assert found.statistic == seen
    assert found.p == pytest.approx(np.mean([(order @ (1, 2, 3)).sum() >= seen for order in orders]))


def test_many_sizes_are_ordered_at_random() -> None:
    from scipy.stats import page_trend_test

    means, names = draw_trainings(np.random.default_rng(4), 2, 9, 0.05), [str(size) for size in range(9)]
    found = measure_trend(means, names)
    peer = page_trend_test(-np.array([means.by_seed(name) for name in names]).T, method="exact").pvalue
    assert 0.01 < peer < 0.99 and found.p == pytest.approx(peer, abs=4 * np.sqrt(peer * (1 - peer) / 20_000))


@pytest.mark.parametrize(
    ("few", "few_long", "many", "verdict"),
    [(9, 3, 2, "mostly updates"), (9, 8, 2, "mostly data"), (2, 2, 2, "no gain")],
)
def test_a_gain_is_split_into_updates_and_data(few: float, few_long: float, many: float, verdict: str) -> None:
    rng = np.random.default_rng(0)
    means = Resampled(
        {name: [tables(value + rng.normal(0, 0.2, 9)) for _ in range(2)] for name, value in
         (("few", few), ("few long", few_long), ("many", many))}
    )  # fmt: skip
    split = split_gain(means, "few", "few long", "many")
    assert split.verdict == verdict
    assert split.updates.value + split.data.value == pytest.approx(split.total.value)
    assert split.total.value == pytest.approx(few - many, abs=0.4)


def test_trainings_are_paired_by_scene_and_seed() -> None:
    """What makes a scene or a seed hard for all cancels in a difference."""
    rng = np.random.default_rng(0)
    hard = [rng.normal(0, 3, 10) for _ in range(3)]
    means = Resampled({"a": [tables(20 + own) for own in hard], "b": [tables(19 + own) for own in hard]})
    assert (means.mean("a") - means.mean("b")).interval().low == pytest.approx(1)
    own = means.mean("a").interval()
    assert own.high - own.low > 1


def test_draws_of_scenes_without_a_value_are_left_out() -> None:
    few = {"a": [10.0, 2.0], "b": [12.0, 2.0]}
    means = Resampled({"a": [{**few, "c": [0.0, 0.0], "d": [0.0, 0.0]}]})
    found = means.mean("a")
    assert np.isnan(found.drawn).any()
    assert found.interval().low >= 5 and found.interval().high <= 6


def make_scene_table(seeds: int, gains: dict[str, float]) -> ScalingTable:
    """Models of which ten scenes gain so much over two, alike in every scene and seed."""
    arms, measures = [], {}
    for model, gain in gains.items():
        settings = [f"{model} {amount}" for amount in (1, 2, 3)]
        arms += [
            ScalingArm(model, name, (1, 2, 3), 3, (1, 2, 3), tuple(settings)) for name in (ONE_EPOCH, EQUAL_UPDATES)
        ]
        arms.append(ScalingArm(model, FEWER_SCENES, (2, 10), 3, (3, 3), (settings[0], settings[-1])))
        for row, setting in enumerate(settings):
            measures[setting] = [
                {"error": tables(20 - gain * (row == 2) + 0.01 * seed + np.arange(8))} for seed in range(seeds)
            ]
    return summarise_scaling(arms, measures, {"error": "error"}, {})


@pytest.mark.parametrize(("seeds", "p"), [(2, 1.0), (6, 2 * 2 / 2**6), (7, 2 * 2 / 2**7)])
def test_scenes_are_said_to_gain_where_the_adjusted_test_over_trainings_finds_it(seeds: int, p: float) -> None:
    """However surely two trainings differ in the scenes measured, so few may do so by chance."""
    table = make_scene_table(seeds, {"warpnet": 3.0, "pocket": 3.0})
    curves = [table.find_curve(model, FEWER_SCENES, "error") for model in table.models]
    assert all(curve.gain.low > 2.9 for curve in curves)
    assert [curve.gain_p for curve in curves] == pytest.approx([p, p])
    said = [line for line in explain(table) if "instead of 2 gain" in line]
    assert ["this may be chance" in line for line in said] == [p > 0.05] * 2
    assert table.find_curve("warpnet", ONE_EPOCH, "error").gain_p is None


def test_a_gain_that_is_unknown_in_a_seed_is_not_tested() -> None:
    table = make_scene_table(6, {"warpnet": 3.0, "pocket": math.nan})
    known, unknown = (table.find_curve(model, FEWER_SCENES, "error") for model in ("warpnet", "pocket"))
    assert known.gain_p == pytest.approx(2 / 2**6) and known.is_gain_shown
    assert unknown.gain_p is None and not unknown.is_gain_shown
    assert any("pocket, error: " in line and "gain –: this may be chance" in line for line in explain(table))


# -- the plan ----------------------------------------------------------------------------------------------------------


def test_sizes_are_whole_batches_over_two_orders_of_magnitude() -> None:
    assert choose_sizes(3200, 16) == (32, 144, 688, 3200)
    assert choose_sizes(12_800, 16) == (128, 592, 2752, 12_800)
    with pytest.raises(ArgumentError, match=r"60 clips are too few for 4 sizes .* expected 1600 or more, or fewer"):
        choose_sizes(60, 16)
    for few in (10, -5):
        with pytest.raises(ArgumentError, match=f"{few} clips are too few"):
            choose_sizes(few, 16)
    with pytest.raises(ArgumentError, match=r"3200 clips are too few for 20 sizes .*; expected fewer --sizes"):
        choose_sizes(3200, 16, 20)


def test_the_fewest_scenes_have_the_clips_whichever_they_are() -> None:
    assert choose_scenes([100] * 32, (30, 150, 900)) == ((2, 8, 32), 150)
    assert choose_scenes([10, 100, *[500] * 8], (32, 144)) == ((2, 10), 32)
    with pytest.raises(ArgumentError, match="expected 8 training scenes or more"):
        choose_scenes([100] * 7, (30,))


def test_arms_differ_in_what_they_are_named_after() -> None:
    plan = ScalingPlan(SMALL, "", (32, 144, 688, 3200), (2, 10), 688)
    arms = plan.list_arms("pocket", 1)
    assert [each.updates for each in arms[ONE_EPOCH]] == [2, 9, 43, 200]
    assert {each.updates for each in arms[EQUAL_UPDATES]} == {200}
    assert [(each.clips, each.scenes) for each in arms[FEWER_SCENES]] == [(688, 2), (688, 10)]
    trainings = plan.list_trainings()
    assert len(trainings) == len(set(trainings)) == 2 * 2 * (4 + 3 + 1)
    assert len({each.name for each in trainings}) == len(trainings)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"models": ("svd",)}, "expected models among warpnet, pocket, got"),
        ({"seeds": (1, 1)}, "expected different seeds"),
        ({"sizes": 2}, "at least 3 sizes"),
        ({"length": 4}, "clips of at least 5 frames, as errors are measured after 4 actions, got a length of 4"),
    ],
)
def test_settings_that_make_no_study_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        replace(SMALL, **changes)


# -- a study in miniature ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, two_rooms: str) -> Path:
    """Two rooms under ten names, of which two are held out."""
    folder = tmp_path_factory.mktemp("scaling")
    numbers: dict[str, list[int]] = {"train": [], "held-out": []}
    for number in range(60):
        numbers[part_of(f"room{number}", SETTINGS.held_out)].append(number)
    chosen = [*numbers["train"][: SCENES - 2], *numbers["held-out"][:2]]
    shutil.copy(Path(two_rooms).with_suffix(".mtl"), folder)
    scenes = [shutil.copy(two_rooms, folder / f"room{number}.obj") for number in chosen]
    rules = {"min_samples": 40, "spacing": 2.0, "leaf_ratio": 0.3}
    collect_navigation(folder / "data", scenes, rules=rules, size=(32, 64), seed=3, backend="cpu")
    return folder / "data"


@pytest.fixture(scope="module")
def study(dataset: Path, two_rooms: str, tmp_path_factory: pytest.TempPathFactory) -> DataScaling:
    folder = tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planning, "SPAN", 9)
        return wiw.data_scaling(dataset, folder, replace(SETTINGS, decision_scenes=two_rooms))


def test_a_pair_of_a_clip_faces_from_one_place_to_the_other(dataset: Path, tmp_path: Path) -> None:
    """With the true distances the second panorama is the warp of the first, straight ahead."""
    data = NavigationData(dataset)
    frames, clips = reduce_frames(data, (32, 64), tmp_path), data.clips(8)
    rows = [row for row in range(0, len(clips), 40) if len(np.unique(clips[row].sources)) > 4]
    chosen = SelectedClips(clips, rows)
    assert chosen.locate(1) == clips.locate(rows[1]) and chosen.describe(1) == clips.describe(rows[1])
    np.testing.assert_array_equal(chosen[1].poses, clips[rows[1]].poses)
    places = [frames.find_places(*chosen.locate(row), 8) for row in range(len(chosen))]
    pairs = draw_pairs(frames, places, np.random.default_rng(0))
    errors = {
        ahead: float((warp(pairs.source, pairs.log_distance, ahead * pairs.ahead) - pairs.target).abs().mean())
        for ahead in (-1, 0, 1)
    }
    assert errors[1] < 0.6 * errors[0] < 0.6 * errors[-1]
    losses = compute_losses(Network(32, (8, 8, 8))(pairs.source, pairs.ahead), pairs, Recipe())
    assert losses.shape == (len(chosen),) and (losses > 0).all()


def test_warpnet_learns_clips_by_heart(dataset: Path, tmp_path: Path) -> None:
    data = NavigationData(dataset)
    recipe = WarpNetClipRecipe(frames=8, size=(32, 64), batch=4, clips=4, widths=(8, 16, 16), precision="float32")
    trainer = WarpNetClipTrainer(data.clips(8), reduce_frames(data, (32, 64), tmp_path), recipe)
    losses = [trainer.train_step(5e-3) for _ in range(30)]
    assert np.mean(losses[-10:]) < 0.9 * np.mean(losses[:10])


def test_subsets_are_nested(dataset: Path) -> None:
    data = NavigationData(dataset, "train", SETTINGS.held_out)
    clips = data.clips(SETTINGS.length)
    scenes = list_scenes(data, clips)
    assert [scenes[row] for row in (0, len(clips) - 1)] == [clips[row].scene for row in (0, len(clips) - 1)]
    material = Material(clips, scenes, None, None, None)  # type: ignore[arg-type]
    rows = [set(material.select_rows(Training("warpnet", 9, count, 1, 0)).tolist()) for count in (2, SCENES - 2)]
    assert rows[0] < rows[1] == set(range(len(clips)))
    assert len(set(scenes[sorted(rows[0])])) == 2
    others = set(material.select_rows(Training("warpnet", 9, 2, 1, 1)).tolist())
    assert others != rows[0]


def test_the_plan_is_written_first_and_all_trainings_are_there(study: DataScaling) -> None:
    plan = json.loads((study.out / "plan.json").read_text())
    assert list(plan)[:2] == ["primary", "registered"] and plan["clips"] == [1, 3, 9] and plan["scenes"] == [2, 8]
    trainings = study.plan.list_trainings()
    files = list((study.out / "measures").iterdir())
    assert len(files) == len(trainings) == 2 * (3 + 2 + 1)
    assert (study.out / "plan.json").stat().st_mtime_ns < min(file.stat().st_mtime_ns for file in files)


def test_numbers_are_those_of_the_trainings(study: DataScaling) -> None:
    """The curve's value is the mean over seeds of the pooled error in their files."""
    curve = study.table.find_curve("warpnet", EQUAL_UPDATES, "error")
    for row, name in enumerate(curve.arm.trainings):
        found = []
        for seed in (0, 1):
            own = json.loads((study.out / "measures" / f"{name}-seed-{seed}.json").read_text())
            sums, counts = np.array(list(own["measures"]["error"].values())).T
            found.append(sums.sum() / counts.sum())
        assert curve.by_seed[row] == pytest.approx(found)
        assert curve.values[row].value == pytest.approx(np.mean(found))
    assert study.table.references["oracle"]["regret"] <= study.table.references["chance"]["regret"]
    assert 0 < study.table.references["turns alone"]["error"] < 255


def test_weights_load_into_their_world_model(study: DataScaling) -> None:
    file = next(iter(sorted((study.out / "weights").iterdir())))
    model = wiw.world_model("warpnet", weights=file)
    assert model.card["training"]["model"] == "warpnet" and model.card["recipe"]["batch"] == 1


def test_the_page_shows_verdicts_figure_and_plan(study: DataScaling, tmp_path: Path) -> None:
    pages = replace(study, out=tmp_path).save()
    assert [page.name for page in pages] == [f"data-scaling.{kind}" for kind in ("html", "svg", "png", "json")]
    text = pages[0].read_text()
    assert text.count("<svg") == 1 and "<script" not in text
    for expected in (
        *(each.split.verdict for each in study.table.splits),
        "Page&#39;s test",
        "equal updates",
        "8 scenes",
        "6 trainings cannot show less than p 0.028",
    ):
        assert expected in text
    numbers = json.loads(pages[3].read_text())
    assert {row["measure"] for row in numbers["splits"]} == {"error", "regret"}


def test_a_finished_study_is_not_trained_again(
    study: DataScaling, dataset: Path, two_rooms: str, monkeypatch: Any, capsys: Any
) -> None:
    monkeypatch.setattr(planning, "SPAN", 9)
    monkeypatch.setattr(TrainingJob, "run", None)
    numbers = {"models": "warpnet", "clips": 9, "sizes": 3, "held-out": 0.2, "held-out-clips": 6}
    command = ["study", "data-scaling", "--data", str(dataset), "--out", str(study.out), "--size", "16", "32"]
    command += [word for name, value in numbers.items() for word in (f"--{name}", str(value))]
    command += ["--decision-scenes", two_rooms, "--decisions-per-scene", "3"]
    monkeypatch.setattr(planning, "FULL", replace(planning.FULL, length=6, batch=1))
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "data-scaling.html" in printed and "The gain of one epoch, split" in printed
    assert main([*command, "--seeds", "0"]) == 2
    assert "different study: seeds was [0, 1], now [0]" in " ".join(capsys.readouterr().err.split())


def test_a_training_that_was_stopped_ends_with_the_same_weights(
    study: DataScaling, dataset: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    training = study.plan.list_arms("warpnet", 1)[ONE_EPOCH][-1]
    shutil.copytree(study.out / "frames", tmp_path / "frames")
    shutil.copy(study.out / "decisions.parquet", tmp_path)
    job = TrainingJob(training, study.plan, dataset, tmp_path)
    step, done = PlaceTrainer.train_step, []

    def stop_at_sixth(self: PlaceTrainer, rate: float) -> float:
        done.append(rate)
        if len(done) == 6:
            raise KeyboardInterrupt
        return step(self, rate)

    monkeypatch.setattr("wiw.studies.data_scaling_training.SAVED_EVERY", 0.0)
    monkeypatch.setattr(PlaceTrainer, "train_step", stop_at_sixth)
    with pytest.raises(KeyboardInterrupt):
        job.run()
    assert job.read_measures() is None and not job.weights.exists()
    job.run()
    assert len(done) == 6 + training.updates - 5
    (resumed, card), (whole, expected) = load(job.weights), load(study.out / "weights" / job.weights.name)
    assert card == expected
    for name, value in whole.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], value), name
    assert list(job.weights.parent.iterdir()) == [job.weights]


def test_models_whose_episodes_all_ended_with_errors_are_left_out(
    study: DataScaling, monkeypatch: pytest.MonkeyPatch
) -> None:
    rate = estimate_mean([0.0, 1.0], ["a", "b"], SUCCESS)
    arms = [SimpleNamespace(name="none", estimates={"success": rate}), SimpleNamespace(name="broken", estimates={})]
    log = SimpleNamespace(numbers=lambda: SimpleNamespace(arms=arms))
    monkeypatch.setattr("wiw.studies.evaluate.evaluate", lambda *_, **__: log)
    assert _run_imagenav([], study.plan, study.out, 2, 1) == [Success("none", rate)]


def test_models_become_arms_of_a_run(study: DataScaling, dataset: Path) -> None:
    jobs = [TrainingJob(training, study.plan, dataset, study.out) for training in study.plan.list_trainings()]
    arms = arm_recipes(wiw.Agent("matcher", "copy"), {"none": "none", **name_arms(jobs, 1)})
    assert len(arms) == 1 + len(jobs) // 2
    arm = arms[jobs[-1].training.setting]
    model = wiw.world_model(arm.model, **arm.model_options)
    assert model.card["training"] == asdict(jobs[-1].training)
    assert model.accepts.size == SOURCE and not model.accepts.is_scalable, "the loop does not ask it for less itself"
    finer = replace(jobs[-1], plan=replace(study.plan, settings=replace(SETTINGS, size=(160, 320))))
    assert name_arms([finer], 1)[finer.training.setting].endswith("&size=[160, 320]"), "no less than the network's"


@pytest.mark.nightly
def test_trained_models_run_an_episode_in_closed_loop(study: DataScaling, dataset: Path, tmp_path: Path) -> None:
    jobs = [TrainingJob(training, study.plan, dataset, study.out) for training in study.plan.list_trainings()]
    arms = name_arms(jobs, study.plan.settings.seeds[0])
    found = _run_imagenav(jobs, study.plan, tmp_path, 1, 1)
    assert [each.name for each in found] == ["none", *arms]
    assert all(each.success.value in (0, 100) for each in found)
    log = load_run(tmp_path / "imagenav-1")
    assert [episode["status"] for episode in log.episodes] == ["done"] * len(found)
    assert all(log.store.info["built"][name]["model"]["size"] == list(SOURCE) for name in arms)
    again = _run_imagenav(jobs, study.plan, tmp_path, 1, 1)
    assert [each.success.value for each in again] == [each.success.value for each in found]
    assert load_run(tmp_path / "imagenav-1").decisions == log.decisions, "what is finished is not run again"


def test_pocket_is_trained_and_measured_by_the_same_job(
    study: DataScaling, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = Training("pocket", 2, 2, 1, 0)
    rates, stock = [], PlaceTrainer.train_step
    monkeypatch.setattr(PlaceTrainer, "train_step", lambda self, rate: (rates.append(rate), stock(self, rate))[1])
    measures = TrainingJob(training, study.plan, dataset, study.out).run()
    assert len(rates) == 1 and rates[0] > 0, "a single update has an effect"
    assert {"error", "regret", "psnr/1", "gap/displacements"} <= set(measures)
    file = study.out / "weights" / f"{training.name}.safetensors"
    assert Pocket(file).card["recipe"]["ema"] == 0
    file.unlink()
    (study.out / "measures" / f"{training.name}.json").unlink()


def test_a_dataset_that_is_too_small_says_so(dataset: Path) -> None:
    with pytest.raises(ArgumentError, match=r"expected 12800 clips of 6 frames .* or use fewer clips \(--clips \d+\)"):
        make_plan(dataset, replace(SETTINGS, clips=12_800))
    with pytest.raises(ArgumentError, match="0 held out; choose another share"):
        make_plan(dataset, replace(SETTINGS, held_out=0.0))
    with pytest.raises(ArgumentError, match="expected a dataset for 12,800 clips"):
        wiw.data_scaling(None)


def test_a_dataset_without_one_of_its_files_is_refused(dataset: Path, tmp_path: Path) -> None:
    lacking = shutil.copytree(dataset, tmp_path / "data")
    next(lacking.glob("data/*.parquet")).unlink()
    with pytest.raises(FileError, match=r"\.parquet is missing; copy it again"):
        make_plan(lacking, SETTINGS)


def test_decisions_in_scenes_that_are_trained_on_are_refused(dataset: Path) -> None:
    trained, held_out = (
        NavigationData(dataset, part, SETTINGS.held_out).segments[0]["scene"] for part in ("train", "held-out")
    )
    with pytest.raises(ArgumentError, match=rf"scenes that are not trained on, got .*{trained}\.obj"):
        make_plan(dataset, replace(SETTINGS, decision_scenes=str(dataset.parent / f"{trained}.obj")))
    others = replace(SETTINGS, clips=12_800, decision_scenes=str(dataset.parent / f"{held_out}.obj"))
    with pytest.raises(ArgumentError, match="expected 12800 clips"):  # the next thing that is checked
        make_plan(dataset, others)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"size": (24, 48)}, "size: expected a height of a multiple of 16"),
        ({"clips": 60}, "60 clips are too few for 4 sizes"),
        ({"decision_scenes": "nowhere.obj"}, "nowhere.obj: no such file"),
    ],
)
def test_what_cannot_be_trained_or_measured_is_refused_before_anything_is_collected(
    changes: dict[str, Any], said: str, tmp_path: Path
) -> None:
    with pytest.raises((ArgumentError, FileError), match=said):
        wiw.data_scaling(None, tmp_path / "study", replace(SMALL, **changes))
    assert not (tmp_path / "study").exists()


def test_torchruns_processes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "4")
    with pytest.raises(ArgumentError, match="expected a single process, got 4 from torchrun; start one"):
        wiw.data_scaling(None, tmp_path / "study", SMALL)
    assert not (tmp_path / "study").exists()


def test_a_dataset_without_depth_is_refused(dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset, tmp_path / "data")
    meta = json.loads((dataset / "meta.json").read_text())
    meta["config"]["depth"] = False
    (tmp_path / "data" / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(ArgumentError, match="expected a dataset with depth"):
        make_plan(tmp_path / "data", SETTINGS)


def test_without_a_dataset_it_collects_its_own(two_rooms: str, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(planning, "SPAN", 9)
    monkeypatch.setattr("wiw.studies.data_scaling.SMALL_SCENES", two_rooms)
    monkeypatch.setattr("wiw.studies.data_scaling.SMALL_SIZE", (32, 64))
    seen: list[tuple[Any, ...]] = []
    with pytest.raises(ArgumentError, match="collect more scenes"):  # one is not enough
        wiw.data_scaling(
            None, tmp_path, SETTINGS, watch=lambda name, done, total, text: seen.append((name, done, total))
        )
    assert seen == [("scenes", 1, 1)]
    assert NavigationData(tmp_path / "data")[0].images.shape[1:] == (32, 64, 3)
