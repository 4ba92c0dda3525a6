# SPDX-License-Identifier: Apache-2.0
"""Scores by the paper's formulas written out, image distances by NumPy and SciPy in double precision."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from wiw import metrics
from wiw.datasets.questions.question import CATEGORIES
from wiw.errors import ArgumentError

RNG = np.random.default_rng(7)
episodes = st.lists(st.tuples(st.booleans(), st.floats(0, 30), st.floats(0, 60)), min_size=1, max_size=30)


def pair(height=40, width=64, noise=20):
    """A smooth picture and a noisy copy, so that SSIM is neither 0 nor 1."""
    clean = gaussian_filter(RNG.uniform(0, 255, (height, width, 3)), (4, 4, 0)) * 3 - 255
    noisy = clean + RNG.normal(0, noise, clean.shape)
    return (np.clip(image, 0, 255).astype(np.uint8) for image in (clean, noisy))


def latitudes(height):
    return np.cos((np.arange(height) + 0.5) / height * np.pi - np.pi / 2)


def slow_psnr(a, b, span, rows=None):
    error = ((a.astype(float) - b.astype(float)) / span) ** 2
    rows = np.ones(len(error)) if rows is None else rows
    return -10 * np.log10((error.mean((1, 2)) * rows).sum() / rows.sum())


def slow_ssim(a, b, span, panorama=False):
    """Wang et al. 2004 as scikit-image computes it (gaussian_weights=True, use_sample_covariance=False)."""
    mode = ["reflect", "wrap"] if panorama else "reflect"
    maps = []
    for channel in range(a.shape[-1]):
        x, y = a[..., channel].astype(float), b[..., channel].astype(float)
        mx, my, xx, yy, xy = (gaussian_filter(image, 1.5, mode=mode, radius=5) for image in (x, y, x * x, y * y, x * y))
        c1, c2 = (0.01 * span) ** 2, (0.03 * span) ** 2
        luminance = (2 * mx * my + c1) / (mx * mx + my * my + c1)
        maps.append(luminance * (2 * (xy - mx * my) + c2) / (xx - mx * mx + yy - my * my + c2))
    inside = np.stack(maps, -1)[5:-5]
    if not panorama:
        return inside[:, 5:-5].mean()
    rows = latitudes(len(a))[5:-5]
    return (inside.mean((1, 2)) * rows).sum() / rows.sum()


@given(episodes)
def test_spl_equals_its_formula(rows):
    success, shortest, travelled = (np.array(column, float) for column in zip(*rows, strict=True))
    longest = np.maximum(shortest, travelled)
    ratio = np.divide(shortest, longest, out=np.ones_like(longest), where=longest > 0)
    assert metrics.spl(success, shortest, travelled) == pytest.approx(100 * (success * ratio).mean())
    assert metrics.spl(success, shortest, travelled) <= metrics.success_rate(success) + 1e-9
    assert metrics.mean_trajectory(travelled) == pytest.approx(travelled.mean())


def test_starting_at_the_goal_and_goals_out_of_reach():
    assert metrics.spl([True], [0.0], [0.0]) == 100
    assert metrics.spl([True], [0.0], [0.4]) == 0
    assert metrics.spl([False, True], [np.inf, 1], [3, 1]) == 50
    with pytest.raises(ArgumentError, match="reached"):
        metrics.spl([True], [np.inf], [3])
    with pytest.raises(ArgumentError, match="none"):
        metrics.success_rate([])
    for success in ([80.0], [True, -0.1], [np.nan]):
        with pytest.raises(ArgumentError, match="numbers from 0 to 1, not percent"):
            metrics.success_rate(success)
    with pytest.raises(ArgumentError, match="one success"):
        metrics.spl([True], [1, 2], [1, 2])
    with pytest.raises(ArgumentError, match="finite"):
        metrics.mean_trajectory([1, np.nan])


def test_answers():
    assert metrics.aeqa_score([1, 3, 5]) == 50
    assert metrics.aeqa_score([0]) == 0
    assert metrics.aeqa_spl([5, 3], [2, 2], [4, 1]) == pytest.approx(100 * (0.5 + 0.5) / 2)
    assert metrics.aeqa_spl([5, 3], [2, 2], [4, 1], answered=[True, False]) == pytest.approx(25)
    with pytest.raises(ArgumentError, match="one flag"):
        metrics.aeqa_spl([5, 3], [2, 2], [4, 1], answered=[True])


@settings(max_examples=20)
@given(st.integers(11, 60), st.integers(11, 70), st.floats(1, 60))
def test_images_equal_the_slow_twins(height, width, noise):
    a, b = pair(height, width, noise)
    assert metrics.psnr(a, b) == pytest.approx(slow_psnr(a, b, 255), abs=1e-9)
    assert metrics.psnr(a, b, weights="latitude") == pytest.approx(slow_psnr(a, b, 255, latitudes(height)), abs=1e-9)
    assert metrics.ssim(a, b) == pytest.approx(slow_ssim(a, b, 255), abs=2e-6)
    assert metrics.ssim(a, b, weights="latitude") == pytest.approx(slow_ssim(a, b, 255, True), abs=2e-6)


def test_floats_and_bytes_agree():
    a, b = pair()
    for measure in (metrics.psnr, metrics.ssim):
        assert measure(a / 255.0, b / 255.0) == pytest.approx(measure(a, b), abs=2e-5)
        assert measure(a.astype(np.float32), b.astype(np.float32), data_range=255) == pytest.approx(measure(a, b), 1e-5)


def test_a_panorama_may_be_rolled():
    a, b = pair()
    rolled = [np.roll(image, 17, 1) for image in (a, b)]
    for measure in (metrics.psnr, metrics.ssim):
        assert measure(*rolled, weights="latitude") == pytest.approx(measure(a, b, weights="latitude"), abs=1e-7)
    assert metrics.ssim(*rolled) != metrics.ssim(a, b)


def test_batches_keep_their_shape():
    images = [np.stack(images) for images in zip(*(pair() for _ in range(6)), strict=True)]
    batch = [image.reshape(2, 3, *image.shape[1:]) for image in images]
    for measure in (metrics.psnr, metrics.ssim):
        values = measure(*batch)
        assert values.shape == (2, 3)
        assert values[1, 2] == measure(images[0][5], images[1][5])


def test_images_that_cannot_be_compared():
    a, b = pair()
    assert metrics.psnr(a, a) == 100
    assert metrics.ssim(a, a) == pytest.approx(1)
    with pytest.raises(ArgumentError, match="one shape"):
        metrics.psnr(a, b[:-1])
    with pytest.raises(ArgumentError, match="one shape and type"):
        metrics.psnr(a, b.astype(float))
    with pytest.raises(ArgumentError, match="uint8 or float"):
        metrics.psnr(a.astype(int), b.astype(int))
    with pytest.raises(ArgumentError, match="11x11"):
        metrics.ssim(a[:10], b[:10])
    with pytest.raises(ArgumentError, match="NaN"):
        metrics.ssim(np.full((11, 11, 1), np.nan), np.zeros((11, 11, 1)))
    with pytest.raises(ArgumentError, match="data_range"):
        metrics.psnr(a, b, data_range=np.inf)
    with pytest.raises(ArgumentError, match="latitude"):
        metrics.psnr(a, b, weights="sphere")


def test_pose_errors_equal_scipy():
    turns = Rotation.random(10, random_state=3), Rotation.random(10, random_state=4)
    poses = np.tile(np.eye(4), (2, 10, 1, 1))
    poses[:, :, :3, 3] = RNG.normal(size=(2, 10, 3))
    for side, turn in enumerate(turns):
        poses[side, :, :3, :3] = turn.as_matrix()
    metres, angle = metrics.pose_error(*poses)
    np.testing.assert_allclose(metres, np.linalg.norm(poses[0, :, :3, 3] - poses[1, :, :3, 3], axis=1))
    np.testing.assert_allclose(angle, (turns[0].inv() * turns[1]).magnitude(), atol=1e-9)


PUBLISHED = {
    "object recognition": ((16, 6, 0, 2, 1), 16.0),
    "attribute recognition": ((21, 2, 0, 2, 8), 30.3),
    "world knowledge": ((10, 9, 2, 4, 3), 33.0),
    "object localization": ((13, 10, 3, 4, 5), 34.3),
    "spatial understanding": ((8, 5, 0, 1, 5), 36.8),
    "object state recognition": ((11, 1, 0, 4, 11), 52.8),
    "functional reasoning": ((0, 4, 1, 11, 1), 63.2),
}
"""Blind answers to OpenEQA's list of 184: how many have each mark, 1 to 5, and the mean on the paper's scale."""


@pytest.mark.parametrize("category", CATEGORIES)
def test_answer_scores_of_published_marks_by_category(category: str) -> None:
    counts, mean = PUBLISHED[category]
    assert metrics.aeqa_score(np.repeat(np.arange(1, 6), counts)) == pytest.approx(mean, abs=0.05)


def test_answer_scores_of_published_marks() -> None:
    counts = np.sum([own for own, _ in PUBLISHED.values()], axis=0)
    assert counts.tolist() == [79, 37, 6, 28, 34]
    assert metrics.aeqa_score(np.repeat(np.arange(1, 6), counts)) == pytest.approx(36.549, abs=5e-4)
    assert metrics.aeqa_score([0, 1, 6]) == pytest.approx(100 / 3)  # clipped to 1 and 5


@pytest.mark.parametrize(
    ("mark", "shortest", "travelled", "answered", "expected"),
    [
        (5, 4.0, 4.0, True, 100.0),
        (1, 4.0, 4.0, True, 0.0),
        (5, 4.0, 2.0, True, 100.0),  # a shorter path than the shortest one counts as that
        (5, 4.0, 8.0, True, 50.0),
        (3, 4.0, 8.0, True, 25.0),
        (5, 4.0, 4.0, False, 0.0),  # a blind answer was judged
    ],
)
def test_answer_score_weighted_by_path_length(
    mark: int, shortest: float, travelled: float, answered: bool, expected: float
) -> None:
    assert metrics.aeqa_spl([mark], [shortest], [travelled], answered=[answered]) == pytest.approx(expected)
