# SPDX-License-Identifier: Apache-2.0
"""Limits of a world model's calls and of a rollout cache unless the user says otherwise."""

DEADLINE = 300.0
"""Seconds a call may take: room for a first call that loads and compiles."""
BUDGET_GB = 20.0
"""Most gigabytes of a rollout cache; a panorama takes 1.8 MB, a front view 0.7 MB."""
