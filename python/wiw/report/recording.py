# SPDX-License-Identifier: Apache-2.0
"""A run as a recording of the Rerun viewer: /episode/arm/..., over the timeline "decision"."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from wiw.report.plans import Poses, Primitives, plan_views
from wiw.report.plots import arm_colors
from wiw.report.stage import read_stage
from wiw.runs.run import Run
from wiw.types import Episode


def record(run: Run, file: Path) -> None:
    """Write the ended episodes of all arms."""
    import rerun as rr

    stream = rr.RecordingStream("wiw", recording_id=f"{run.path.name} {run.store.created}")
    stream.save(file)
    stage = read_stage(run.store.info)
    up = rr.ViewCoordinates.RIGHT_HAND_Y_UP if stage is None else rr.ViewCoordinates.RIGHT_HAND_Z_UP
    stream.log("/", up, static=True)
    colors, episodes, begun = arm_colors(run.arms), run.store.episodes(), set[int]()
    for outcome in run.store.outcomes():
        arm, index = outcome["arm"], outcome["episode"]
        home = f"/episode_{index:04d}"
        if index not in begun:
            _log_ends(rr, stream, home, episodes[index])
            begun.add(index)
        place = f"{home}/{rr.escape_entity_path_part(arm)}"
        ended = f"{outcome['status']} {outcome['metrics']} {outcome['error']}".strip()
        stream.log(f"{place}/outcome", rr.TextDocument(ended), static=True)
        rows = run.store.decisions(arm, index)
        for row, way in zip(rows, plan_views(rows, stage), strict=True):
            stream.set_time("decision", sequence=row["decision"])
            _log_decision(rr, stream, place, row, way, colors[arm])
            for name, jpeg in run.store.images(arm, index, row["decision"]).items():
                stream.log(f"{place}/{name}", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
    stream.flush()
    stream.disconnect()


def _log_ends(rr: Any, stream: Any, home: str, episode: Episode) -> None:
    stream.log(f"{home}/scene", rr.TextDocument(episode.info.get("instruction", episode.scene)), static=True)
    if episode.kind:  # such as a task at a table, whose start and goal are no places
        return
    points = rr.Points3D(
        [episode.start_position, episode.goal_position],
        labels=["start", "goal"],
        radii=0.12,
        colors=[0x22242AFF, 0xE0475BFF],
    )
    stream.log(f"{home}/world", points, static=True)


def _log_decision(rr: Any, stream: Any, place: str, row: dict[str, Any], way: Primitives | Poses, color: str) -> None:
    stream.log(
        f"{place}/path",
        rr.LineStrips3D(
            [np.asarray(row["path"])], radii=0.003 if isinstance(way, Poses) else 0.03, colors=[color_of(color)]
        ),
    )
    if row["after_distance"] is not None:
        stream.log(f"{place}/distance_to_goal", rr.Scalars(row["after_distance"]))
    if isinstance(way, Poses):
        plans = [np.array([way.start, *(pose[:3] for pose in each["actions"])]) for each in row["proposals"]]
        stream.log(f"{place}/planned", rr.LineStrips3D(plans, radii=0.002))
    scores = [np.nan if score is None else score for score in row["scores"] or []]
    if scores:
        stream.log(f"{place}/scores", rr.Scalars(scores))
    said = [
        f"{'chosen ' if i == row['chosen'] else ''}{way.text(p['actions'])} {p['note']}"
        for i, p in enumerate(row["proposals"])
    ]
    stream.log(f"{place}/plans", rr.TextDocument("\n".join([*said, row["note"]]).strip()))


def color_of(web: str) -> int:
    """Return 0xRRGGBBAA of "#rrggbb"."""
    return (int(web.removeprefix("#"), 16) << 8) | 0xFF
