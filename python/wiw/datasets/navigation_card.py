# SPDX-License-Identifier: Apache-2.0
"""The card of a navigation dataset: README.md with the metadata that the Hugging Face Hub and `datasets` read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wiw.datasets.navigation_files import COLUMNS

SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))


def build_card(meta: Mapping[str, Any]) -> str:
    """Return the card's text, from the content of `meta.json`."""
    totals, camera = meta["totals"], meta["camera"]
    size = next((name for limit, name in SIZES if totals["frames"] < limit), "n>10M")
    height, width = camera["size"]
    panorama = camera["projection"] == "equirectangular"
    depth = meta["depth"] is not None
    names = [name for name in COLUMNS if depth or name != "depth"]
    columns = "\n".join(f"| `{name}` | {COLUMNS[name]} |" for name in names)
    what = "panoramas" if panorama else f"perspective views (HFOV {camera['hfov_deg']:g} degrees)"
    coverage = _mean_coverage(meta)
    return f"""---
pretty_name: Navigation in {totals["scenes"]} scenes
tags:
- world-model
- embodied-ai
- {"panorama" if panorama else "perspective"}
size_categories:
- {size}
configs:
- config_name: frames
  default: true
  data_files:
  - split: train
    path: data/*.parquet
- config_name: segments
  data_files:
  - split: train
    path: segments.parquet
---
# Navigation in {totals["scenes"]} scenes

{totals["frames"]:,} frames in {totals["segments"]:,} segments of {totals["scenes"]} scenes of train splits: posed
{what} of {height} x {width}{" with depth" if depth else ""}, and the action that led to each frame. Collected by
`wiw collect navigation` (wiw {meta["wiw"]}) along paths between peripheral waypoints, Algorithm 1 of the World-in-World
paper. {coverage:.0%} of the floor is within 1 m of a frame.

A row is a frame, a row group is a segment; frame 0 of a segment is before its first action. Colour is
{meta["color"]}{"; depth is " + meta["depth"]["measure"] + " in millimetres, 0 where nothing is hit" if depth else ""}.
{_ROLLS if panorama else ""}
| column | |
|---|---|
{columns}

```python
from wiw.datasets.navigation import NavigationData

clips = NavigationData(".").clips(14)          # every window of 14 frames
clips[0].images, clips[0].actions              # uint8 [14, {height}, {width}, 3], int8 [14]

import datasets
frames = datasets.load_dataset(".", split="train", streaming=True)
```

`segments.parquet` says where each segment is; `meta.json` has camera, rules, a map of each scene and the SHA-256 of
each file. `wiw data verify .` checks them.
"""


_ROLLS = """
A turn on the spot only rolls a panorama, so that the first picture of each position is stored and `rgb` is null in
frames after turns: `numpy.roll(rgb[source], roll, axis=1)` is their picture, exactly.
"""


def _mean_coverage(meta: Mapping[str, Any]) -> float:
    """Return the mean share of covered floor, weighted by area."""
    islands = [each for record in meta["passes"] for each in record["traversals"]]
    area = sum(each["area"] for each in islands)
    return sum(each["coverage"] * each["area"] for each in islands) / area if area else 0.0
