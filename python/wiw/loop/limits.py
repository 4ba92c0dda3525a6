# SPDX-License-Identifier: Apache-2.0
"""Default limits of a world model's calls and of a rollout cache."""

DEADLINE = 300.0
"""Default time limit of a call in seconds: enough for a first call that loads and compiles."""
BUDGET_GB = 20.0
"""Default size limit of a rollout cache in gigabytes; a panorama takes 1.8 MB, a front view 0.7 MB."""
