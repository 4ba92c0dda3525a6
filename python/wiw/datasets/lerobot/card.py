# SPDX-License-Identifier: Apache-2.0
"""The card of an exported LeRobot dataset: README.md with the metadata that the Hugging Face Hub reads."""

from __future__ import annotations

from collections.abc import Mapping

import wiw
from wiw.datasets.lerobot.layout import INDICES, Feature


def build_card(what: str, episodes: int, features: Mapping[str, Feature], fps: int) -> str:
    """Return the card's text.

    Args:
        what: "navigation" or "manipulation".
        episodes: their number.
        features: of their frames.
        fps: frames per second.
    """
    all_of = {**features, **INDICES}
    rows = "\n".join(f"| `{name}` | {each.dtype} {list(each.shape)} | {each.about} |" for name, each in all_of.items())
    return f"""---
tags:
- LeRobot
- {what}
task_categories:
- robotics
configs:
- config_name: default
  data_files: data/*/*.parquet
---
# LeRobot dataset: {what}

{episodes} episodes at {fps} frames a second, LeRobot format v3.0, exported by `wiw data export` (wiw {wiw.__version__})
from what `wiw collect {what}` has collected; `wiw data import` makes that again. An `action` follows the frame that it
is stored with.

| feature | type | |
|---|---|---|
{rows}

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

LeRobotDataset("any/name", root=".")[0]
```
"""
