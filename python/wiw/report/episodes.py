# SPDX-License-Identifier: Apache-2.0
"""Episodes with pictures, read from the run store for a page."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from wiw.analysis.blame import read_blame
from wiw.report import cuts
from wiw.report.beliefs import list_beliefs, list_expected, read_verdict
from wiw.report.maps import (
    MapFrame,
    Trail,
    all_points,
    frame_of_picture,
    frame_of_points,
    start_and_goal,
    trail,
)
from wiw.report.plans import is_pose_row, plan_views
from wiw.report.stage import Stage, read_stage
from wiw.report.steps import step
from wiw.report.story import Album, Attempt, Picture, Step, Story
from wiw.runs.pictures import choose_pictured_episodes
from wiw.runs.run import Run
from wiw.runs.store import RunStore
from wiw.types import Episode, Wording


def read_stories(
    store: RunStore, arms: Sequence[str], album: Album, most: int | None = None
) -> tuple[list[Story], dict[str, Picture]]:
    """Return the ended episodes among those chosen for pictures, `most` at most, and the scene maps by id."""
    outcomes = outcomes_by_episode(store, arms)
    episodes, maps = store.episodes(), dict[str, Picture]()
    kept = [index for index in choose_pictured_episodes(store) if outcomes.get(index)][:most]
    return [read_story(store, index, episodes[index], outcomes[index], maps, album) for index in kept], maps


def make_title(run: Run) -> str:
    """Return task and folder of a run, or one of them where they have the same name."""
    return " · ".join(dict.fromkeys((str(run.store.config["task"].get("task", "run")), run.path.name)))


def outcomes_by_episode(store: RunStore, arms: Sequence[str]) -> dict[int, dict[str, Mapping[str, Any]]]:
    """Return outcomes by episode, then by arm in the order of `arms`, without episodes that no arm has ended.

    Metrics that were not measured (None in the store) are left out.
    """
    found_blame = read_blame(store)
    verdicts = found_blame.verdicts() if found_blame is not None else {}
    by_arm = {(row["arm"], row["episode"]): _drop_unmeasured(row) for row in store.outcomes()}
    by_arm |= {key: {**by_arm[key], "blame": verdict} for key, verdict in verdicts.items()}
    found: dict[int, dict[str, Mapping[str, Any]]] = {}
    for index in sorted({episode for _, episode in by_arm}):
        found[index] = {arm: by_arm[arm, index] for arm in arms if (arm, index) in by_arm}
    return found


def _drop_unmeasured(row: Mapping[str, Any]) -> dict[str, Any]:
    return {**row, "metrics": {name: value for name, value in row["metrics"].items() if value is not None}}


def read_story(
    store: RunStore,
    index: int,
    episode: Episode,
    outcomes: Mapping[str, Mapping[str, Any]],
    maps: dict[str, Picture],
    album: Album,
) -> Story:
    """Return one episode; add its scene's map to `maps`."""
    decisions = {arm: store.decisions(arm, index) for arm in outcomes}
    rows = [row for own in decisions.values() for row in own]
    poses = any(is_pose_row(row) for row in rows)
    frame, picture = (None, None) if poses else _map(store, episode, rows, maps, album)
    shots = dict[str, Picture]()
    attempts = tuple(
        _make_attempt(store, frame, episode, outcome, decisions[arm], shots, album, f"{index}-{number}")
        for number, (arm, outcome) in enumerate(outcomes.items())
    )
    goal = next((found for arm in outcomes if (found := store.images(arm, index, 0).get("goal"))), None)
    ends = start_and_goal(frame, episode) if frame is not None else None
    shown = (
        album.draw(f"{index}-goal", partial(cuts.cut_front, goal, album.goal_side, album.quality, album.scale))
        if goal
        else None
    )
    return Story(index, episode, shown, picture, frame, ends, attempts, read_wording(store), poses, shots)


def _map(
    store: RunStore, episode: Episode, rows: Sequence[Mapping[str, Any]], maps: dict[str, Picture], album: Album
) -> tuple[MapFrame, str | None]:
    """Return the frame of an episode's map and the id of its picture."""
    kept = store.scene_map(episode.scene)
    if kept is None:
        return frame_of_points(all_points(episode, rows)), None
    webp, matrix = kept
    picture = f"scene-{hashlib.sha256(episode.scene.encode()).hexdigest()[:12]}"
    drawing = album.put_map(picture, webp)
    maps[picture] = drawing
    return frame_of_picture((drawing.width, drawing.height), matrix), picture


def read_wording(store: RunStore) -> Wording:
    """Return the run's words for its task's outcomes."""
    return Wording(**store.info.get("wording", {}))


def _make_attempt(
    store: RunStore,
    frame: MapFrame | None,
    episode: Episode,
    outcome: Mapping[str, Any],
    decisions: list[dict[str, Any]],
    shots: dict[str, Picture],
    album: Album,
    name: str,
) -> Attempt:
    """Return one arm's run of an episode; add the images of a gripper's camera to `shots`."""
    arm, index = outcome["arm"], outcome["episode"]
    stage, steps, end = read_stage(store.info), list[Step](), ""
    beliefs = list_beliefs(decisions, list_expected(episode))
    for row, way, belief in zip(decisions, plan_views(decisions, stage), beliefs, strict=True):
        number, images = row["decision"], store.images(arm, index, row["decision"])
        made = step(row, images, way, album, f"{name}-{number}", belief)
        if made.shot and made.seen:
            shots[made.shot] = made.seen
        if "end" in images:
            end = f"shot-{name}-end"
            shots[end] = album.draw(end, partial(way.observation, images["end"], album))
        steps.append(made)
    film = store.film(arm, index)
    return Attempt(
        arm,
        outcome,
        tuple(steps),
        _make_trail(frame, stage, arm, decisions),
        read_wording(store),
        store.config.get("task", {}).get("categories", ()),
        album.put(f"{name}-film", "webp", film) if film else None,
        end,
        read_verdict(outcome["details"]),
    )


def _make_trail(
    frame: MapFrame | None, stage: Stage | None, arm: str, decisions: Sequence[Mapping[str, Any]]
) -> Trail | None:
    if not decisions:
        return None
    if frame is not None:
        return trail(frame, arm, decisions)
    return None if stage is None else stage.trail(arm, decisions)
