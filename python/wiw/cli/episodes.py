# SPDX-License-Identifier: Apache-2.0
"""`wiw episodes`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from wiw.cli.announcement import count_noun
from wiw.cli.options import Options, task_options


def episodes(
    task: Positional[Annotated[str, arg(metavar="TASK")]] = "imagenav",
    /,
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("episodes.json.gz"),
    preset: Annotated[str | None, arg(metavar="NAME|FILE")] = None,
    scenes: Annotated[str | None, arg(metavar="SPEC")] = None,
    episodes: Annotated[int, arg(metavar="N")] = 20,
    per_scene: Annotated[int | None, arg(metavar="N")] = None,
    tier: Literal["near", "far", "beyond", "all"] | None = None,
    seed: Annotated[int, arg(metavar="N")] = 0,
    backend: Literal["auto", "cpu", "gpu"] | None = None,
    attributes: Annotated[Path | None, arg(metavar="FILE")] = None,
    task_option: Options = (),
    sheet: Annotated[Path | None, arg(metavar="PNG")] = None,
    overwrite: bool = False,
) -> int:
    """Generate the episodes of a task and write them to a file for `wiw run --episode-file`.

    $ wiw episodes imagenav --scenes apartments:val:20 --episodes 100 --out val.json.gz
    $ wiw episodes imagenav --scenes house.glb --per-scene 10 --episodes 10 --out house.json
    $ wiw run imagenav --episode-file house.json --world-model warp
    $ wiw episodes aeqa --scenes house.world --attributes house.json --episodes 40 --out house_questions.json
    $ wiw episodes imagenav --tier beyond --scenes apartments:test:12 --episodes 60 --out beyond.json.gz
    $ wiw episodes ar --task-option categories=bed,sofa,desk --out three.json
    $ wiw episodes ar --preset foresight --scenes apartments:val:12 --episodes 60 --out hard.json.gz

    Scenes inside the file's folder are stored as relative paths, so that the folder can be moved or shared.

    Args:
        task: See `wiw list`.
        out: JSON file; gzipped if the name ends in .gz.
        preset: Preset whose rules the episodes satisfy, such as foresight for ar. Default: default. See `wiw list
            presets`.
        scenes: apartments:train|val|test[[:FIRST]:END], a mesh (GLB, glTF, OBJ, PLY, DAE), a Gazebo world, or scans
            (hm3d:DIR:val, mp3d:DIR, replica:DIR, hssd:DIR, replicacad:DIR, procthor:DIR). Default: apartments:val.
        episodes: Number of episodes.
        per_scene: Episodes per scene. Default: the task's.
        tier: For imagenav: goals 2 to 5 m away (near), 5 to 8 m away (far), or one corner beyond what is visible from
            the start, where the way forks (beyond); all: the three in turn.
        seed: Seed; together with the scenes, it determines the episodes.
        backend: Renderer used to check that goals are out of sight. Default: auto.
        attributes: For aeqa and a scene from a file: JSON with attributes of its instances, by their names, such as
            {"Desk_01": {"color": "brown", "state": "open"}}.
        task_option: Another option of the task, such as categories=bed,sofa or, for scans, goal_instances=1; may be
            repeated.
        sheet: For imagenav: PNG file in which to draw up to 12 episodes. Each shows the scene from above, with the
            floor visible from the start (yellow), the possible ways on and the shortest path, then the start's panorama
            and the goal image.
        overwrite: Whether to replace an existing file.
    """
    from wiw.datasets.episodes import save
    from wiw.errors import ArgumentError
    from wiw.registry import TASKS

    if episodes < 1:
        raise ArgumentError(f"episodes: expected --episodes of at least 1, got {episodes}")
    if out.exists() and not overwrite:
        raise ArgumentError(f"{out} already exists; give --overwrite to replace it, or choose another name with --out")
    more = {} if attributes is None else {"attributes": str(attributes)}
    rules = {"preset": preset, "tier": tier, "per_scene": per_scene, **more}
    flags = {"scenes": scenes, "seed": seed, "backend": backend, **rules}
    made = TASKS.make(task, **task_options(task, task_option, flags))
    if made.file_header is None:
        raise ArgumentError(
            f"episodes: task '{task}' does not read episode files; its episodes are determined by the seed, so `wiw "
            f"run {task} --seed {seed} --episodes {episodes}` runs the same ones anywhere"
        )
    found = made.episodes(episodes)
    save(out, found, task, **made.file_header)
    places = count_noun(len({episode.scene for episode in found}), "scene")
    lengths = sorted(episode.geodesic for episode in found)
    print(f"{count_noun(len(found), 'episode')} in {places}, {lengths[0]:.1f} to {lengths[-1]:.1f} m")
    for remark in made.explain_episodes(found):
        print(remark)
    print(f"episodes  {out}")
    if sheet is not None:
        from wiw.viz.episode_sheet import save_sheet

        print(f"sheet     {save_sheet(made, found, sheet)}")
    return 0
