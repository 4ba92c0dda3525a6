# SPDX-License-Identifier: Apache-2.0
"""Do better-looking frames help more? Score imagined frames and compare the scores with success.

The paper's question ("Fine-grained controllability matters more than visuals for task success"): quality is how good a
frame looks on its own, controllability how close it is to what would really have been seen. Both are measured on the
same frames for all arms, as kept in the run's store.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.analysis.quality import (
    CONTROL_BY_LPIPS,
    CONTROL_BY_SSIM,
    QualityTable,
    Sample,
    add_paper_quality,
    summarise_quality,
)
from wiw.analysis.summary import split_outcomes
from wiw.analysis.utility import CEILING
from wiw.errors import ArgumentError, FileError, ScorerError, StoreError
from wiw.metrics import Lpips, ssim
from wiw.metrics.metric import ANSWER_SCORE, SUCCESS, Metric
from wiw.panorama import to_perspective
from wiw.ray_cluster import HERE, Engine, map_batches
from wiw.runs.frame_scores import FrameScores
from wiw.runs.imagined_frames import (
    FrameKey,
    FramePlace,
    common_frames,
    digest_frame,
    list_frames,
    read_frames,
    sample_frames,
)
from wiw.runs.rows import to_json
from wiw.scenes import strip_edits
from wiw.scorers import Scorer, ScorerCard, make_scorer
from wiw.scorers.process import DEADLINE
from wiw.studies.compare import count_executed, require_comparable
from wiw.studies.run_log import RunLog, load_run

FRAMES = 200
"""Default number of frames per arm."""
ALWAYS = "pixels"
"""The scorer that needs nothing and takes next to no time."""
VIEW = (128, 128)
"""Height and width of the views of a panorama on which LPIPS is computed."""
MOST_AT_ONCE = 256
"""Maximum number of frames that an actor scores per call."""
SHOWN = 6
"""Frames per arm shown on the page."""

Watch = Callable[[str, int, int, str], None]
"""Called with what is being done, how much is done, out of how much, and a text."""
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Quality:
    """The result of `wiw.quality`."""

    table: QualityTable
    out: Path
    """Folder that `save` writes into."""
    pictures: Mapping[str, Sequence[Image]] = field(repr=False, default_factory=dict)
    """Some of the scored frames, the same ones for each arm, uint8 [H, W, 3]; "true": what would really have been
    seen."""

    def summary(self) -> None:
        """Print the tables, with notes on how to read them."""
        from wiw.report.quality_tables import print_quality

        print_quality(self.table)

    def __str__(self) -> str:
        from wiw.report.quality_tables import as_text

        return as_text(self.table)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"

    def to_json(self) -> str:
        """Return the numbers as JSON."""
        return json.dumps(json.loads(to_json(self.table.as_dict())), indent=2)

    def save(self) -> list[Path]:
        """Write quality.html, quality.svg, quality.png and quality.json into `out`, and return their paths."""
        from wiw.report.quality_page import write_quality

        return write_quality(self.table, self.pictures, self.to_json(), self.out)


@dataclass
class _Arm:
    """An arm whose imagined frames are scored."""

    label: str
    log: RunLog
    name: str
    places: Mapping[FrameKey, FramePlace]
    frames: dict[FrameKey, Image] = field(default_factory=dict)
    true: dict[FrameKey, Image] = field(default_factory=dict)
    scores: dict[str, dict[FrameKey, float]] = field(default_factory=dict)

    @cached_property
    def digests(self) -> dict[FrameKey, str]:
        """Digests of `frames`, once these have been read."""
        return {key: digest_frame(frame) for key, frame in self.frames.items()}


def quality(
    runs: str | Path | RunLog | Sequence[str | Path | RunLog],
    scorers: Sequence[str] = (),
    *,
    frames: int = FRAMES,
    arms: Sequence[str] | None = None,
    lpips: str | Path | None = None,
    out: str | Path | None = None,
    deadline: float = DEADLINE,
    workers: int = 1,
    place: Engine = HERE,
    watch: Watch | None = None,
) -> Quality:
    """Score imagined frames of stored runs, and compare quality and controllability with success over arms.

        found = wiw.quality("runs/four", ["python my_scorer.py"])
        found.summary()
        found.save()

    Scores are stored in `quality.sqlite` next to each run, so after an interruption, or with more frames, only what is
    missing is scored.

    Args:
        runs: folders of runs, one or several with the same task, seed and episodes, or `RunLog`s. Only episodes that
            kept images (`keep_images`) have frames.
        scorers: "laion", "laion:FOLDER", or commands (see `wiw.scorers.process`), in addition to sharpness and
            colourfulness.
        frames: number of frames to score per arm, the same ones for each.
        arms: arms to compare; by default all with a world model. Arms of several runs are called RUN/ARM if names
            repeat.
        lpips: folder of the weights of LPIPS, or "auto"; controllability is then 1 - LPIPS, otherwise SSIM.
        out: folder for `save`; by default `quality` in the first run's folder.
        deadline: seconds that a command may be silent.
        workers: number of Ray actors, each with its own scorers.
        place: this process, or actors on a Ray cluster that score the frames; sharpness and colourfulness are computed
            here.
        watch: called with progress.

    Raises:
        ArgumentError: a number out of range, an arm that does not exist, or no frames that all arms have imagined.
        StoreError: runs that cannot be read or compared, or scores that cannot be written.
        ScorerError: a command gave no valid scores; earlier scores are stored.
        WeightsError: weights that a scorer needs are missing.
    """
    if frames < 1:
        raise ArgumentError(f"quality: expected frames of at least 1, got {frames}")
    place.require_valid("quality")
    if workers < 1 or (workers > 1 and place.engine != "ray"):
        raise ArgumentError(f"quality: expected 1 worker, or several with engine ray, got {workers}")
    given = [runs] if isinstance(runs, str | Path | RunLog) else list(runs)
    if not given:
        raise ArgumentError("quality: expected at least one run, got none")
    judged = None if lpips is None else Lpips(lpips)  # fails before anything takes time
    with ExitStack() as stack:
        logs = [one if isinstance(one, RunLog) else stack.enter_context(_open_run(one)) for one in given]
        for log in logs[1:]:
            require_comparable(logs[0], log)
        chosen, notes = _choose_arms(logs, arms)
        _require_same_budget(chosen)
        keys = _choose_frames(chosen, frames)
        if len(keys) < frames:
            notes.append(
                f"{frames} frames were requested, but all arms have imagined the same future in only {len(keys)}."
            )
        for arm in chosen:
            arm.frames = dict(read_frames(arm.log.store, arm.places, keys))
        _find_truth(logs, chosen, keys)
        stores = {log.path: stack.enter_context(FrameScores(log.path)) for log in logs}
        cards = _score_all([ALWAYS, *scorers], chosen, stores, _Scoring(deadline, workers, place, watch))
        _compare_with_truth(chosen, stores, judged, watch)
        if not any(arm.true for arm in chosen):
            notes.append("No controllability, as there are no true frames: run with --fidelity, or with an oracle arm.")
        table = _summarise(chosen, cards, notes, logs[0])
    folder = Path(out) if out is not None else logs[0].path / "quality"
    return Quality(table, folder, _choose_pictures(chosen, keys))


def require_scorers(scorers: Sequence[str] = (), lpips: str | Path | None = None, deadline: float = DEADLINE) -> None:
    """Check that scorers start and that weights are there, before anything takes time.

    Raises:
        ScorerError: a command cannot be run, or gives no card.
        WeightsError: weights are missing.
    """
    if lpips is not None:
        Lpips(lpips)
    for scorer in scorers:
        with make_scorer(scorer, deadline):
            pass


def _require_same_budget(chosen: Sequence[_Arm]) -> None:
    """Check that all arms execute as many actions per decision, on which success depends.

    Raises:
        StoreError: they do not.
    """
    counts = {arm.label: count_executed(arm.log, arm.name) for arm in chosen}
    known = {name: count for name, count in counts.items() if count is not None}
    if len(set(known.values())) > 1:
        said = ", ".join(f"{name} {count}" for name, count in known.items())
        raise StoreError(f"quality: the arms execute different numbers of actions per decision: {said}; choose some")


@contextmanager
def _open_run(path: str | Path) -> Iterator[RunLog]:
    """Open a run for a `with` block."""
    log = load_run(path)
    try:
        yield log
    finally:
        log.close()


def _choose_arms(logs: Sequence[RunLog], wanted: Sequence[str] | None) -> tuple[list[_Arm], list[str]]:
    """Return the arms with imagined frames, and notes on those without."""
    names = [name for log in logs for name in log.arms]
    labels = [
        (name if names.count(name) == 1 else f"{run}/{name}", log, name)
        for run, log in zip(_name_runs(logs), logs, strict=True)
        for name in log.arms
    ]
    if unknown := sorted(set(wanted or ()) - {label for label, _, _ in labels}):
        known = ", ".join(label for label, _, _ in labels)
        raise ArgumentError(f"quality: no arm '{unknown[0]}'; expected some of {known}")
    found = [
        _Arm(label, log, name, list_frames(log.store, name))
        for label, log, name in labels
        if wanted is None or label in wanted
    ]
    without = [arm.label for arm in found if not arm.places]
    if len(without) == len(found):
        raise ArgumentError(
            f"quality: no imagined frames of {', '.join(without)} in {', '.join(str(log.path) for log in logs)}; run "
            "world models and keep images (`wiw run --keep-images N`, or keep_images=)"
        )
    notes = [f"Left out, as no imagined frames of them were kept: {', '.join(map(repr, without))}."] if without else []
    return [arm for arm in found if arm.places], notes


def _name_runs(logs: Sequence[RunLog]) -> list[str]:
    """Return the names of the runs' folders, or their full paths if two share a name."""
    paths = [log.path.resolve() for log in logs]
    if len(set(paths)) < len(paths):
        raise ArgumentError(f"quality: expected different runs, got {', '.join(map(str, paths))}; name each once")
    names = [path.name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def _choose_frames(arms: Sequence[_Arm], count: int) -> list[FrameKey]:
    keys = common_frames(arm.places for arm in arms)
    if not keys:
        counts = ", ".join(f"{arm.label} {len(arm.places)}" for arm in arms)
        raise ArgumentError(
            "quality: expected frames that all arms have imagined from the same place for the same plan, got none in "
            f"common ({counts}); choose arms with the same policy and kind of view with arms= or --arms"
        )
    return sample_frames(keys, count)


def _find_truth(logs: Sequence[RunLog], arms: Sequence[_Arm], keys: Sequence[FrameKey]) -> None:
    """Give each arm the true frames: its own where fidelity was measured, else what the oracle imagined."""
    true: dict[FrameKey, Image] = {}
    for log in logs:
        places = list_frames(log.store, CEILING) if CEILING in log.arms else {}
        true |= dict(read_frames(log.store, places, [key for key in keys if key in places]))
    for arm in arms:
        arm.true = {**true, **dict(read_frames(arm.log.store, arm.places, keys, "true"))}


@dataclass(frozen=True)
class _Scoring:
    """How frames are scored."""

    deadline: float
    workers: int
    place: Engine
    watch: Watch | None


def _score_all(
    specs: Sequence[str], arms: Sequence[_Arm], stores: Mapping[Path, FrameScores], scoring: _Scoring
) -> list[dict[str, Any]]:
    """Let each scorer score what it has not scored yet; return the cards with their commands."""
    cards: list[dict[str, Any]] = []
    for spec in dict.fromkeys(specs):
        with make_scorer(spec, scoring.deadline) as scorer:
            card = scorer.card
            taken = {name for one in cards for name in one["scores"]} | {CONTROL_BY_LPIPS, CONTROL_BY_SSIM, "q"}
            if both := sorted(taken & set(card.scores)):
                raise ArgumentError(
                    f"quality: scorer '{spec}' gives {both[0]}, a name that is already taken; rename its score"
                )
            cards.append({**card.as_dict(), "command": spec})
            _score(scorer, spec, arms, stores, scoring)
    return cards


def _score(
    scorer: Scorer, spec: str, arms: Sequence[_Arm], stores: Mapping[Path, FrameScores], scoring: _Scoring
) -> None:
    card = scorer.card
    images = {arm.digests[key]: frame for arm in arms for key, frame in arm.frames.items()}
    homes = {
        path: {digest for arm in arms if arm.log.path == path for digest in arm.digests.values()} for path in stores
    }
    known = {path: store.read(card.digest, homes[path]) for path, store in stores.items()}
    found = {digest: scores for own in known.values() for digest, scores in own.items()}
    for path, store in stores.items():
        store.add_scorer(card.digest, card.as_dict(), spec)
        for digest in homes[path] & found.keys() - known[path].keys():
            store.write(card.digest, digest, found[digest])
    missing = {digest: image for digest, image in images.items() if digest not in found}
    remote = scoring.place.engine == "ray" and spec != ALWAYS
    asked = _ask_actors(spec, card, missing, scoring) if remote else _ask(scorer, missing)
    for digest, scores in asked:
        found[digest] = scores
        if scoring.watch is not None:
            scoring.watch(card.scorer, len(found), len(images), f"{len(found)}/{len(images)} frames")
        for path, store in stores.items():
            if digest in homes[path]:
                store.write(card.digest, digest, scores)
    for arm in arms:
        for name in card.scores:
            arm.scores[name] = {key: found[digest][name] for key, digest in arm.digests.items()}


def _ask(scorer: Scorer, images: Mapping[str, Image]) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the scores of images by digest; meanwhile the images are PNG files in a folder."""
    with tempfile.TemporaryDirectory(prefix="wiw-quality-") as folder:
        paths = {Path(folder) / f"{digest[:32]}.png": digest for digest in images}
        for path, digest in paths.items():
            if not cv2.imwrite(str(path), cv2.cvtColor(images[digest], cv2.COLOR_RGB2BGR)):
                raise FileError(
                    f"{path}: cannot be written; expected room for {len(paths)} frames in the temporary folder: free "
                    "some space, or choose another folder with the environment variable TMPDIR"
                )
        for path, scores in scorer.score(list(paths)):
            yield paths[path], scores


def _ask_actors(
    spec: str, card: ScorerCard, images: Mapping[str, Image], scoring: _Scoring
) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the scores of images by digest, from actors on a Ray cluster."""
    if not images:
        return
    rows = [
        {"digest": digest, "shape": list(image.shape), "pixels": image.tobytes()} for digest, image in images.items()
    ]
    batch = min(MOST_AT_ONCE, math.ceil(len(rows) / scoring.workers))
    given = {"spec": spec, "deadline": scoring.deadline, "card": card}
    for row in map_batches(scoring.place, BatchScorer, given, rows, scoring.workers, batch):
        yield row["digest"], json.loads(row["scores"])


class BatchScorer:
    """A scorer in an actor; a new one is created for each batch, as a command answers only one list of images.

    Args:
        spec: the scorer, as for `make_scorer`.
        deadline: seconds that it may be silent.
        card: card of the scorer of that name where the scores are stored.
    """

    def __init__(self, spec: str, deadline: float, card: ScorerCard) -> None:
        self._spec, self._deadline, self._card = spec, deadline, card

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Return {"digest": [B], "scores": [B], as JSON} of {"digest": [B], "shape": [B, 3], "pixels": [B]}.

        Raises:
            ScorerError: no valid scores, or the scorer here has a different version.
        """
        rows = zip(batch["digest"], batch["pixels"], batch["shape"], strict=True)
        images = {str(digest): np.frombuffer(data, np.uint8).reshape(shape) for digest, data, shape in rows}
        with make_scorer(self._spec, self._deadline) as scorer:
            if scorer.card.digest != self._card.digest:
                raise ScorerError(
                    f"scorer '{self._spec}' is {scorer.card.label} on a machine of the cluster, expected "
                    f"{self._card.label} as here; install the same one everywhere"
                )
            found = dict(_ask(scorer, images))
        return {"digest": list(found), "scores": [json.dumps(scores) for scores in found.values()]}


def _compare_with_truth(
    arms: Sequence[_Arm], stores: Mapping[Path, FrameScores], lpips: Lpips | None, watch: Watch | None
) -> None:
    """Add controllability of each frame against the true one: SSIM, and 1 - LPIPS if its weights are available."""
    measures: dict[str, Callable[[Image, Image], float]] = {CONTROL_BY_SSIM: _measure_similarity}
    if lpips is not None:
        measures = {CONTROL_BY_LPIPS: lambda a, b: 1 - _measure_distance(lpips, a, b), **measures}
    for name, measure in measures.items():
        card = ScorerCard("truth", "2", "Apache-2.0", {name: None})
        total = sum(key in arm.true for arm in arms for key in arm.frames)
        for arm in arms:
            arm.scores[name] = _compare_arm(arm, stores[arm.log.path], card, name, measure)
            if watch is not None and total:
                done = sum(len(each.scores.get(name, ())) for each in arms)
                watch(name, done, total, f"{done}/{total} frames")


def _is_panorama(frame: Image) -> bool:
    """Return whether a frame is a panorama, which need not be twice as wide as it is high; other views are square."""
    return frame.shape[1] > 1.6 * frame.shape[0]


def _measure_similarity(frame: Image, true: Image) -> float:
    """Return SSIM, weighted by latitude for panoramas."""
    found = ssim(frame, true, weights="latitude" if _is_panorama(frame) else "uniform")
    return min(1.0, float(np.asarray(found)))  # rounding of the weights


def _measure_distance(lpips: Lpips, frame: Image, true: Image) -> float:
    """Return LPIPS; as it is not defined on a sphere, for panoramas the mean over front, left, right and back views."""
    if not _is_panorama(frame):
        return float(np.asarray(lpips(frame, true)))
    views = [
        np.stack([np.asarray(to_perspective(image, 90.0, VIEW, yaw_deg=yaw)) for yaw in (0.0, 90.0, -90.0, 180.0)])
        for image in (frame, true)
    ]
    return float(np.mean(lpips(*views)))


def _compare_arm(
    arm: _Arm, store: FrameScores, card: ScorerCard, name: str, measure: Callable[[Image, Image], float]
) -> dict[FrameKey, float]:
    """Return a measure of an arm's frames against the true ones, if these are known."""
    pairs = {key: f"{digest}:{digest_frame(arm.true[key])}" for key, digest in arm.digests.items() if key in arm.true}
    store.add_scorer(card.digest, card.as_dict(), name)
    known = store.read(card.digest, pairs.values())
    for key, pair in pairs.items():
        if pair not in known:
            known[pair] = {name: measure(arm.frames[key], arm.true[key])}
            store.write(card.digest, pair, known[pair])
    return {key: known[pair][name] for key, pair in pairs.items()}


def _summarise(
    arms: Sequence[_Arm], cards: Sequence[Mapping[str, Any]], notes: Sequence[str], first: RunLog
) -> QualityTable:
    metric, outcomes = _read_outcomes(arms)
    ranges = {name: span and tuple(span) for card in cards for name, span in card["scores"].items()}
    samples = [
        Sample(
            arm.label,
            outcomes[arm.label],
            add_paper_quality({name: _average_by_episode(own) for name, own in arm.scores.items() if own}, ranges),
            len(arm.frames),
        )
        for arm in arms
    ]
    scenes = {index: strip_edits(episode.scene) for index, episode in enumerate(first.store.episodes())}
    seed = first.store.config["seed"]
    return summarise_quality(samples, scenes, metric, notes=notes, scorers=cards, seed=seed)


def _read_outcomes(arms: Sequence[_Arm]) -> tuple[Metric, dict[str, dict[int, float]]]:
    """Return what counts as success, and its value by arm and episode."""
    done = {arm.label: split_outcomes([arm.name], _list_outcomes(arm))[0][arm.name] for arm in arms}
    for metric in (ANSWER_SCORE, SUCCESS):
        values = {
            label: {index: row["metrics"][metric.name] for index, row in rows.items() if metric.name in row["metrics"]}
            for label, rows in done.items()
        }
        if set.intersection(*map(set, values.values())):
            return metric, values
    raise ArgumentError(
        f"quality: expected episodes that are scored in all of {', '.join(done)}, got none; continue the run (`wiw "
        "resume`), or choose other arms"
    )


def _list_outcomes(arm: _Arm) -> list[dict[str, Any]]:
    return [row for row in arm.log.store.outcomes() if row["arm"] == arm.name]


def _average_by_episode(scores: Mapping[FrameKey, float]) -> dict[int, float]:
    """Return the mean over the frames of each episode."""
    values: dict[int, list[float]] = {}
    for key in sorted(scores):
        values.setdefault(key.episode, []).append(scores[key])
    return {episode: float(np.mean(own)) for episode, own in values.items()}


def _choose_pictures(arms: Sequence[_Arm], keys: Sequence[FrameKey]) -> dict[str, list[Image]]:
    """Return the first frames of the sample, the same for each arm, and the true ones if all are known."""
    shown = list(keys[:SHOWN])
    pictures = {arm.label: [arm.frames[key] for key in shown] for arm in arms}
    true = next((arm.true for arm in arms if all(key in arm.true for key in shown)), None)
    return pictures if true is None else {"true": [true[key] for key in shown], **pictures}
