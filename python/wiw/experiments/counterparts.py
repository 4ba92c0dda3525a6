# SPDX-License-Identifier: Apache-2.0
"""Privileged counterparts of policies: the same policy with ground truth in some of its own stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Counterpart:
    """A policy with ground truth, which takes the options of the policy without."""

    policy: str
    """Its name in the registry."""
    identity: Mapping[str, Any]
    """Fields that differ in its description."""


COUNTERPARTS: Mapping[str, Mapping[tuple[str, ...], Counterpart]] = {
    "explorer": {
        ("perception",): Counterpart("explorer-oracle", {"policy": "OracleExplorer", "privileged": ["perception"]}),
        ("exploration",): Counterpart("explorer-tour", {"policy": "TourExplorer", "privileged": ["tour"]}),
        ("perception", "exploration"): Counterpart(
            "explorer-oracle-tour", {"policy": "OracleTourExplorer", "privileged": ["perception", "tour"]}
        ),
    },
}
"""By policy and stages with ground truth."""


def find_counterpart(policy: Any, stages: tuple[str, ...]) -> Counterpart | None:
    """Return a policy's counterpart with ground truth in these stages; None if there is none."""
    return COUNTERPARTS.get(policy, {}).get(stages) if isinstance(policy, str) else None


def is_counterpart(policy: str, original: Any) -> bool:
    """Return whether a policy is another one with ground truth."""
    known = COUNTERPARTS.get(original, {}) if isinstance(original, str) else {}
    return policy in [own.policy for own in known.values()]
