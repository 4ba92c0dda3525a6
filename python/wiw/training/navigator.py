# SPDX-License-Identifier: Apache-2.0
"""Train the navigator's network on pairs of places; evaluate it on held-out pairs, beside the matcher's similarity."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import rankdata
from torch import Tensor
from torch.nn import functional

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.networks import autocast_bfloat16, single_thread
from wiw.policies.matcher import appearance
from wiw.policies.navigator.bands import BAND_ROWS, GOAL_COLUMNS, GOAL_WIDTH, WIDTH, get_goal_mask
from wiw.policies.navigator.estimator import GoalEstimator, PlaceEstimates
from wiw.policies.navigator.network import DISTANCES, HEADINGS, Estimate, Network, to_input
from wiw.policies.navigator.weights import load, save
from wiw.training.checkpoint import Checkpoint, ResumableTrainer, require_unfinished
from wiw.training.gather import gather_goal_places, require_held_out
from wiw.training.goal_places import GoalPlaces, PlaceRules
from wiw.training.preparation import PREPARATION, Preparation, ProgressBar, show_no_bar
from wiw.training.trainer import apply_gradients, run_training, warmup_cosine_schedule
from wiw.typed_values import require_positive

NEAR, FAR = 2.0, 9.0
"""Metres: below the first a goal counts as near; pairs farther apart than the second are not evaluated."""
RANGES = ((0.3, 2.0), (2.0, 5.0), (5.0, 9.0))
"""Metres between which errors of the bearing are reported."""
HEADING_SPREAD = 1.0
"""Standard deviation, in classes, of the distribution that a bearing is taught as."""
LEAST_BEARING = 0.3
"""Metres from the goal below which it has no direction."""
FRONT_SHARE = 0.1
"""Share of places of which the network only sees the front view."""
GOAL_TRIES = 4
"""Headings at a goal of which the one that sees farthest is its view, as in episodes."""
GOALS_PER_PLACE = 2
"""Views of each place that held-out pairs have."""


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters of the training."""

    epochs: int = 4
    """Number of times each place is used, on average."""
    scenes: int = 3
    """Scenes in a batch."""
    places: int = 12
    """Places of each; every one is compared with the goal views of all."""
    cluster: int = 4
    """Places that are drawn near each other."""
    width: int = 32
    """Channels of the first layer."""
    heads: int = 12
    """Kinds of features that are correlated."""
    rate: float = 2e-3
    decay: float = 0.02
    visible: float = 0.5
    """Weight of the loss of visibility, beside 1 for bearing and distance."""
    bfloat16: bool = True
    """Compute products in bfloat16 on CPUs that have instructions for it, where it is faster."""
    seed: int = 0

    def __post_init__(self) -> None:
        require_positive("Recipe", self, "epochs", "scenes", "places", "cluster", "width", "heads")


def make_weights(
    out: Path,
    scenes: str,
    val: str,
    rules: PlaceRules = PlaceRules(),
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    preparation: Preparation = PREPARATION,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    bar: ProgressBar = show_no_bar,
) -> dict[str, Any]:
    """Record places, train on them, or resume, evaluate on held-out scenes, and write the weights; return the card.

    Args:
        out: file of the weights; the state of training is kept beside it.
        scenes: training scenes, as in `wiw run --scenes`.
        val: held-out scenes.
        rules: which places are recorded.
        recipe: how to train; its seed is that of the places, too.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        preparation: how places are recorded and cached.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        bar: shows the progress of recording.

    Raises:
        ArgumentError: scenes that are both trained and evaluated on, or where nobody can walk from place to place;
            finished weights in the file, or a state of another training.
        TrainingError: the loss or a gradient is not finite.
        FileError: a file cannot be written.
    """
    require_unfinished(out)
    require_held_out(scenes, val)
    places = gather_goal_places(scenes, recipe.seed, rules, **preparation.list_arguments(bar))
    held_out = gather_goal_places(val, recipe.seed, rules, **preparation.list_arguments(bar))
    card: dict[str, Any] = {"scenes": scenes, "val": val, "places": sum(map(len, places))}
    card |= {"sampling": asdict(rules)}
    checkpoint = Checkpoint.beside(out, {**card, "recipe": asdict(recipe), "minutes": minutes})
    with single_thread():
        network, recipe = train(places, recipe, minutes, on_step, checkpoint)
        card |= {"recipe": asdict(recipe), **measure_prior(places, recipe)}
        save(out, network, card)  # before the evaluation, which takes another minute
        card["held_out"] = evaluate(load(out)[0], card, held_out, recipe.seed)  # as stored, in half precision
    save(out, network, card)
    checkpoint.remove()
    return card


def train(
    scenes: Sequence[GoalPlaces],
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    checkpoint: Checkpoint | None = None,
) -> tuple[Network, Recipe]:
    """Train a network; return it with the recipe that reproduces it without a time limit.

    Args:
        scenes: to learn from.
        recipe: how to train; see `Recipe`.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        checkpoint: where the state of training is saved, and from where it resumes.
    """
    steps_per_epoch = max(1, sum(map(len, scenes)) // (recipe.scenes * recipe.places))
    trainer, recipe = run_training(
        lambda: _Trainer(scenes, recipe),
        recipe,
        steps_per_epoch,
        minutes,
        warmup_cosine_schedule(0.03),
        on_step,
        checkpoint,
    )
    return trainer.network.eval(), recipe


class _Trainer(ResumableTrainer):
    """The network in training, with everything that its next step depends on."""

    stateful_parts = ("network", "optimiser")

    def __init__(self, scenes: Sequence[GoalPlaces], recipe: Recipe) -> None:
        torch.manual_seed(core.fold_key([recipe.seed, 0x4C31]) % 2**63)
        self.scenes, self.recipe = scenes, recipe
        self.network = Network(recipe.width, recipe.heads)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), recipe.rate, weight_decay=recipe.decay)

    def train_step(self, learning_rate: float) -> float:
        """Train on the pairs of a few scenes and return their loss."""
        recipe = self.recipe
        key = core.fold_key([recipe.seed, 0x4C32, self.step_count])
        rng = np.random.default_rng(key)
        torch.manual_seed(key % 2**63)  # of dropout
        self.step_count += 1
        chosen = rng.integers(0, len(self.scenes), recipe.scenes)
        batches = [sample_pairs(self.scenes[i], recipe, rng) for i in chosen]
        network = self.network.train()
        with autocast_bfloat16("cpu", recipe.bfloat16):
            places = network.encode(torch.cat([batch.places for batch in batches]))
            goals = network.encode(torch.cat([batch.goals for batch in batches]))
            found = [
                network.compare(places.take(rows), goals.take(rows))
                for rows in torch.arange(len(places.keys)).split([len(batch.places) for batch in batches])
            ]
        losses = [_compute_loss(own, batch, recipe) for own, batch in zip(found, batches, strict=True)]
        loss = torch.stack(losses).mean()
        loss.backward()
        apply_gradients(self.optimiser, self.network, learning_rate)
        return float(loss.detach())


@dataclass(frozen=True)
class Pairs:
    """P places and as many goal views of a scene; labels of all P * P pairs, those of the first place first."""

    places: Tensor
    """[P, 4, 32, 128] of `to_input`."""
    goals: Tensor
    """[P, 4, 32, 32]."""
    metres: Tensor
    """[P * P]; inf if there is no path."""
    bearings: Tensor
    """[P * P] azimuths from the panorama's front, in radians, left positive."""
    visible: Tensor
    """[P * P] 0 or 1."""


def sample_pairs(scene: GoalPlaces, recipe: Recipe, rng: np.random.Generator) -> Pairs:
    """Sample places in clusters, with goal views that see far, other colours, blur, and half of them mirrored."""
    rows = _choose_places(scene, recipe, rng)
    rolls = rng.integers(0, WIDTH, len(rows))
    mirrored, paint = rng.random() < 0.5, _draw_paint(rng)
    goals = np.stack([_cut_goal(scene.bands[i], choose_goal_column(scene.depths[i], rng)) for i in rows])
    places = np.stack([np.roll(scene.bands[i], roll, axis=1) for i, roll in zip(rows, rolls, strict=True)])
    # content that moves right by a column is a column less to the left of the front
    bearings = scene.bearings[np.ix_(rows, rows)].astype(np.float32) - (rolls * (2 * np.pi / WIDTH))[:, None]
    if mirrored:
        places, goals, bearings = places[:, :, ::-1], goals[:, :, ::-1], -bearings
    shown = [_degrade(paint(band), rng) for band in places]
    wanted = [paint(goal) for goal in goals]
    index = np.ix_(rows, rows)
    return Pairs(
        to_input(torch.from_numpy(np.stack(shown)), torch.from_numpy(_draw_masks(len(rows), rng))),
        to_input(torch.from_numpy(np.stack(wanted)), torch.from_numpy(get_goal_mask())),
        torch.from_numpy(scene.distances[index].astype(np.float32).ravel()),
        torch.from_numpy(bearings.astype(np.float32).ravel()),
        torch.from_numpy(scene.visible[index].astype(np.float32).ravel()),
    )


def _choose_places(scene: GoalPlaces, recipe: Recipe, rng: np.random.Generator) -> NDArray[np.intp]:
    """Choose places in clusters: one anywhere, and others more likely the nearer they are to it."""
    rows: list[int] = []
    while len(rows) < recipe.places:
        first = int(rng.integers(len(scene)))
        weights = np.exp(-np.nan_to_num(scene.distances[first].astype(np.float64), posinf=50.0)) + 1e-9
        size = min(recipe.cluster, recipe.places - len(rows), len(scene))
        weights[first] = 0
        rows.append(first)
        if size > 1:
            rows += [int(i) for i in rng.choice(len(scene), size - 1, replace=False, p=weights / weights.sum())]
    return np.array(rows)


def choose_goal_column(depths: NDArray[np.float16], rng: np.random.Generator) -> int:
    """Return the middle column of the view of 90 degrees that sees farthest, of a few drawn by chance."""
    columns = rng.integers(0, WIDTH, GOAL_TRIES)
    window = np.arange(GOAL_WIDTH) - GOAL_WIDTH // 2
    return int(columns[np.median(depths[(columns[:, None] + window) % WIDTH], axis=1).argmax()])


def _cut_goal(band: NDArray[np.uint8], column: int) -> NDArray[np.uint8]:
    """Return the part of a place's band that a view of 90 degrees shows: uint8 [32, 32, 3]; the mask comes later."""
    return np.roll(band, WIDTH // 2 - column, axis=1)[:, GOAL_COLUMNS]


def _draw_paint(rng: np.random.Generator) -> Callable[[NDArray[np.uint8]], NDArray[np.float32]]:
    """Return a change of colours for a whole scene, and a little of one that differs by view."""
    order = rng.permutation(3) if rng.random() < 0.5 else np.arange(3)
    gain, gamma = rng.uniform(0.6, 1.3) * rng.uniform(0.85, 1.15, 3), rng.uniform(0.7, 1.4)

    def paint(band: NDArray[np.uint8]) -> NDArray[np.float32]:
        light = rng.uniform(0.93, 1.07) * rng.uniform(0.97, 1.03, 3)
        painted = (band[..., order].astype(np.float32) / 255) ** np.float32(gamma) * (255 * gain * light)
        return np.clip(painted, 0, 255).astype(np.float32)

    return paint


def _degrade(band: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Blur some places, and hide a part of others, as imagined views are blurred and incomplete; add a little noise."""
    draw = rng.random()
    if draw < 0.3:
        band = np.asarray(cv2.GaussianBlur(band, (0, 0), rng.uniform(0.4, 1.8)), np.float32)
    elif draw < 0.5:
        height, width = rng.integers(6, 24), rng.integers(8, 40)
        top, left = rng.integers(0, 32 - height), rng.integers(0, WIDTH - width)
        band = band.copy()
        band[top : top + height, left : left + width] = band.mean(axis=(0, 1)) if rng.random() < 0.5 else 0
    return np.clip(band + rng.normal(0, rng.uniform(0, 5), band.shape), 0, 255).astype(np.float32)


def _draw_masks(count: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return what is shown of each place, bool [N, 1, 32, 128]: of some the front view alone."""
    masks = np.ones((count, 1, 32, WIDTH), bool)
    front = np.flatnonzero(rng.random(count) < FRONT_SHARE)
    masks[front] = False
    masks[front, 0, :, GOAL_COLUMNS] = get_goal_mask()
    return masks


def _compute_loss(found: Estimate, pairs: Pairs, recipe: Recipe) -> Tensor:
    """Return the mean loss of the pairs of a scene."""
    edges = torch.tensor(DISTANCES)
    classes = torch.bucketize(pairs.metres, edges)
    distance = functional.cross_entropy(found.distances.float(), classes)
    likely = functional.log_softmax(found.bearings.float(), dim=1)
    directed = torch.isfinite(pairs.metres) & (pairs.metres > LEAST_BEARING)
    bearing = -(spread_bearings(pairs.bearings) * likely).sum(dim=1)
    bearing = (bearing * directed).sum() / directed.sum().clamp_min(1)
    visible = functional.binary_cross_entropy_with_logits(found.visible.float(), pairs.visible)
    return distance + bearing + recipe.visible * visible


def spread_bearings(bearings: Tensor) -> Tensor:
    """Return the distributions over headings that bearings [N] are taught as: [N, 32]."""
    place = (torch.arange(HEADINGS) + 0.5) / HEADINGS
    off = place - (0.5 - bearings[:, None] / (2 * torch.pi))
    off = (off - off.round()) * HEADINGS
    weights = torch.exp(-0.5 * (off / HEADING_SPREAD) ** 2)
    return weights / weights.sum(dim=1, keepdim=True)


def measure_prior(scenes: Sequence[GoalPlaces], recipe: Recipe, draws: int = 60) -> dict[str, Any]:
    """Measure what the network was taught to expect, and the matcher's similarity by distance.

    Returns:
        {"shares": [...], "similarity": [[mean, deviation], ...]}: of each class of distance, how often it is drawn,
        and the similarity of pairs of it.
    """
    rng = np.random.default_rng(core.fold_key([recipe.seed, 0x4C34]))
    classes, similarities = [], []
    for number in rng.integers(0, len(scenes), draws):
        scene = scenes[number]
        rows = _choose_places(scene, recipe, rng)
        features = appearance.extract_features(_fill_panoramas(scene.bands[rows]))
        for goal in rows:
            cut = _cut_goal(scene.bands[goal], choose_goal_column(scene.depths[goal], rng))
            similarities.append(appearance.similarity(features, build_template(cut)).max(axis=1))
            classes.append(np.digitize(scene.distances[rows, goal].astype(np.float64), DISTANCES))
    own, values = np.concatenate(classes), np.clip(np.concatenate(similarities), 0, appearance.HIGHEST)
    groups = [values[own == number] for number in range(len(DISTANCES) + 1)]
    groups = [group if len(group) > 1 else values for group in groups]  # too few scenes have all distances
    counts = np.bincount(own, minlength=len(groups)) + 1
    return {
        "shares": [round(float(share), 5) for share in counts / counts.sum()],
        "similarity": [[round(float(g.mean()), 4), round(max(float(g.std()), 0.01), 4)] for g in groups],
    }


# -- measuring ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Measured:
    """Held-out pairs with what is known and what was estimated of each; one entry a pair."""

    metres: NDArray[np.float64]
    bearings: NDArray[np.float64]
    """True azimuths."""
    similarity: NDArray[np.float64]
    """Similarity that the matcher finds at its best heading."""
    similar_heading: NDArray[np.float64]
    """Azimuth of the matcher's best heading."""
    estimates: PlaceEstimates


def evaluate(
    network: Network, card: Mapping[str, Any], scenes: Sequence[GoalPlaces], seed: int, most: int = 400
) -> dict[str, Any]:
    """Measure the network and the matcher's similarity on pairs of held-out places at most 9 m apart.

    Args:
        network: as it is saved.
        card: has what `measure_prior` returns.
        scenes: none that the network has learned from.
        seed: of the goal views and the pairs.
        most: pairs of each scene.

    Returns:
        {"pairs": N, "auc": {"network": ..., "similarity": ..., "both": ...}, "bearing": {"0.3-2": {"network": ...,
        "similarity": ..., "within_45": ..., "pairs": ...}, ...}}: the probability that a pair within 2 m is rated
        nearer than one that is farther apart (None if all pairs are near, or none), and median errors of the bearing
        in degrees by range of distance.

    Raises:
        ArgumentError: no two places are within 9 m of each other.
    """
    estimator = GoalEstimator(network, card)
    parts = [
        _measure_scene(estimator, scene, np.random.default_rng(core.fold_key([seed, 0x4C33, i])), most)
        for i, scene in enumerate(scenes)
        if _find_pairs(scene).any()
    ]
    if not parts:
        raise ArgumentError(
            f"navigator: expected held-out scenes with two places within {FAR:g} m of each other, got none; choose "
            "others"
        )
    metres = np.concatenate([part.metres for part in parts])
    similarity = np.concatenate([part.similarity for part in parts])
    rated = -np.concatenate([part.estimates.metres for part in parts])
    near = metres < NEAR
    auc = {"network": rated, "similarity": similarity, "both": _standardise(rated) + _standardise(similarity)}
    return {
        "pairs": len(metres),
        "auc": {name: _compute_auc(values, near) for name, values in auc.items()},
        "bearing": {f"{low:g}-{high:g}": _measure_bearing(parts, low, high) for low, high in RANGES},
    }


def _measure_scene(estimator: GoalEstimator, scene: GoalPlaces, rng: np.random.Generator, most: int) -> _Measured:
    goals, places = _draw_held_out_pairs(scene, rng, most)
    columns = {goal: choose_goal_column(scene.depths[goal[0]], rng) for goal in sorted(set(goals))}
    estimates, similarity, heading = [], [], []
    features = appearance.extract_features(_fill_panoramas(scene.bands))
    for goal, column in columns.items():
        rows = np.array([place for own, place in zip(goals, places, strict=True) if own == goal])
        cut = _cut_goal(scene.bands[goal[0]], column)
        estimates.append(estimator.estimate(estimator.encode_goal(cut * get_goal_mask()[..., None]), scene.bands[rows]))
        template = build_template(cut)
        profile = np.concatenate([appearance.similarity(features.take(i), template) for i in rows])
        similarity.append(profile.max(axis=1))
        heading.append(np.pi - (profile.argmax(axis=1) + 0.5) * 2 * np.pi / WIDTH)
    order = [(goal[0], place) for own in columns for goal, place in zip(goals, places, strict=True) if goal == own]
    to, at = np.array(order).T
    return _Measured(
        scene.distances[at, to].astype(np.float64),
        scene.bearings[at, to].astype(np.float64),
        np.concatenate(similarity).astype(np.float64),
        np.concatenate(heading),
        PlaceEstimates.join(estimates),
    )


def _draw_held_out_pairs(
    scene: GoalPlaces, rng: np.random.Generator, most: int
) -> tuple[list[tuple[int, int]], list[int]]:
    """Return goals, as place and number of the view, and for each a place at most 9 m from it."""
    pairs = np.repeat(np.argwhere(_find_pairs(scene)), GOALS_PER_PLACE, axis=0)
    views = np.arange(len(pairs)) % GOALS_PER_PLACE
    chosen = rng.permutation(len(pairs))[:most]
    return [(int(pairs[i, 1]), int(views[i])) for i in chosen], [int(pairs[i, 0]) for i in chosen]


def _find_pairs(scene: GoalPlaces) -> NDArray[np.bool_]:
    """Return which places are at most 9 m from which others, bool [N, N]."""
    return np.asarray((scene.distances <= FAR) & ~np.eye(len(scene), dtype=bool))


def _fill_panoramas(bands: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return panoramas [N, 64, 128, 3] with everything but the bands hidden; the matcher reads no more."""
    whole = np.zeros((len(bands), *appearance.PANORAMA, 3), np.uint8)
    whole[:, BAND_ROWS] = bands
    return whole


def build_template(cut: NDArray[np.uint8]) -> appearance.GoalTemplate:
    """Return the matcher's features of a goal cut from a panorama, uint8 [32, 32, 3]; its edges are continued."""
    before, behind = GOAL_COLUMNS.start, WIDTH - GOAL_COLUMNS.stop
    wide = np.pad(cut, ((0, 0), (before, behind), (0, 0)), mode="edge")
    return appearance.build_template(_fill_panoramas(wide[None])[0], get_goal_mask())


def _standardise(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return (values - values.mean()) / max(float(values.std()), 1e-9)


def _compute_auc(values: NDArray[np.float64], positive: NDArray[np.bool_]) -> float | None:
    """Return the probability that a positive has a higher value than a negative; ties count half.

    None without a positive or without a negative.
    """
    count = int(positive.sum())
    if count in (0, len(values)):
        return None
    ranks = rankdata(values)[positive].sum() - count * (count + 1) / 2
    return round(float(ranks / (count * (len(values) - count))), 4)


def _measure_bearing(parts: Sequence[_Measured], low: float, high: float) -> dict[str, float]:
    """Return median errors in degrees, and the share of the network's within 45, of pairs in a range of metres."""
    errors: dict[str, list[NDArray[np.float64]]] = {"network": [], "similarity": []}
    for part in parts:
        own = (part.metres >= low) & (part.metres < high)
        guesses = {"network": part.estimates.find_bearings(), "similarity": part.similar_heading}
        for name, guess in guesses.items():
            off = np.remainder(guess[own] - part.bearings[own] + np.pi, 2 * np.pi) - np.pi
            errors[name].append(np.degrees(np.abs(off)))
    found = {name: np.concatenate(values) for name, values in errors.items()}
    medians = {name: round(float(np.median(values)), 1) for name, values in found.items() if len(values)}
    within = float((found["network"] < 45).mean()) if len(found["network"]) else 0.0
    return {**medians, "within_45": round(within, 4), "pairs": len(found["network"])}
