# SPDX-License-Identifier: Apache-2.0
"""Quality against success: formulas, scorers in processes of their own, the same frames of all arms, and the page."""

from __future__ import annotations

import json
import math
import os
import signal
import sqlite3
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from locations import ROOT
from scipy import stats

import wiw
from wiw.analysis import intervals, rank_correlation
from wiw.analysis.quality import Sample, add_paper_quality, summarise_quality
from wiw.analysis.rank_correlation import correlate, permutation_p, spearman
from wiw.cli import main
from wiw.errors import ArgumentError, ScorerError, StoreError, WeightsError
from wiw.metrics import colourfulness, paper_quality, sharpness, ssim
from wiw.metrics.metric import SUCCESS
from wiw.policies.base import FrameSpec
from wiw.policies.matcher.policy import Matcher
from wiw.runs.config import RunConfig
from wiw.runs.frame_scores import FrameScores
from wiw.runs.imagined_frames import FrameKey, list_frames, read_frames, sample_frames
from wiw.scorers import LaionScorer, ProcessScorer, laion, make_scorer
from wiw.studies.evaluate import run_arms

CARD = '{"scorer": "toy", "version": "1", "licence": "MIT", "scores": {"aesthetic": [1, 10], "musiq": [0, 100]}}'
GOOD = 'print(json.dumps({"path": p, "scores": {"aesthetic": 5.0, "musiq": size / 1000}}), flush=True)'


def write_scorer(folder: Path, answer: str = GOOD, card: str = CARD, end: str = "pass") -> str:
    """Write a scorer and return the command that runs it; `answer` is done for path p of `size` bytes, number i."""
    file = folder / "my scorer.py"
    file.write_text(
        "import json, os, sys, time\n"
        f"print('''{card}''', flush=True)\n"
        "for i, line in enumerate(sys.stdin):\n"
        "    p = line.rstrip(chr(10)); size = os.path.getsize(p)\n"
        f"    {answer}\n"
        f"{end}\n"
    )
    return f"'{sys.executable}' '{file}'"


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    rng = np.random.default_rng(0)
    found = [tmp_path / f"{index}.png" for index in range(4)]
    for path in found:
        cv2.imwrite(str(path), rng.integers(0, 256, (12, 16, 3), np.uint8))
    return found


# -- formulas --------------------------------------------------------------------------------------------------------


def test_sharpness_is_the_variance_of_the_laplacian() -> None:
    image = np.random.default_rng(1).integers(0, 256, (9, 13, 3), np.uint8)
    luma = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    padded = np.pad(luma, 1, mode="reflect")
    laplacian = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:] - 4 * luma
    assert sharpness(image) == pytest.approx(laplacian.var())


def test_blur_is_less_sharp() -> None:
    image = np.random.default_rng(2).integers(0, 256, (32, 32, 3), np.uint8)
    assert sharpness(cv2.GaussianBlur(image, (5, 5), 0)) < sharpness(image) / 10


def test_colourfulness_of_single_colours_is_known() -> None:
    def plain(color):
        return np.full((4, 4, 3), color, np.uint8)

    assert colourfulness(plain((90, 90, 90))) == 0
    assert colourfulness(plain((255, 0, 0))) == pytest.approx(0.3 * math.hypot(255, 127.5))
    halves = np.concatenate([plain((255, 0, 0)), plain((0, 255, 0))])  # rg = +-255, yb = 127.5
    assert colourfulness(halves) == pytest.approx(255 + 0.3 * 127.5)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_quality_of_pixels_does_not_depend_on_mirroring_and_grey_has_no_colour(seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (7, 8, 3), np.uint8)
    grey = np.repeat(image[..., :1], 3, axis=-1)
    assert colourfulness(grey) == 0 <= sharpness(grey)
    assert colourfulness(image[:, ::-1]) == pytest.approx(colourfulness(image))
    assert sharpness(image[::-1]) == pytest.approx(sharpness(image))


@pytest.mark.parametrize("image", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((2, 4, 3), np.uint8)])
def test_what_is_no_image_is_refused(image: np.ndarray) -> None:
    for measure in (sharpness, colourfulness):
        with pytest.raises(ArgumentError, match="expected a uint8 image"):
            measure(image)


def test_the_papers_quality_averages_both_on_one_scale() -> None:
    assert paper_quality(10, 100) == 100 and paper_quality(1, 0) == 5
    scores = {"aesthetic": {0: 5.0, 1: 6.0}, "musiq": {0: 50.0}}
    assert add_paper_quality(scores, {"aesthetic": (1, 10), "musiq": (0, 100)})["q"] == {0: 50.0}
    assert "q" not in add_paper_quality(scores, {"aesthetic": (0, 1), "musiq": (0, 100)})


# -- rank correlation ------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=3, max_size=12))
def test_spearman_is_scipys(pairs: list[tuple[int, int]]) -> None:
    x, y = np.array(pairs, np.float64).T
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        assert math.isnan(spearman(x, y))
    else:
        assert float(spearman(x, y)) == pytest.approx(stats.spearmanr(x, y).statistic)


def test_p_is_exact() -> None:
    x, y = np.array([1.0, 2, 3, 4]), np.array([10.0, 20, 30, 40])
    assert permutation_p(x, y) == pytest.approx(2 / 24)
    y = np.array([20.0, 10, 30, 40])
    expected = stats.permutation_test(
        (y,), lambda own: stats.spearmanr(x, own).statistic, permutation_type="pairings", n_resamples=math.inf
    ).pvalue
    assert permutation_p(x, y) == pytest.approx(expected)
    assert permutation_p(np.arange(12.0), np.arange(12.0)) == pytest.approx(1 / 20_001, rel=2)


def test_a_clear_order_has_a_narrow_interval_and_a_vague_one_does_not() -> None:
    rng = np.random.default_rng(0)
    worth = np.array([0.1, 0.4, 0.6, 0.9])[:, None]
    success = (rng.random((4, 200)) < worth).astype(np.float64)
    scenes = np.repeat(np.arange(40), 5)
    clear = correlate("m", success, worth + rng.normal(0, 0.01, (4, 200)), scenes)
    assert (clear.rho, clear.low, clear.high, clear.unit, clear.units) == (1, 1, 1, "scenes", 40)
    assert clear.p == pytest.approx(clear.least_p) == pytest.approx(1 / 12)
    vague = correlate("m", success, rng.normal(0, 1, (4, 200)), scenes)
    assert vague.low < vague.rho < vague.high and vague.high - vague.low > 0.5


def test_scenes_are_drawn_whole() -> None:
    """Copies of one episode in a scene add nothing: the interval is that of one episode a scene."""
    rng = np.random.default_rng(3)
    success, values = rng.integers(0, 2, (5, 12)).astype(np.float64), rng.normal(size=(5, 12))
    once = correlate("m", success, values, np.arange(12))
    often = correlate("m", np.repeat(success, 4, 1), np.repeat(values, 4, 1), np.repeat(np.arange(12), 4))
    assert (often.rho, often.low, often.high) == pytest.approx((once.rho, once.low, once.high))


def test_many_scenes_take_little_memory_and_blocks_are_the_draws_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    success, values, scenes = rng.random((4, 5000)), rng.random((4, 5000)), np.arange(5000)
    monkeypatch.setattr(rank_correlation, "RESAMPLES", 50)
    whole = correlate("m", success, values, scenes)
    monkeypatch.setattr(intervals, "BLOCK", 7 * 5000)
    tracemalloc.start()
    assert correlate("m", success, values, scenes) == whole
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6  # a matrix of scenes by scenes has 200 MB


def test_no_order_no_coefficient() -> None:
    flat = correlate("m", np.ones((3, 4)), np.arange(12.0).reshape(3, 4), list("abcd"))
    assert math.isnan(flat.rho) and math.isnan(flat.p) and math.isnan(flat.low)
    assert math.isnan(correlate("m", np.eye(2), np.eye(2), ["a", "a"]).rho)
    few = correlate("m", np.eye(4), np.eye(4) + np.arange(4.0)[:, None], list("abcd"))
    assert math.isnan(few.low) and math.isnan(few.high)  # four scenes have no interval
    with pytest.raises(ArgumentError, match="without NaN"):
        correlate("m", np.full((3, 2), np.nan), np.ones((3, 2)), ["a", "b"])


def test_the_table_says_how_little_few_arms_prove() -> None:
    samples = [
        Sample(
            f"m{arm}",
            {e: float(e < 2 * arm) for e in range(6)},
            {"sharpness": {e: 10.0 * arm + e for e in range(6)}},
            6,
        )
        for arm in range(4)
    ]
    table = summarise_quality(samples, {e: f"s{e}" for e in range(6)}, SUCCESS)
    assert [line.success.value for line in table.arms] == pytest.approx([0, 100 / 3, 200 / 3, 100])
    assert table.correlations[0].rho == 1 and table.quality == "sharpness" and table.control is None
    assert any("prove little" in note and "Nothing can be significant" in note for note in table.notes)
    few = summarise_quality(samples[:2], {e: f"s{e}" for e in range(6)}, SUCCESS)
    assert any("at least 3 arms" in note for note in few.notes)


# -- scorers ---------------------------------------------------------------------------------------------------------


def test_a_command_scores_in_any_order_and_says_who_it_is(tmp_path: Path, paths: list[Path]) -> None:
    late = "held = [*globals().get('held', []), p]"
    end = 'for p in held[::-1]: print(json.dumps({"path": p, "scores": {"aesthetic": 5, "musiq": 50}}))'
    with make_scorer(write_scorer(tmp_path, late, end=end), 20) as scorer:
        assert (scorer.card.scorer, scorer.card.licence, scorer.card.scores["musiq"]) == ("toy", "MIT", (0, 100))
        found = list(scorer.score(paths))
    assert [path for path, _ in found] == paths[::-1]
    assert all(scores == {"aesthetic": 5, "musiq": 50} for _, scores in found)


def test_the_example_scores_contrast(tmp_path: Path) -> None:
    file = tmp_path / "grey.png"
    cv2.imwrite(str(file), np.repeat(np.array([[100, 200]], np.uint8), 8, 0)[..., None].repeat(3, -1))
    example = ROOT / "docs/examples/contrast_scorer.py"
    with make_scorer(f"'{sys.executable}' '{example}'", 60) as scorer:
        assert list(scorer.score([file])) == [(file, {"contrast": pytest.approx(50 / 150)})]


BAD = {
    "crashed": ("sys.exit(3) if i == 2 else " + GOOD, "exit code 3 with 2 of 4 .* answered"),
    "partial": ("i < 3 and " + GOOD, "ended with 3 of 4 images answered"),
    "malformed": (
        "print('loading weights', flush=True)",
        "'loading weights'; print anything else to standard error",
    ),
    "unknown": ("print(json.dumps({'path': 'x', 'scores': {}}), flush=True)", "'x', which was not requested"),
    "repeated": (f"[{GOOD} for _ in range(2)]", "scored .* twice"),
    "names": (
        "print(json.dumps({'path': p, 'scores': {'musiq': 1}}), flush=True)",
        "aesthetic, musiq that its first line",
    ),
    "number": (GOOD.replace("5.0", "float('nan')"), "a finite number as aesthetic .* got 'NaN'"),
    "range": (GOOD.replace("5.0", "0.01"), "aesthetic of .* is 0.01, but its first line says 1 to 10"),
    "hung": ("time.sleep(60)", "no line for 0.8 s, with 0 of 4 images answered; flush"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_scorers_give_typed_errors(kind: str, tmp_path: Path, paths: list[Path]) -> None:
    answer, said = BAD[kind]
    deadline = 0.8 if kind == "hung" else 20
    with (
        pytest.raises(ScorerError, match=said) as caught,
        ProcessScorer(write_scorer(tmp_path, answer), deadline) as scorer,
    ):
        list(scorer.score(paths))
    assert caught.value.kind == kind


@pytest.mark.parametrize(
    ("card", "said"),
    [
        ('{"scorer": "toy", "version": "1", "scores": {"a": null}}', '"licence": "MIT"'),
        ('{"scorer": "toy", "version": "1", "licence": "MIT", "scores": {"a": [2, 1]}}', "least, most"),
        ("[1, 2]", "expected its first line"),
    ],
)
def test_who_does_not_say_who_it_is_is_refused(card: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ScorerError, match=said):
        ProcessScorer(write_scorer(tmp_path, card=card), 20)


def test_what_cannot_be_run_is_said(tmp_path: Path) -> None:
    with pytest.raises(ScorerError, match="cannot be run") as caught:
        make_scorer("no-such-scorer --fast")
    assert caught.value.kind == "missing"
    with pytest.raises(ScorerError, match="ended without identifying itself"):
        make_scorer("true")
    for spec, said in (("", "got nothing"), ("'open", "quote it as in a shell")):
        with pytest.raises(ArgumentError, match=said):
            make_scorer(spec)


def test_a_scorer_that_reads_nothing_is_ended_at_its_deadline(tmp_path: Path) -> None:
    """Its pipe is full, and the thread that writes to it waits."""
    command = write_scorer(tmp_path, card=f"{CARD}''', flush=True); time.sleep(60); print('''")
    began = time.monotonic()
    with pytest.raises(ScorerError, match="no line"), ProcessScorer(command, 1.5) as scorer:
        list(scorer.score([tmp_path / f"{number:060d}.png" for number in range(5000)]))
    assert time.monotonic() - began < 30


def test_a_hung_scorer_and_its_children_are_ended(tmp_path: Path, paths: list[Path]) -> None:
    child = (
        "import subprocess; c = subprocess.Popen(['sleep', '60']); print(c.pid, file=open('PID', 'w')); time.sleep(60)"
    )
    command = write_scorer(tmp_path, child.replace("PID", str(tmp_path / "pid")))
    with pytest.raises(ScorerError, match="no line"), ProcessScorer(command, 1.5) as scorer:
        list(scorer.score(paths))
    pid = int((tmp_path / "pid").read_text())
    end = time.monotonic() + 10
    while alive(pid) and time.monotonic() < end:  # it has the signal, and dies when it is scheduled
        time.sleep(0.05)
    assert not alive(pid)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def test_laions_predictor_on_the_real_classes(tmp_path: Path, paths: list[Path]) -> None:
    torch, transformers = pytest.importorskip("torch"), pytest.importorskip("transformers")
    torch.manual_seed(0)
    sizes = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    vision = transformers.CLIPVisionConfig(**sizes, image_size=28, patch_size=14, projection_dim=768)
    network = transformers.CLIPVisionModelWithProjection(vision).eval()
    network.save_pretrained(tmp_path / laion.CLIP)
    square = {"shortest_edge": 28}
    processor = transformers.CLIPImageProcessor(size=square, crop_size={"height": 28, "width": 28})
    processor.save_pretrained(tmp_path / laion.CLIP)
    head = torch.nn.Sequential(*(torch.nn.Linear(b, a) for a, b in laion.LAYERS.values()))
    state = {
        f"{name}.{part}": getattr(layer, part).detach()
        for name, layer in zip(laion.LAYERS, head, strict=True)
        for part in ("weight", "bias")
    }
    torch.save(state, tmp_path / laion.HEAD)
    with make_scorer(f"laion:{tmp_path}") as scorer:
        assert scorer.card.licence.startswith("Apache-2.0") and len(scorer.card.version) == 12
        found = [scores["laion_aesthetic"] for _, scores in scorer.score(paths)]
        pixels = scorer._prepare(images=[cv2.imread(str(path))[..., ::-1] for path in paths], return_tensors="pt")
    with torch.inference_mode():
        embedding = network(**pixels).image_embeds
        expected = head(torch.nn.functional.normalize(embedding, dim=-1))[:, 0]
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-4, atol=1e-5)
    assert len(set(found)) == len(paths)

    version = scorer.card.version
    assert LaionScorer(tmp_path).card.version == version
    network.visual_projection.weight.data[0, 0] += 1
    network.save_pretrained(tmp_path / laion.CLIP)
    assert LaionScorer(tmp_path).card.version != version, "another CLIP gives other scores"
    torch.save({**state, "layers.7.weight": torch.zeros(1, 8)}, tmp_path / laion.HEAD)
    with pytest.raises(WeightsError, match=r"layers\.7\.weight differs") as caught:
        LaionScorer(tmp_path)
    assert caught.value.kind == "unfit"


def test_missing_weights_of_laions_predictor_are_explained(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="curl -L") as caught:
        make_scorer(f"laion:{tmp_path}")
    assert caught.value.kind == "missing"


# -- a run -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(two_rooms: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    agent = wiw.Agent("matcher", "copy", candidates=3)
    out = tmp_path_factory.mktemp("quality") / "run"
    arms = {"none": wiw.Agent("matcher"), "copy": agent, "warp": wiw.Agent("matcher", "warp", candidates=3)}
    arms["oracle"] = wiw.Agent("matcher", "oracle", candidates=3)
    config = RunConfig(episodes=2, seed=0, out=out, progress=False, keep_images="all")
    run_arms("imagenav", arms, config=config, scenes=two_rooms, decisions=2)
    return out


def forget_scores(run: Path) -> None:
    for file in run.glob("quality.sqlite*"):
        file.unlink()


def test_the_same_frames_of_all_arms_are_scored(run: Path, tmp_path: Path) -> None:
    forget_scores(run)
    moves: list[tuple[str, int, int]] = []
    found = wiw.quality(
        run, frames=12, out=tmp_path, watch=lambda name, done, total, text: moves.append((name, done, total))
    )
    lines = {line.arm: line for line in found.table.arms}
    assert list(lines) == ["copy", "warp", "oracle"] and {line.frames for line in found.table.arms} == {12}
    assert any("'none'" in note for note in found.table.notes)
    assert lines["oracle"].scores["SSIM"].value == pytest.approx(1)
    assert lines["warp"].scores["SSIM"].value < 0.999
    assert lines["warp"].scores["SSIM"].value > lines["copy"].scores["SSIM"].value
    assert moves[-1][0] == "SSIM" and any(done == total for name, done, total in moves if name == "pixels")

    with wiw.load_run(run).store as store:
        places = {arm: list_frames(store, arm) for arm in lines}
        keys = sample_frames(set.intersection(*map(set, places.values())), 12)
        frames = {arm: dict(read_frames(store, own, keys)) for arm, own in places.items()}
    assert {key.episode for key in keys} == {0, 1}
    for arm, line in lines.items():
        for name, measure in (("sharpness", sharpness), ("colourfulness", colourfulness)):
            means = [np.mean([measure(frames[arm][k]) for k in keys if k.episode == e]) for e in (0, 1)]
            assert line.scores[name].value == pytest.approx(np.mean(means))
    means = [
        np.mean([ssim(frames["copy"][k], frames["oracle"][k], weights="latitude") for k in keys if k.episode == e])
        for e in (0, 1)
    ]
    assert lines["copy"].scores["SSIM"].value == pytest.approx(np.mean(means))


def test_controllability_is_one_less_lpips_where_its_weights_are(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, ...]] = []

    def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        seen.append(a.shape)
        return np.abs(a.astype(float) - b).mean((1, 2, 3)) / 255

    monkeypatch.setattr("wiw.studies.quality.Lpips", lambda folder: distance)
    lines = {line.arm: line.scores["1 - LPIPS"].value for line in wiw.quality(run, frames=6, lpips="auto").table.arms}
    assert lines["oracle"] == 1 > lines["warp"] > lines["copy"]
    assert set(seen) == {(4, 128, 128, 3)}  # four views of each panorama
    forget_scores(run)


class WideMatcher(Matcher):
    """Looks at panoramas in the shape in which the agent observes them."""

    frames = FrameSpec("panorama", (72, 128))

    def score(self, situations, plans, rollouts):
        return [np.zeros(len(own)) for own in plans]


def test_panoramas_of_any_shape_are_compared_as_panoramas(
    two_rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arms = {name: wiw.Agent("matcher", name, WideMatcher(), candidates=2) for name in ("copy", "oracle")}
    config = RunConfig(episodes=1, seed=0, out=tmp_path / "wide", progress=False, keep_images="all")
    run_arms("imagenav", arms, config=config, scenes=two_rooms, decisions=1)
    seen: list[tuple[int, ...]] = []
    monkeypatch.setattr("wiw.studies.quality.Lpips", lambda _: lambda a, b: (seen.append(a.shape), np.zeros(len(a)))[1])
    found = wiw.quality(tmp_path / "wide", frames=2, lpips="auto").table
    with wiw.load_run(tmp_path / "wide").store as store:
        places = {arm: list_frames(store, arm) for arm in arms}
        keys = sample_frames(set.intersection(*map(set, places.values())), 2)
        frames = {arm: dict(read_frames(store, own, keys)) for arm, own in places.items()}
    own = [ssim(frames["copy"][key], frames["oracle"][key], weights="latitude") for key in keys]
    assert {key.size for key in keys} == {(160, 284)} and set(seen) == {(4, 128, 128, 3)}
    assert next(line for line in found.arms if line.arm == "copy").scores["SSIM"].value == pytest.approx(np.mean(own))


def test_real_views_turned_are_not_scored(run: Path) -> None:
    with wiw.load_run(run).store as store:
        rows = {(row["episode"], row["decision"]): row for row in store.decisions("warp")}
        for key, place in list_frames(store, "warp").items():
            row = rows[key.episode, key.decision]
            assert not row["real_frames"][place.plan][key.frame]
            assert json.loads(key.plan) == row["proposals"][place.plan]["actions"]


@given(st.integers(1, 40), st.integers(1, 40), st.lists(st.integers(1, 9), min_size=1, max_size=4))
@settings(max_examples=25, deadline=None)
def test_fewer_frames_are_among_more_and_spread_over_episodes(one: int, other: int, sizes: list[int]) -> None:
    keys = [
        FrameKey(episode, 0, (0.0, 0.0, 0.0, 0.0), "[1]", frame, 0, (160, 160))
        for episode, size in enumerate(sizes)
        for frame in range(size)
    ]
    few, many = (sample_frames(keys, count) for count in sorted((one, other)))
    assert many[: len(few)] == few and len(set(many)) == min(max(one, other), len(keys))
    counts = [sum(key.episode == episode for key in few) for episode in range(len(sizes))]
    assert all(count >= min(size, max(counts) - 1) for count, size in zip(counts, sizes, strict=True))


def test_a_scorer_that_breaks_keeps_what_it_gave_and_is_asked_for_the_rest_only(run: Path, tmp_path: Path) -> None:
    forget_scores(run)
    with pytest.raises(ScorerError, match="exit code 3 with 5 of"):
        wiw.quality(run, [write_scorer(tmp_path, "sys.exit(3) if i == 5 else " + GOOD)], frames=10)
    log = tmp_path / "asked"
    command = write_scorer(tmp_path, f"print(p, file=open('{log}', 'a')); {GOOD}")
    found = wiw.quality(run, [command], frames=10, out=tmp_path / "out")
    asked = len(log.read_text().splitlines())
    with FrameScores(run) as store:
        cards = store.scorers()
        total = (
            sqlite3.connect(store.path)
            .execute("SELECT count(*) FROM score JOIN scorer ON digest = scorer WHERE card LIKE '%toy%'")
            .fetchone()[0]
        )
    assert asked == total - 5 and ("toy", "MIT") in {(card["scorer"], card["licence"]) for card in cards}
    assert found.table.quality == "q" and found.table.measures[0] == "q"
    one = found.table.arms[0].scores
    assert one["q"].value == pytest.approx((10 * one["aesthetic"].value + one["musiq"].value) / 2)
    wiw.quality(run, [command], frames=10)
    assert len(log.read_text().splitlines()) == asked
    page = (found.save()[0]).read_text()
    assert "quality: q (5 to 100)" in page and "Scorer toy 1, licence MIT" in page


def test_a_killed_call_goes_on_where_it_was(run: Path, tmp_path: Path) -> None:
    forget_scores(run)
    command = write_scorer(tmp_path, f"{GOOD}; i == 3 and time.sleep(60)")
    code = f"import wiw; wiw.quality({str(run)!r}, [{command!r}], frames=10)"
    process = subprocess.Popen([sys.executable, "-c", code])
    counted = "SELECT count(*) FROM score WHERE scores LIKE '%musiq%'"
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if (run / "quality.sqlite").exists():
            try:
                if sqlite3.connect(run / "quality.sqlite", timeout=5).execute(counted).fetchone()[0] == 4:
                    break
            except sqlite3.OperationalError:  # not made yet
                pass
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    log = tmp_path / "asked"
    wiw.quality(run, [write_scorer(tmp_path, f"print(p, file=open('{log}', 'a')); {GOOD}")], frames=10)
    total = sqlite3.connect(run / "quality.sqlite").execute(counted).fetchone()[0]
    assert len(log.read_text().splitlines()) == total - 4


def test_the_command_line_writes_tables_and_figures(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["quality", str(run), "--frames", "12", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert str(wiw.quality(run, frames=12, out=tmp_path)) == said[: said.index(str(tmp_path))]
    assert "Rank correlation with SR over arms" in said and "3 arms prove little" in said and "SSIM" in said
    assert {file.name for file in tmp_path.iterdir()} == {f"quality.{form}" for form in ("html", "svg", "png", "json")}
    assert cv2.imread(str(tmp_path / "quality.png")).shape[1] > 1000
    page = (tmp_path / "quality.html").read_text()
    assert page.count("<svg") == 2 and page.count("data:image/jpeg") == 4 * 6
    numbers = json.loads((tmp_path / "quality.json").read_text())
    assert [line["arm"] for line in numbers["arms"]] == ["copy", "warp", "oracle"]


def test_arms_of_several_runs_are_named_by_run(run: Path, two_rooms: str, tmp_path: Path) -> None:
    agent = wiw.Agent("matcher", "copy", candidates=3)
    again = wiw.evaluate(
        "imagenav",
        agent,
        2,
        seed=0,
        out=tmp_path / "again",
        progress=False,
        keep_images="all",
        scenes=two_rooms,
        decisions=2,
    )
    found = wiw.quality([run, again], frames=8)
    assert [line.arm for line in found.table.arms] == ["run/copy", "warp", "oracle", "again/copy"]
    first, last = found.table.arms[0], found.table.arms[-1]
    assert first.scores == last.scores
    chosen = wiw.quality([run, again], frames=8, arms=["warp", "again/copy"])
    assert chosen.table.control == "SSIM"  # the oracle tells what is true, compared or not
    alone = wiw.quality([run, again], frames=8, arms=["warp"])  # no arm of the second run
    assert [line.arm for line in alone.table.arms] == ["warp"]


def test_what_cannot_be_compared_is_refused(
    run: Path, two_rooms: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["quality", str(run), "--arms", "none"]) == 2
    assert "--keep-images" in capsys.readouterr().err
    for options, said in (
        ({"frames": 0}, "at least 1"),
        ({"arms": ["copi"]}, "no arm 'copi'; expected some of none, copy"),
    ):
        with pytest.raises(ArgumentError, match=said):
            wiw.quality(run, **options)
    with pytest.raises(ArgumentError, match="a name that is already taken"):
        card = CARD.replace("aesthetic", "sharpness")
        wiw.quality(run, [write_scorer(tmp_path, card=card)], frames=4)
    with pytest.raises(ArgumentError, match="expected different runs"):
        wiw.quality([run, run])
    with pytest.raises(ArgumentError, match="at least one run"):
        wiw.quality([])
    other = wiw.evaluate(
        "imagenav",
        wiw.Agent("matcher", "copy"),
        1,
        seed=1,
        out=tmp_path / "x",
        progress=False,
        scenes=two_rooms,
        decisions=1,
    )
    with pytest.raises(StoreError, match="cannot compare"):
        wiw.quality([run, other])


def test_arms_that_execute_other_numbers_of_actions_are_refused(two_rooms: str, tmp_path: Path) -> None:
    runs = []
    for execute in (1, 2):
        runs.append(
            wiw.evaluate(
                "imagenav",
                wiw.Agent("matcher", "copy", execute=execute),
                1,
                out=tmp_path / str(execute),
                progress=False,
                scenes=two_rooms,
                decisions=2,
                keep_images=1,
            )
        )
    with pytest.raises(StoreError, match=r"different numbers of actions per decision: .*copy 1, .*copy 2"):
        wiw.quality(runs, frames=2)


def test_a_file_that_holds_no_scores_is_named(run: Path) -> None:
    forget_scores(run)
    (run / "quality.sqlite").write_bytes(b"no database at all, but long enough to look at" * 10)
    with pytest.raises(StoreError, match="move it away"):
        wiw.quality(run, frames=4)
    forget_scores(run)
    sqlite3.connect(run / "quality.sqlite").execute("CREATE TABLE other (x)").connection.close()
    with pytest.raises(StoreError, match="expected scores of frames"):
        wiw.quality(run, frames=4)
    forget_scores(run)
