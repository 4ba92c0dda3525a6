# SPDX-License-Identifier: Apache-2.0
"""Statistics of homes, counted in train apartments: kinds of rooms, their contents, materials and sizes."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wiw.datasets.questions.answers import MATERIALS
from wiw.datasets.questions.facts import STRUCTURE, SceneTable, make_table
from wiw.files import atomic_file
from wiw.scenes import apartment_table

APARTMENTS = 200
"""Train apartments that the package's knowledge is made from."""


def count_homes(tables: Sequence[SceneTable]) -> dict[str, dict[str, object]]:
    """Return shares of rooms by kind, mean numbers of things by kind and category, commonest materials, and sizes."""
    rooms, contents = Counter[str](), defaultdict[str, Counter[str]](Counter)
    materials, sizes = defaultdict[str, Counter[str]](Counter), defaultdict[str, list[list[float]]](list)
    for table in tables:
        rooms.update(room.kind for room in table.rooms)
        for thing in table.things:
            material = MATERIALS.get(thing.material, thing.material)
            materials[thing.category][material] += 1
            materials[f"{thing.category}/{thing.color}"][material] += 1
            width, height, depth = (thing.high - thing.low).tolist()
            sizes[thing.category].append([max(width, depth), min(width, depth), height])
            if thing.category not in STRUCTURE and (kind := table.kind_of(thing.room)):
                contents[kind][thing.category] += 1
    total = sum(rooms.values())
    return {
        "rooms": {kind: round(count / total, 4) for kind, count in sorted(rooms.items())},
        "contents": {
            kind: {name: round(count / rooms[kind], 4) for name, count in sorted(contents[kind].items())}
            for kind in sorted(contents)
        },
        "materials": {
            name: min(c.items(), key=lambda item: (-item[1], item[0]))[0] for name, c in sorted(materials.items())
        },
        "sizes": {name: np.median(found, axis=0).round(3).tolist() for name, found in sorted(sizes.items())},
    }


def write_knowledge(path: str | Path, apartments: int = APARTMENTS) -> None:
    """Count in the first train apartments and write the file that `wiw.policies.explorer.home.load_knowledge` reads."""
    found = count_homes([make_table(apartment_table(seed, "train")) for seed in range(apartments)])
    with atomic_file(Path(path)) as partial:
        partial.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
