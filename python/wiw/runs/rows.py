# SPDX-License-Identifier: Apache-2.0
"""Rows of the run store: a decision as plain values, and its images as JPEG for selected episodes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, ContractError, StoreError
from wiw.json_text import escape_surrogates
from wiw.runs.shapes import find_misfit
from wiw.types import Answer, ArmObservation, DecisionRecord, Episode, EpisodeResult, Fidelity, TextAnswer, Truth

STRIP_HEIGHT = 160
JPEG_QUALITY = 85
MOST_FRAMES = 20
"""Maximum number of frames of a rollout that are kept as pictures: a JPEG has room for 65535 pixels, a reader for
fewer."""


@dataclass(frozen=True)
class DecisionRow:
    """One row of table `decision`, ready to be written, with its pictures."""

    arm: str
    episode: int
    decision: int
    values: dict[str, Any]
    """The other columns by name."""
    images: dict[str, bytes]
    """JPEG by name: "panorama" (of a manipulator "front", at last "end"), "goal", "imagined/0" and so on,
    "believed/map" and whatever else the policies draw."""


@dataclass(frozen=True)
class OutcomeRow:
    """One row of table `outcome`: how an episode ended."""

    arm: str
    result: EpisodeResult


@dataclass(frozen=True)
class RestartRow:
    """Notice that episodes of an arm start again; their rows so far are discarded."""

    arm: str
    episodes: tuple[int, ...]


@dataclass(frozen=True)
class LostRow:
    """Costs of a decision that ended in an error."""

    arm: str
    spent: Mapping[str, float]


@dataclass(frozen=True)
class AgentRow:
    """Description of an arm's agent, from when it was built."""

    arm: str
    agent: dict[str, Any]


def to_json(value: Any) -> str:
    """Return the standard JSON of arrays and numbers; what is not finite becomes null.

    Raises:
        ArgumentError: a value has no JSON form.
    """
    try:
        return json.dumps(_make_plain(value), allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    except TypeError as error:
        raise ArgumentError(f"a record must consist of numbers, text, lists and mappings: {error}") from None


def _make_plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return escape_surrogates(value)
    if isinstance(value, dict):
        return {escape_surrogates(str(key)): _make_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_make_plain(item) for item in value]
    return value


def drop_folders(value: Any) -> Any:
    """Return a plain value as it is compared between machines: an absolute path by its last part, and NaN, which
    stands for an unknown place, as None.
    """
    if isinstance(value, Mapping):
        return {name: drop_folders(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [drop_folders(each) for each in value]
    if isinstance(value, float) and math.isnan(value):
        return None
    if isinstance(value, str) and "/" in value and Path(value).is_absolute():
        return Path(value).name
    return value


def decision_row(arm: str, record: DecisionRecord, with_images: bool) -> DecisionRow:
    """Return the row of a decision, with pictures only if asked: they are most of the bytes.

    Raises:
        ContractError: the agent has decided something that could not be read again, such as a note that is no text.
    """
    decision = record.decision
    proposals = [
        {"actions": p.actions, "prior": p.prior, "note": p.note} | ({"text": p.text} if p.text else {})
        for p in decision.proposals
    ]
    real = None if decision.rollouts is None else [rollout.real for rollout in decision.rollouts]
    values: dict[str, Any] = {
        "actions": to_json(decision.actions),
        "execute": int(decision.execute),
        "executed": to_json(record.executed),
        "chosen": None if decision.chosen is None else int(decision.chosen),
        "scores": None if decision.scores is None else to_json(decision.scores),
        "proposals": to_json(proposals),
        "real_frames": None if real is None else to_json(real),
        "answer": None if decision.answer is None else to_json(_answer(decision.answer)),
        "fidelity": None
        if decision.fidelity is None
        else to_json(_describe_fidelity(decision.fidelity, decision.chosen)),
        "exchanges": to_json([asdict(exchange) for exchange in decision.exchanges]),
        "note": decision.note,
        "path": to_json(record.path),
        "refused": to_json(record.refused),
        "seconds": to_json(dict(decision.seconds)),
        "calls": to_json(dict(decision.calls)),
        "spent": to_json(dict(decision.spent)),
        **_describe_truth("before", record.before),
        **_describe_truth("after", record.after),
    }
    _require_readable(arm, record.episode, f", decision {record.index}", values)
    images = dict(_encode_images(record)) if with_images else {}
    return DecisionRow(arm, int(record.episode), int(record.index), values, images)


def outcome_row(arm: str, result: EpisodeResult) -> OutcomeRow:
    """Return the row of an episode's end.

    Raises:
        ContractError: the environment gives a metric that is no number, no success or one that is not from 0 to 1, or
            details that are no mapping.
    """
    if result.status == "done" and "success" not in result.metrics:
        raise ContractError(
            f"arm {arm}, episode {result.episode}: expected the metric 'success', 0 or 1, as every table is about it, "
            f"got only {', '.join(result.metrics) or 'nothing'}; return it from the environment's `result`, or the "
            "task's `measure`"
        )
    success = result.metrics.get("success", 0.0)
    if isinstance(success, int | float | np.number | np.bool_) and not 0 <= success <= 1:
        raise ContractError(
            f"arm {arm}, episode {result.episode}: cannot be recorded: success: expected 0 or 1, got {success}. "
            "Correct what the environment returns"
        )
    values = {"metrics": to_json(dict(result.metrics)), "details": to_json(dict(result.details))}
    _require_readable(arm, result.episode, "", values)
    return OutcomeRow(arm, result)


def _require_readable(arm: str, episode: int, place: str, values: Mapping[str, Any]) -> None:
    """Check that a row can be read again: one that cannot would take all others of the run with it."""
    if misfit := find_misfit(values):
        raise ContractError(
            f"arm {arm}, episode {episode}{place}: cannot be recorded: {misfit}. Correct what the agent or the "
            "environment returns"
        )


def _answer(answer: Answer | TextAnswer) -> dict[str, Any]:
    if isinstance(answer, TextAnswer):
        return {"label": answer.text, "confidence": answer.confidence, "final": answer.final}
    return {
        "label": answer.label,
        "confidence": answer.confidence,
        "probabilities": dict(zip(answer.choices, answer.probabilities, strict=True)),
        **({} if answer.raw is None else {"raw": dict(zip(answer.choices, answer.raw, strict=True))}),
    }


def _describe_fidelity(found: Fidelity, chosen: int | None) -> dict[str, Any]:
    return {
        "scores": found.scores,
        "rank": found.rank,
        "regret": found.regret(chosen),
        "best": None if chosen is None else bool(found.scores[chosen] == found.scores.max()),
        "psnr": found.psnr,
        "ssim": found.ssim,
        **({} if found.lpips is None else {"lpips": found.lpips}),
        **({} if found.pose_errors is None else {"pose_errors": found.pose_errors}),
    }


def _describe_truth(when: str, truth: Truth) -> dict[str, float]:
    x, y, z = (float(value) for value in truth.position)
    return {
        f"{when}_x": x,
        f"{when}_y": y,
        f"{when}_z": z,
        f"{when}_yaw": float(truth.yaw),
        f"{when}_distance": float(truth.distance_to_goal),
        f"{when}_geodesic": float(truth.geodesic_to_goal),
    }


def _encode_images(record: DecisionRecord) -> Iterator[tuple[str, bytes]]:
    decision = record.decision
    if isinstance(decision.observation, ArmObservation):
        yield "front", encode_jpeg(decision.observation.front)
    elif decision.observation is not None:
        yield "panorama", encode_jpeg(decision.observation.mark_target("panorama"))
    if isinstance(record.end, ArmObservation):
        yield "end", encode_jpeg(record.end.front)
    if decision.goal is not None and decision.goal.image is not None and record.index == 0:
        yield "goal", encode_jpeg(decision.goal.image)
    for name, picture in decision.pictures.items():
        yield f"believed/{name}", encode_jpeg(picture)
    for index, rollout in enumerate(decision.rollouts or ()):
        yield f"imagined/{index}", encode_jpeg(strip(rollout.frames[select_frames(len(rollout.frames))]))
    for index, rollout in enumerate(decision.fidelity.rollouts if decision.fidelity else ()):
        yield f"true/{index}", encode_jpeg(strip(rollout.frames[select_frames(len(rollout.frames))]))


def select_frames(count: int) -> NDArray[np.int64]:
    """Return the indices of the frames to store: all where they are few, else evenly spread ones with the last."""
    return np.round(np.linspace(count - 1, 0, min(count, MOST_FRAMES))).astype(np.int64)[::-1]


def strip(frames: NDArray[np.uint8], height: int = STRIP_HEIGHT) -> NDArray[np.uint8]:
    """Return the frames side by side, uint8 [height, K * width, 3]; several views of a frame stand above one another.

    Args:
        frames: uint8 [K, H, W, 3] or [K, V, H, W, 3].
        height: of one view, in pixels.
    """
    views = frames[:, None] if frames.ndim == 4 else frames
    width = max(1, round(height * views.shape[3] / views.shape[2]))
    columns = [
        np.concatenate([cv2.resize(view, (width, height), interpolation=cv2.INTER_AREA) for view in frame])
        for frame in views
    ]
    return np.ascontiguousarray(np.concatenate(columns, axis=1))


def encode_jpeg(image: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """Return JPEG bytes of an RGB image."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data)


def decode_jpeg(data: bytes) -> NDArray[np.uint8]:
    """Return RGB image [H, W, 3] from JPEG bytes."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise StoreError(f"a picture of {len(data)} bytes is not a JPEG; the run store is damaged")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def to_episode_values(index: int, episode: Episode) -> tuple[Any, ...]:
    """Return an episode as the values of its row in table `episode`, in order."""
    values = asdict(episode)
    return (
        index,
        values["episode_id"],
        values["scene"],
        *map(float, values["start_position"]),
        float(values["start_yaw"]),
        *map(float, values["goal_position"]),
        float(values["goal_yaw"]),
        float(values["geodesic"]) if math.isfinite(values["geodesic"]) else None,
        to_json(values["info"]),
    )


def build_episode(row: Mapping[str, Any], info: dict[str, Any]) -> Episode:
    """Return the episode of a row of table `episode`, whose `info` is decoded."""
    return Episode(
        row["episode_id"],
        row["scene"],
        (row["start_x"], row["start_y"], row["start_z"]),
        row["start_yaw"],
        (_read_length(row["goal_x"]), _read_length(row["goal_y"]), _read_length(row["goal_z"])),
        row["goal_yaw"],
        _read_length(row["geodesic"]),
        info,
    )


def _read_length(value: float | None) -> float:
    """Return metres; NaN where they are not known."""
    return math.nan if value is None else value
