# SPDX-License-Identifier: Apache-2.0
"""A metric in one file: how many episodes end within 1.5 m of the goal, whether they succeed or not."""

from __future__ import annotations

from collections.abc import Mapping

import wiw


def is_near(metrics: Mapping[str, float]) -> float:
    """Return 1 if an episode ended near its goal; a KeyError means that the task does not measure distances."""
    return float(metrics["distance_to_goal"] < 1.5)


NEAR = wiw.Metric("near", "Near", "rate", True, of=is_near, about="Episodes that end within 1.5 m of the goal.")
