# SPDX-License-Identifier: Apache-2.0
"""`wiw scenes`: draw scenes, check scans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg


def draw_scenes(
    spec: Positional[Annotated[str, arg(metavar="SPEC")]] = "apartments:val:4",
    /,
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("scenes.png"),
    views: Annotated[int, arg(metavar="N")] = 2,
    backend: Literal["auto", "cpu", "gpu"] = "auto",
) -> int:
    """Load scenes, print their sizes, and draw a contact sheet: each scene from above, and panoramas inside it.

    $ wiw scenes apartments:val:4
    $ wiw scenes house.glb --out house.png

    Args:
        spec: apartments:train|val|test[[:FIRST]:END], a scene with edits (apartments:val/3?state:floor_lamp_1=off), a
            mesh (GLB, glTF, OBJ, PLY, DAE), a Gazebo world, or scans (hm3d:DIR:val, mp3d:DIR, replica:DIR, hssd:DIR,
            replicacad:DIR, procthor:DIR).
        out: PNG file to write.
        views: Panoramas per scene.
        backend: Renderer.
    """
    from PIL import Image
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from wiw.errors import ArgumentError
    from wiw.files import atomic_file
    from wiw.scenes import resolve
    from wiw.viz.contact_sheet import contact_sheet

    if views < 0:
        raise ArgumentError(f"scenes: expected --views of at least 0, got {views}")
    names = resolve(spec)
    if len(names) > LIMIT:
        print(f"{spec} names {len(names)} scenes; showing the first {LIMIT}")
        names = names[:LIMIT]
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for column in ("scene", "size m", "triangles", "objects", "kinds", "rooms", "walk m2", "islands"):
        if column == "scene":
            table.add_column(column, overflow="fold")
        else:
            table.add_column(column, justify="right", no_wrap=True, min_width=len(column))
    rows = []
    for name in names:
        place = _load(name, backend)
        table.add_row(*map(Text, _list_facts(place)))
        rows.append(place)
    Console().print(table)
    with atomic_file(out) as draft:
        kind = Image.registered_extensions().get(out.suffix.lower(), "PNG")
        contact_sheet(rows, views, backend).save(draft, format=kind if kind in Image.SAVE else "PNG")
    print(f"\nsheet  {out}")
    return 0


def verify_scans(
    folder: Positional[Annotated[str, arg(metavar="DIR|SPEC")]],
    /,
) -> int:
    """Open every scan in a dataset and print what is wrong; exit code 1 if anything is.

    $ wiw scenes verify scene_datasets/mp3d
    $ wiw scenes verify hm3d:scene_datasets/hm3d:val

    Textures, objects, categories, rooms and walkable area are counted and compared with the dataset's own files. Scans
    are cached as they are read, so that runs open them fast.

    Args:
        folder: Folder of a dataset or of one scan, or a spec such as hm3d:DIR:val.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from wiw.cli.terminal import printable
    from wiw.datasets.scan_check import check_scan
    from wiw.datasets.scene_splits import name_scene
    from wiw.scenes.scans.formats import find_all, find_scans, parse_spec

    spec = parse_spec(folder)
    files = find_scans(*spec) if spec else find_all(Path(folder))
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for column in ("scan", "triangles", "textures", "grey %", "objects", "kinds", "rooms", "walk m2", "islands", "s"):
        table.add_column(column, justify="left" if column == "scan" else "right", no_wrap=column != "scan")
    checks = []
    for file in files:
        check = check_scan(file)
        checks.append(check)
        table.add_row(
            Text(name_scene(file)),
            *(f"{number:,}" for number in (check.triangles, check.textures)),
            f"{100 * check.missing:.1f}",
            *map(str, (check.objects, check.categories, check.rooms)),
            f"{check.area:.0f}{'' if check.navmesh == 'file' else '*'}",
            *map(str, (check.islands, f"{check.seconds:.0f}")),
        )
    Console().print(table)
    if any(check.navmesh == "built" for check in checks):
        print("* on a navigation mesh built here, as the scan came without one")
    for check in checks:
        lines = [f"  wrong: {line}" for line in check.problems] + [f"  note: {line}" for line in check.remarks]
        if lines:
            print(printable("\n".join([f"\n{check.file}", *lines])))
    wrong = sum(bool(check.problems) for check in checks)
    print(f"\n{len(checks)} scan{'s' * (len(checks) > 1)}, {wrong} with something wrong")
    return 1 if wrong else 0


LIMIT = 8
"""Maximum number of scenes on a sheet."""


def _load(name: str, backend: Any) -> Any:
    from wiw.datasets.worlds import world

    return world(name, backend)


def _list_facts(place: Any) -> list[str]:
    from wiw.viz.contact_sheet import short_name

    scene = place.scene
    floors = [island for index, island in enumerate(place.navmesh.islands) if index not in place.roofs]
    width, height, depth = scene.bounds[1] - scene.bounds[0]
    return [
        short_name(place.name),
        f"{width:.1f} x {depth:.1f} x {height:.1f}",
        f"{scene.triangle_count:,}",
        str(len(scene.instances)),
        str(len(scene.categories)),
        str(len(scene.rooms)) if scene.rooms else "?",
        f"{sum(island.area for island in floors):.0f}",
        str(len(floors)),
    ]
